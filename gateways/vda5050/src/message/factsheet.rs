//! Topic `factsheet` (6.15; in 3.0 6.10). Members that 3.0 has added are optional here, and filled in for 3.0 only.

use serde_json::Value;

use super::{BlockingType, Header, LoadDimensions, object, words};

object! {
    /// What a vehicle of a series is and can do.
    Factsheet {
        #[serde(flatten)] header: Header,
        type_specification: TypeSpecification, physical_parameters: PhysicalParameters, protocol_limits: ProtocolLimits,
        protocol_features: ProtocolFeatures, agv_geometry: AgvGeometry, load_specification: LoadSpecification;
        vehicle_config: VehicleConfig
    }
    TypeSpecification {
        series_name: String, agv_kinematic: String, agv_class: String, max_load_mass: f64,
        localization_types: Vec<String>, navigation_types: Vec<String>;
        series_description: String, supported_zones: Vec<String>
    }
    PhysicalParameters {
        speed_min: f64, speed_max: f64, acceleration_max: f64, deceleration_max: f64, height_max: f64, width: f64, length: f64;
        height_min: f64, minimum_angular_speed: f64, maximum_angular_speed: f64
    }
    ProtocolLimits { max_string_lens: MaxStringLens, max_array_lens: MaxArrayLens, timing: Timing }
    MaxStringLens {;
        msg_len: u32, topic_serial_len: u32, topic_elem_len: u32, id_len: u32, id_numerical_only: bool, enum_len: u32, load_id_len: u32
    }
    MaxArrayLens {;
        #[serde(rename = "order.nodes")] order_nodes: u32,
        #[serde(rename = "order.edges")] order_edges: u32,
        #[serde(rename = "node.actions")] node_actions: u32,
        #[serde(rename = "edge.actions")] edge_actions: u32,
        #[serde(rename = "actions.actionsParameters")] actions_actions_parameters: u32,
        instant_actions: u32,
        #[serde(rename = "trajectory.knotVector")] trajectory_knot_vector: u32,
        #[serde(rename = "trajectory.controlPoints")] trajectory_control_points: u32,
        #[serde(rename = "zoneSet.zones")] zone_set_zones: u32,
        #[serde(rename = "state.instantActionStates")] state_instant_action_states: u32,
        #[serde(rename = "state.zoneActionStates")] state_zone_action_states: u32,
        #[serde(rename = "state.nodeStates")] state_node_states: u32,
        #[serde(rename = "state.edgeStates")] state_edge_states: u32,
        #[serde(rename = "state.loads")] state_loads: u32,
        #[serde(rename = "state.actionStates")] state_action_states: u32,
        #[serde(rename = "state.errors")] state_errors: u32,
        #[serde(rename = "state.information")] state_information: u32,
        #[serde(rename = "error.errorReferences")] error_error_references: u32,
        #[serde(rename = "information.infoReferences")] information_info_references: u32
    }
    Timing { min_order_interval: f64, min_state_interval: f64; default_state_interval: f64, visualization_interval: f64 }
    ProtocolFeatures { optional_parameters: Vec<OptionalParameter>, agv_actions: Vec<AgvAction> }
    OptionalParameter { parameter: String, support: Support; description: String }
    AgvAction {
        action_type: String, action_scopes: Vec<ActionScope>;
        action_description: String, action_parameters: Vec<ActionParameterType>, result_description: String,
        blocking_types: Vec<BlockingType>, pause_allowed: bool, cancel_allowed: bool
    }
    ActionParameterType { key: String, value_data_type: String; description: String, is_optional: bool }
    AgvGeometry {;
        wheel_definitions: Vec<WheelDefinition>,
        #[serde(rename = "envelopes2d")] envelopes_2d: Vec<Envelope2d>,
        #[serde(rename = "envelopes3d")] envelopes_3d: Vec<Envelope3d>
    }
    WheelDefinition {
        #[serde(rename = "type")] kind: String, is_active_driven: bool, is_active_steered: bool, position: WheelPosition,
        diameter: f64, width: f64; center_displacement: f64, constraints: String
    }
    WheelPosition { x: f64, y: f64; theta: f64 }
    Envelope2d { set: String, polygon_points: Vec<PolygonPoint>; description: String }
    PolygonPoint { x: f64, y: f64 }
    /// The description is an integer in the schema, and text in the document.
    Envelope3d { set: String, format: String; data: Value, url: String, description: Value }
    LoadSpecification {; load_positions: Vec<String>, load_sets: Vec<LoadSet> }
    LoadSet {
        set_name: String, load_type: String;
        load_positions: Vec<String>, bounding_box_reference: super::BoundingBoxReference, load_dimensions: LoadDimensions,
        max_weight: f64, #[serde(rename = "minLoadhandlingHeight")] min_load_handling_height: f64,
        #[serde(rename = "maxLoadhandlingHeight")] max_load_handling_height: f64,
        #[serde(rename = "minLoadhandlingDepth")] min_load_handling_depth: f64,
        #[serde(rename = "maxLoadhandlingDepth")] max_load_handling_depth: f64,
        #[serde(rename = "minLoadhandlingTilt")] min_load_handling_tilt: f64,
        #[serde(rename = "maxLoadhandlingTilt")] max_load_handling_tilt: f64,
        agv_speed_limit: f64, agv_acceleration_limit: f64, agv_deceleration_limit: f64, pick_time: f64, drop_time: f64,
        description: String
    }
    VehicleConfig {; versions: Vec<ComponentVersion>, network: VehicleNetwork, battery_charging: BatteryCharging }
    BatteryCharging {;
        critical_low_charging_level: f64, minimum_desired_charging_level: f64, maximum_desired_charging_level: f64,
        minimum_charging_time: f64
    }
    ComponentVersion { key: String, value: String }
    VehicleNetwork {;
        dns_servers: Vec<String>, ntp_servers: Vec<String>, local_ip_address: String, netmask: String, default_gateway: String
    }
}

words! {
    Support { #[default] Supported = "SUPPORTED", Required = "REQUIRED" }
    /// `ZONE` is of 3.0.
    ActionScope { #[default] Instant = "INSTANT", Node = "NODE", Edge = "EDGE", Zone = "ZONE" }
}
