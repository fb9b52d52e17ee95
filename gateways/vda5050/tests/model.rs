//! Random sequences of orders, updates, cancels, pauses, modes, losses, restarts, duplicates and late messages: 2,000 by default,
//! and as many as `CARA_TEST_SEQUENCES` says; with the rules of 3.0 a quarter of them.

mod fake;

use std::collections::BTreeMap;

use cara_vda5050::machine::Machine;
use cara_vda5050::message::{Action, ActionStatus, BlockingType, InstantActions, OperatingMode, Order, read, write};
use cara_vda5050::state::{OnBrokerLoss, Policy, Record};
use cara_vda5050::version::Version;
use fake::{Pair, instant, order, policy};
use serde_json::{Value, json};

/// What is sent, and may come again later.
#[derive(Clone)]
enum Sent {
    Order(Order),
    Instant(InstantActions),
}

struct World {
    rng: fastrand::Rng,
    pair: Pair,
    policy: Policy,
    sent: Vec<Sent>,
    names: u32,
    /// What was released of each order, by sequence id.
    released: BTreeMap<(String, u32), String>,
    order_of_drive: Vec<(String, u32, String)>,
}

impl World {
    fn new(seed: u64, version: Version) -> Self {
        let mut rng = fastrand::Rng::with_seed(seed);
        let on_broker_loss = match rng.bool() {
            true => OnBrokerLoss::Stop,
            false => OnBrokerLoss::FinishBase { seconds: 1.0, metres: 3.0 },
        };
        let policy = Policy { version, on_broker_loss, resumes_by_itself: rng.bool(), ..policy() };
        let (sent, released, order_of_drive) = Default::default();
        let mut pair = Pair::with("a", policy.clone());
        pair.vehicle.ramp = rng.u32(0..3);
        Self { rng, pair, policy, sent, names: 0, released, order_of_drive }
    }

    /// A way from a node, with a base and a horizon and some actions.
    fn way(&mut self, from: &str) -> String {
        let (base, horizon) = (self.rng.usize(1..4), self.rng.usize(0..3));
        let mut way = format!("{from}!");
        for index in 0..base + horizon {
            let node = self.rng.choice(["a", "b", "c", "d"]).unwrap();
            let actions = ["", "", "", ":pick=HARD", ":beep", ":drop=SOFT", "/beep", "/pick=SOFT", ":beep=SINGLE"];
            let actions = &actions[..actions.len() - usize::from(self.policy.version == Version::V2)];
            let released = if index < base - 1 || horizon == 0 { "!" } else { "" };
            let action = *self.rng.choice(actions).unwrap();
            let (node_action, edge_action) = if action.starts_with('/') { ("", action) } else { (action, "") };
            way.push_str(&format!(" {node}{released}{node_action}{edge_action}"));
        }
        way
    }

    fn send(&mut self, sent: Sent) {
        self.sent.push(sent.clone());
        self.deliver(sent);
    }

    fn deliver(&mut self, sent: Sent) {
        let before = self.pair.machine.record().clone();
        match sent {
            Sent::Instant(message) => self.pair.machine.instant_actions(message),
            Sent::Order(order) => {
                self.pair.machine.order(order.clone());
                let after = self.pair.machine.record();
                let is_taken = (&after.order_id, after.order_update_id) != (&before.order_id, before.order_update_id);
                if !is_taken {
                    let kept = |record: &Record| (record.nodes.clone(), record.edges.clone(), record.actions.clone());
                    assert_eq!(kept(&before), kept(after), "an order that is not taken changes nothing");
                    return;
                }
                if after.order_id == before.order_id {
                    let base = before.nodes.iter().filter(|node| node.released);
                    assert!(base.eq(after.nodes.iter().take(before.nodes.iter().filter(|node| node.released).count())));
                } else {
                    assert!(before.nodes.is_empty() && before.actions.iter().all(|entry| entry.status.has_ended()));
                }
                for node in order.nodes.iter().filter(|node| node.released) {
                    let place = (order.order_id.clone(), node.sequence_id);
                    let known = self.released.entry(place).or_insert_with(|| node.node_id.clone());
                    assert_eq!(*known, node.node_id, "the base never changes");
                }
            }
        }
    }

