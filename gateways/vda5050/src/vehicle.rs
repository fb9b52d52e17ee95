//! What a vehicle offers to be driven under VDA 5050, as services of CARA, and how the gateway calls them.
//!
//! A vehicle drives over a stretch of the released base. Each call that moves is an order with a lease: the vehicle moves while the gateway wants it,
//! and stops by itself when the gateway, its host or the link fails. The gateway renews orders as its loop beats, and that loop asks
//! for nothing beyond the released base.

use std::pin::pin;
use std::sync::Arc;
use std::task::{Context, Poll, Wake, Waker};
use std::thread::Thread;
use std::time::{Duration, Instant};

use cara_std::{AnyCall, CallError, Error, Heart, Peer, RequestOptions, ServiceError, Variables, interface};

use crate::driver::Vehicle;
use crate::message::{Action, ActionStatus, AgvPosition, BatteryState, EStop, Load, OperatingMode, Velocity};
use crate::order::{ID_BYTES, parameters};
use crate::state::{Command, Failure, Status};
use crate::stretch::{LEGS, NAMES_BYTES, Stretch, of_order};

/// How long the vehicle moves on after the gateway's last sign that it wants it, in milliseconds.
pub const LEASE_MS: u64 = 600;
/// How long the vehicle may take to say how it is.
const PATIENCE: Duration = Duration::from_millis(250);
/// What it carries is asked so often, if no action ends.
const EQUIPMENT_ASKED: Duration = Duration::from_secs(2);
/// How long it may take to begin something.
const PATIENCE_TO_BEGIN: Duration = Duration::from_millis(500);
/// The loop beats so often while it waits for an answer or for the disk.
pub(crate) const BEAT: Duration = Duration::from_millis(20);
/// And for so long in one turn: what stops the vehicle is heard between two turns.
const LONGEST_TURN: Duration = Duration::from_secs(1);

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
    /// The number of the edge that it drives over, or has driven over last; 0 since it was switched on.
    pub drive: i64,
    /// It stands at that one's node, and has no further one.
    pub has_arrived: bool,
    /// Its order to drive lives.
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

    /// Drives over edges, past their end nodes, and stands at the last one, while its caller wants it. The first edge has this number,
    /// the next ones those that follow. What it is told replaces what it was told before: an edge that it drives over it goes on with,
    /// and those that it has driven over it skips. `Stretch` reads the variables.
    /// Each call is an order: so that there is no gap between two, the motors' loop asks `Actuator::watch`, and the safe hook ends
    /// what the order before wanted. One that is refused has ended the order before as well: the vehicle stops. So that it is asked
    /// before it is told more under way, it is `Consulted` too.
    #[actuator(drive)]
    #[lease(ms = 600)]
    #[allow(clippy::too_many_arguments, reason = "each is a variable of the service")]
    fn vda_drive(
        &mut self,
        call: &impl AnyCall<Order = Self::Order>,
        number: i64,
        count: i64,
        #[size(192)] edges: &str,
        #[size(192)] nodes: &str,
        #[size(64)] map: &str,
        #[unit = "m, m, rad"] positions: [f64; 24],
        given: [bool; 16],
        #[unit = "m, rad"] deviations: [f64; 16],
        #[unit = "m/s"] max_speeds: [f64; 8],
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
        #[size(768)] details: &str,
    ) -> Result<(), ServiceError>;

    /// Takes this for where it is.
    #[idempotent]
    fn vda_init(&mut self, #[unit = "m, m, rad"] position: [f64; 3], #[size(64)] map: &str)
    -> Result<(), ServiceError>;

    /// Tells how it is.
    #[idempotent]
    fn vda_condition(&mut self) -> Condition;
}

/// A vehicle that is asked under way, before it is told to drive further. Not every one offers this.
#[interface]
pub trait Consulted {
    /// Whether it would take this for `vda_drive` now. It changes nothing, and what it drives goes on.
    #[idempotent]
    #[allow(clippy::too_many_arguments, reason = "those of the service that it is asked about")]
    fn vda_can_drive(
        &mut self,
        number: i64,
        count: i64,
        #[size(192)] edges: &str,
        #[size(192)] nodes: &str,
        #[size(64)] map: &str,
        #[unit = "m, m, rad"] positions: [f64; 24],
        given: [bool; 16],
        #[unit = "m, rad"] deviations: [f64; 16],
        #[unit = "m/s"] max_speeds: [f64; 8],
    ) -> Result<(), ServiceError>;
}

