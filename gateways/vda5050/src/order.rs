//! Whether an order is taken: the boxes of figure 8 (6.6.2), without any I/O.

use std::collections::{BTreeMap, BTreeSet};

use serde::{Deserialize, Serialize};

use crate::errors::{Kind, Refusal};
use crate::message::{Action, ActionScope, Edge, Node, NodePosition, Order};
use crate::version::{Rules, Version};

/// The most bytes of a text that goes to the vehicle: identifiers, and the names of actions and maps.
pub const ID_BYTES: usize = 64;
/// The most bytes of an action's parameters as JSON: the call is shorter than the 1,024 bytes that a vehicle takes by default.
pub const PARAMETER_BYTES: usize = 768;

/// What a vehicle can do, from the gateway's configuration.
#[derive(Clone, Debug, Deserialize, Serialize)]
#[serde(default, deny_unknown_fields)]
pub struct Capabilities {
    /// The actions that it offers beside those of the gateway, by their types.
    pub actions: BTreeMap<String, ActionKind>,
    /// The maps that it knows; empty: whatever it is sent.
    pub maps: Vec<String>,
    /// Whether each node needs a position.
    pub needs_positions: bool,
    /// Most nodes of an order message.
    pub max_nodes: usize,
    /// Most actions of the order held at a time.
    pub max_actions: usize,
    /// How far from an order's first node it may stand if that node allows no deviation, in metres.
    pub tolerance: f64,
}

impl Default for Capabilities {
    fn default() -> Self {
        let (actions, maps) = Default::default();
        Self { actions, maps, needs_positions: true, max_nodes: 256, max_actions: 256, tolerance: 0.5 }
    }
}

/// An action of a vehicle.
#[derive(Clone, Debug, Deserialize, Serialize)]
#[serde(deny_unknown_fields)]
pub struct ActionKind {
    /// Where it may be.
    pub scopes: Vec<ActionScope>,
    /// Whether `cancelOrder` ends it while it runs. One that does not end is awaited.
    #[serde(default = "yes")]
    pub can_be_cancelled: bool,
}

const fn yes() -> bool {
    true
}