    fn act(&mut self) {
        let record = self.pair.machine.record();
        let (id, update) = (record.order_id.clone(), record.order_update_id);
        match self.rng.u8(0..24) {
            0..3 => {
                self.names += 1;
                let from = self.node_here();
                let way = self.way(&from);
                self.send(Sent::Order(order(&format!("o{}", self.names), 0, 0, &way)));
            }
            3..6 if !id.is_empty() => {
                let base = record.nodes.iter().take_while(|node| node.released).last();
                let last = (record.last_node_id.clone(), record.last_node_sequence_id);
                let (node, sequence) = base.map_or(last, |node| (node.node_id.clone(), node.sequence_id));
                let way = self.way(&node);
                let mut next = order(&id, update + 1, sequence, &way);
                // Ids of actions differ from update to update, as a master's do.
                rename(&mut next, update + 1);
                self.send(Sent::Order(next));
            }
            6 => {
                self.names += 1;
                let kinds =
                    ["cancelOrder", "startPause", "stopPause", "beep", "stateRequest", "clearInstantActions", "beep"];
                let of_version = if self.policy.version == Version::V3 { &kinds[..] } else { &kinds[..5] };
                let kind = *self.rng.choice(of_version).unwrap();
                let mut message = instant(kind, &format!("i{}", self.names));
                message.actions[0].blocking_type =
                    self.rng.choice([BlockingType::None, BlockingType::Soft, BlockingType::Hard]).unwrap();
                self.send(Sent::Instant(message));
            }
            7 => {
                self.names += 1;
                self.send(Sent::Instant(instant("stopPause", &format!("i{}", self.names))));
            }
            // Something comes again, or late.
            8 | 9 if !self.sent.is_empty() => {
                let again = self.sent[self.rng.usize(..self.sent.len())].clone();
                self.deliver(again);
            }
            10 => self.pair.machine.broker(self.rng.bool(), self.pair.now),
            11 => {
                self.pair.machine.vehicle_lost();
                self.pair.vehicle.unlink();
            }
            12 if self.rng.u8(0..4) == 0 => {
                // Edges that it had not reported would be driven again.
                self.pair.machine.status(self.pair.vehicle.status.clone());
                self.pair.machine.vehicle_lost();
                self.pair.vehicle.reboot();
            }
            13 if self.rng.u8(0..4) == 0 => {
                self.pair.vehicle.status.mode = OperatingMode::Manual;
                self.pair.vehicle.unlink();
            }
            14 | 15 => self.pair.vehicle.status.mode = OperatingMode::Automatic,
            16 => {
                self.restart();
                self.pair.machine.broker(true, self.pair.now);
            }
            // A command is written, and the program is killed before it is sent, or right behind that.
            17 => {
                if let Some(command) = self.pair.machine.next(self.pair.now)
                    && self.rng.bool()
                {
                    let reached = self.pair.vehicle.reached.len();
                    let _ = self.pair.vehicle.command(&command);
                    self.note(reached);
                }
                self.restart();
            }
            // Somebody stands in its way, or no longer.
            18 => {
                self.pair.vehicle.refuses = self.rng.choice(["", "", "d", "bc"]).unwrap();
                self.pair.vehicle.is_consulted = self.rng.bool();
            }
            _ => self.turn(),
        }
    }

    /// The program is killed, and starts with what it has written.
    fn restart(&mut self) {
        let kept = serde_json::to_string(self.pair.machine.record()).unwrap();
        let record: Record = serde_json::from_str(&kept).unwrap();
        assert_eq!(serde_json::to_string(&record).unwrap(), kept);
        self.pair.machine = Machine::new(record, self.policy.clone(), self.pair.now);
        self.pair.vehicle.unlink();
    }