/// What it carries, and more of its battery. What it does not know is NaN, or a count of -1.
#[derive(Variables, Clone, Debug, PartialEq)]
pub struct Equipment {
    /// How many loads it carries, 8 at most.
    pub loads: i64,
    /// Their identifiers, one a line; an empty line where it is not known.
    #[size(192)]
    pub load_ids: String,
    /// Their types.
    #[size(192)]
    pub load_types: String,
    /// Where on the vehicle each one is.
    #[size(192)]
    pub load_positions: String,
    /// Their weights.
    #[unit = "kg"]
    pub load_weights: [f64; 8],
    /// Of the battery.
    #[unit = "V"]
    pub voltage: f64,
    /// Of a new battery.
    #[unit = "%"]
    pub health: f64,
    /// How far it gets.
    #[unit = "m"]
    pub reach: f64,
}

impl Default for Equipment {
    fn default() -> Self {
        let [load_ids, load_types, load_positions] = Default::default();
        let (loads, unknown) = (-1, f64::NAN);
        let (load_weights, voltage, health, reach) = ([unknown; 8], unknown, unknown, unknown);
        Self { loads, load_ids, load_types, load_positions, load_weights, voltage, health, reach }
    }
}

impl Equipment {
    /// With these loads. A name for which there is no space is left out.
    pub fn carrying(loads: &[Load]) -> Self {
        let loads = &loads[..loads.len().min(LEGS)];
        let lines = |of: fn(&Load) -> &Option<String>| {
            let mut lines = String::new();
            for (index, load) in loads.iter().enumerate() {
                let name = of(load).as_deref().unwrap_or_default();
                if lines.len() + name.len() + loads.len() - index <= NAMES_BYTES {
                    lines.push_str(name);
                }
                lines.push('\n');
            }
            lines.pop();
            lines
        };
        let mut load_weights = [f64::NAN; 8];
        load_weights.iter_mut().zip(loads).for_each(|(to, load)| *to = load.weight.unwrap_or(f64::NAN));
        let (load_ids, load_types) = (lines(|load| &load.load_id), lines(|load| &load.load_type));
        let load_positions = lines(|load| &load.load_position);
        Self { loads: loads.len() as i64, load_ids, load_types, load_positions, load_weights, ..Self::default() }
    }

    fn report(&self, status: &mut Status) {
        let known = |value: f64| Some(value).filter(|value| value.is_finite());
        let line =
            |text: &str, index: usize| text.split('\n').nth(index).filter(|line| !line.is_empty()).map(str::to_owned);
        let load = |index: usize| Load {
            load_id: line(&self.load_ids, index),
            load_type: line(&self.load_types, index),
            load_position: line(&self.load_positions, index),
            weight: known(self.load_weights[index]),
            ..Load::default()
        };
        status.loads = usize::try_from(self.loads).ok().map(|count| (0..count.min(LEGS)).map(load).collect());
        let battery = &mut status.battery;
        (battery.battery_voltage, battery.battery_health) = (known(self.voltage), known(self.health));
        battery.reach = known(self.reach);
    }
}

/// A vehicle that carries something, or knows more of its battery. Not every one offers this.
#[interface]
pub trait Equipped {
    /// Tells what it carries and how its battery is.
    #[idempotent]
    fn vda_equipment(&mut self) -> Equipment;
}

/// A vehicle behind a link of CARA.
#[derive(Debug)]
pub struct Linked {
    peer: Peer,
    heart: Heart,
    equipment: Equipment,
    /// When that was asked, and what the vehicle had done then.
    asked: Option<(Instant, u64, ActionStatus)>,
    /// Nothing is renewed any more.
    is_given_up: bool,
    /// When the loop came round.
    turned: Instant,
}

impl Linked {
    /// What moves is renewed as the heart beats.
    pub fn new(peer: Peer, heart: Heart) -> Self {
        Self { peer, heart, equipment: Equipment::default(), asked: None, is_given_up: false, turned: Instant::now() }
    }

