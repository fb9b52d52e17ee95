//! A vehicle and orders for tests of the machine.
#![allow(dead_code, unreachable_pub)]

use std::time::Duration;

use cara_vda5050::machine::Machine;
use cara_vda5050::message::{
    Action, ActionScope, ActionStatus, AgvPosition, BlockingType, Edge, Header, InstantActions, Node, NodePosition,
    Order,
};
use cara_vda5050::order::{ActionKind, Capabilities};
use cara_vda5050::state::{Command, Failure, OnBrokerLoss, Policy, Status};
use cara_vda5050::version::Version;

/// Actions `pick` and `beep` anywhere, `drop` that cannot be cancelled.
pub fn policy() -> Policy {
    let scopes = vec![ActionScope::Node, ActionScope::Edge, ActionScope::Instant];
    let kind = |can_be_cancelled| ActionKind { scopes: scopes.clone(), can_be_cancelled };
    let actions = [("pick", true), ("beep", true), ("drop", false)].map(|(name, can)| (name.to_owned(), kind(can)));
    Policy {
        version: Version::V2,
        can: Capabilities { actions: actions.into(), max_nodes: 20, max_actions: 20, ..Capabilities::default() },
        on_broker_loss: OnBrokerLoss::FinishBase { seconds: 60.0, metres: 100.0 },
        resumes_by_itself: false,
        actions_at_once: 1,
    }
}

pub fn header(version: &str) -> Header {
    Header {
        header_id: 1,
        timestamp: "2026-11-28T09:00:00.00Z".into(),
        version: version.into(),
        manufacturer: "KIT".into(),
        serial_number: "0001".into(),
    }
}

/// Nodes are single letters at x = a, b, c … metres; `!` releases one; then its actions, as `(pick HARD)`, and after `/` those of
/// the edge to it. Action ids are of order, node and type.
pub fn order(id: &str, update: u32, first: u32, way: &str) -> Order {
    let (mut nodes, mut edges): (Vec<Node>, Vec<Edge>) = Default::default();
    for (index, word) in way.split_whitespace().enumerate() {
        let (word, on_edge) = word.split_once('/').unwrap_or((word, ""));
        let (name, at_node) = word.split_once(':').unwrap_or((word, ""));
        let released = name.ends_with('!');
        let name = name.trim_end_matches('!');
        let sequence_id = first + 2 * index as u32;
        let actions = |list: &str, place: &str| -> Vec<Action> {
            list.split(',')
                .filter(|text| !text.is_empty())
                .map(|text| action(&format!("{id}-{name}{sequence_id}{place}"), text))
                .collect()
        };
        if let Some(before) = nodes.last() {
            edges.push(Edge {
                edge_id: format!("{}{name}", before.node_id),
                sequence_id: sequence_id - 1,
                released,
                start_node_id: before.node_id.clone(),
                end_node_id: name.into(),
                actions: actions(on_edge, "e"),
                ..Edge::default()
            });
        }
        let position = NodePosition { x: place(name), map_id: "hall".into(), ..NodePosition::default() };
        nodes.push(Node {
            node_id: name.into(),
            sequence_id,
            released,
            actions: actions(at_node, "n"),
            node_position: Some(position),
            node_description: None,
        });
    }
    let (order_id, zone_set_id, order_description) = (id.into(), None, None);
    Order { header: header("2.1.0"), order_id, order_update_id: update, nodes, edges, zone_set_id, order_description }
}

/// `pick=HARD`.
fn action(id: &str, text: &str) -> Action {
    let (kind, blocking) = text.split_once('=').unwrap_or((text, "NONE"));
    let blocking_type = match blocking {
        "HARD" => BlockingType::Hard,
        "SOFT" => BlockingType::Soft,
        "SINGLE" => BlockingType::Single,
        _ => BlockingType::None,
    };
    let (action_id, action_type) = (format!("{id}-{kind}"), kind.into());
    Action { action_id, action_type, blocking_type, ..Action::default() }
}

pub fn place(node: &str) -> f64 {
    node.bytes().next().map_or(0.0, |letter| f64::from(letter - b'a') * 2.0)
}

pub fn instant(kind: &str, id: &str) -> InstantActions {
    let action = Action { action_id: id.into(), action_type: kind.into(), ..Action::default() };
    InstantActions { header: header("2.1.0"), actions: vec![action] }
}

