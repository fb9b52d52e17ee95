//! Layouts as in VDMA's Layout Interchange Format (LIF) 1.0.0.
//!
//! The whole format nests deeper than eight levels, and its signature is longer than a kilobyte, so a layout goes in two messages:
//! [`Nodes`] and [`Edges`]. Lists that the format lets be absent are empty ones here.

use cara_std::Variables;

/// A layout without its edges.
#[derive(Variables, Clone, Debug, PartialEq)]
pub struct Nodes {
    #[name = "layoutId"]
    #[size(36)]
    pub layout_id: String,
    #[name = "layoutName"]
    #[size(64)]
    pub layout_name: Option<String>,
    #[name = "layoutVersion"]
    #[size(16)]
    pub layout_version: String,
    #[name = "layoutLevelId"]
    #[size(36)]
    pub layout_level_id: Option<String>,
    #[name = "layoutDescription"]
    #[size(128)]
    pub layout_description: Option<String>,
    #[size(200)]
    pub nodes: Vec<Node>,
    #[size(100)]
    pub stations: Vec<Station>,
}

/// The edges of a layout.
#[derive(Variables, Clone, Debug, PartialEq)]
pub struct Edges {
    #[name = "layoutId"]
    #[size(36)]
    pub layout_id: String,
    #[name = "layoutVersion"]
    #[size(16)]
    pub layout_version: String,
    #[size(200)]
    pub edges: Vec<Edge>,
}

/// A place where a vehicle may stop.
#[derive(Variables, Clone, Debug, PartialEq)]
pub struct Node {
    #[name = "nodeId"]
    #[size(36)]
    pub node_id: String,
    #[name = "nodeName"]
    #[size(64)]
    pub node_name: Option<String>,
    #[name = "nodeDescription"]
    #[size(128)]
    pub node_description: Option<String>,
    #[name = "mapId"]
    #[size(36)]
    pub map_id: Option<String>,
    #[name = "nodePosition"]
    pub node_position: Position,
    #[name = "vehicleTypeNodeProperties"]
    #[size(4)]
    pub vehicle_type_node_properties: Vec<NodeProperties>,
}

/// Metres from the layouts' common origin.
#[derive(Variables, Clone, Debug, PartialEq)]
pub struct Position {
    pub x: f64,
    pub y: f64,
}

/// What holds for one type of vehicle on a node.
#[derive(Variables, Clone, Debug, PartialEq)]
pub struct NodeProperties {
    #[name = "vehicleTypeId"]
    #[size(64)]
    pub vehicle_type_id: String,
    pub theta: Option<f64>,
    #[size(4)]
    pub actions: Vec<Action>,
}

/// What may be done on a node or edge.
#[derive(Variables, Clone, Debug, PartialEq)]
pub struct Action {
    #[name = "actionType"]
    #[size(32)]
    pub action_type: String,
    #[name = "actionDescription"]
    #[size(80)]
    pub action_description: Option<String>,
    #[name = "requirementType"]
    #[size(11)]
    pub requirement_type: Option<String>,
    #[name = "blockingType"]
    #[size(4)]
    pub blocking_type: String,
    #[name = "actionParameters"]
    #[size(8)]
    pub action_parameters: Vec<ActionParameter>,
}

/// A parameter, as text.
#[derive(Variables, Clone, Debug, PartialEq)]
pub struct ActionParameter {
    #[size(32)]
    pub key: String,
    #[size(64)]
    pub value: String,
}

/// A way from one node to another.
#[derive(Variables, Clone, Debug, PartialEq)]
pub struct Edge {
    #[name = "edgeId"]
    #[size(36)]
    pub edge_id: String,
    #[name = "edgeName"]
    #[size(64)]
    pub edge_name: Option<String>,
    #[name = "edgeDescription"]
    #[size(128)]
    pub edge_description: Option<String>,
    #[name = "startNodeId"]
    #[size(36)]
    pub start_node_id: String,
    #[name = "endNodeId"]
    #[size(36)]
    pub end_node_id: String,
    #[name = "vehicleTypeEdgeProperties"]
    #[size(4)]
    pub vehicle_type_edge_properties: Vec<EdgeProperties>,
}

/// What holds for one type of vehicle on an edge.
#[derive(Variables, Clone, Debug, PartialEq)]
pub struct EdgeProperties {
    #[name = "vehicleTypeId"]
    #[size(64)]
    pub vehicle_type_id: String,
    #[name = "vehicleOrientation"]
    pub vehicle_orientation: Option<f64>,
    #[name = "orientationType"]
    #[size(10)]
    pub orientation_type: Option<String>,
    #[name = "rotationAllowed"]
    pub rotation_allowed: bool,
    #[name = "rotationAtStartNodeAllowed"]
    #[size(4)]
    pub rotation_at_start_node_allowed: Option<String>,
    #[name = "rotationAtEndNodeAllowed"]
    #[size(4)]
    pub rotation_at_end_node_allowed: Option<String>,
    #[name = "maxSpeed"]
    pub max_speed: Option<f64>,
    #[name = "maxRotationSpeed"]
    pub max_rotation_speed: Option<f64>,
    #[name = "minHeight"]
    pub min_height: Option<f64>,
    #[name = "maxHeight"]
    pub max_height: Option<f64>,
    #[name = "loadRestriction"]
    pub load_restriction: Option<LoadRestriction>,
    #[size(4)]
    pub actions: Vec<Action>,
    pub trajectory: Option<Trajectory>,
    #[name = "reentryAllowed"]
    pub reentry_allowed: Option<bool>,
}

/// What a vehicle may carry on an edge.
#[derive(Variables, Clone, Debug, PartialEq)]
pub struct LoadRestriction {
    pub unloaded: bool,
    pub loaded: bool,
    #[name = "loadSetNames"]
    #[size(8, 32)]
    pub load_set_names: Vec<String>,
}

/// The edge's curve, a NURBS.
#[derive(Variables, Clone, Debug, PartialEq)]
pub struct Trajectory {
    pub degree: Option<u32>,
    #[name = "knotVector"]
    #[size(32)]
    pub knot_vector: Vec<f64>,
    #[name = "controlPoints"]
    #[size(16)]
    pub control_points: Vec<ControlPoint>,
}

/// A control point. One without a weight has 1.
#[derive(Variables, Clone, Debug, PartialEq)]
pub struct ControlPoint {
    pub x: f64,
    pub y: f64,
    pub weight: f64,
}

/// Where a vehicle takes or leaves something.
#[derive(Variables, Clone, Debug, PartialEq)]
pub struct Station {
    #[name = "stationId"]
    #[size(36)]
    pub station_id: String,
    #[name = "interactionNodeIds"]
    #[size(8, 36)]
    pub interaction_node_ids: Vec<String>,
    #[name = "stationName"]
    #[size(64)]
    pub station_name: Option<String>,
    #[name = "stationDescription"]
    #[size(128)]
    pub station_description: Option<String>,
    #[name = "stationHeight"]
    pub station_height: Option<f64>,
    #[name = "stationPosition"]
    pub station_position: Option<StationPosition>,
}

/// A station's centre, for displays.
#[derive(Variables, Clone, Debug, PartialEq)]
pub struct StationPosition {
    pub x: f64,
    pub y: f64,
    pub theta: Option<f64>,
}
