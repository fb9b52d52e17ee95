//! What a vehicle offers to be driven under VDA 5050, as services of CARA, and how the gateway calls them.
//!
//! A vehicle drives from node to node. Each call that moves is an order with a lease: the vehicle moves while the gateway wants it,
//! and stops by itself when the gateway, its host or the link fails. The gateway renews orders as its loop beats, and that loop asks
//! for nothing beyond the released base.

use cara_std::{AnyCall, CallError, Error, Heart, Peer, RequestOptions, ServiceError, Variables, interface};

use crate::driver::Vehicle;
use crate::message::{Action, ActionStatus, AgvPosition, BatteryState, EStop, Edge, Node, OperatingMode, Velocity};
use crate::order::{ID_BYTES, parameters};
use crate::state::{Command, Failure, Status};

/// How long the vehicle moves on after the gateway's last sign that it wants it, in milliseconds.
pub const LEASE_MS: u64 = 600;
/// How long the vehicle may take to say how it is; the loop's heart waits meanwhile.
const PATIENCE: std::time::Duration = std::time::Duration::from_millis(250);
/// How long it may take to begin something.
const PATIENCE_TO_BEGIN: std::time::Duration = std::time::Duration::from_millis(500);

/// Codes with which a vehicle refuses a call.
pub mod refusal {
    /// A command of a higher number was taken before.
    pub const OLD_NUMBER: u16 = 1;
    /// It cannot get there.
    pub const NO_WAY: u16 = 2;
    /// It does not have this action.
    pub const NO_ACTION: u16 = 3;
}

/// The words of [`Condition::mode`], by their numbers.
pub const MODES: [OperatingMode; 5] = [
    OperatingMode::Automatic,
    OperatingMode::Semiautomatic,
    OperatingMode::Manual,
    OperatingMode::Service,
    OperatingMode::Teachin,
];
/// The words of [`Condition::e_stop`].
pub const E_STOPS: [EStop; 4] = [EStop::None, EStop::AutoAck, EStop::Manual, EStop::Remote];
/// The words of [`Condition::action_status`].
pub const ACTION_STATUSES: [ActionStatus; 4] =
    [ActionStatus::Initializing, ActionStatus::Running, ActionStatus::Finished, ActionStatus::Failed];

/// All that the gateway asks of a vehicle.
#[derive(Variables, Clone, Debug, Default, PartialEq)]
pub struct Condition {
    /// The number of the last `vda_drive` that it took; 0 since it was switched on.
    pub drive: i64,
    /// It has reached that one's node.
    pub has_arrived: bool,
    /// That one's order lives.
    pub is_ordered: bool,
    /// It moves.
    pub is_driving: bool,
    /// The number of the last `vda_act` that it took; 0 since it was switched on.
    pub action: i64,
    /// What has become of that one: an index into `ACTION_STATUSES`.
    pub action_status: i64,
    /// What it has yielded, or why it failed.
    #[size(128)]
    pub action_result: String,
    /// Where it is: x, y and the angle.
    #[unit = "m, m, rad"]
    pub position: [f64; 3],
    /// On which map; empty if it does not know where it is.
    #[size(64)]
    pub map: String,
    /// Forwards, sideways, and how fast it turns.
    #[unit = "m/s, m/s, rad/s"]
    pub velocity: [f64; 3],
    /// Since it was built.
    #[unit = "m"]
    pub driven: f64,
    /// An index into `MODES`.
    pub mode: i64,
    /// Of a full battery.
    #[unit = "%"]
    pub charge: f64,
    /// Its battery is being charged.
    pub is_charging: bool,
    /// By its safety controller: an index into `E_STOPS`.
    pub e_stop: i64,
    /// By its safety controller.
    pub field_violation: bool,
}

/// A vehicle that is driven under VDA 5050. Numbers of commands rise; a vehicle does each number once, and refuses one that is lower
/// than the last.
#[interface]
pub trait Guided {
    /// What its port knows an order by.
    type Order;

