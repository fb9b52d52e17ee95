//! The processes of a run.

use std::collections::HashMap;
use std::fs::OpenOptions;
use std::io::Write;
use std::os::unix::fs::OpenOptionsExt;
use std::process::Command;
use std::sync::mpsc::{Receiver, Sender, channel};
use std::time::{Duration, Instant};

use anyhow::{Context, Result};
use cara_std::StartError;
use cara_std::keys::Store;
use rustix::process::Signal;
use tempfile::TempDir;

use super::board::{Board, Log};
use super::child::{Child, Said};
use super::soak;
use crate::files::MapFiles;
use crate::network::{MANAGER, Network, vehicle_name};
use crate::orders::Order;

/// Vehicles of a process, at most.
const TOGETHER: u32 = 50;
/// How long a process may take to end.
const ENDING: Duration = Duration::from_secs(20);

/// Something that a process has said.
#[derive(Debug)]
pub(super) enum Heard {
    /// A line of a vehicle's log.
    Vehicle(String),
    /// A line of a manager, with its number.
    Manager(usize, String),
    /// A process has ended that was not to.
    Ended(String),
}

#[derive(Clone, Debug, PartialEq, Eq)]
enum Role {
    Vehicles { first: u32, count: u32 },
    Board,
    Manager,
    Mechanic,
    Page,
}

/// All processes, and what they share.
pub(super) struct Stage {
    folder: TempDir,
    files: MapFiles,
    network: Network,
    vehicles: u32,
    /// The last of them, if it is one.
    board: Option<Board>,
    /// Two managers stand by for each other.
    standby: bool,
    seed: u64,
    began: Instant,
    sender: Sender<Said>,
    said: Receiver<Said>,
    children: Vec<Child>,
    /// By the child's number.
    roles: Vec<Role>,
    /// Those that are to run, by number.
    running: Vec<usize>,
    /// The one that commands.
    manager: usize,
    /// Messages and datagrams that each child has sent.
    sent: HashMap<usize, [u64; 2]>,
}

impl Stage {
    /// Makes what the processes share: keys, orders, folders.
    pub(super) fn new(
        files: MapFiles,
        orders: &[Order],
        vehicles: u32,
        board: Option<Board>,
        standby: bool,
        seed: u64,
    ) -> Result<Self> {
        let folder = tempfile::tempdir()?;
        let network = Network { fleet: fastrand::u32(1..), everywhere: false };
        Store::create(&folder.path().join("keys"), network.draw_keys(vehicles)?)?;
        let text: String = orders.iter().map(|order| format!("{order}\n")).collect();
        std::fs::write(folder.path().join("orders"), text)?;
        let (sender, said) = channel();
        let (children, roles, running, sent) = (Vec::new(), Vec::new(), Vec::new(), HashMap::new());
        let began = Instant::now();
        Ok(Self {
            folder,
            files,
            network,
            vehicles,
            board,
            standby,
            seed,
            began,
            sender,
            said,
            children,
            roles,
            running,
            manager: 0,
            sent,
        })
    }

    /// Says something to who watches.
    pub(super) fn show(&self, what: &str) {
        println!("{:7.1} s  {what}", self.began.elapsed().as_secs_f64());
    }

    /// Starts vehicles, mechanic and manager.
    pub(super) fn start_all(&mut self) -> Result<()> {
        let hosted = self.vehicles - u32::from(self.board.is_some());
        for first in (1..=hosted).step_by(TOGETHER as usize) {
            let count = TOGETHER.min(hosted - first + 1);
            let mut arguments = self.arguments("vehicles");
            let numbers = [("--first", first), ("--count", count), ("--vehicles", self.vehicles)];
            arguments.extend(numbers.iter().flat_map(|(name, number)| [(*name).to_owned(), number.to_string()]));
            arguments.extend(["--seed".to_owned(), self.seed.to_string()]);
            self.start(Role::Vehicles { first, count }, &arguments)?;
        }
        if let Some(board) = &self.board {
            let emulator = board.start(self.folder.path(), self.network)?;
            let log = Log::new(vehicle_name(board.number));
            let child = Child::emulate(self.children.len(), emulator, log, self.sender.clone())?;
            self.add(Role::Board, child);
        }
        self.start(Role::Mechanic, &["mechanic".to_owned(), "--fleet".to_owned(), self.network.fleet.to_string()])?;
        self.start_manager(false)?;
        let (fleet, map) = (self.network.fleet, self.files.map.display());
        self.show(&format!("to watch: cara web --unit {}/{} --fleet {fleet} --background {map}", MANAGER.0, MANAGER.1));
        Ok(())
    }

