//! Messages of VDA 5050 as the gateway takes them from a broker, and one vehicle that gets what follows from them. What is read can
//! be written, and then reads the same; an order that is taken keeps the standard's rules, and what is driven was released.

use std::collections::{BTreeMap, BTreeSet};
use std::fmt::Debug;
use std::time::Duration;

use cara_fuzz_vda5050::machine::{ERRORS, INSTANT_ACTIONS, Machine, Topic};
use cara_fuzz_vda5050::message::{
    Action, ActionParameter, ActionScope, ActionStatus, AgvPosition, BlockingType, Connection, Deviation, EStop, Edge,
    Header, InstantActions, Node, NodePosition, OperatingMode, Order, State, Visualization, read, write,
};
use cara_fuzz_vda5050::order::{ActionKind, Capabilities, ID_BYTES};
use cara_fuzz_vda5050::state::{Command, Failure, OnBrokerLoss, Policy, Record, Status};
use cara_fuzz_vda5050::stretch::{LEGS, of_order};
use cara_fuzz_vda5050::version::Version;
use serde::Serialize;
use serde::de::DeserializeOwned;

use crate::script::{Script, text};

/// Pieces of messages.
const PIECES: &[&str] = &[
    r#"{"headerId":1,"timestamp":"t","version":"2.1.0","manufacturer":"m","serialNumber":"1","#,
    r#""orderId":"o","orderUpdateId":0,"#,
    r#""nodes":["#,
    r#"],"edges":["#,
    r#"{"nodeId":"a","sequenceId":0,"released":true,"actions":[]"#,
    r#"{"edgeId":"e","sequenceId":1,"released":true,"startNodeId":"a","endNodeId":"b","actions":[]"#,
    r#","nodePosition":{"x":1.5,"y":-0.0,"mapId":"hall""#,
    r#","allowedDeviationXY":"#,
    r#""allowedDeviationXy":"#,
    r#"{"a":1,"b":2,"theta":0}"#,
    r#""actions":["#,
    r#"{"actionType":"pick","actionId":"1","blockingType":"HARD""#,
    r#","actionParameters":[{"key":"k","value":"#,
    r#""instantActions":["#,
    r#""connectionState":"ONLINE""#,
    r#""connectionState":"CONNECTION_BROKEN""#,
    r#""actionName":"initPosition""#,
    r#""initializePosition""#,
    r#""SINGLE""#,
    r#","retriable":true"#,
    r#","maxSpeed":0.1"#,
    r#","maximumSpeed":0.1"#,
    r#","rotationAllowed":false"#,
    r#","corridor":{"leftWidth":1,"rightWidth":1,"corridorRefPoint":"CONTOUR""#,
    r#","corridorReferencePoint":"KINEMATIC_CENTER""#,
    r#","trajectory":{"degree":1,"knotVector":[0,1],"controlPoints":[{"x":0,"y":0}]}"#,
    r#","zoneSetId":"z""#,
    r#","nodeDescription":null"#,
    r#","velocity":{"vx":1e300}"#,
    r#","mobileRobotPosition":{"x":0,"y":0,"theta":0,"mapId":"","localized":true}"#,
    "[",
    "]",
    "{",
    "}",
    ",",
    "1",
    "-1",
    "1e400",
    "null",
    "true",
    "\"\\ud800\"",
    "\"\\n\"",
    ":",
    "\"value\":",
];
/// What actions may be; the first three are the vehicle's.
const ACTIONS: [&str; 12] = [
    "pick",
    "beep",
    "drop",
    "startPause",
    "stopPause",
    "cancelOrder",
    "stateRequest",
    "initPosition",
    "clearInstantActions",
    "factsheetRequest",
    "beep",
    "fly",
];
const MAX_NODES: usize = 8;
const MAX_ACTIONS: usize = 10;

pub(crate) fn run(data: &[u8]) {
    let mut script = Script::new(data);
    let how = script.byte();
    let version = if how & 1 == 0 { Version::V2 } else { Version::V3 };
    if how & 6 == 6 {
        let text = text(script, PIECES).into_bytes();
        again::<Connection>(version, &text);
        again::<InstantActions>(version, &text);
        again::<Order>(version, &text);
        again::<Visualization>(version, &text);
        let _ = read::<State>(version, &text);
    } else {
        let mut fleet = Master::new(version, how);
        while !script.is_over() {
            fleet.step(&mut script);
            fleet.check();
        }
    }
}

