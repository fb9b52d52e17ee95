//! What an operator may do, and who has which role.

use std::collections::BTreeMap;
use std::fmt;

use cara_core::distribution::function::Attributes;
use serde::{Deserialize, Serialize};

use super::location::own_uid;
use super::protocol::{CallQuestion, Failure, Question};
use super::select;
use crate::CommunicationSystem;

/// What an operator may do. Each role includes those before it, so every role may stop: no operator is turned away with a stop
/// because of a missing right.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Role {
    /// Stops nodes, and sees the unit and which nodes there are.
    Stop,
    /// Sees everything and changes nothing.
    See,
    /// Calls and holds functions, publishes the unit's own, and hands vehicles over to other managers.
    Operate,
    /// Does everything: resets, which lets stopped vehicles move again, and changes the roster and the constraints.
    Reset,
}

impl Role {
    /// The role with this name.
    pub fn named(name: &str) -> Option<Self> {
        [Self::Stop, Self::See, Self::Operate, Self::Reset].into_iter().find(|role| role.as_str() == name)
    }

    /// Its name.
    pub const fn as_str(self) -> &'static str {
        match self {
            Self::Stop => "stop",
            Self::See => "see",
            Self::Operate => "operate",
            Self::Reset => "reset",
        }
    }

    /// Whether an operator with this role may ask that of a unit.
    pub fn permit<T: Send + 'static>(
        self,
        system: &CommunicationSystem<T>,
        question: &Question,
    ) -> Result<(), Failure> {
        let needed = Self::needed(system, question);
        if self >= needed { Ok(()) } else { Err(Failure::role(self, needed)) }
    }

    fn needed<T: Send + 'static>(system: &CommunicationSystem<T>, question: &Question) -> Self {
        match question {
            Question::As { .. } | Question::Stop { .. } | Question::Unit | Question::Nodes { .. } => Self::Stop,
            Question::Search
            | Question::Functions { .. }
            | Question::Orders { .. }
            | Question::Watch
            | Question::Commands
            | Question::Stream { .. }
            | Question::Streams { .. }
            | Question::Counters { .. }
            | Question::Metrics
            | Question::Ping { .. } => Self::See,
            Question::Call(call) => Self::of_call(&attributes(system, call), call.take_over),
            Question::Hold(call) => Self::of_call(&attributes(system, call), true),
            Question::Publish { .. } | Question::HandOver { .. } => Self::Operate,
            // Without the roster a stop of all misses a node silently, and constraints decide how soon a lost one stands.
            Question::Reset { .. } | Question::Retire { .. } | Question::Set { .. } => Self::Reset,
        }
    }

    /// A function that stops can be called by whoever may stop, one that resets by nobody else than may reset.
    fn of_call(functions: &[Attributes], keeps_or_takes: bool) -> Self {
        if functions.iter().any(|function| function.reset) {
            return Self::Reset;
        }
        let only_stops =
            !functions.is_empty() && functions.iter().all(|function| function.stop && function.lease.is_none());
        if only_stops && !keeps_or_takes { Self::Stop } else { Self::Operate }
    }
}

impl fmt::Display for Role {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(self.as_str())
    }
}

/// Of the functions that a call means, as far as nodes have published them.
fn attributes<T: Send + 'static>(system: &CommunicationSystem<T>, call: &CallQuestion) -> Vec<Attributes> {
    let peers = match &call.node {
        Some(node) => select::node(system, node).into_iter().collect(),
        None => system.nodes_offering(&call.function),
    };
    let lists = peers.iter().map(|peer| peer.their_function_list());
    lists
        .filter_map(|list| {
            list.iter().find(|function| function.definition.name() == call.function).map(|found| found.attributes)
        })
        .collect()
}

/// Other users of the host who may connect to a [shared](super::Control::Shared) control socket, each with a role.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub struct Operators(BTreeMap<u32, (String, Role)>);

/// Why an operator cannot be added.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
#[non_exhaustive]
pub enum OperatorError {
    /// There is no such user.
    #[error("this host has no user '{0}' in /etc/passwd: write its name there, or its number")]
    Unknown(String),
    /// Root needs no role.
    #[error("root may do everything, whatever role it is given: leave it out")]
    Root,
    /// The user is there already.
    #[error("'{0}' and '{1}' are the same user: leave one of them out")]
    Doubled(String, String),
}

impl Operators {
    /// Adds a user, by name or by number.
    pub fn add(&mut self, user: &str, role: Role) -> Result<(), OperatorError> {
        let number = || users().into_iter().find(|(name, _)| name == user).map(|(_, uid)| uid);
        let Some(uid) = user.parse().ok().or_else(number) else { return Err(OperatorError::Unknown(user.to_owned())) };
        if uid == 0 {
            return Err(OperatorError::Root);
        }
        if let Some((other, _)) = self.0.get(&uid) {
            return Err(OperatorError::Doubled(other.clone(), user.to_owned()));
        }
        self.0.insert(uid, (user.to_owned(), role));
        Ok(())
    }

    /// The role of a user; the unit's own user and root, who could end the unit, may do everything.
    pub(super) fn role_of(&self, uid: u32) -> Option<Role> {
        if uid == own_uid() || uid == 0 {
            return Some(Role::Reset);
        }
        self.0.get(&uid).map(|(_, role)| *role)
    }
}

/// The names of users, of several the first.
pub(super) fn names_of_users() -> BTreeMap<u32, String> {
    users().into_iter().rev().map(|(name, uid)| (uid, name)).collect()
}

/// Those of this host alone: a directory service is not asked.
fn users() -> Vec<(String, u32)> {
    let listed = std::fs::read("/etc/passwd").unwrap_or_default();
    let user = |line: &str| {
        let mut words = line.split(':');
        Some((words.next()?.to_owned(), words.nth(1)?.parse().ok()?))
    };
    String::from_utf8_lossy(&listed).lines().filter_map(user).collect()
}