    /// Starts `cara web`, and reads it as a browser does.
    pub(super) fn start_page(&mut self) -> Result<()> {
        let (place, token) = (self.folder.path().join("token"), format!("{:032x}", fastrand::u128(..)));
        let mut file = OpenOptions::new().write(true).create_new(true).mode(0o600).open(&place)?;
        writeln!(file, "{token}")?;
        let mut page = Command::new(std::env::current_exe()?.with_file_name("cara"));
        page.arg("web").arg("--unit").arg(format!("{}/{}", MANAGER.0, MANAGER.1));
        page.arg("--fleet").arg(self.network.fleet.to_string()).arg("--background").arg(&self.files.map);
        page.arg("--token-file").arg(&place).arg("--listen").arg(format!("127.0.0.1:{}", soak::PAGE));
        let child = Child::run(self.children.len(), page, self.sender.clone())?;
        self.add(Role::Page, child);
        soak::read_page(token);
        Ok(())
    }

    /// What each process holds, a line each: columns of the file of a soak.
    pub(super) fn held(&self) -> Vec<String> {
        let line = |number: &usize| {
            let sent = self.sent.get(number).copied().unwrap_or_default();
            let process = match &self.roles[*number] {
                Role::Vehicles { first, count } => format!("vehicles {first} to {}", first + count - 1),
                Role::Board => "board".to_owned(),
                Role::Manager if *number == self.manager => "manager".to_owned(),
                Role::Manager => "standby".to_owned(),
                Role::Mechanic => "mechanic".to_owned(),
                Role::Page => "page".to_owned(),
            };
            soak::line(&process, *number, self.children[*number].id(), sent)
        };
        self.running.iter().filter_map(line).collect()
    }

    /// How many vehicles there are.
    pub(super) const fn vehicles(&self) -> u32 {
        self.vehicles
    }

    fn arguments(&self, role: &str) -> Vec<String> {
        let (map, stations) = (self.files.map.to_string_lossy(), self.files.stations.to_string_lossy());
        let fleet = self.network.fleet.to_string();
        [role, "--fleet", &fleet, "--map", &map, "--stations", &stations].map(str::to_owned).to_vec()
    }

    /// Whether two managers stand by for each other.
    pub(super) const fn has_standby(&self) -> bool {
        self.standby
    }

    /// Starts a manager, which commands from now on; the number of the one before.
    pub(super) fn start_manager(&mut self, take_over: bool) -> Result<usize> {
        let number = self.start_another(take_over)?;
        Ok(std::mem::replace(&mut self.manager, number))
    }

    /// Starts a manager beside the one that commands.
    pub(super) fn start_standby(&mut self) -> Result<usize> {
        self.start_another(false)
    }

    fn start_another(&mut self, take_over: bool) -> Result<usize> {
        let mut arguments = self.arguments("manager");
        // One that takes over, or stands by, is on another host: what it shares with the first one is the book.
        let is_elsewhere = take_over || self.standby;
        let state = if is_elsewhere { format!("state-{}", self.children.len()) } else { self.state() };
        let path = |name: &str| self.folder.path().join(name).to_string_lossy().into_owned();
        let options = [
            ("--orders", path("orders")),
            ("--book", path("book")),
            ("--state", path(&state)),
            ("--vehicles", self.vehicles.to_string()),
            ("--began", self.began.elapsed().as_secs_f64().to_string()),
        ];
        arguments.extend(options.into_iter().flat_map(|(name, value)| [name.to_owned(), value]));
        if self.board.is_some() {
            arguments.push("--everywhere".to_owned());
        }
        if take_over {
            arguments.push("--take-over".to_owned());
        }
        if self.standby {
            arguments.push("--standby".to_owned());
        }
        let number = self.start(Role::Manager, &arguments)?;
        std::fs::write(self.folder.path().join("newest-state"), &state)?;
        Ok(number)
    }

    /// A manager that has stood by commands from now on; `false` where it did already.
    pub(super) const fn commands(&mut self, number: usize) -> bool {
        std::mem::replace(&mut self.manager, number) != number
    }

    /// Where the manager that commanded last keeps its term.
    fn state(&self) -> String {
        std::fs::read_to_string(self.folder.path().join("newest-state")).unwrap_or_else(|_| "state".to_owned())
    }

    fn start(&mut self, role: Role, arguments: &[String]) -> Result<usize> {
        let keys = self.folder.path().join("keys");
        let child = Child::start(self.children.len(), &keys, arguments, self.sender.clone())?;
        Ok(self.add(role, child))
    }

    fn add(&mut self, role: Role, child: Child) -> usize {
        let number = self.children.len();
        self.children.push(child);
        self.roles.push(role);
        self.running.push(number);
        number
    }

    /// Whether a vehicle is the board, whose unit cannot be switched off without its body.
    pub(super) fn is_board(&self, name: &str) -> bool {
        self.board.as_ref().is_some_and(|board| vehicle_name(board.number) == name)
    }

    /// Whether it is the manager that is to command.
    pub(super) const fn is_manager(&self, number: usize) -> bool {
        self.manager == number
    }