    /// Asks what it carries: now and then, and when an action has changed that, so that a state never shows the one without the other.
    fn ask_equipment(&mut self, status: &mut Status) {
        if self.peer.function("vda_equipment").is_none() {
            return;
        }
        let is_news = self.asked.is_none_or(|(at, action, how)| {
            at.elapsed() >= EQUIPMENT_ASKED || (action, how) != (status.action, status.action_status)
        });
        if is_news {
            let options = RequestOptions { timeout: Some(PATIENCE.into()), ..RequestOptions::new() };
            let peer = self.peer.clone();
            let answer = answered(EquippedClient::at(&peer).with(options).vda_equipment(), || self.beat());
            // Without an answer it is what it was: a vehicle is not lost for that.
            self.equipment = answer.unwrap_or_else(|_| self.equipment.clone());
            self.asked = Some((Instant::now(), status.action, status.action_status));
        }
        self.equipment.report(status);
    }

    /// The gateway's loop has come round.
    pub fn turn(&mut self) {
        self.turned = Instant::now();
        self.beat();
    }

    /// While the record cannot be written, no stop may wait for it: the vehicle stops by its lease.
    pub const fn give_up(&mut self, is_given_up: bool) {
        self.is_given_up = is_given_up;
    }
}

impl Vehicle for Linked {
    fn beat(&mut self) {
        if !self.is_given_up && self.turned.elapsed() < LONGEST_TURN {
            self.heart.beat();
        }
    }

    fn status(&mut self) -> Result<Option<Status>, Failure> {
        if !self.peer.is_connected() || self.peer.function("vda_condition").is_none() {
            return Ok(None);
        }
        let options = RequestOptions { timeout: Some(PATIENCE.into()), ..RequestOptions::new() };
        let peer = self.peer.clone();
        let condition = answered(GuidedClient::at(&peer).with(options).vda_condition(), || self.beat());
        let condition = condition.map_err(|error| failure(&error))?;
        let latch = self.peer.actuator_state("vda_drive").and_then(|state| state.latch);
        let boot = self.peer.epoch().map_or(0, |epoch| epoch.0);
        let stopped = latch.map(|latch| format!("stopped by {}, reason {}", latch.by, latch.reason));
        let mut status = Status { stopped, boot, ..status(condition) };
        self.ask_equipment(&mut status);
        Ok(Some(status))
    }

    fn tell(&mut self, command: &Command) -> Result<(), Failure> {
        let options = RequestOptions { timeout: Some(PATIENCE_TO_BEGIN.into()), ..RequestOptions::new() };
        let peer = self.peer.clone();
        let asked = GuidedClient::at(&peer).with(options);
        let answer = match command {
            Command::Drive { number, legs, goes_on } => {
                let (stretch, [edges, nodes], map) = of_order(signed(*number), legs);
                let Stretch { number, count, positions, given, deviations, max_speeds, .. } = stretch;
                let mut left = PATIENCE_TO_BEGIN;
                // A vehicle that refuses the call itself has stopped by then.
                if *goes_on && self.peer.function("vda_can_drive").is_some() {
                    let (since, options) =
                        (Instant::now(), RequestOptions { timeout: Some(PATIENCE.into()), ..options });
                    let client = ConsultedClient::at(&peer).with(options);
                    let call = client
                        .vda_can_drive(number, count, &edges, &nodes, map, positions, given, deviations, max_speeds);
                    // Without an answer it goes on by what it has, too.
                    answered(call, || self.beat()).map_err(|error| Failure::Refused(error.to_string()))?;
                    left = left.saturating_sub(since.elapsed());
                }
                let client = asked.with(RequestOptions { timeout: Some(left.into()), ..options });
                let client = client.renewing(self.heart.renew());
                let call =
                    client.vda_drive(number, count, &edges, &nodes, map, positions, given, deviations, max_speeds);
                answered(call, || self.beat())
            }
            Command::Act { number, action } => {
                let client = asked.renewing(self.heart.renew());
                let Action { action_id, action_type, .. } = action;
                let details = parameters(action);
                answered(client.vda_act(signed(*number), action_id, action_type, &details), || self.beat())
            }
            Command::InitPosition { action } => {
                let (position, map) = initial(action)?;
                answered(asked.vda_init(position, map), || self.beat())
            }
            Command::Halt => return released(self.peer.release("vda_drive")),
            Command::EndAction { .. } => return released(self.peer.release("vda_act")),
        };
        answer.map_err(|error| failure(&error))
    }
}