/// Reads a message; and again what is written of it.
fn again<T: Serialize + DeserializeOwned + PartialEq + Debug>(version: Version, bytes: &[u8]) -> Option<T> {
    let message: T = read(version, bytes).ok()?;
    let written = write(version, &message);
    let shown = || String::from_utf8_lossy(&written);
    let same: T =
        read(version, &written).unwrap_or_else(|error| panic!("what is written is no message: {error}: {}", shown()));
    assert_eq!(same, message, "a message is written as another one");
    Some(message)
}

/// What a master sends to the gateway of one vehicle, and what that tells the vehicle.
struct Master {
    machine: Machine,
    policy: Policy,
    now: Duration,
    status: Status,
    is_linked: bool,
    orders: u32,
    /// What was sent, and may come again later.
    sent: Vec<Order>,
    /// Which node was released of an order, by its sequence id.
    released: BTreeMap<(String, u32), String>,
    /// What each number has meant to the vehicle.
    numbers: BTreeMap<u64, String>,
}

impl Master {
    fn new(version: Version, how: u8) -> Self {
        let scopes = vec![ActionScope::Node, ActionScope::Edge, ActionScope::Instant];
        let kind = |can_be_cancelled| ActionKind { scopes: scopes.clone(), can_be_cancelled };
        let actions = [("pick", true), ("beep", true), ("drop", false)].map(|(name, can)| (name.to_owned(), kind(can)));
        let can = Capabilities {
            actions: actions.into(),
            max_nodes: MAX_NODES,
            max_actions: MAX_ACTIONS,
            ..Capabilities::default()
        };
        let on_broker_loss = match how & 8 {
            0 => OnBrokerLoss::FinishBase { seconds: 1.0, metres: 3.0 },
            _ => OnBrokerLoss::Stop,
        };
        let policy = Policy {
            version,
            can,
            on_broker_loss,
            resumes_by_itself: how & 16 != 0,
            actions_at_once: 1 + usize::from(how >> 7),
        };
        let position = AgvPosition { map_id: "hall".into(), position_initialized: true, ..AgvPosition::default() };
        let status =
            Status { boot: 1, position: Some(position), action_status: ActionStatus::Finished, ..Status::default() };
        let mut machine = Machine::new(Record::default(), policy.clone(), Duration::ZERO);
        machine.broker(true, Duration::ZERO);
        machine.status(status.clone());
        let (sent, released, numbers) = Default::default();
        Self { machine, policy, now: Duration::ZERO, status, is_linked: true, orders: 0, sent, released, numbers }
    }

    fn step(&mut self, script: &mut Script<'_>) {
        match script.below(16) {
            0..4 => {
                let order = self.order(script);
                let bytes = write(self.policy.version, &order);
                // One with a text that is too long is no message.
                if let Some(order) = again::<Order>(self.policy.version, &bytes) {
                    self.sent.push(order.clone());
                    self.send(order);
                }
            }
            4 if !self.sent.is_empty() => {
                let again = self.sent[usize::from(script.byte()) % self.sent.len()].clone();
                self.send(again);
            }
            5 => {
                let message = self.at_once(script);
                let bytes = write(self.policy.version, &message);
                if let Some(message) = again::<InstantActions>(self.policy.version, &bytes) {
                    self.machine.instant_actions(message);
                }
            }
            6 => self.machine.broker(script.flag(), self.now),
            7 => {
                self.machine.vehicle_lost();
                self.is_linked = false;
                self.status.is_ordered = false;
                self.status.boot += u64::from(script.flag());
            }
            8 => self.restart(),
            9 => self.now += Duration::from_millis(u64::from(script.byte()) * 20),
            10..13 => self.drive(script),
            _ => self.tell(script),
        }
    }