    pub(super) fn notify_manager(&mut self, line: &str) {
        self.children[self.manager].show(line);
    }

    /// Has a vehicle's process do something with it.
    pub(super) fn notify_vehicle(&mut self, verb: &str, name: &str) -> Result<()> {
        let has = |role: &Role| match role {
            Role::Vehicles { first, count } => (*first..first + count).any(|number| vehicle_name(number) == name),
            Role::Board | Role::Manager | Role::Mechanic | Role::Page => false,
        };
        let number = self.roles.iter().position(has).with_context(|| format!("no process has {name}"))?;
        self.children[number].show(&format!("{verb} {name}"));
        Ok(())
    }

    /// Has the manager that commands hang.
    pub(super) fn freeze_manager(&mut self) -> Result<()> {
        self.children[self.manager].signal(Signal::STOP)
    }

    /// Lets a manager go on that hangs, also where its standby commands by now.
    pub(super) fn thaw_managers(&self) -> Result<()> {
        let mut managers = self.running.iter().filter(|number| self.roles[**number] == Role::Manager);
        managers.try_for_each(|number| self.children[*number].signal(Signal::CONT))
    }

    pub(super) fn kill_manager(&mut self) -> Result<()> {
        self.running.retain(|number| *number != self.manager);
        self.children[self.manager].kill()
    }

    /// What has been said, after waiting for a while at most.
    pub(super) fn hear(&mut self, patience: Duration) -> Vec<Heard> {
        let first = self.said.recv_timeout(patience).ok().and_then(|said| self.understand(said));
        let mut heard: Vec<_> = first.into_iter().collect();
        while let Ok(said) = self.said.try_recv() {
            heard.extend(self.understand(said));
        }
        heard
    }

    /// What has been said and not been heard, at the end.
    pub(super) fn next_heard(&mut self) -> Option<Heard> {
        loop {
            let said = self.said.recv_timeout(Duration::from_millis(100)).ok()?;
            if let Some(heard) = self.understand(said) {
                return Some(heard);
            }
        }
    }

    fn understand(&mut self, Said { child, line }: Said) -> Option<Heard> {
        let role = &self.roles[child];
        let Some(line) = line else {
            return self.ended(child);
        };
        if let ["sent", messages, datagrams] = line.split(' ').collect::<Vec<_>>()[..]
            && let (Ok(messages), Ok(datagrams)) = (messages.parse(), datagrams.parse())
        {
            self.sent.insert(child, [messages, datagrams]);
            return None;
        }
        match role {
            Role::Vehicles { .. } | Role::Board => Some(Heard::Vehicle(line)),
            Role::Manager => Some(Heard::Manager(child, line)),
            Role::Mechanic | Role::Page => None,
        }
    }

    /// A process has closed its output. A manager that another one took over from ends with a code of its own.
    fn ended(&mut self, child: usize) -> Option<Heard> {
        let was_to_run = self.running.contains(&child);
        self.running.retain(|number| *number != child);
        let is_fenced = self.roles[child] == Role::Manager && child != self.manager;
        if was_to_run && is_fenced {
            let status = self.children[child].end(ENDING).ok();
            let code = status.and_then(|status| status.code());
            return (code != Some(i32::from(StartError::FENCED_EXIT)))
                .then(|| Heard::Ended(format!("a manager that was to step down, with {code:?}")));
        }
        was_to_run.then(|| Heard::Ended(format!("{:?}", self.roles[child])))
    }

    /// CPU time of all processes so far, and their memory now.
    pub(super) fn usage(&mut self) -> (Duration, u64) {
        for number in &self.running {
            self.children[*number].look();
        }
        let cpu = self.children.iter().map(|child| child.usage.cpu).sum();
        let resident = self.running.iter().map(|number| self.children[*number].usage.resident_kib).sum();
        (cpu, resident)
    }

    /// Messages and datagrams that all processes have sent.
    pub(super) fn sent(&self) -> [u64; 2] {
        self.sent.values().fold([0; 2], |sum, sent| [sum[0] + sent[0], sum[1] + sent[1]])
    }

    /// Ends all processes, the manager first; those that did not end well.
    pub(super) fn end(&mut self) -> Vec<String> {
        let mut wrong = Vec::new();
        for number in std::mem::take(&mut self.running).into_iter().rev() {
            // Neither ends with its input. An emulator is the last one of all that loses its power.
            if matches!(self.roles[number], Role::Board | Role::Page) {
                let killed = self.children[number].kill();
                wrong.extend(killed.err().map(|error| format!("{:?}: {error}", self.roles[number])));
                continue;
            }
            match self.children[number].end(ENDING) {
                Ok(status) if status.success() => {}
                Ok(status) => wrong.push(format!("{:?} ended with {status}", self.roles[number])),
                Err(error) => wrong.push(format!("{:?}: {error}", self.roles[number])),
            }
        }
        wrong
    }
}