/// Waits for an answer, and beats meanwhile: a slow one must not end a lease.
fn answered<C: IntoFuture>(call: C, mut beat: impl FnMut()) -> C::Output {
    struct Unpark(Thread);
    impl Wake for Unpark {
        fn wake(self: Arc<Self>) {
            self.0.unpark();
        }
    }
    let mut reply = pin!(call.into_future());
    let waker = Waker::from(Arc::new(Unpark(std::thread::current())));
    loop {
        let answer = reply.as_mut().poll(&mut Context::from_waker(&waker));
        beat();
        if let Poll::Ready(answer) = answer {
            return answer;
        }
        std::thread::park_timeout(BEAT);
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
        // Sent again it would be as long.
        Error::TooLarge { .. } => Failure::Refused(error.to_string()),
        _ if error.code().is_some() => Failure::Refused(error.to_string()),
        _ => Failure::Lost(error.to_string()),
    }
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
    // JSON has no NaN: what is not known is left out, and a charge that is not known is none.
    let [vx, vy, omega] = condition.velocity.map(|speed| Some(speed).filter(|speed| speed.is_finite()));
    let charge = Some(condition.charge).filter(|charge| charge.is_finite()).unwrap_or(0.0);
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
        battery: BatteryState { battery_charge: charge, charging: condition.is_charging, ..BatteryState::default() },
        loads: None,
        e_stop: word(&E_STOPS, condition.e_stop, EStop::Manual),
        field_violation: condition.field_violation,
        boot: 0,
    }
}

#[cfg(test)]
mod tests {
    use std::cell::Cell;
    use std::future::poll_fn;
    use std::task::Poll;

    use super::{Condition, Equipment, answered, status};
    use crate::message::Load;
    use crate::version::Version;

    /// The answer comes once the loop has beaten a few times, and nothing else wakes it.
    #[test]
    fn the_loop_beats_while_it_waits_for_an_answer() {
        let beats = Cell::new(0);
        let answer = poll_fn(|_| if beats.get() < 5 { Poll::Pending } else { Poll::Ready("answer") });
        assert_eq!(answered(answer, || beats.set(beats.get() + 1)), "answer");
        assert_eq!(beats.get(), 6);
    }

    /// A sensor that has nothing to say makes no state that a master cannot read.
    #[test]
    fn what_is_not_a_number_is_not_reported() {
        let nothing = f64::NAN;
        let condition = Condition {
            position: [nothing; 3],
            map: "hall".into(),
            velocity: [nothing; 3],
            charge: nothing,
            ..Condition::default()
        };
        let mut status = status(condition);
        Equipment { load_weights: [nothing; 8], loads: 99, ..Equipment::default() }.report(&mut status);
        let record = crate::state::Record::default();
        let text = serde_json::to_string(&record.report(&status, &[], Version::V2, false)).unwrap();
        assert!(!text.contains("null") && status.position.is_none(), "{text}");
        assert_eq!(status.loads.map(|loads| loads.len()), Some(8));
    }

    #[test]
    fn loads_are_read_as_they_were_told() {
        let load = |id: &str, weight| Load { load_id: Some(id.into()), weight, ..Load::default() };
        let loads = vec![load("pallet-7", Some(12.5)), Load::default(), load("box", None)];
        let mut status = status(Condition::default());
        Equipment::carrying(&loads).report(&mut status);
        assert_eq!(status.loads, Some(loads));
        Equipment::default().report(&mut status);
        assert_eq!(status.loads, None, "it does not know");
        // Names that do not fit are left out, and no load is.
        Equipment::carrying(&vec![load(&"x".repeat(64), None); 9]).report(&mut status);
        let named = status.loads.unwrap().into_iter().map(|load| load.load_id.is_some()).collect::<Vec<_>>();
        assert_eq!(named, [true, true, false, false, false, false, false, false]);
    }
}