    /// The vehicle has been told to drive to nodes of the order.
    fn note(&mut self, from: usize) {
        let order = &self.pair.machine.record().order_id;
        let reached = self.pair.vehicle.reached[from..].iter();
        self.order_of_drive.extend(reached.map(|(node, sequence)| (order.clone(), *sequence, node.clone())));
    }

    fn node_here(&self) -> String {
        let x = self.pair.vehicle.status.position.as_ref().unwrap().x;
        ["a", "b", "c", "d"].into_iter().find(|node| fake::place(node) == x).unwrap().into()
    }

    fn turn(&mut self) {
        let reached = self.pair.vehicle.reached.len();
        let last = (self.pair.machine.record().last_node_sequence_id, self.pair.left());
        let had_ended = self.stops_that_ended();
        self.pair.begin_turn();
        self.note(reached);
        // Now and then it does not say how it is.
        if self.rng.u8(0..4) > 0 {
            self.pair.machine.status(self.pair.vehicle.status.clone());
        }
        let record = self.pair.machine.record();
        assert!(!last.1.is_empty() || record.last_node_sequence_id == last.0);
        let vehicle = &self.pair.vehicle.status;
        let stands = !vehicle.is_driving || vehicle.mode != OperatingMode::Automatic;
        let is_new = |id: &String| !had_ended.contains(id);
        assert!(stands || !self.stops_that_ended().iter().any(is_new), "a stop is FINISHED, and it moves");
    }

    fn stops_that_ended(&self) -> Vec<String> {
        let entries = self.pair.machine.record().actions.iter();
        let stops = entries.filter(|entry| matches!(entry.action.action_type.as_str(), "startPause" | "cancelOrder"));
        let ended = stops.filter(|entry| entry.status == ActionStatus::Finished);
        ended.map(|entry| entry.action.action_id.clone()).collect()
    }

    fn check(&self) {
        let mut began = self.pair.vehicle.began.clone();
        began.sort();
        let count = began.len();
        began.dedup();
        assert_eq!(began.len(), count, "an action ran twice");
        for (index, (order, sequence, node)) in self.order_of_drive.iter().enumerate() {
            assert_eq!(self.released.get(&(order.clone(), *sequence)), Some(node), "driven without a release");
            let before = self.order_of_drive[..index].iter().filter(|(of, ..)| of == order);
            // A vehicle that was switched off drives to the same node again.
            assert!(before.map(|(_, sequence, _)| sequence).max() <= Some(sequence), "driven backwards");
        }
        let record = self.pair.machine.record();
        assert!(record.nodes.len() == record.edges.len());
        assert!(record.actions.iter().all(|entry| entry.status != ActionStatus::Paused));
    }
}

fn rename(order: &mut Order, update: u32) {
    let edges = order.edges.iter_mut().flat_map(|edge| &mut edge.actions);
    let nodes = order.nodes.iter_mut().flat_map(|node| &mut node.actions);
    edges.chain(nodes).for_each(|Action { action_id, .. }| action_id.push_str(&format!("-{update}")));
}

#[test]
fn no_action_twice_no_other_base_and_no_order_lost() {
    let sequences = std::env::var("CARA_TEST_SEQUENCES").ok().and_then(|text| text.parse().ok()).unwrap_or(2_000);
    sequences_of(Version::V2, sequences);
    sequences_of(Version::V3, sequences / 4);
}