/// What the vehicle has when an order comes.
#[derive(Clone, Copy, Debug)]
pub struct Held<'a> {
    /// Empty before the first order.
    pub order_id: &'a str,
    /// Of the last update that was taken.
    pub order_update_id: u32,
    /// The zones of the order.
    pub zone_set_id: Option<&'a str>,
    /// The order was cancelled, or is being.
    pub is_cancelled: bool,
    /// Since it ended, `initPosition` has said at which node the vehicle is.
    pub is_placed: bool,
    /// Nodes are left, or actions have not ended (box 3).
    pub is_executing: bool,
    /// The last node of the base and its sequence id (box 7).
    pub decision_point: Option<(&'a str, u32)>,
    /// The last node that was traversed (box 8).
    pub last_node: (&'a str, u32),
    /// Whether a message with the same ids has the same content.
    pub is_same_content: bool,
    /// Where it is, if it knows: x, y and map.
    pub position: Option<(f64, f64, &'a str)>,
}

/// What becomes of an order that is not refused.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Verdict {
    /// It is here already.
    Duplicate,
    /// It takes the place of the one before.
    New,
    /// It continues the order from its first node, which is here already.
    Update,
}

/// Judges an order by the boxes of figure 8, with the numbers of 2.x.
pub fn judge(order: &Order, held: &Held<'_>, can: &Capabilities, version: Version) -> Result<Verdict, Refusal> {
    let rules = version.rules();
    // Box 1.
    validate(order)?;
    // Box 2.
    if order.order_id != held.order_id {
        new(order, held, can, rules)?;
        executable(order, can)?;
        return Ok(Verdict::New);
    }
    let verdict = update(order, held, rules)?;
    if verdict == Verdict::Update {
        executable(order, can)?;
    }
    Ok(verdict)
}

/// Boxes 3 and 4; in 3.0 box 5 as well, as its box 4 is new.
fn new(order: &Order, held: &Held<'_>, can: &Capabilities, rules: &Rules) -> Result<(), Refusal> {
    if held.is_executing {
        return Err(Refusal::new(Kind::OtherOrder, format!("order {} is still being executed", held.order_id)));
    }
    if rules.begins_with_update_0 && order.order_update_id != 0 {
        return Err(Refusal::new(Kind::Replaced, "a new order begins with update 0"));
    }
    let first = &order.nodes[0];
    if is_reachable(first, held, can) {
        return Ok(());
    }
    Err(Refusal::new(Kind::OutOfRange, "the vehicle is not at the first node").about("nodeId", &first.node_id))
}

/// The vehicle stands on the node, or within its deviation (6.6.1). Where it is counts more than where it was last.
fn is_reachable(node: &Node, held: &Held<'_>, can: &Capabilities) -> bool {
    let is_last = !held.last_node.0.is_empty() && node.node_id == held.last_node.0;
    let (Some(at), Some((x, y, map))) = (&node.node_position, held.position) else {
        // A cancelled order may have ended between two nodes.
        return is_last && (held.is_placed || !held.is_cancelled);
    };
    let (x, y) = (x - at.x, y - at.y);
    let deviation = at.allowed_deviation_xy.filter(|deviation| deviation.is_some());
    let is_near = x.hypot(y) <= can.tolerance && (is_last || deviation.is_none());
    at.map_id == map && (is_near || deviation.is_some_and(|deviation| deviation.contains(x, y)))
}

/// Boxes 5, 6, 3, 7 and 8; in 3.0 6 to 10.
fn update(order: &Order, held: &Held<'_>, rules: &Rules) -> Result<Verdict, Refusal> {
    let refused = |kind: Kind, text: &str| Err(Refusal::new(kind, text));
    let wrong = |text: String| refused(Kind::NoContinuation, &text);
    if order.order_update_id < held.order_update_id {
        return refused(Kind::Outdated, &format!("update {} has been taken", held.order_update_id));
    }
    let is_same = order.order_update_id == held.order_update_id;
    if held.is_cancelled && (!is_same || rules.compares_content) {
        return refused(Kind::Cancelled, "the order was cancelled");
    }
    if is_same && rules.compares_content && !held.is_same_content {
        return refused(Kind::SameUpdate, "this update was sent before, with other content");
    }
    if is_same {
        return Ok(Verdict::Duplicate);
    }
    if order.zone_set_id.as_deref() != held.zone_set_id {
        return wrong("an update does not change the zone set".into());
    }
    if held.is_placed {
        return wrong("initPosition has said since where the vehicle is: a new order begins there".into());
    }
    let first = (order.nodes[0].node_id.as_str(), order.nodes[0].sequence_id);
    let expected = if held.is_executing { held.decision_point } else { Some(held.last_node) };
    // In 3.0 a mode may have made the last node unknown, and no node is known by no name.
    let expected = expected.filter(|(node, _)| !node.is_empty());
    if expected == Some(first) {
        return Ok(Verdict::Update);
    }
    let (node, sequence) = expected.unwrap_or_default();
    wrong(format!("it has to continue from node {node}, sequence id {sequence}"))
}

/// Box 1: what the schemas cannot say (6.6.1, 6.6.2).
fn validate(order: &Order) -> Result<(), Refusal> {
    let wrong = |text: &str| Refusal::new(Kind::Validation, text);
    let (nodes, edges) = (&order.nodes, &order.edges);
    let Some(first) = nodes.first() else { return Err(wrong("an order has a node at least")) };
    if edges.len() + 1 != nodes.len() {
        return Err(wrong("an order has one edge less than nodes"));
    }
    if !first.released {
        return Err(wrong("the first node is released").about("nodeId", &first.node_id));
    }
    let mut sequence = first.sequence_id;
    for (edge, pair) in edges.iter().zip(nodes.windows(2)) {
        let wrong = |text: &str| Err(wrong(text).about("edgeId", &edge.edge_id));
        let Some(next) = sequence.checked_add(2) else { return wrong("a sequence id is too high") };
        if edge.sequence_id != sequence + 1 || pair[1].sequence_id != next {
            return wrong("sequence ids run over nodes and edges");
        }
        if edge.start_node_id != pair[0].node_id || edge.end_node_id != pair[1].node_id {
            return wrong("an edge joins the nodes beside it");
        }
        if edge.released != pair[1].released || (edge.released && !pair[0].released) {
            return wrong("the base ends once, at a node");
        }
        sequence = next;
    }
    let mut ids = BTreeSet::new();
    match actions(order).find(|(action, _)| !ids.insert(&action.action_id)) {
        Some((twice, _)) => Err(wrong("an action's id is used twice").about("actionId", &twice.action_id)),
        None => Ok(()),
    }
}

/// What this vehicle can do (6.6.4.2). Members that change what it does and that it cannot use are refused (6.1.1).
fn executable(order: &Order, can: &Capabilities) -> Result<(), Refusal> {
    if order.nodes.len() > can.max_nodes {
        return Err(Refusal::new(Kind::Space, "too many nodes").about("nodes", order.nodes.len()));
    }
    for id in [&order.order_id].into_iter().chain(&order.zone_set_id) {
        fits(id)?;
    }
    for node in &order.nodes {
        let id = &node.node_id;
        fits(id).and_then(|()| positioned(node, can)).map_err(|refusal| refusal.about("nodeId", id))?;
    }
    for edge in &order.edges {
        if let Some(member) = unusable(edge) {
            let refusal = Refusal::new(Kind::Unsupported, "the vehicle cannot use this");
            return Err(refusal.about("edgeId", &edge.edge_id).about(member, member));
        }
        fits(&edge.edge_id).map_err(|refusal| refusal.about("edgeId", &edge.edge_id))?;
    }
    for (action, scope) in actions(order) {
        performable(action, scope, can)?;
        if action.retriable == Some(true) {
            let refusal = Refusal::new(Kind::Unsupported, "the vehicle does not try an action again");
            return Err(refusal.about("actionId", &action.action_id).about("retriable", "retriable"));
        }
    }
    Ok(())
}

/// Whether the vehicle has an action where it is asked for.
pub fn performable<'c>(action: &Action, scope: ActionScope, can: &'c Capabilities) -> Result<&'c ActionKind, Refusal> {
    let unknown = if scope == ActionScope::Instant { Kind::InstantAction } else { Kind::OrderAction };
    let wrong = |kind: Kind, text: &str| {
        Refusal::new(kind, text).about("actionId", &action.action_id).about("actionType", &action.action_type)
    };
    let kind = can.actions.get(&action.action_type).filter(|kind| kind.scopes.contains(&scope));
    let kind = kind.ok_or_else(|| wrong(unknown, "the vehicle does not have this action here"))?;
    fits(&action.action_id).map_err(|_| wrong(Kind::Text, "the action's id is too long"))?;
    if parameters(action).len() > PARAMETER_BYTES {
        return Err(wrong(Kind::Text, "the action's parameters are too long"));
    }
    Ok(kind)
}