/// A vehicle that keeps the rules of its interface: each number once, an order dies with its link.
#[derive(Clone, Debug)]
pub struct Fake {
    pub status: Status,
    /// To which node, and how many steps are left.
    target: Option<(String, u32)>,
    /// What it was told: numbers, nodes and their sequence ids.
    legs: Vec<(u64, String, u32)>,
    action: Option<(String, u32)>,
    /// It is one that the vehicle stands for.
    is_blocked: bool,
    /// Actions as they began.
    pub began: Vec<String>,
    /// Nodes as they were reached.
    pub reached: Vec<(String, u32)>,
    /// Steps of a drive and of an action.
    pub steps: u32,
    /// Steps until it stands, and how many are left.
    pub ramp: u32,
    braking: u32,
    /// It refuses a stretch with one of these nodes,
    pub refuses: &'static str,
    /// and is asked before, or stops for each stretch that it refuses.
    pub is_consulted: bool,
}

impl Fake {
    pub fn at(node: &str) -> Self {
        let position =
            AgvPosition { x: place(node), map_id: "hall".into(), position_initialized: true, ..AgvPosition::default() };
        let status =
            Status { position: Some(position), boot: 1, action_status: ActionStatus::Finished, ..Status::default() };
        Self {
            status,
            target: None,
            legs: Vec::new(),
            action: None,
            is_blocked: false,
            began: Vec::new(),
            reached: Vec::new(),
            steps: 2,
            ramp: 0,
            braking: 0,
            refuses: "",
            is_consulted: true,
        }
    }

    pub fn command(&mut self, command: &Command) -> Result<(), Failure> {
        match command {
            Command::Drive { number, legs, goes_on } => {
                if legs.iter().any(|(_, node)| self.refuses.contains(&node.node_id)) {
                    if !(*goes_on && self.is_consulted) {
                        self.stop_driving();
                    }
                    return Err(Failure::Refused("no way there".into()));
                }
                if number + legs.len() as u64 <= self.status.drive {
                    return Err(Failure::Refused("an old number".into()));
                }
                assert!(!legs.is_empty() && legs.len() <= 8);
                assert!(legs.iter().all(|(edge, node)| edge.released && node.released), "{command:?}");
                let blocks = |actions: &[Action]| actions.iter().any(|of| of.blocking_type.blocks_driving());
                let (_, passed) = legs.split_last().unwrap();
                assert!(!passed.iter().any(|(_, node)| blocks(&node.actions)), "past a node with {command:?}");
                assert!(legs.len() == 1 || legs.iter().all(|(edge, _)| edge.actions.is_empty()), "{command:?}");
                assert!(!self.is_blocked || self.action.is_none(), "driven while an action blocks that");
                let leg = |(index, (_, node)): (usize, &(Edge, Node))| {
                    (number + index as u64, node.node_id.clone(), node.sequence_id)
                };
                self.legs = legs.iter().enumerate().map(leg).collect();
                if self.status.drive < *number || self.status.has_arrived {
                    self.next_leg();
                }
                self.braking = 0;
                self.status.is_ordered = !self.status.has_arrived;
                self.status.is_driving = !self.status.has_arrived;
            }
            Command::Halt => self.stop_driving(),
            Command::Act { number, action } => {
                if *number < self.status.action {
                    return Err(Failure::Refused("an old number".into()));
                }
                if *number > self.status.action {
                    self.is_blocked = action.blocking_type.blocks_driving();
                    assert!(!self.is_blocked || !self.status.is_driving, "{action:?} begins while it drives");
                    self.began.push(action.action_id.clone());
                    self.action = Some((action.action_id.clone(), self.steps));
                    self.status.action_status = ActionStatus::Running;
                }
                self.status.action = *number;
            }
            Command::EndAction { number } => {
                if *number == self.status.action {
                    self.stop_action();
                }
            }
            Command::InitPosition { .. } => {}
        }
        Ok(())
    }

    /// Begins the next edge of the stretch.
    fn next_leg(&mut self) {
        let next = self.legs.iter().find(|(number, ..)| *number > self.status.drive).cloned();
        self.status.has_arrived = next.is_none();
        if let Some((number, node, sequence)) = next {
            self.status.drive = number;
            self.target = Some((node.clone(), self.steps));
            self.reached.push((node, sequence));
        }
    }

