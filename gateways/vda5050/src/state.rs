//! What is known of a vehicle and its order: what outlives the program, what the vehicle says, and the state that follows (6.10).

use serde::{Deserialize, Serialize};

use crate::actions::Entry;
use crate::errors::{Kind, Refusal};
use crate::message::{
    Action, ActionStatus, AgvPosition, BatteryState, EStop, Edge, EdgeState, Error, Load, MapState, Node, NodeState,
    OperatingMode, Report, SafetyState, Velocity,
};
use crate::order::Capabilities;
use crate::version::Version;

/// What outlives the program.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
#[serde(default)]
pub struct Record {
    /// The order that was taken last; empty before the first.
    pub order_id: String,
    /// Its last update.
    pub order_update_id: u32,
    /// A digest of that message; none in a record of a gateway that did not compare.
    pub content: Option<u64>,
    /// Its zones.
    pub zone_set_id: Option<String>,
    /// It was cancelled, or is being.
    pub is_cancelled: bool,
    /// Since the order ended, `initPosition` has said at which node the vehicle is.
    pub is_placed: bool,
    /// The last node that was traversed; empty before the first.
    pub last_node_id: String,
    /// Its sequence id.
    pub last_node_sequence_id: u32,
    /// Still to be traversed, the horizon included.
    pub nodes: Vec<Node>,
    /// The edges to them; one less if the first node of an order is among them.
    pub edges: Vec<Edge>,
    /// Of the order, in its sequence, and those at once.
    pub actions: Vec<Entry>,
    /// What is reported until the next order.
    pub errors: Vec<Error>,
    /// No driving until `stopPause`.
    pub is_paused: bool,
    /// The number of the last command to the vehicle. It never takes a lower one.
    pub number: u64,
    /// The number under which the vehicle drives to the first of `nodes`.
    pub drive: Option<u64>,
    /// How many of `nodes` the vehicle has been told of, with that number and those that follow.
    pub told: usize,
    /// The last number that the vehicle has agreed to drive.
    pub taken: u64,
    /// By topic: the header ids below this one may have been used.
    pub header_ids: [u32; 4],
    /// Ids of instant actions and orders that are over: a late copy of one does nothing. The oldest go.
    pub spent: Vec<String>,
}

/// What the vehicle says of itself.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Status {
    /// The number of the edge that it drives over, or has driven over last.
    pub drive: u64,
    /// It stands at that one's node, and has no further one.
    pub has_arrived: bool,
    /// Its order to drive lives.
    pub is_ordered: bool,
    /// It moves.
    pub is_driving: bool,
    /// The action that it took last.
    pub action: u64,
    /// What has become of that one.
    pub action_status: ActionStatus,
    /// What it has yielded, or why it failed.
    pub action_result: String,
    /// Where it is, if it knows.
    pub position: Option<AgvPosition>,
    /// How fast it moves.
    pub velocity: Option<Velocity>,
    /// Metres since it was built.
    pub driven: f64,
    /// Why it does not drive until it is reset, if so.
    pub stopped: Option<String>,
    /// Who is in control of it.
    pub mode: OperatingMode,
    /// Its battery.
    pub battery: BatteryState,
    /// What it carries, if it knows.
    pub loads: Option<Vec<Load>>,
    /// By its safety controller only.
    pub e_stop: EStop,
    /// By its safety controller only.
    pub field_violation: bool,
    /// This boot of it.
    pub boot: u64,
}

/// What the vehicle is to be told. Commands with a number may be repeated: the vehicle does each number once.
#[derive(Clone, Debug, PartialEq)]
pub enum Command {
    /// Drive over edges, each to its node, and stand at the last one.
    Drive {
        /// Of the first edge; those behind it have the numbers that follow.
        number: u64,
        /// Over which, to which.
        legs: Vec<(Edge, Node)>,
        /// It drives already, and goes on by what it was told before if it refuses this.
        goes_on: bool,
    },
    /// The order to drive is given up: it stops.
    Halt,
    /// Begin an action.
    Act {
        /// Of this command.
        number: u64,
        /// Which.
        action: Action,
    },
    /// The action of a number is given up.
    EndAction {
        /// Which.
        number: u64,
    },
    /// Take this for where it is.
    InitPosition {
        /// The instant action.
        action: Action,
    },
}

impl Command {
    /// Whether it only makes something stop.
    pub const fn is_stop(&self) -> bool {
        matches!(self, Self::Halt | Self::EndAction { .. })
    }

    /// For people.
    pub const fn word(&self) -> &'static str {
        match self {
            Self::Drive { .. } => "drive",
            Self::Halt => "halt",
            Self::Act { .. } => "act",
            Self::EndAction { .. } => "end an action",
            Self::InitPosition { .. } => "initPosition",
        }
    }
}