/// An action's parameters as the vehicle gets them: a JSON object, or nothing.
pub fn parameters(action: &Action) -> String {
    let parameters = action.action_parameters.as_deref().unwrap_or_default();
    if parameters.is_empty() {
        return String::new();
    }
    let members = parameters.iter().map(|parameter| (parameter.key.clone(), parameter.value.clone()));
    serde_json::Value::Object(members.collect()).to_string()
}

fn actions(order: &Order) -> impl Iterator<Item = (&Action, ActionScope)> {
    let nodes = order.nodes.iter().flat_map(|node| node.actions.iter().map(|action| (action, ActionScope::Node)));
    nodes.chain(order.edges.iter().flat_map(|edge| edge.actions.iter().map(|action| (action, ActionScope::Edge))))
}

fn fits(id: &str) -> Result<(), Refusal> {
    // Those of a stretch go to the vehicle as lines.
    let fits = id.len() <= ID_BYTES && !id.contains(char::is_control);
    fits.then_some(())
        .ok_or_else(|| Refusal::new(Kind::Text, "an identifier has 64 bytes at most, and no control characters"))
}

fn positioned(node: &Node, can: &Capabilities) -> Result<(), Refusal> {
    let wrong = |kind: Kind, text: &str| Err(Refusal::new(kind, text));
    match &node.node_position {
        None if can.needs_positions => wrong(Kind::NoWay, "the vehicle needs the node's position"),
        Some(NodePosition { map_id, .. }) if !can.maps.is_empty() && !can.maps.contains(map_id) => {
            wrong(Kind::UnknownMap, "the vehicle does not have this map")
        }
        Some(NodePosition { map_id, .. }) => fits(map_id),
        None => Ok(()),
    }
}

/// What an edge asks for that no vehicle gets yet.
fn unusable(edge: &Edge) -> Option<&'static str> {
    let Edge { max_height, min_height, orientation, direction, rotation_allowed, max_rotation_speed, .. } = edge;
    let asked = [
        // To the vehicle 0 is no limit.
        ("maxSpeed", edge.max_speed.is_some_and(|speed| speed <= 0.0)),
        ("maxHeight", max_height.is_some()),
        ("minHeight", min_height.is_some()),
        ("orientation", orientation.is_some()),
        ("direction", direction.is_some()),
        ("rotationAllowed", *rotation_allowed == Some(false)),
        ("reachOrientationBeforeEntering", edge.reach_orientation_before_entering == Some(true)),
        ("maxRotationSpeed", max_rotation_speed.is_some()),
        ("trajectory", edge.trajectory.is_some()),
        ("corridor", edge.corridor.is_some()),
    ];
    asked.into_iter().find_map(|(member, is_asked)| is_asked.then_some(member))
}
