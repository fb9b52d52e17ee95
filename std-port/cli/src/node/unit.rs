//! The node's unit, whichever role it has.

use std::net::SocketAddr;
use std::ops::ControlFlow;
use std::path::PathBuf;
use std::sync::Arc;
use std::sync::mpsc::Receiver;
use std::time::Duration;

use cara_std::access::AccessError;
use cara_std::control::execute;
use cara_std::control::protocol::{Answer, Question};
use cara_std::{
    BuildError, Builder, CommunicationSystem, Constraints, Error, Identity, Log, Mode, MyFunctionList, StartError,
    Unit, UnitEvent,
};

use super::black_box::{BlackBox, Cause, Look};
use super::http::Metrics;
use super::settings::Settings;
use crate::commands::logs::Logs;

/// Between two values of a stream in the black box.
const BOXED_MS: u64 = 1_000;

/// An m_unit or an s_unit.
pub(super) enum Node {
    Manager(CommunicationSystem),
    Vehicle(Unit),
}

/// Tells where a connected peer is.
pub(super) type Addresses = Box<dyn Fn(&Identity) -> Option<SocketAddr> + Send>;

/// Why a node could not be built.
pub(super) enum NotBuilt {
    Unit(BuildError),
    /// Its access table was correct when it was looked at first.
    Access(AccessError),
    /// Its audit log.
    Audit(std::io::Error),
}

impl<E: Into<BuildError>> From<E> for NotBuilt {
    fn from(error: E) -> Self {
        Self::Unit(error.into())
    }
}

impl Node {
    /// Builds the unit; it does nothing until it is started.
    pub(super) fn build(settings: &Settings) -> Result<Self, NotBuilt> {
        let Settings { name, id, .. } = settings;
        let Some(manager) = &settings.manager else {
            let builder = CommunicationSystem::builder(name, *id)?;
            let builder = match &settings.m_units {
                Some(m_units) => builder.m_units(m_units.iter().map(|m_unit| (&m_unit.name, m_unit.id)))?,
                None => builder,
            };
            let builder = match &settings.tcp_port {
                Some(port) => builder.tcp_port(port.value),
                None => builder,
            };
            let builder = builder.control(settings.control.clone()).take_over(settings.takes_over);
            let builder = if settings.forces { builder.force_take_over() } else { builder };
            let builder = if settings.stands_by { builder.standby() } else { builder };
            let builder = match &settings.audit {
                Some(path) => builder.audit(path).map_err(NotBuilt::Audit)?,
                None => builder,
            };
            return Ok(Self::Manager(with(builder, settings).map_err(NotBuilt::Access)?.build()?));
        };
        let builder = Unit::builder(name, *id, &manager.name, manager.id)?;
        let builder = match manager.address {
            Some(address) => builder.manager_address(address),
            None => builder,
        };
        Ok(Self::Vehicle(with(builder, settings).map_err(NotBuilt::Access)?.build()?))
    }

    pub(super) fn start(&self) -> Result<(), StartError> {
        match self {
            Self::Manager(system) => system.start(),
            Self::Vehicle(unit) => unit.start(),
        }
    }

    pub(super) fn stop(&self) {
        match self {
            Self::Manager(system) => system.stop(),
            Self::Vehicle(unit) => unit.stop(),
        }
    }

    /// To the s_unit's manager, or to the m_unit's operators.
    pub(super) fn show_log(&self, log: &Log) -> Result<(), Error> {
        match self {
            Self::Manager(system) => system.show_log(log),
            Self::Vehicle(unit) => unit.my_function_list().add_log(log)?,
        }
        Ok(())
    }

    pub(super) fn my_function_list(&self) -> MyFunctionList<'_, ()> {
        match self {
            Self::Manager(system) => system.my_function_list(),
            Self::Vehicle(unit) => unit.my_function_list(),
        }
    }

    pub(super) fn publish_my_function_list(&self) -> Result<(), Error> {
        match self {
            Self::Manager(system) => system.publish_my_function_list(),
            Self::Vehicle(unit) => unit.publish_my_function_list(),
        }
    }

    pub(super) fn set_constraints(&self, constraints: Constraints) -> Result<(), Error> {
        match self {
            Self::Manager(system) => system.set_constraints(constraints),
            Self::Vehicle(unit) => unit.set_constraints(constraints),
        }
    }

    pub(super) fn events(&self) -> Receiver<UnitEvent> {
        match self {
            Self::Manager(system) => system.events(),
            Self::Vehicle(unit) => unit.events(),
        }
    }

    pub(super) fn mode(&self) -> Mode {
        match self {
            Self::Manager(system) => system.mode(),
            Self::Vehicle(unit) => unit.mode(),
        }
    }

    /// The UDP port of broadcasts.
    pub(super) fn discovery_port(&self) -> u16 {
        match self {
            Self::Manager(system) => system.discovery_port(),
            Self::Vehicle(unit) => unit.discovery_port(),
        }
    }

    /// Where it takes connections; an s_unit takes none.
    pub(super) fn tcp_port(&self) -> Option<u16> {
        match self {
            Self::Manager(system) => Some(system.tcp_port()),
            Self::Vehicle(_) => None,
        }
    }
}