    /// Mostly one that continues what is there.
    fn order(&mut self, script: &mut Script<'_>) -> Order {
        let record = self.machine.record();
        let how = script.byte();
        let base = record.nodes.iter().take_while(|node| node.released).last();
        let last = base.map_or((record.last_node_id.clone(), record.last_node_sequence_id), |node| {
            (node.node_id.clone(), node.sequence_id)
        });
        let is_new = how & 3 == 0 || record.order_id.is_empty();
        let (order_id, order_update_id, first) = match is_new {
            true => {
                self.orders += u32::from(how & 4 == 0);
                (format!("o{}", self.orders), 0, (self.here(), 0))
            }
            false => (record.order_id.clone(), record.order_update_id.saturating_add(u32::from(how & 12 != 12)), last),
        };
        let mut order = Order { order_id, order_update_id, ..Order::default() };
        let (mut name, mut sequence_id, mut released) = (first.0, first.1, true);
        for index in 0..=how >> 5 {
            let what = script.byte();
            if index > 0 {
                let next = ["a", "b", "c", "d"][usize::from(what & 3)].to_owned();
                released = if what > 0xF8 { !released } else { released && what & 4 == 0 };
                order.edges.push(Edge {
                    edge_id: format!("{name}{next}"),
                    sequence_id: sequence_id.wrapping_add(1),
                    released,
                    start_node_id: name,
                    end_node_id: next.clone(),
                    actions: if what & 0x18 == 0x18 { vec![self.action(script)] } else { Vec::new() },
                    ..Edge::default()
                });
                sequence_id = sequence_id.wrapping_add(2);
                name = next;
            }
            let position = NodePosition { x: place(&name), map_id: "hall".into(), ..NodePosition::default() };
            order.nodes.push(Node {
                node_id: name.clone(),
                sequence_id,
                released,
                actions: if what & 0x18 == 0x08 { vec![self.action(script)] } else { Vec::new() },
                node_position: Some(position),
                node_description: None,
            });
        }
        if how & 16 != 0 {
            change(script, &mut order);
        }
        order
    }

    fn action(&self, script: &mut Script<'_>) -> Action {
        let what = script.byte();
        let record = self.machine.record();
        let action_id = match what & 0x60 {
            0 => format!("{}", what >> 7),
            _ => format!("{}-{}-{}", record.order_id, record.order_update_id, script.byte()),
        };
        let kinds = [BlockingType::None, BlockingType::Soft, BlockingType::Hard, BlockingType::Single];
        let mut blocking_type = kinds[usize::from(what >> 3 & 3)];
        if self.policy.version == Version::V2 && blocking_type == BlockingType::Single {
            blocking_type = BlockingType::Hard;
        }
        Action { action_type: ACTIONS[usize::from(what & 3) % 3].into(), action_id, blocking_type, ..Action::default() }
    }

