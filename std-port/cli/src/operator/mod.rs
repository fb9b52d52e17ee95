//! The m_unit that is asked: one that runs on this host, through its control socket, or one in this process. The same
//! questions, the same answers.

mod own;
mod running;

use std::ops::ControlFlow;
use std::path::PathBuf;
use std::time::{Duration, Instant};

use cara_std::CommunicationSystem;
use cara_std::control::protocol::{Answer, Failure, Question, UnitInfo};
use cara_std::control::{Client, Closer, Role, execute, execute_while};

use cara_tools::exit::{Ended, Exit};
use cara_tools::global::Global;

pub(crate) use self::running::of_others;

/// What a command is about: as a manager of its own it waits until that is there.
#[derive(Clone, Copy, Debug)]
pub(crate) enum Need<'n> {
    /// No node.
    Nothing,
    /// All that come.
    Everybody,
    /// A node; with `--as`, once it has published.
    Node(&'n str),
    /// The unit itself, or a node.
    UnitOrNode(&'n str),
    /// A node with this function.
    Function(&'n str, &'n str),
    /// All that come and offer this function.
    Offering(&'n str),
}

/// A unit that answers questions.
pub(crate) struct Operator {
    unit: Unit,
    /// How long nodes were waited for.
    waited: Option<Duration>,
    /// What may be asked of a unit of this process; one of another process knows that itself.
    role: Role,
}

enum Unit {
    /// In another process of this host.
    Running(Client),
    /// In this process.
    Own(CommunicationSystem),
}

/// How a unit is reached; see [`Operator::way`].
#[derive(Clone)]
pub(crate) enum Way {
    /// Its control socket.
    Socket(PathBuf),
    /// It is in this process.
    Own(CommunicationSystem),
}

impl Way {
    /// A connection of its own.
    pub(crate) fn open(&self) -> anyhow::Result<Operator> {
        self.open_with(Client::connect)
    }

    /// Likewise, for a question that is answered also where all connections of the unit are in use.
    pub(crate) fn open_to_stop(&self) -> anyhow::Result<Operator> {
        self.open_with(Client::connect_to_stop)
    }

    /// A unit of this process stops.
    pub(crate) fn end(&self) {
        if let Self::Own(system) = self {
            system.stop();
        }
    }

    fn open_with(&self, connect: running::Connect) -> anyhow::Result<Operator> {
        let unit = match self {
            Self::Socket(path) => Unit::Running(running::at(path, connect)?),
            Self::Own(system) => Unit::Own(system.clone()),
        };
        Ok(Operator { unit, waited: None, role: Role::Reset })
    }
}

/// What becomes of an answer; `false` when no more are wanted.
type Each<'e> = &'e mut dyn FnMut(Answer) -> anyhow::Result<bool>;

/// There is no unit to ask; `ways` says what can be done.
fn none_runs(global: &Global, ways: &str) -> anyhow::Error {
    let others = running::not_meant();
    let of_others = running::of_others(None, global.fleet);
    if others.is_empty() && !of_others.is_empty() {
        return Ended::no_unit(of_others);
    }
    Ended::no_unit(format!(
        "no such m_unit runs on this host, unless one stands by{others} (looked in {}). {ways}",
        running::looked_in()
    ))
}

impl Operator {
    /// The unit that the options choose; with none there, an error that names the ways out.
    pub(crate) fn open(global: &Global, need: &Need) -> anyhow::Result<Self> {
        let ways = "Start a manager (`cara node --name NAME --id ID`), or be one for the time of this command: --as NAME/ID \
                    with the fleet's --fleet NUMBER";
        Self::open_if_any(global, need)?.ok_or_else(|| none_runs(global, ways))
    }

    /// As [`open`](Self::open), for a question that is answered also where all connections of a unit are in use.
    pub(crate) fn open_to_stop(global: &Global, need: &Need) -> anyhow::Result<Self> {
        if global.act_as.is_none()
            && let Some(client) = running::choose(global, Client::connect_to_stop)?
        {
            return Ok(Self { unit: Unit::Running(client), waited: None, role: Role::Reset });
        }
        Self::open(global, need)
    }

    /// The running unit that the options choose, for a verb that a manager for the time of a command has no use for.
    /// `why_not` says why.
    pub(crate) fn open_running(global: &Global, why_not: &str) -> anyhow::Result<Self> {
        if global.act_as.is_some() {
            return Err(Ended::usage(format!("{why_not}: leave out --as")));
        }
        let running = Self::open_if_any(global, &Need::Nothing)?;
        running
            .ok_or_else(|| none_runs(global, "This verb is for a manager that runs (`cara node --name NAME --id ID`)"))
    }

    /// The unit that the options choose; `None` if they choose none and none runs.
    pub(crate) fn open_if_any(global: &Global, need: &Need) -> anyhow::Result<Option<Self>> {
        let Some(identity) = &global.act_as else {
            let client = running::choose(global, Client::connect)?;
            return Ok(client.map(|client| Self { unit: Unit::Running(client), waited: None, role: Role::Reset }));
        };
        let system = own::start(identity, global)?;
        let mut operator = Self { unit: Unit::Own(system), waited: None, role: Role::Reset };
        own::wait_for(&mut operator, need, global.wait())?;
        operator.waited = Some(global.wait());
        Ok(Some(operator))
    }

    /// How long nodes were waited for, as a remark on missing ones.
    pub(crate) fn waited(&self) -> String {
        own::within(self.waited)
    }

    /// Asks, and has each answer looked at. A question that could not be answered is an error.
    pub(crate) fn ask(
        &mut self,
        question: &Question,
        mut each: impl FnMut(Answer) -> anyhow::Result<()>,
    ) -> anyhow::Result<()> {
        self.converse(question, &mut |answer| each(answer).map(|()| true))
    }

    /// All answers to a question.
    pub(crate) fn answers(&mut self, question: &Question) -> anyhow::Result<Vec<Answer>> {
        let mut answers = Vec::new();
        self.ask(question, |answer| {
            answers.push(answer);
            Ok(())
        })?;
        Ok(answers)
    }

    /// The unit that is asked.
    pub(crate) fn unit(&mut self) -> anyhow::Result<UnitInfo> {
        let answers = self.answers(&Question::Unit)?.into_iter();
        let unit = answers.filter_map(|answer| if let Answer::Unit(unit) = answer { Some(unit) } else { None }).next();
        unit.ok_or_else(|| Ended::failed("Malformed", "the unit does not give its identity: update cara or the unit"))
    }

    /// Whether that is the unit which is asked: `.`, its name, or its name and ID.
    pub(crate) fn is_itself(&mut self, meant: &str) -> anyhow::Result<bool> {
        if meant == "." {
            return Ok(true);
        }
        let unit = self.unit()?;
        Ok(meant == unit.name || meant == format!("{}/{}", unit.name, unit.id))
    }

    /// Asks until `each` says `false`, or until `span` has passed: then the process ends.
    pub(crate) fn watch(
        &mut self,
        question: &Question,
        span: Option<Duration>,
        mut each: impl FnMut(Answer) -> anyhow::Result<bool>,
    ) -> anyhow::Result<()> {
        if let Some(span) = span {
            let system = match &self.unit {
                Unit::Own(system) => Some(system.clone()),
                Unit::Running(_) => None,
            };
            std::thread::Builder::new().name("end".into()).spawn(move || {
                std::thread::sleep(span);
                system.inspect(CommunicationSystem::stop);
                std::process::exit(Exit::Done as i32);
            })?;
        }
        self.converse(question, &mut each)
    }

    /// A second connection to the same unit, for questions that are answered at the same time.
    pub(crate) fn another(&self) -> anyhow::Result<Self> {
        Ok(Self { waited: self.waited, role: self.role, ..self.way().open()? })
    }

    /// How the same unit is reached again, also by other threads and after its restart.
    pub(crate) fn way(&self) -> Way {
        match &self.unit {
            Unit::Running(client) => Way::Socket(client.unit().path.clone()),
            Unit::Own(system) => Way::Own(system.clone()),
        }
    }

    /// Asks, and passes on each answer, a failure too, until that says `Break`; of a unit of this process also until `lives`
    /// says that the client has gone, or that its last sign of life is too old.
    pub(crate) fn pass_on(
        &mut self,
        question: &Question,
        each: &mut dyn FnMut(Answer) -> ControlFlow<()>,
        lives: &dyn Fn() -> Option<Instant>,
    ) -> anyhow::Result<()> {
        match &mut self.unit {
            Unit::Own(system) => match (self.role.permit(system, question), question) {
                (Err(failure), _) => drop(each(Answer::Failed(failure))),
                (Ok(()), Question::As { role, .. }) => {
                    self.role = self.role.min(*role);
                    let _ = each(Answer::Done);
                }
                (Ok(()), _) => execute_while(system, question, each, lives),
            },
            Unit::Running(client) => running::pass_on(client, question, each)?,
        }
        Ok(())
    }

    /// What closes the connection to a unit of another process, from another thread.
    pub(crate) fn closer(&self) -> anyhow::Result<Option<Closer>> {
        match &self.unit {
            Unit::Own(_) => Ok(None),
            Unit::Running(client) => Ok(Some(client.closer()?)),
        }
    }

    /// What alone keeps a hold of a unit of another process from here on.
    pub(crate) fn beater(&mut self) -> anyhow::Result<Option<Closer>> {
        if let Unit::Running(client) = &mut self.unit {
            client.leave_beats();
        }
        self.closer()
    }

    /// Requests that were accepted leave this process before it ends.
    pub(crate) fn deliver(&self) {
        if let Unit::Own(system) = &self.unit {
            own::deliver(system);
        }
    }

    fn converse(&mut self, question: &Question, each: Each) -> anyhow::Result<()> {
        let (mut failure, mut wrong) = (None, None);
        let mut sink = |answer| match answer {
            Answer::Done => ControlFlow::Continue(()),
            Answer::Failed(why) => {
                failure = Some(why);
                ControlFlow::Continue(())
            }
            answer => match each(answer) {
                Ok(true) => ControlFlow::Continue(()),
                Ok(false) => ControlFlow::Break(()),
                Err(error) => {
                    wrong = Some(error);
                    ControlFlow::Break(())
                }
            },
        };
        match &mut self.unit {
            Unit::Own(system) => execute(system, question, &mut sink),
            Unit::Running(client) => running::ask(client, question, &mut sink)?,
        }
        match (wrong, failure) {
            (Some(error), _) => Err(error),
            (None, Some(failure)) => Err(error_of(failure)),
            (None, None) => Ok(()),
        }
    }
}

/// The exit code of a failure; errors of the configuration are the caller's to correct.
pub(crate) fn exit_of(failure: &Failure) -> Exit {
    if failure.cause == "configuration" { Exit::Usage } else { Exit::Failed }
}

fn error_of(failure: Failure) -> anyhow::Error {
    Ended { exit: exit_of(&failure), text: failure.text, name: failure.error }.into()
}
