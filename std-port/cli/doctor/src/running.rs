//! The units of this host, asked through their control sockets.

use std::io;
use std::sync::mpsc::{Receiver, channel};
use std::thread;
use std::time::{Duration, Instant};

use cara_std::Mode;
use cara_std::control::protocol::{Answer, NodeInfo, Question, RefusedInfo, UnitInfo};
use cara_std::control::{self, Client, ControlError, RunningUnit, UnitState};

pub(crate) use super::holder::Files;
use super::holder::files_of_tcp_port;
use super::which::Which;
use cara_tools::exit::Ended;
use cara_tools::global::Global;

/// Between two questions to a unit.
const PAUSE: Duration = Duration::from_secs(1);
/// How long is waited for the first answers.
const FIRST_ANSWER: Duration = Duration::from_secs(3);

/// A unit of this host, as it was last.
#[derive(Clone, Debug)]
pub(crate) struct Running {
    pub(crate) unit: UnitInfo,
    /// Nodes that have joined, connected or not.
    pub(crate) nodes: Vec<NodeInfo>,
    /// When it was asked for them: what it said of them held later, and may hold no longer.
    pub(crate) asked: Instant,
    pub(crate) refused: Vec<RefusedInfo>,
    pub(crate) counters: Vec<Counted>,
    /// Its open files, where they can be seen.
    pub(crate) files: Option<Files>,
}

/// Counters of a unit, or of its link to a node.
#[derive(Clone, Debug)]
pub(crate) struct Counted {
    pub(crate) node: Option<String>,
    pub(crate) counters: Vec<(String, u64)>,
}

impl Running {
    /// `NAME/ID`.
    pub(crate) fn name(&self) -> String {
        format!("{}/{}", self.unit.name, self.unit.id)
    }

    /// Its mode, where it tells.
    pub(crate) fn mode(&self) -> Option<Mode> {
        match self.unit.mode.as_deref()? {
            "plain" => Some(Mode::Plain),
            "secured" => Some(Mode::Secured),
            _ => None,
        }
    }

    pub(crate) fn is_m_unit(&self) -> bool {
        self.unit.role == "m_unit"
    }

    /// As many nodes are connected as may be.
    pub(crate) fn is_full(&self) -> bool {
        self.unit.connected >= usize::from(self.unit.constraints.maximum_nodes)
    }

    /// A counter of the link to `NAME/ID`.
    pub(crate) fn counter(&self, node: &str, name: &str) -> Option<u64> {
        count(self.counters.iter().find(|counted| counted.node.as_deref() == Some(node))?, name)
    }

    /// A counter of the unit.
    pub(crate) fn own_counter(&self, name: &str) -> Option<u64> {
        count(self.counters.iter().find(|counted| counted.node.is_none())?, name)
    }
}

fn count(counted: &Counted, name: &str) -> Option<u64> {
    counted.counters.iter().find(|(known, _)| known == name).map(|(_, count)| *count)
}

/// The units of this host, each asked by a thread of its own: one that hangs holds up nothing.
pub(crate) struct Sources {
    news: Receiver<(usize, Option<Running>)>,
    latest: Vec<Option<Running>>,
    /// Those that run and cannot be asked now.
    pub(crate) unasked: Vec<RunningUnit>,
    /// Why units could not be asked.
    pub(crate) refused: Option<String>,
}

impl Sources {
    /// Begins to ask the units that the options select, or all of the fleet that they select. That a named unit
    /// does not run is an error; that no unit runs is not.
    pub(crate) fn open(which: Option<&Which>, global: &Global) -> anyhow::Result<Self> {
        let (clients, unasked, refused) = clients(global)?;
        let (sender, news) = channel();
        let mut sources = Self { news, latest: vec![None; clients.len()], unasked, refused };
        for (index, client) in clients.into_iter().enumerate() {
            let (sender, which) = (sender.clone(), which.cloned());
            thread::spawn(move || report(client, which.as_ref(), |reported| sender.send((index, reported)).is_ok()));
        }
        drop(sender);
        sources.first_answers();
        Ok(sources)
    }

    /// Waits until each has answered once, or for as long as is reasonable.
    fn first_answers(&mut self) {
        let end = Instant::now() + FIRST_ANSWER;
        while self.latest.iter().any(Option::is_none) {
            match self.news.recv_timeout(end.saturating_duration_since(Instant::now())) {
                Ok(reported) => self.take(reported),
                Err(_) => return,
            }
        }
    }

