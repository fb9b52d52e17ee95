//! What a unit sees happen, kept with its time in the unit's log.

use std::net::SocketAddr;

use cara_core::distribution::identity::Identity;

/// What a unit tells its program: functions by their names, the network as whether it can be used.
pub type UnitEvent = cara_core::services::event::UnitEvent<String, bool, SocketAddr>;

/// Something that happened to a unit.
#[derive(Clone, Debug, PartialEq, Eq)]
#[non_exhaustive]
pub enum LogEvent {
    /// The unit began a life.
    Started,
    /// The life ended, in an orderly way or not.
    Stopped,
    /// A service of the unit was called.
    Called {
        /// The function.
        function: String,
        /// The caller.
        caller: Identity,
    },
    /// What the unit told its program.
    Report(UnitEvent),
}

impl From<UnitEvent> for LogEvent {
    fn from(event: UnitEvent) -> Self {
        Self::Report(event)
    }
}

impl LogEvent {
    /// What the program was told, if it was.
    pub const fn reported(&self) -> Option<&UnitEvent> {
        if let Self::Report(event) = self { Some(event) } else { None }
    }

    /// What the trace of a run has of it: the same text whatever types and variants are called.
    pub(super) fn words(&self) -> String {
        match self {
            Self::Started => "started".to_owned(),
            Self::Stopped => "stopped".to_owned(),
            Self::Called { function, caller } => format!("{caller} called {function}"),
            Self::Report(event) => words_of(event),
        }
    }
}

fn words_of(event: &UnitEvent) -> String {
    match event {
        UnitEvent::Joined { peer } => format!("{peer} joined"),
        UnitEvent::Left { peer, reason } => format!("{peer} left: {reason:?}"),
        UnitEvent::NotJoined { reason, .. } => format!("a link ended: {reason:?}"),
        UnitEvent::NetworkChanged { up } => format!("interface up: {up}"),
        UnitEvent::ListChanged { peer } => format!("{peer} has another list"),
        UnitEvent::RequestFailed { peer, call, error } => format!("{} failed at {peer}: {error:?}", call.0),
        UnitEvent::LeaseExpired { function, .. } => format!("the lease of {function} expired"),
        UnitEvent::LeaseEnded { peer, function, call, why } => {
            format!("the lease of {function} at {peer} for {} ended: {why:?}", call.0)
        }
        other => format!("{other:?}"),
    }
}