    /// Drives over an edge to its end node and stands there, while its caller wants it. With the number of the last call it goes on
    /// to the same node, or has arrived already. `given` says whether x and y, and the angle, are given; `deviation` is the node's,
    /// 0 where it has none; a speed of 0 is no limit.
    #[actuator(drive)]
    #[lease(ms = 600)]
    #[allow(clippy::too_many_arguments, reason = "each is a variable of the service")]
    fn vda_drive(
        &mut self,
        call: &impl AnyCall<Order = Self::Order>,
        number: i64,
        #[size(64)] edge: &str,
        #[size(64)] node: &str,
        #[size(64)] map: &str,
        #[unit = "m, m, rad"] position: [f64; 3],
        given: [bool; 2],
        #[unit = "m, rad"] deviation: [f64; 2],
        #[unit = "m/s"] max_speed: f64,
    ) -> Result<(), ServiceError>;

    /// Begins an action, which goes on while its caller wants it. With the number of the last call it changes nothing. `details` are its
    /// parameters, a JSON object, or nothing.
    #[actuator(handling)]
    #[lease(ms = 600)]
    fn vda_act(
        &mut self,
        call: &impl AnyCall<Order = Self::Order>,
        number: i64,
        #[size(64)] id: &str,
        #[size(64)] kind: &str,
        #[size(1024)] details: &str,
    ) -> Result<(), ServiceError>;

    /// Takes this for where it is.
    #[idempotent]
    fn vda_init(&mut self, #[unit = "m, m, rad"] position: [f64; 3], #[size(64)] map: &str)
    -> Result<(), ServiceError>;

    /// Tells how it is.
    #[idempotent]
    fn vda_condition(&mut self) -> Condition;
}

/// A vehicle behind a link of CARA.
#[derive(Debug)]
pub struct Linked {
    peer: Peer,
    heart: Heart,
    /// Nothing is renewed any more.
    is_given_up: bool,
}

impl Linked {
    /// What moves is renewed as the heart beats.
    pub const fn new(peer: Peer, heart: Heart) -> Self {
        Self { peer, heart, is_given_up: false }
    }

    /// The gateway's loop has come round.
    pub fn beat(&mut self) {
        if !self.is_given_up {
            self.heart.beat();
        }
    }

    /// While the record cannot be written, no stop may wait for it: the vehicle stops by its lease.
    pub const fn give_up(&mut self, is_given_up: bool) {
        self.is_given_up = is_given_up;
    }
}

impl Vehicle for Linked {
    fn status(&mut self) -> Result<Option<Status>, Failure> {
        if !self.peer.is_connected() || self.peer.function("vda_condition").is_none() {
            return Ok(None);
        }
        let options = RequestOptions { timeout: Some(PATIENCE.into()), ..RequestOptions::new() };
        let condition = GuidedClient::at(&self.peer).with(options).vda_condition().wait();
        self.beat();
        let condition = condition.map_err(|error| failure(&error))?;
        let latch = self.peer.actuator_state("vda_drive").and_then(|state| state.latch);
        let boot = self.peer.epoch().map_or(0, |epoch| epoch.0);
        let stopped = latch.map(|latch| format!("stopped by {}, reason {}", latch.by, latch.reason));
        Ok(Some(Status { stopped, boot, ..status(condition) }))
    }

