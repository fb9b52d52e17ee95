//! A manager, vehicles and `cara web`, each a process, and a browser that looks.

use std::collections::hash_map::RandomState;
use std::hash::{BuildHasher, Hasher};
use std::os::unix::fs::PermissionsExt;
use std::os::unix::net::UnixListener;
use std::path::{Path, PathBuf};
use std::time::Duration;

use anyhow::{Context, Result, anyhow, ensure};
use cara_processes::Process;
use cara_processes::ticker::Ticker;
use cara_test_keys::KeyFolder;
use tempfile::TempDir;

use crate::proxy::Ports;

/// Longest wait for anything that is to happen.
pub(crate) const PATIENCE: Duration = Duration::from_secs(40);
/// Vehicles, of which the last one is killed.
pub(crate) const AGVS: [&str; 5] = ["agv-1", "agv-2", "agv-3", "agv-4", "agv-5"];
/// Where those drive that do not wait for the page: along x first, then along y, through the aisles of the [map].
/// Each command has one of the few connections to the manager.
const TARGETS: [(&str, [u32; 2]); 2] = [("agv-2", [24, 13]), ("agv-3", [12, 13])];
/// What a command says whose lease has ended, or ended before the vehicle drove.
const STOPPED: [&str; 3] = ["it stopped there", "gave no sign of life", ": Expired:"];
/// How often commands that have ended are given again.
const MOST_AGAIN: usize = 5;
/// The lease of the vehicles' `go_to`, as `cara-apps` has it.
const LEASE: Duration = Duration::from_millis(400);

const BOX: &str = "name = 'box'
id = 20
role = 's_unit'
manager = { name = 'depot', id = 1 }
[[functions]]
signature = 'load(l: {stamp: int, at: {x: int}[..2], kg: float}) -> (l: {stamp: int, at: {x: int}[..2], kg: float})'
answer = 'echo'
[[functions]]
signature = 'clock() -> (unix_us: int)'
run = ['printf', '{\"unix_us\": 1}']
";

/// All processes but the browser.
pub(crate) struct Stage {
    programs: PathBuf,
    fleet: u32,
    folder: TempDir,
    keys: KeyFolder,
    manager: Option<Process>,
    agvs: Vec<Process>,
    web: Option<Process>,
    pub(crate) ports: Ports,
    /// Calls that are held from outside of the page, and how long the host held this process up since each began.
    held: Vec<(Process, Ticker)>,
    /// How often one was made again.
    again: usize,
}

impl Stage {
    /// The manager and its vehicles, all joined, the latter at their start.
    pub(crate) fn start(programs: &Path) -> Result<Self> {
        let fleet = RandomState::new().build_hasher().finish() as u32;
        let folder = tempfile::tempdir()?;
        std::fs::set_permissions(folder.path(), std::fs::Permissions::from_mode(0o700))?;
        std::fs::write(folder.path().join("hall.map"), map())?;
        let nodes: Vec<String> = AGVS.iter().zip(11..).map(|(name, id)| format!("{name}/{id}")).collect();
        let mut all = vec!["depot/1@m_unit"];
        all.extend(nodes.iter().map(String::as_str));
        let keys = KeyFolder::draw(fleet, &all)?;
        let programs = programs.to_owned();
        let mut stage = Self {
            programs,
            fleet,
            folder,
            keys,
            manager: None,
            agvs: Vec::new(),
            web: None,
            ports: Ports::choose()?,
            held: Vec::new(),
            again: 0,
        };
        stage.start_manager()?;
        for (name, id) in AGVS.iter().zip(11..) {
            let id = id.to_string();
            let arguments = ["--name", name, "--id", &id, "--manager", "depot/1", "--loopback"];
            let agv = stage.process(name, "agv", &arguments)?;
            stage.agvs.push(agv);
        }
        stage.agvs.iter().try_for_each(|agv| agv.seen("joined depot", PATIENCE).map(drop))?;
        Ok(stage)
    }

    /// A program with the keys, the fleet and the control sockets of this test.
    fn process(&self, name: &str, program: &str, arguments: &[&str]) -> Result<Process> {
        self.process_by(&[], name, program, arguments)
    }

    /// The same, which another program starts.
    fn process_by(&self, starter: &[&str], name: &str, program: &str, arguments: &[&str]) -> Result<Process> {
        let keys = format!("CARA_KEYS={}", self.keys.path().display());
        let control = format!("CARA_CONTROL_DIR={}", self.folder.path().display());
        let (program, fleet) = (self.programs.join(program).display().to_string(), self.fleet.to_string());
        let all = [&[&*keys, &*control][..], starter, &[&*program], arguments, &["--fleet", &*fleet]].concat();
        Process::start(name, Path::new("env"), all)
    }

    pub(crate) fn start_manager(&mut self) -> Result<()> {
        self.manager = Some(self.process("depot", "cara", &["node", "--name", "depot", "--id", "1", "--loopback"])?);
        Ok(())
    }

    /// Has some vehicles drive, kept by commands until they have arrived.
    pub(crate) fn drive(&mut self) -> Result<()> {
        for target in TARGETS {
            let held = self.hold(target)?;
            self.held.push(held);
        }
        Ok(())
    }