    fn at_once(&self, script: &mut Script<'_>) -> InstantActions {
        let stamp = script.byte();
        let header = Header { header_id: u32::from(stamp & 7), ..Header::default() };
        let action = |script: &mut Script<'_>| {
            let action_type = ACTIONS[usize::from(script.below(ACTIONS.len() as u8))].to_owned();
            let mut action = Action { action_type, ..self.action(script) };
            if script.flag() {
                let key = if script.flag() { "orderId" } else { "lastNodeId" }.to_owned();
                let value = String::from_utf8_lossy(script.bytes()).into_owned().into();
                action.action_parameters = Some(vec![ActionParameter { key, value }]);
            } else {
                action.blocking_type = BlockingType::None;
            }
            action
        };
        InstantActions { header, actions: (0..1 + (stamp >> 6)).map(|_| action(script)).collect() }
    }

    fn here(&self) -> String {
        let x = self.status.position.as_ref().map_or(0.0, |at| at.x);
        ["a", "b", "c", "d"].into_iter().find(|name| place(name) == x).unwrap_or("a").to_owned()
    }

    fn send(&mut self, order: Order) {
        let before = self.machine.record().clone();
        self.machine.order(order.clone());
        let after = self.machine.record();
        if (&after.order_id, after.order_update_id) == (&before.order_id, before.order_update_id) {
            let kept = |record: &Record| (record.nodes.clone(), record.edges.clone(), record.actions.clone());
            assert_eq!(kept(&before), kept(after), "an order that is not taken changes something");
            return;
        }
        assert!(self.is_linked && is_controlled(&self.status), "an order is taken for a vehicle that has no master");
        valid(&order);
        if after.order_id == before.order_id {
            assert!(after.order_update_id > before.order_update_id, "a late update is taken");
            assert!(!before.is_cancelled, "an update of a cancelled order is taken");
            let base = || before.nodes.iter().filter(|node| node.released);
            assert!(base().eq(after.nodes.iter().take(base().count())), "an update changes the base");
        } else {
            assert!(before.nodes.is_empty(), "an order is taken beside another one");
            let waits = before.actions.iter().any(|entry| !entry.status.has_ended());
            assert!(!waits, "an order is taken beside another one's actions");
            assert!(!before.spent.contains(&order.order_id), "an order comes back");
        }
        for node in order.nodes.iter().filter(|node| node.released) {
            let place = (order.order_id.clone(), node.sequence_id);
            let known = self.released.entry(place).or_insert_with(|| node.node_id.clone());
            assert_eq!(*known, node.node_id, "the base changes");
        }
    }

    /// The program ends, and starts with what it has written.
    fn restart(&mut self) {
        let kept = serde_json::to_string(self.machine.record()).expect("it is JSON");
        let record: Record = serde_json::from_str(&kept).expect("what is written can be read");
        assert_eq!(serde_json::to_string(&record).expect("it is JSON"), kept);
        self.machine = Machine::new(record, self.policy.clone(), self.now);
        self.machine.broker(true, self.now);
        self.is_linked = false;
        self.status.is_ordered = false;
    }

    /// The vehicle is told what is due, and answers.
    fn drive(&mut self, script: &mut Script<'_>) {
        self.machine.reserve_header_ids();
        let Some(command) = self.machine.next(self.now) else { return };
        assert!(self.is_linked, "a vehicle that is lost is told something");
        let record = self.machine.record();
        let (order_id, is_cancelled) = (record.order_id.clone(), record.is_cancelled);
        let is_free = is_controlled(&self.status) && self.status.e_stop == EStop::None && !record.is_paused;
        match &command {
            Command::Drive { number, legs, .. } => {
                assert!(is_free && !is_cancelled, "it is told to drive, and has to stand");
                assert!((1..=LEGS).contains(&legs.len()));
                let (mut stretch, [edges, nodes], _) = of_order(i64::try_from(*number).expect("it is small"), legs);
                (stretch.edges, stretch.nodes) = (&edges, &nodes);
                assert_eq!(stretch.legs().map(|legs| legs.len()), Some(legs.len()), "the vehicle cannot read this");
                for (number, (edge, node)) in (*number..).zip(legs) {
                    assert!(edge.released && node.released, "driven without a release");
                    let place = (order_id.clone(), node.sequence_id);
                    assert_eq!(self.released.get(&place), Some(&node.node_id), "driven elsewhere");
                    self.means(number, format!("{} {}", place.0, place.1));
                }
                self.status.is_ordered = true;
            }
            Command::Act { number, action } => {
                assert!(is_free, "it is told to act, and has to stand");
                self.means(*number, action.action_id.clone());
            }
            Command::InitPosition { .. } | Command::EndAction { .. } => {}
            Command::Halt => self.status.is_ordered = false,
        }
        let why = || "why".to_owned();
        let answer = match script.byte() {
            0..0xD0 => Ok(()),
            0xD0..0xE0 => Err(Failure::Refused(why())),
            0xE0..0xF0 => Err(Failure::Stopped(why())),
            _ => Err(Failure::Lost(why())),
        };
        self.machine.answered(&command, answer, self.now);
    }

    /// A vehicle does each number once: none ever means something else.
    fn means(&mut self, number: u64, what: String) {
        let known = self.numbers.entry(number).or_insert_with(|| what.clone());
        assert_eq!(*known, what, "number {number} has meant something else");
    }

    /// The vehicle says how it is: what may be, or what it never does.
    fn tell(&mut self, script: &mut Script<'_>) {
        let (what, record) = (script.byte(), self.machine.record());
        let status = &mut self.status;
        match what & 3 {
            0 => {}
            1 => {
                status.drive = record.drive.map_or(status.drive, |number| number + u64::from(what >> 4 & 3));
                status.has_arrived = what & 4 != 0;
                (status.is_driving, status.driven) = (!status.has_arrived, status.driven + 1.0);
            }
            2 => {
                const ENDS: [ActionStatus; 4] =
                    [ActionStatus::Running, ActionStatus::Finished, ActionStatus::Failed, ActionStatus::Paused];
                let runs = record.actions.iter().filter(|entry| entry.runs()).map(|entry| entry.number).next();
                status.action = runs.unwrap_or(status.action);
                status.action_status = ENDS[usize::from(what >> 4 & 3)];
            }
            _ => match what >> 2 & 7 {
                0 => status.mode = OperatingMode::Manual,
                1 => status.mode = OperatingMode::Service,
                2 => status.e_stop = EStop::Manual,
                3 => status.stopped = Some("why".into()),
                4 => status.position = None,
                5 => status.is_ordered = !status.is_ordered,
                _ => {
                    let x = place(["a", "b", "c", "d"][usize::from(what >> 6)]);
                    let at = AgvPosition { x, map_id: "hall".into(), ..AgvPosition::default() };
                    (status.mode, status.e_stop) = (OperatingMode::Automatic, EStop::None);
                    (status.stopped, status.position) = (None, Some(at));
                    status.is_driving = false;
                }
            },
        }
        let status = status.clone();
        self.machine.status(status);
        self.is_linked = true;
    }

    /// What is kept is bounded, and what is reported is a state.
    fn check(&mut self) {
        let record = self.machine.record();
        assert_eq!(record.nodes.len(), record.edges.len());
        assert!(record.nodes.len() <= MAX_NODES && record.errors.len() <= ERRORS && record.spent.len() <= 256);
        assert!(record.actions.len() <= MAX_ACTIONS + 2 * INSTANT_ACTIONS, "{} actions", record.actions.len());
        assert!(record.told <= LEGS && record.told <= record.nodes.len());
        if let Some(report) = self.machine.report() {
            let header = Header { header_id: self.machine.header_id(Topic::State), ..Header::default() };
            let written = write(self.policy.version, &State { header, report });
            read::<State>(self.policy.version, &written).expect("a master can read the state");
        }
    }
}

