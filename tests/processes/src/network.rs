//! A private network: the program runs itself again in a namespace, where it may change interfaces, addresses and
//! firewalls freely, and meets no other host. No interface is up there, loopback included. It ends with the process.

use std::ffi::OsStr;
use std::fs::File;
use std::os::fd::AsFd;
use std::process::{Command, ExitStatus, Stdio};

use anyhow::{Context, Result, bail, ensure};
use rustix::thread::{LinkNameSpaceType, move_into_link_name_space};

/// Set inside.
const INSIDE: &str = "CARA_OWN_NETWORK";
/// Where Debian keeps `ip` and the like, which is not on everybody's path.
const PATHS: &str = "/usr/sbin:/sbin:/usr/local/sbin";

/// Where this program runs.
pub enum Own {
    /// In a network of its own: go on.
    Inside,
    /// It has run there, and ended.
    Ended(ExitStatus),
    /// The system does not let this user make one, or something is missing.
    Impossible(String),
}

/// Runs this program again, with these arguments, in a network of its own, unless it is there already. `needs` are
/// programs that must be there; with `tap`, the network must be able to hold virtual Ethernet devices and bridges.
pub fn own<A: AsRef<OsStr>>(arguments: impl IntoIterator<Item = A>, needs: &[&str], tap: bool) -> Result<Own> {
    if std::env::var_os(INSIDE).is_some() {
        return Ok(Own::Inside);
    }
    match again(needs, tap)? {
        Ok(mut again) => Ok(Own::Ended(again.args(arguments).status().context("cannot start `unshare`")?)),
        Err(reason) => Ok(Own::Impossible(reason)),
    }
}

/// Whether the test of this name goes on: `true` in a network of its own, in which it is run once more. What cannot be had
/// is said, and fails where `CI` is set, as does a name that is no test's.
pub fn test(name: &str, needs: &[&str], tap: bool) -> bool {
    if std::env::var_os(INSIDE).is_some() {
        return true;
    }
    let mut again = match again(needs, tap).expect("this test has a file") {
        Ok(again) => again,
        Err(reason) => {
            crate::skip(format_args!("{name}: {reason}"));
            return false;
        }
    };
    let output = again.args(["--exact", name, "--include-ignored", "--nocapture", "--test-threads=1"]).output();
    let output = output.expect("`unshare` was just there");
    let said = [output.stdout, output.stderr].concat();
    let said = String::from_utf8_lossy(&said);
    assert!(output.status.success() && said.contains("1 passed"), "it failed in its own network:\n{said}");
    print!("{said}");
    false
}

/// This program in a network of its own, or why there can be none.
fn again(needs: &[&str], tap: bool) -> Result<std::result::Result<Command, String>> {
    if let Some(absent) = ["setpriv", "unshare", "ip"].iter().chain(needs).find(|program| !find(program)) {
        return Ok(Err(format!("the program `{absent}` is not installed")));
    }
    let devices = "ip tuntap add name trial mode tap && ip link add trial0 type bridge";
    let trial = if tap { devices } else { "ip link set lo up" };
    let Some(kind) = KINDS.iter().find(|kind| works(unshare(kind).args(["sh", "-c", trial]))) else {
        return Ok(Err(format!("`unshare` and then `{trial}` does not work for this user")));
    };
    let mut again = unshare(kind);
    again.arg(std::env::current_exe()?).env(INSIDE, "1");
    Ok(Ok(again))
}

/// As root, and as a user that is root inside only.
const KINDS: [&[&str]; 2] = [&["--net"], &["--user", "--map-root-user", "--net"]];

fn unshare(kind: &[&str]) -> Command {
    // Whichever of them ends, what runs inside is asked to end, and cleans up. `unshare` ignores SIGINT and SIGTERM, and below
    // `nohup` SIGHUP as well: a signal that it can ignore would leave it, and all that runs inside, behind.
    let mut command = Command::new("setpriv");
    let words = ["--pdeathsig", "KILL", "unshare", "--fork", "--kill-child=TERM"];
    command.env("PATH", paths()).args(words).args(kind);
    command
}

/// Where programs are looked for: where this process looks, and where `ip` and the like are.
pub fn paths() -> String {
    std::env::var("PATH").map_or_else(|_| PATHS.to_owned(), |path| format!("{path}:{PATHS}"))
}

fn works(command: &mut Command) -> bool {
    command.stdout(Stdio::null()).stderr(Stdio::null()).status().is_ok_and(|status| status.success())
}

pub(crate) fn find(program: &str) -> bool {
    paths().split(':').any(|path| std::path::Path::new(path).join(program).is_file())
}

/// The network of another process.
pub struct Namespace(File);

impl Namespace {
    /// The one that a running process is in.
    pub fn of(process: u32) -> Result<Self> {
        File::open(format!("/proc/{process}/ns/net")).map(Self).context("a running process has a network")
    }

    /// This thread is there from now on, as are the processes and threads that it starts.
    pub fn enter(&self) -> Result<()> {
        move_into_link_name_space(self.0.as_fd(), Some(LinkNameSpaceType::Network)).context("entering a network")
    }

    /// Does something there.
    pub fn within<T: Send>(&self, act: impl FnOnce() -> Result<T> + Send) -> Result<T> {
        std::thread::scope(|scope| {
            let there = scope.spawn(|| self.enter().and_then(|()| act()));
            there.join().expect("what is done there does not panic")
        })
    }

    /// Runs a command there, as `ip link set wire down`; an error unless it succeeds.
    pub fn run(&self, words: &str) -> Result<()> {
        self.within(|| run(words))
    }
}

/// Runs a command of the namespace, as `ip link set tap0 up`; an error unless it succeeds.
pub fn run(words: &str) -> Result<()> {
    let mut words = words.split_whitespace();
    let Some(program) = words.next() else { bail!("nothing to run") };
    succeed(Command::new(program).args(words))
}

/// `ip` with these words, for tests: it panics unless it succeeds.
pub fn ip(words: &str) {
    run(&format!("ip {words}")).unwrap();
}

/// A rule for all that comes in (`input`) or goes out (`output`), in a table such as `inet cara` or `bridge tap0`.
pub fn filter(table: &str, hook: &str, rule: &str) -> Result<()> {
    let chain = format!("chain {hook} {{\ntype filter hook {hook} priority 0\n{rule}\n}}");
    succeed(Command::new("nft").arg(format!("table {table} {{\n{chain}\n}}")))
}

fn succeed(command: &mut Command) -> Result<()> {
    let status = command.env("PATH", paths()).status().with_context(|| format!("cannot start {command:?}"))?;
    ensure!(status.success(), "{command:?} failed: {status}");
    Ok(())
}