impl Node {
    /// Where operators reach it.
    pub(super) fn control_path(&self) -> Option<PathBuf> {
        match self {
            Self::Manager(system) => system.control_path(),
            Self::Vehicle(_) => None,
        }
    }

    /// Where a connected peer is; holds no unit alive.
    pub(super) fn addresses(&self) -> Addresses {
        match self {
            Self::Manager(system) => {
                let system = system.downgrade();
                Box::new(move |peer| system.upgrade()?.node(peer)?.address())
            }
            Self::Vehicle(unit) => {
                let unit = unit.downgrade();
                Box::new(move |_| unit.upgrade()?.manager()?.address())
            }
        }
    }

    /// Whether the unit keeps time, asked for at most so long; `None` once it is gone. Holds none alive but meanwhile.
    pub(super) fn lives(&self) -> Box<dyn Fn(Duration) -> Option<bool> + Send> {
        match self {
            Self::Manager(system) => {
                let system = system.downgrade();
                Box::new(move |within| Some(system.upgrade()?.keeps_time(within)))
            }
            Self::Vehicle(unit) => {
                let unit = unit.downgrade();
                Box::new(move |within| Some(unit.upgrade()?.keeps_time(within)))
            }
        }
    }

    /// What is so at a moment, as the answers of a control socket; holds no unit alive but meanwhile.
    pub(super) fn look(&self) -> Look {
        match self {
            Self::Manager(system) => {
                let system = system.downgrade();
                Box::new(move |found| {
                    let Some(system) = system.upgrade() else { return };
                    let questions = [
                        Question::Unit,
                        Question::Nodes { offering: None },
                        Question::Orders { node: None },
                        Question::Counters { node: None },
                    ];
                    for question in questions {
                        execute(&system, &question, &mut |answer| {
                            found(answer);
                            ControlFlow::Continue(())
                        });
                    }
                })
            }
            Self::Vehicle(unit) => {
                let unit = unit.downgrade();
                Box::new(move |found| {
                    let Some(unit) = unit.upgrade() else { return };
                    let counters = unit.counters().into_iter().map(|(name, count)| (name.to_owned(), count));
                    found(Answer::Counters { node: None, counters: counters.collect() });
                })
            }
        }
    }

    /// Has a manager's commands put into the black box, until it stops.
    pub(super) fn follow_commands(&self, black_box: BlackBox) {
        let Self::Manager(system) = self else { return };
        let system = system.downgrade();
        let follow = move || {
            let Some(system) = system.upgrade() else { return };
            execute(&system, &Question::Commands, &mut |answer| {
                if let Answer::Command { question, .. } = &answer {
                    black_box.take(&answer);
                    match **question {
                        Question::Stop { .. } => black_box.freeze(Cause::Stop),
                        Question::Reset { .. } => black_box.freeze(Cause::Reset),
                        _ => {}
                    }
                }
                ControlFlow::Continue(())
            });
        };
        if let Err(error) = std::thread::Builder::new().name("cara-commands".into()).spawn(follow) {
            tracing::warn!(%error, "the black box has no commands");
        }
    }

    /// Puts the values of streams with these names into the black box, of all nodes.
    pub(super) fn follow_streams(&self, names: &[String], black_box: BlackBox) {
        let Self::Manager(system) = self else { return };
        if names.is_empty() {
            return;
        }
        let (system, names) = (system.downgrade(), names.to_vec());
        let follow = move || {
            let Some(system) = system.upgrade() else { return };
            let (own, mut logs) = (system.identity().to_string(), Logs::default());
            execute(&system, &Question::Streams { interval_ms: BOXED_MS, names }, &mut |answer| {
                // The box has its own log line by line.
                if !matches!(&answer, Answer::Value { node, stream, .. } if *node == own && stream.starts_with("log("))
                {
                    logs.events(answer).iter().for_each(|answer| black_box.take(answer));
                }
                ControlFlow::Continue(())
            });
        };
        if let Err(error) = std::thread::Builder::new().name("cara-streams".into()).spawn(follow) {
            tracing::warn!(%error, "the black box has no streams");
        }
    }

    /// What is served as metrics; holds no unit alive.
    pub(super) fn metrics(&self) -> Metrics {
        match self {
            Self::Manager(system) => {
                let system = system.downgrade();
                Arc::new(move || system.upgrade().map(|system| system.metrics()))
            }
            Self::Vehicle(unit) => {
                let unit = unit.downgrade();
                Arc::new(move || unit.upgrade().map(|unit| unit.metrics()))
            }
        }
    }
}

fn with<R>(builder: Builder<(), R>, settings: &Settings) -> Result<Builder<(), R>, AccessError> {
    let builder = builder.fleet(settings.fleet).interfaces(settings.interfaces);
    let builder = builder.constraints(settings.constraints).capacities(settings.capacities).spin(settings.spin);
    let builder = settings.keys.given_to(builder);
    let builder = match &settings.discovery_port {
        Some(port) => builder.discovery_port(port.value),
        None => builder,
    };
    let builder = match &settings.state {
        Some(folder) => builder.state_folder(folder),
        None => builder,
    };
    match &settings.access {
        Some(path) => builder.access_file(path),
        None => Ok(builder),
    }
}