/// Where nodes are, in metres.
fn place(node: &str) -> f64 {
    node.bytes().next().map_or(0.0, |letter| f64::from(letter.wrapping_sub(b'a')) * 2.0)
}

fn is_controlled(status: &Status) -> bool {
    matches!(status.mode, OperatingMode::Automatic | OperatingMode::Semiautomatic)
}

/// What an order has that is taken (6.6.1, 6.6.2).
fn valid(order: &Order) {
    let Order { nodes, edges, .. } = order;
    assert_eq!(nodes.len(), edges.len() + 1, "nodes and edges take turns");
    assert!(nodes.iter().zip(0..).all(|(node, at)| node.sequence_id == nodes[0].sequence_id + 2 * at), "a gap");
    for ((at, edge), node) in (0..).zip(edges).zip(&nodes[1..]) {
        assert_eq!(edge.sequence_id + 1, node.sequence_id, "a gap before a node");
        assert_eq!((&edge.start_node_id, &edge.end_node_id), (&nodes[at].node_id, &node.node_id), "a torn edge");
        assert!(edge.released == node.released && edge.trajectory.is_none() && edge.corridor.is_none());
    }
    assert!(nodes[0].released && nodes.is_sorted_by_key(|node| !node.released), "the base ends twice");
    let actions = || nodes.iter().flat_map(|node| &node.actions).chain(edges.iter().flat_map(|edge| &edge.actions));
    let ids: BTreeSet<_> = actions().map(|action| &action.action_id).collect();
    assert_eq!(ids.len(), actions().count(), "an action's id is there twice");
    let names = nodes.iter().map(|node| &node.node_id).chain(edges.iter().map(|edge| &edge.edge_id)).chain(ids);
    names.for_each(|id| assert!(id.len() <= ID_BYTES, "{id} is too long"));
}

/// A mistake of the master, or something that most orders do not have.
fn change(script: &mut Script<'_>, order: &mut Order) {
    let what = script.byte();
    let at = usize::from(what >> 4) % order.nodes.len();
    let node = &mut order.nodes[at];
    match what & 15 {
        0 => node.sequence_id = script.number() as u32,
        1 => node.node_position = None,
        2 => node.node_id = String::from_utf8_lossy(script.bytes()).into_owned(),
        3 => drop(order.edges.pop()),
        4 => order.zone_set_id = Some("zone".into()),
        5 => order.order_update_id = script.number() as u32,
        6 => node.released = !node.released,
        7 => node.actions.extend(node.actions.clone()),
        8 => {
            if let Some(position) = &mut node.node_position {
                position.map_id = "yard".into();
            }
        }
        9 => {
            if let Some(position) = &mut node.node_position {
                let a = f64::from(script.byte());
                position.allowed_deviation_xy = Some(match script.flag() {
                    true => Deviation::Radius(a),
                    false => Deviation::Ellipse { a, b: 1.0, theta: 1.0 },
                });
            }
        }
        10 => order.nodes.clear(),
        _ => {
            let Some(edge) = order.edges.get_mut(at) else { return };
            match what & 15 {
                11 => edge.max_speed = Some(f64::from(script.byte() as i8)),
                12 => edge.rotation_allowed = Some(script.flag()),
                13 => edge.sequence_id = script.number() as u32,
                14 => edge.edge_id = String::from_utf8_lossy(script.bytes()).into_owned(),
                _ => edge.end_node_id = "x".into(),
            }
        }
    }
}