    /// Has them drive on where their lease has ended since the host held this process up.
    pub(crate) fn drive_on(&mut self) -> Result<()> {
        for (number, target) in TARGETS.into_iter().enumerate() {
            let (held, ticker) = &mut self.held[number];
            if held.wait(Duration::ZERO).is_ok_and(|status| !status.success()) {
                held.expect_any(&STOPPED, PATIENCE)?;
                excuse(ticker, target.0)?;
                ensure!(self.again < MOST_AGAIN, "vehicles have stopped again and again");
                self.again += 1;
                self.held[number] = self.hold(target)?;
            }
        }
        Ok(())
    }

    fn hold(&self, (name, [x, y]): (&str, [u32; 2])) -> Result<(Process, Ticker)> {
        let call = format!("go_to(position: [{x}, {y}])");
        let arguments = ["call", "--hold", "--timeout", "30s", name, &call];
        let ticker = Ticker::start();
        // Why it ended stands in its standard error.
        let held = self.process_by(&["sh", "-c", r#"exec "$0" "$@" 2>&1"#], name, "cara", &arguments)?;
        Ok((held, ticker))
    }

    /// The page's server; its address with the key. It was told of the proxies, and is reached without them as well.
    pub(crate) fn start_web(&mut self) -> Result<String> {
        let map = self.folder.path().join("hall.map").display().to_string();
        let (listen, origins) = (format!("127.0.0.1:{}", self.ports.web), self.ports.origins());
        let mut arguments = vec!["web", "--listen", &listen, "--background", &map];
        arguments.extend(origins.iter().map(String::as_str));
        let mut web = self.process("web", "cara", &arguments)?;
        let line = web.expect("the page is at ", PATIENCE)?.text;
        self.web = Some(web);
        let (url, key) = line.rsplit_once('#').context("it names an address with a key")?;
        let first = origins[0].trim_start_matches("--origin=");
        ensure!(url.ends_with(first), "it is at {first} for browsers, and says {url}");
        Ok(format!("http://{listen}/#{key}"))
    }

    /// Another server of the page, for these users; it ends when it is dropped.
    pub(crate) fn start_web_for(&self, users: &str) -> Result<(Process, String)> {
        let file = self.folder.path().join("users");
        std::fs::write(&file, users)?;
        std::fs::set_permissions(&file, std::fs::Permissions::from_mode(0o600))?;
        let file = file.display().to_string();
        let mut web = self.process("users", "cara", &["web", "--listen", "127.0.0.1:0", "--token-file", &file])?;
        let line = web.expect("the page is at ", PATIENCE)?.text;
        let url = line.rsplit_once(' ').context("it names an address")?.1.to_owned();
        Ok((web, url))
    }

    /// The socket of a manager that does not answer, with a name that would be markup.
    pub(crate) fn hostile_socket(&self) -> Result<UnixListener> {
        let name = format!("%3Cimg src=x onerror=alert%281%29%3E%E2%80%AE-9-{}.sock", self.fleet);
        Ok(UnixListener::bind(self.folder.path().join(name))?)
    }

    /// A node with a record in its signature, which it echoes.
    pub(crate) fn start_box(&mut self) -> Result<()> {
        self.keys.add(&["box/20"])?;
        let file = self.folder.path().join("box.toml");
        std::fs::write(&file, BOX)?;
        let node = self.process("box", "cara", &["node", "--loopback", &file.display().to_string()])?;
        self.agvs.push(node);
        Ok(())
    }

    pub(crate) fn kill_manager(&mut self) -> Result<()> {
        kill(&mut self.manager)
    }

    pub(crate) fn freeze_manager(&mut self) -> Result<()> {
        self.manager.as_mut().context("it runs")?.freeze().map(drop)
    }

    pub(crate) fn thaw_manager(&mut self) -> Result<()> {
        self.manager.as_mut().context("it runs")?.thaw()
    }

    pub(crate) fn kill_web(&mut self) -> Result<()> {
        kill(&mut self.web)
    }

    /// Kills the last vehicle.
    pub(crate) fn kill_a_vehicle(&mut self) -> Result<()> {
        self.agvs.last_mut().context("there is one")?.kill().map(drop)
    }
}

/// An error unless the host held this process up so long, since a ticker began, that it may have ended a lease.
pub(crate) fn excuse(ticker: &Ticker, what: &str) -> Result<()> {
    let longest = ticker.longest();
    ensure!(
        ticker.may_have_ended(LEASE),
        "{what} has stopped though the host did not hold this process up: {longest:?} at most"
    );
    println!("{what} has stopped while the host held this process up for {longest:?}, and is called again");
    Ok(())
}

fn kill(process: &mut Option<Process>) -> Result<()> {
    process.take().ok_or_else(|| anyhow!("it runs"))?.kill().map(drop)
}

/// Racks with aisles between them.
fn map() -> String {
    let (width, height) = (25, 14);
    let is_rack = |x: usize, y: usize| ((2..=5).contains(&y) || (9..=11).contains(&y)) && !x.is_multiple_of(6);
    let row = |y: usize| (0..width).map(|x| if is_rack(x, y) { 'T' } else { '.' }).collect::<String>() + "\n";
    format!("type octile\nheight {height}\nwidth {width}\nmap\n") + &(0..height).map(row).collect::<String>()
}
