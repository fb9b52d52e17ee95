//! The actions of an order and those at once: when each begins, and what has become of it (6.8, 6.11, 6.12).

use serde::{Deserialize, Serialize};

use crate::message::{Action, ActionState, ActionStatus};

/// Where an action stands.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub enum Place {
    /// At a node, by its sequence id.
    Node(u32),
    /// On an edge, by its sequence id.
    Edge(u32),
    /// In no order.
    Instant,
}

/// An action and what has become of it.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct Entry {
    /// As it was sent.
    pub action: Action,
    /// Where it stands.
    pub place: Place,
    /// Of an action at once: which message it came in, as some masters use an id again.
    #[serde(default)]
    pub message: String,
    /// What is reported.
    pub status: ActionStatus,
    /// What it has yielded, or why it failed.
    pub result: Option<String>,
    /// Its node was traversed or its edge entered: it may begin.
    pub is_triggered: bool,
    /// Under which number the vehicle was told to begin; 0 before.
    pub number: u64,
    /// The boot of the vehicle to which that was said.
    pub boot: u64,
    /// The vehicle is to end it, and how it counts then.
    pub ends_as: Option<ActionStatus>,
    /// This program has told the vehicle to begin, on this link.
    #[serde(skip)]
    pub is_sent: bool,
    /// This program has told the vehicle to end it.
    #[serde(skip)]
    pub is_end_sent: bool,
}

impl Entry {
    /// One that waits.
    pub const fn new(action: Action, place: Place) -> Self {
        Self {
            action,
            place,
            message: String::new(),
            status: ActionStatus::Waiting,
            result: None,
            is_triggered: false,
            number: 0,
            boot: 0,
            ends_as: None,
            is_sent: false,
            is_end_sent: false,
        }
    }

    /// Is over.
    pub fn end(&mut self, status: ActionStatus, result: Option<String>) {
        self.status = status;
        self.result = result.filter(|result| !result.is_empty());
        self.ends_as = None;
    }

    /// Whether it is of the order, and not an action at once.
    pub fn is_of_order(&self) -> bool {
        self.place != Place::Instant
    }

    /// Whether it is an action at once that the vehicle does, and not the gateway.
    pub fn is_of_vehicle_at_once(&self) -> bool {
        self.place == Place::Instant && self.is_triggered
    }

    /// Whether it runs on the vehicle, or may.
    pub const fn runs(&self) -> bool {
        self.number != 0 && !self.status.has_ended()
    }

    /// As the state reports it.
    pub fn state(&self) -> ActionState {
        ActionState {
            action_id: self.action.action_id.clone(),
            action_status: self.status,
            action_type: Some(self.action.action_type.clone()),
            action_description: self.action.action_description.clone(),
            result_description: self.result.clone(),
        }
    }
}

/// The one to begin next, if one may begin: figure 17. What stands before it in the list began before it.
///
/// `at_once` is how many the vehicle runs side by side. Actions that the gateway itself does are not among them.
pub fn startable(entries: &[Entry], at_once: usize) -> Option<usize> {
    let mut running = 0;
    let runs = entries.iter().filter(|entry| entry.runs()).count();
    for (index, entry) in entries.iter().enumerate() {
        if !entry.is_triggered || entry.status.has_ended() {
            continue;
        }
        let is_alone = entry.action.blocking_type.is_alone();
        if entry.number == 0 {
            // One that runs alone waits for those before it, and those behind it wait for it.
            let may = runs < at_once && (!is_alone || running == 0 && runs == 0);
            if may {
                return Some(index);
            }
        }
        if is_alone {
            return None;
        }
        running += 1;
    }
    None
}

/// Whether the vehicle stands still for an action that runs or is due.
pub fn block_driving(entries: &[Entry]) -> bool {
    let blocks = |entry: &&Entry| entry.is_triggered && !entry.status.has_ended();
    entries.iter().filter(blocks).any(|entry| entry.action.blocking_type.blocks_driving())
}