    fn stop_driving(&mut self) {
        if self.status.is_ordered {
            self.braking = self.ramp;
        }
        (self.status.is_ordered, self.status.is_driving) = (false, self.braking > 0);
    }

    fn stop_action(&mut self) {
        if self.action.take().is_some() {
            self.status.action_status = ActionStatus::Failed;
            self.status.action_result = "given up".into();
        }
    }

    /// The link ends, and with it what moves.
    pub fn unlink(&mut self) {
        self.stop_driving();
        self.stop_action();
    }

    /// Switched off and on.
    pub fn reboot(&mut self) {
        self.unlink();
        self.braking = 0;
        let boot = self.status.boot + 1;
        self.status = Status { boot, position: self.status.position.clone(), ..Status::default() };
    }

    pub fn step(&mut self) {
        if self.braking > 0 {
            self.braking -= 1;
            self.status.is_driving = self.braking > 0;
        } else if self.status.is_driving
            && let Some((node, left)) = &mut self.target
        {
            *left = left.saturating_sub(1);
            self.status.driven += 1.0;
            if *left == 0 {
                if let Some(position) = &mut self.status.position {
                    position.x = place(node);
                }
                self.next_leg();
                let drives = !self.status.has_arrived;
                (self.status.is_ordered, self.status.is_driving) = (drives, drives);
            }
        }
        if let Some((_, left)) = &mut self.action {
            *left = left.saturating_sub(1);
            if *left == 0 {
                self.action = None;
                self.status.action_status = ActionStatus::Finished;
                self.status.action_result.clear();
            }
        }
    }
}

/// A machine and its vehicle.
pub struct Pair {
    pub machine: Machine,
    pub vehicle: Fake,
    pub now: Duration,
}

impl Pair {
    pub fn new(node: &str) -> Self {
        Self::with(node, policy())
    }

    pub fn of(node: &str, version: Version) -> Self {
        Self::with(node, Policy { version, ..policy() })
    }

    pub fn with(node: &str, policy: Policy) -> Self {
        let machine = Machine::new(Default::default(), policy, Duration::ZERO);
        let mut pair = Self { machine, vehicle: Fake::at(node), now: Duration::ZERO };
        pair.machine.broker(true, Duration::ZERO);
        pair.machine.status(pair.vehicle.status.clone());
        pair
    }

    /// The vehicle gets all that it is to be told, moves a step, and reports.
    pub fn turn(&mut self) {
        self.begin_turn();
        self.machine.status(self.vehicle.status.clone());
    }

    /// Without a report.
    pub fn begin_turn(&mut self) {
        self.now += Duration::from_millis(100);
        self.tell();
        self.vehicle.step();
    }

    pub fn tell(&mut self) {
        while let Some(command) = self.machine.next(self.now) {
            let answer = self.vehicle.command(&command);
            let failed = answer.is_err();
            self.machine.answered(&command, answer, self.now);
            if failed {
                break;
            }
        }
    }

    pub fn turns(&mut self, turns: usize) {
        (0..turns).for_each(|_| self.turn());
    }

    /// The types of the errors.
    pub fn errors(&self) -> Vec<&str> {
        self.machine.record().errors.iter().map(|error| error.error_type.as_str()).collect()
    }

    /// What is left of the order, as `b! bc c`: nodes and edges by their sequence.
    pub fn left(&self) -> String {
        let record = self.machine.record();
        let nodes = record.nodes.iter().map(|node| (node.sequence_id, &node.node_id, node.released));
        let edges = record.edges.iter().map(|edge| (edge.sequence_id, &edge.edge_id, edge.released));
        let mut left: Vec<_> = nodes.chain(edges).collect();
        left.sort();
        let word = |(_, id, released): &(u32, &String, bool)| format!("{id}{}", if *released { "!" } else { "" });
        left.iter().map(word).collect::<Vec<_>>().join(" ")
    }

    /// The states of the actions, as `o1-b2n-pick FINISHED`.
    pub fn actions(&self) -> Vec<String> {
        let word = |status: ActionStatus| serde_json::to_value(status).unwrap().as_str().unwrap().to_owned();
        let entries = self.machine.record().actions.iter();
        entries.map(|entry| format!("{} {}", entry.action.action_id, word(entry.status))).collect()
    }
}