    fn tell(&mut self, command: &Command) -> Result<(), Failure> {
        let options = RequestOptions { timeout: Some(PATIENCE_TO_BEGIN.into()), ..RequestOptions::new() };
        let asked = GuidedClient::at(&self.peer).with(options);
        let answer = match command {
            Command::Drive { number, edge, node } => {
                let (position, given, deviation, map) = target(node);
                let client = asked.renewing(self.heart.renew());
                let Edge { edge_id, max_speed, .. } = &**edge;
                let (number, speed) = (signed(*number), max_speed.unwrap_or(0.0));
                client.vda_drive(number, edge_id, &node.node_id, map, position, given, deviation, speed).wait()
            }
            Command::Act { number, action } => {
                let client = asked.renewing(self.heart.renew());
                let Action { action_id, action_type, .. } = action;
                client.vda_act(signed(*number), action_id, action_type, &parameters(action)).wait()
            }
            Command::InitPosition { action } => {
                let (position, map) = initial(action)?;
                asked.vda_init(position, map).wait()
            }
            Command::Halt => return released(self.peer.release("vda_drive")),
            Command::EndAction { .. } => return released(self.peer.release("vda_act")),
        };
        self.beat();
        answer.map_err(|error| failure(&error))
    }
}

fn signed(number: u64) -> i64 {
    i64::try_from(number).unwrap_or(i64::MAX)
}

/// What is not there has nothing to give up.
fn released(answer: Result<(), Error>) -> Result<(), Failure> {
    match answer {
        Ok(()) | Err(Error::NotConnected | Error::UnknownFunction) => Ok(()),
        Err(error) => Err(Failure::Lost(error.to_string())),
    }
}

fn failure(error: &CallError) -> Failure {
    match error.error {
        Error::Inhibited { .. } => Failure::Stopped(error.to_string()),
        _ if error.code().is_some() => Failure::Refused(error.to_string()),
        _ => Failure::Lost(error.to_string()),
    }
}

type Target<'n> = ([f64; 3], [bool; 2], [f64; 2], &'n str);

fn target(node: &Node) -> Target<'_> {
    let Some(at) = &node.node_position else { return ([0.0; 3], [false; 2], [0.0; 2], "") };
    let deviation = [at.allowed_deviation_xy, at.allowed_deviation_theta].map(Option::unwrap_or_default);
    ([at.x, at.y, at.theta.unwrap_or(0.0)], [true, at.theta.is_some()], deviation, &at.map_id)
}

/// Parameters of `initPosition` (6.8.1).
fn initial(action: &Action) -> Result<([f64; 3], &str), Failure> {
    let value = |key: &str| {
        let of_key = action.action_parameters.iter().flatten().find(|parameter| parameter.key == key);
        of_key.map(|parameter| &parameter.value).ok_or_else(|| Failure::Refused(format!("{key} is missing")))
    };
    let number = |key: &str| value(key)?.as_f64().ok_or_else(|| Failure::Refused(format!("{key} is no number")));
    let map = value("mapId")?.as_str().filter(|map| map.len() <= ID_BYTES);
    let map = map.ok_or_else(|| Failure::Refused("mapId is no text of 64 bytes at most".into()))?;
    Ok(([number("x")?, number("y")?, number("theta")?], map))
}

fn word<T: Copy>(words: &[T], index: i64, other: T) -> T {
    usize::try_from(index).ok().and_then(|index| words.get(index)).copied().unwrap_or(other)
}

fn status(condition: Condition) -> Status {
    let unsigned = |number: i64| u64::try_from(number).unwrap_or(0);
    let [x, y, theta] = condition.position;
    let [vx, vy, omega] = condition.velocity.map(Some);
    let at = AgvPosition { x, y, theta, map_id: condition.map, position_initialized: true, ..AgvPosition::default() };
    Status {
        drive: unsigned(condition.drive),
        has_arrived: condition.has_arrived,
        is_ordered: condition.is_ordered,
        is_driving: condition.is_driving,
        action: unsigned(condition.action),
        action_status: word(&ACTION_STATUSES, condition.action_status, ActionStatus::Failed),
        action_result: condition.action_result,
        position: Some(at)
            .filter(|at| !at.map_id.is_empty() && at.x.is_finite() && at.y.is_finite() && at.theta.is_finite()),
        velocity: Some(Velocity { vx, vy, omega }),
        driven: condition.driven,
        stopped: None,
        // What is not known is not automatic.
        mode: word(&MODES, condition.mode, OperatingMode::Manual),
        battery: BatteryState {
            battery_charge: condition.charge,
            charging: condition.is_charging,
            ..BatteryState::default()
        },
        e_stop: word(&E_STOPS, condition.e_stop, EStop::Manual),
        field_violation: condition.field_violation,
        boot: 0,
    }
}