    /// The units as they were last; one that has stopped is no longer among them.
    pub(crate) fn look(&mut self) -> Vec<Running> {
        while let Ok(reported) = self.news.try_recv() {
            self.take(reported);
        }
        self.latest.iter().flatten().cloned().collect()
    }

    fn take(&mut self, (index, reported): (usize, Option<Running>)) {
        if let Some(place) = self.latest.get_mut(index) {
            *place = reported;
        }
    }
}

/// Those that are meant, those that cannot be asked now, and why there may be others that cannot be asked at all.
fn clients(global: &Global) -> anyhow::Result<(Vec<Client>, Vec<RunningUnit>, Option<String>)> {
    let no_unit = |error: ControlError| Ended::no_unit(error.to_string());
    if let Some(path) = &global.socket {
        return Ok((vec![Client::connect(path).map_err(no_unit)?], Vec::new(), None));
    }
    let (running, refused) = match &global.unit {
        Some(unit) => (named(unit).map_err(no_unit)?, None),
        None => match control::running() {
            Ok(running) => (running, None),
            Err(error) => (Vec::new(), Some(error.to_string())),
        },
    };
    let ours = running.into_iter().filter(|unit| global.fleet.is_none_or(|fleet| fleet == unit.fleet));
    let (asked, unasked): (Vec<_>, Vec<_>) = ours.partition(|unit| unit.state == UnitState::Answers);
    Ok((asked.iter().filter_map(|unit| Client::connect(&unit.path).ok()).collect(), unasked, refused))
}

/// The units of a name and id, of which one that cannot be asked is a finding; that none runs is an error.
fn named(wanted: &str) -> Result<Vec<RunningUnit>, ControlError> {
    let directories = control::directories();
    let named = control::first_of(&directories, |directory| control::running_called(directory, wanted))?;
    if !named.is_empty() {
        return Ok(named);
    }
    let running = control::running()?;
    let wanted = wanted.to_owned();
    Err(if running.is_empty() {
        ControlError::NoneRunning(directories)
    } else {
        ControlError::NotRunning { wanted, running }
    })
}

/// Asks a unit again and again, until it stops or the receiver is gone.
fn report(mut client: Client, which: Option<&Which>, notify: impl Fn(Option<Running>) -> bool) {
    loop {
        let began = Instant::now();
        let Ok(running) = ask(&mut client, which) else {
            notify(None);
            return;
        };
        if !notify(Some(running)) {
            return;
        }
        // A manager of a thousand nodes has more to tell, and is asked less often.
        thread::sleep(PAUSE.max(began.elapsed() * 10));
    }
}

fn ask(client: &mut Client, which: Option<&Which>) -> Result<Running, ControlError> {
    let (mut nodes, mut refused, mut counters, mut unit) = (Vec::new(), Vec::new(), Vec::new(), None);
    for answer in client.ask(&Question::Unit)? {
        if let Answer::Unit(info) = answer? {
            unit = Some(info);
        }
    }
    let asked = Instant::now();
    for answer in client.ask(&Question::Nodes { offering: None })? {
        match answer? {
            Answer::Node(node) => nodes.push(node),
            Answer::Refused(refusal) => refused.push(refusal),
            _ => {}
        }
    }
    if let Some(question) = counters_question(which, &nodes) {
        for answer in client.ask(&question)? {
            match answer {
                Ok(Answer::Counters { node, counters: reported }) => {
                    counters.push(Counted { node, counters: reported })
                }
                // A node that has just left has no counters.
                Ok(_) | Err(ControlError::Failed(_)) => {}
                Err(error) => return Err(error),
            }
        }
    }
    let unit = unit.ok_or_else(|| io::Error::new(io::ErrorKind::InvalidData, "it did not give its identity"))?;
    let files = files_of_tcp_port(unit.tcp_port);
    Ok(Running { unit, nodes, asked, refused, counters, files })
}

/// All counters, or those of the one link that is asked about.
fn counters_question(which: Option<&Which>, nodes: &[NodeInfo]) -> Option<Question> {
    let Some(which) = which else { return Some(Question::Counters { node: None }) };
    let node = nodes.iter().find(|node| node.connected && which.is(&node.name, node.id))?;
    Some(Question::Counters { node: Some(format!("{}/{}", node.name, node.id)) })
}