fn sequences_of(version: Version, sequences: u64) {
    let (mut driven, mut began, mut orders) = (0, 0, 0);
    for seed in 0..sequences {
        let run = std::panic::catch_unwind(|| {
            let mut world = World::new(seed, version);
            let mut last = String::new();
            for _ in 0..80 {
                world.act();
                let id = &world.pair.machine.record().order_id;
                assert!(last.is_empty() || !id.is_empty(), "the order vanished");
                last.clone_from(id);
            }
            // Left alone with all that it needs, every order comes to its end.
            world.pair.machine.broker(true, world.pair.now);
            world.pair.vehicle.status.mode = OperatingMode::Automatic;
            world.pair.vehicle.refuses = "";
            let status = world.pair.vehicle.status.clone();
            world.pair.machine.status(status);
            world.pair.machine.instant_actions(instant("stopPause", "the end"));
            (0..250).for_each(|_| world.turn());
            world.check();
            let record = world.pair.machine.record();
            assert!(record.nodes.iter().all(|node| !node.released), "{}", world.pair.left());
            let is_due = |entry: &cara_vda5050::actions::Entry| entry.is_triggered && !entry.status.has_ended();
            assert!(!record.actions.iter().any(is_due), "{:?} {:?}", record.actions, world.pair.vehicle);
            (world.pair.vehicle.reached.len(), world.pair.vehicle.began.len(), world.released.len())
        });
        match run {
            Ok((reached, actions, released)) => {
                (driven, began, orders) = (driven + reached, began + actions, orders + released);
            }
            Err(_) => panic!("{version:?}: seed {seed}"),
        }
    }
    println!("{version:?}: {sequences} sequences: {driven} edges driven, {began} actions run, {orders} nodes released");
    assert!(driven as u64 > sequences && began as u64 > sequences / 2, "the model does nothing");
}

/// Something else in the place of any value of a message.
fn spoil(value: &mut Value, rng: &mut fastrand::Rng) {
    let inside: Vec<&mut Value> = match value {
        Value::Object(members) => members.values_mut().collect(),
        Value::Array(values) => values.iter_mut().collect(),
        _ => Vec::new(),
    };
    let count = inside.len();
    if count > 0 && rng.u8(0..6) > 0 {
        return spoil(inside.into_iter().nth(rng.usize(..count)).unwrap(), rng);
    }
    let others = [
        Value::Null,
        json!(0),
        json!(-1),
        json!(u32::MAX),
        json!(u64::MAX),
        json!(1e308),
        json!(0.5),
        json!(true),
        json!(""),
        json!("a\nb"),
        json!("x".repeat(70)),
        json!([]),
        json!({}),
        json!([[[]]]),
    ];
    *value = rng.choice(others).unwrap();
}

/// Messages with anything in them: the machine goes on, and keeps its rules.
#[test]
fn no_message_is_the_end() {
    let mut taken = 0;
    for seed in 0..400 {
        let version = if seed % 4 == 0 { Version::V3 } else { Version::V2 };
        let mut world = World::new(seed, version);
        for _ in 0..40 {
            let from = world.node_here();
            let way = world.way(&from);
            world.names += 1;
            let mut order = serde_json::to_value(order(&format!("o{}", world.names), 0, 0, &way)).unwrap();
            let mut action = serde_json::to_value(instant("beep", &format!("i{}", world.names))).unwrap();
            for message in [&mut order, &mut action] {
                (0..world.rng.u8(0..3)).for_each(|_| spoil(message, &mut world.rng));
            }
            // As a master of this version sends them.
            let [order, action] = [order, action].map(|message| write(version, &message));
            if let Ok(order) = read::<Order>(version, &order) {
                world.pair.machine.order(order.clone());
                taken += u32::from(world.pair.machine.record().order_id == order.order_id);
            }
            if let Ok(action) = read(version, &action) {
                world.pair.machine.instant_actions(action);
            }
            (0..world.rng.u8(0..8)).for_each(|_| world.pair.turn());
            // The vehicle stands elsewhere where an order said so.
            if let Some(at) = &mut world.pair.vehicle.status.position {
                at.x = fake::place("a");
            }
        }
        let text = write(version, &world.pair.machine.report());
        assert!(text.len() < 100_000);
    }
    assert!(taken > 300, "{taken}");
}