/// What it does when the broker is away.
#[derive(Clone, Copy, Debug, PartialEq, Deserialize, Serialize)]
#[serde(rename_all = "kebab-case", deny_unknown_fields, tag = "do")]
pub enum OnBrokerLoss {
    /// The standard's way (6.2): on to the last released node, within limits.
    FinishBase {
        /// At most so long.
        seconds: f64,
        /// At most so far.
        metres: f64,
    },
    /// It stops at once.
    Stop,
}

/// How a gateway behaves.
#[derive(Clone, Debug)]
pub struct Policy {
    /// What it speaks.
    pub version: Version,
    /// What the vehicle can do.
    pub can: Capabilities,
    /// Without a broker.
    pub on_broker_loss: OnBrokerLoss,
    /// A vehicle that stood because the broker was away goes on by itself when it is back, without `stopPause`.
    pub resumes_by_itself: bool,
    /// Actions that the vehicle runs side by side.
    pub actions_at_once: usize,
}

/// Why the vehicle did not do something.
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum Failure {
    /// It has answered that it does not.
    Refused(String),
    /// What moves is stopped until it is reset.
    Stopped(String),
    /// There was no answer: it may have been done.
    Lost(String),
}

impl std::fmt::Display for Failure {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        let (Self::Refused(why) | Self::Stopped(why) | Self::Lost(why)) = self;
        f.write_str(why)
    }
}

/// By what a copy of an instant action is known.
pub(crate) fn copy_of(id: &str, message: &str) -> String {
    format!("{id} {message}")
}

impl Record {
    /// An order or an instant action is over.
    pub(crate) fn spend(&mut self, id: String) {
        /// Most that are remembered.
        const SPENT: usize = 256;
        self.spent.push(id);
        self.spent.drain(..self.spent.len().saturating_sub(SPENT));
    }

    /// The same of an action at once: neither its id nor its message counts again.
    pub(crate) fn spend_action(&mut self, entry: Entry) {
        self.spend(copy_of(&entry.action.action_id, &entry.message));
        self.spend(entry.action.action_id);
    }

    /// Whether the order has nodes left or actions that have not ended; those at once do not count.
    pub(crate) fn is_order_open(&self) -> bool {
        !self.nodes.is_empty() || self.actions.iter().any(|entry| entry.is_of_order() && !entry.status.has_ended())
    }

    /// What the state says; `is_held` where the vehicle stands because the broker is away.
    pub fn report(&self, status: &Status, maps: &[String], version: Version, is_held: bool) -> Report {
        let node = |node: &Node| NodeState {
            node_id: node.node_id.clone(),
            sequence_id: node.sequence_id,
            released: node.released,
            node_description: node.node_description.clone(),
            node_position: node.node_position.clone().map(|at| at.reported(version)),
        };
        let edge = |edge: &Edge| EdgeState {
            edge_id: edge.edge_id.clone(),
            sequence_id: edge.sequence_id,
            released: edge.released,
            edge_description: edge.edge_description.clone(),
            trajectory: edge.trajectory.clone(),
        };
        let mut errors = self.errors.clone();
        errors.extend(status.stopped.as_ref().map(|why| Refusal::new(Kind::VehicleStopped, why).error(version)));
        let has_horizon = self.nodes.iter().any(|node| !node.released);
        let base = self.nodes.iter().filter(|node| node.released).count();
        let map = |id: &String| MapState { map_id: id.clone(), map_version: "1".into(), ..MapState::default() };
        // Those at once are behind those of the order.
        let (of_order, at_once): (Vec<&Entry>, Vec<&Entry>) =
            self.actions.iter().partition(|entry| entry.is_of_order());
        let states = |entries: &[&Entry]| entries.iter().map(|entry| entry.state()).collect::<Vec<_>>();
        let (mut action_states, mut instant_action_states) = (states(&of_order), Some(states(&at_once)));
        if !version.rules().lists_instant_actions {
            action_states.extend(instant_action_states.take().into_iter().flatten());
        }
        Report {
            order_id: self.order_id.clone(),
            order_update_id: self.order_update_id,
            zone_set_id: self.zone_set_id.clone(),
            last_node_id: self.last_node_id.clone(),
            last_node_sequence_id: self.last_node_sequence_id,
            driving: status.is_driving,
            operating_mode: status.mode,
            node_states: self.nodes.iter().map(node).collect(),
            edge_states: self.edges.iter().map(edge).collect(),
            action_states,
            instant_action_states,
            battery_state: status.battery.clone(),
            errors,
            safety_state: SafetyState { e_stop: status.e_stop, field_violation: status.field_violation }
                .reported(version),
            maps: (!maps.is_empty()).then(|| maps.iter().map(map).collect()),
            paused: Some(self.is_paused || is_held),
            new_base_request: Some(has_horizon && base <= 1 && !self.is_cancelled),
            distance_since_last_node: None,
            agv_position: status.position.clone(),
            velocity: status.velocity.clone(),
            loads: status.loads.clone(),
            information: None,
        }
    }
}
