//! The messages of VDA 5050 2.0 and 2.1 (clauses 6.4 to 6.15), as their schemas and the document have them, and those of 3.0.
//!
//! One set of structs serves all versions: 2.1 only adds members to 2.0, and what 3.0 calls otherwise is translated when a message is
//! [`read`] or [written](write()). Where a schema and its document differ, the document counts: 2.0's schemas have `allowedDeviationXy`
//! and `actionName`, which are read and never written.
// The members are the standard's, with its names and its meanings.
#![allow(missing_docs)]

mod factsheet;
mod shape;
mod third;

use serde::de::DeserializeOwned;
use serde::{Deserialize, Serialize};
use serde_json::{Map, Value};

pub use factsheet::*;

use crate::version::Version;

/// Reads a type as its derived `deserialize` does, from this shape only.
macro_rules! shaped {
    ($shape:ident $name:ident) => {
        impl<'de> ::serde::Deserialize<'de> for $name {
            fn deserialize<D: ::serde::Deserializer<'de>>(deserializer: D) -> Result<Self, D::Error> {
                Self::deserialize($crate::message::shape::$shape(deserializer))
            }
        }
        impl ::serde::Serialize for $name {
            fn serialize<S: ::serde::Serializer>(&self, serializer: S) -> Result<S::Ok, S::Error> {
                Self::serialize(self, serializer)
            }
        }
    };
}
/// A struct of a JSON object: members that must be there; those that may be absent, or null when read.
macro_rules! object {
    ($($(#[$attribute:meta])* $name:ident { $($(#[$of:meta])* $field:ident: $type:ty),* $(; $($(#[$of_optional:meta])* $optional:ident: $optional_type:ty),*)? $(,)? })*) => {
        $($(#[$attribute])*
        #[derive(Clone, Debug, Default, PartialEq, ::serde::Serialize, ::serde::Deserialize)]
        #[serde(rename_all = "camelCase", remote = "Self")]
        pub struct $name {
            $($(#[$of])* pub $field: $type,)*
            $($($(#[$of_optional])* #[serde(default, skip_serializing_if = "Option::is_none")] pub $optional: Option<$optional_type>,)*)?
        }
        $crate::message::shaped!(Object $name);)*
    };
}
/// An enum of a text; the first is what a `Default` needs.
macro_rules! words {
    ($($(#[$attribute:meta])* $name:ident { $($(#[$of:meta])* $word:ident = $text:literal),* $(,)? })*) => {
        $($(#[$attribute])*
        #[derive(Clone, Copy, Debug, Default, PartialEq, Eq, PartialOrd, Ord, ::serde::Serialize, ::serde::Deserialize)]
        #[serde(remote = "Self")]
        pub enum $name { $($(#[$of])* #[serde(rename = $text)] $word),* }
        $crate::message::shaped!(Word $name);)*
    };
}
pub(crate) use {object, shaped, words};

object! {
    /// What each message starts with (6.4).
    Header { header_id: u32, timestamp: String, version: String, manufacturer: String, serial_number: String }
    /// Topic `order` (6.6.6).
    Order {
        #[serde(flatten)] header: Header,
        order_id: String, order_update_id: u32, nodes: Vec<Node>, edges: Vec<Edge>;
        zone_set_id: String, order_description: String
    }
    Node {
        node_id: String, sequence_id: u32, released: bool, actions: Vec<Action>;
        node_description: String, node_position: NodePosition
    }
    NodePosition {
        x: f64, y: f64, map_id: String;
        theta: f64, #[serde(rename = "allowedDeviationXY")] allowed_deviation_xy: Deviation, allowed_deviation_theta: f64,
        map_description: String
    }
    Edge {
        edge_id: String, sequence_id: u32, released: bool, start_node_id: String, end_node_id: String, actions: Vec<Action>;
        edge_description: String, max_speed: f64, max_height: f64, min_height: f64, orientation: f64, orientation_type: String,
        direction: String, rotation_allowed: bool, reach_orientation_before_entering: bool, max_rotation_speed: f64, length: f64, trajectory: Trajectory, corridor: Corridor
    }
    Trajectory { degree: i64, knot_vector: Vec<f64>, control_points: Vec<ControlPoint> }
    ControlPoint { x: f64, y: f64; weight: f64 }
    Corridor {
        left_width: f64, right_width: f64;
        corridor_ref_point: CorridorRefPoint, release_required: bool, release_loss_behavior: String
    }
    Action {
        action_type: String, action_id: String, blocking_type: BlockingType;
        action_description: String, action_parameters: Vec<ActionParameter>, retriable: bool
    }
    ActionParameter { key: String, value: Value }
    /// Topic `instantActions` (6.9).
    /// Some masters of 2.0 have the member's name of 1.1.
    InstantActions { #[serde(flatten)] header: Header, #[serde(alias = "instantActions")] actions: Vec<Action> }
    /// Topic `connection` (6.14).
    Connection { #[serde(flatten)] header: Header, connection_state: ConnectionState }
    /// Topic `visualization` (6.13). The reference is of 3.0, and needed there.
    Visualization { #[serde(flatten)] header: Header; reference_state_header_id: u32, agv_position: AgvPosition, velocity: Velocity }
    /// Topic `zoneSet` of 3.0, which is read to be refused.
    ZoneSetMessage { #[serde(flatten)] header: Header, zone_set: ZoneSet }
    ZoneSet { zone_set_id: String, map_id: String }
    /// Topic `responses` of 3.0. Nothing is ever requested.
    Responses { #[serde(flatten)] header: Header, responses: Vec<Response> }
    Response { request_id: String, grant_type: GrantType; lease_expiry: String }
    /// Topic `state` (6.10.6), without its header: what is compared to see whether there is news.
    Report {
        order_id: String, order_update_id: u32, last_node_id: String, last_node_sequence_id: u32, driving: bool,
        operating_mode: OperatingMode, node_states: Vec<NodeState>, edge_states: Vec<EdgeState>, action_states: Vec<ActionState>,
        battery_state: BatteryState, errors: Vec<Error>, safety_state: SafetyState;
        instant_action_states: Vec<ActionState>, maps: Vec<MapState>, zone_set_id: String, paused: bool, new_base_request: bool, distance_since_last_node: f64,
        agv_position: AgvPosition, velocity: Velocity, loads: Vec<Load>, information: Vec<Information>
    }
    /// Topic `state`.
    State { #[serde(flatten)] header: Header, #[serde(flatten)] report: Report }
    MapState { map_id: String, map_version: String, map_status: MapStatus; map_description: String }
    NodeState { node_id: String, sequence_id: u32, released: bool; node_description: String, node_position: NodePosition }
    EdgeState { edge_id: String, sequence_id: u32, released: bool; edge_description: String, trajectory: Trajectory }
    AgvPosition {
        x: f64, y: f64, theta: f64, map_id: String, position_initialized: bool;
        map_description: String, localization_score: f64, deviation_range: f64
    }
    Velocity {; vx: f64, vy: f64, omega: f64 }
    Load {;
        load_id: String, load_type: String, load_position: String, bounding_box_reference: BoundingBoxReference,
        load_dimensions: LoadDimensions, weight: f64
    }
    BoundingBoxReference { x: f64, y: f64, z: f64; theta: f64 }
    LoadDimensions { length: f64, width: f64; height: f64 }
    ActionState {
        action_id: String, action_status: ActionStatus; action_type: String, action_description: String, result_description: String
    }
    BatteryState { battery_charge: f64, charging: bool; battery_voltage: f64, battery_current: f64, battery_health: f64, reach: f64 }
    Error {
        error_type: String, error_level: ErrorLevel;
        error_references: Vec<Reference>, error_description: String, error_hint: String
    }
    Reference { reference_key: String, reference_value: String }
    Information { info_type: String, info_level: InfoLevel; info_references: Vec<Reference>, info_description: String }
    SafetyState { e_stop: EStop, field_violation: bool }
}

words! {
    /// `SINGLE` is of 3.0: beside driving, and beside no other action.
    BlockingType { #[default] None = "NONE", Single = "SINGLE", Soft = "SOFT", Hard = "HARD" }
    CorridorRefPoint { #[default] KinematicCenter = "KINEMATICCENTER", Contour = "CONTOUR" }
    /// `HIBERNATING` is of 3.0, and never written.
    ConnectionState {
        #[default] Online = "ONLINE", Offline = "OFFLINE", Hibernating = "HIBERNATING", Broken = "CONNECTIONBROKEN",
    }
    /// `STARTUP` and `INTERVENED` are of 3.0, and never written.
    OperatingMode {
        Startup = "STARTUP", Intervened = "INTERVENED",
        #[default] Automatic = "AUTOMATIC", Semiautomatic = "SEMIAUTOMATIC", Manual = "MANUAL", Service = "SERVICE", Teachin = "TEACHIN",
    }
    MapStatus { #[default] Enabled = "ENABLED", Disabled = "DISABLED" }
    /// `PAUSED` is in the documents of 2.x (6.11) and absent from their schemas, `RETRIABLE` is of 3.0; neither is ever written.
    ActionStatus {
        #[default] Waiting = "WAITING", Initializing = "INITIALIZING", Running = "RUNNING", Paused = "PAUSED",
        Retriable = "RETRIABLE",
        Finished = "FINISHED", Failed = "FAILED",
    }
    /// The two in the middle are of 3.0.
    ErrorLevel { #[default] Warning = "WARNING", Urgent = "URGENT", Critical = "CRITICAL", Fatal = "FATAL" }
    GrantType { #[default] Granted = "GRANTED", Queued = "QUEUED", Revoked = "REVOKED", Rejected = "REJECTED" }
    InfoLevel { #[default] Info = "INFO", Debug = "DEBUG" }
    EStop { #[default] None = "NONE", AutoAck = "AUTOACK", Manual = "MANUAL", Remote = "REMOTE" }
}

/// How far from a node's place a vehicle may be: a circle in 2.x, an ellipse in 3.0 (6.6.2.1).
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
#[serde(untagged, from = "ReadDeviation")]
pub enum Deviation {
    /// In metres.
    Radius(f64),
    /// In metres, and the angle from the map's x axis to that of `a`.
    Ellipse { a: f64, b: f64, theta: f64 },
}

#[derive(Deserialize)]
#[serde(untagged)]
enum ReadDeviation {
    Radius(f64),
    Ellipse(Axes),
}
object! { Axes { a: f64, b: f64, theta: f64 } }

impl From<ReadDeviation> for Deviation {
    fn from(read: ReadDeviation) -> Self {
        match read {
            ReadDeviation::Radius(radius) => Self::Radius(radius),
            ReadDeviation::Ellipse(Axes { a, b, theta }) => Self::Ellipse { a, b, theta },
        }
    }
}

impl Deviation {
    /// Of the largest circle in it.
    pub const fn radius(self) -> f64 {
        match self {
            Self::Radius(radius) => radius,
            Self::Ellipse { a, b, .. } => a.min(b),
        }
    }

    /// Whether it has a place that is so far from its middle. One without any size has none.
    pub fn contains(self, x: f64, y: f64) -> bool {
        let (a, b, theta) = match self {
            Self::Radius(radius) => return radius > 0.0 && x.hypot(y) <= radius,
            Self::Ellipse { a, b, theta } => (a, b, theta),
        };
        let (along, across) = (x * theta.cos() + y * theta.sin(), y * theta.cos() - x * theta.sin());
        a > 0.0 && b > 0.0 && (along / a).hypot(across / b) <= 1.0
    }

    /// Whether it allows anything.
    pub fn is_some(self) -> bool {
        self.radius() > 0.0
    }
}

impl ActionStatus {
    /// Whether it is over.
    pub const fn has_ended(self) -> bool {
        matches!(self, Self::Finished | Self::Failed)
    }
}

/// The most bytes of a text in a message, but for the values of an action's parameters.
const TEXT_BYTES: usize = 1_024;

/// What a probe of topic `instantActions` begins with: it is an instant action message of nothing with one more member.
pub const PROBE: &[u8] = b"{\"caraProbe\":";

/// A probe that was sent so many milliseconds after the start.
pub fn probe(header: &Header, sent: u128) -> Vec<u8> {
    let header = serde_json::to_string(header).unwrap_or_default();
    [PROBE, format!("{sent},\"actions\":[],{}", header.trim_start_matches('{')).as_bytes()].concat()
}

/// When a probe was sent. One with an action is none.
pub fn sent_probe(bytes: &[u8]) -> Option<u64> {
    #[derive(Deserialize)]
    #[serde(rename_all = "camelCase")]
    struct Probe {
        cara_probe: u64,
        actions: [(); 0],
    }
    let Probe { cara_probe, actions: [] } = bytes.starts_with(PROBE).then(|| serde_json::from_slice(bytes).ok())??;
    Some(cara_probe)
}

/// Reads a message of a version, with the names that 2.0's schemas have instead of the document's. Texts of it are kept and reported:
/// their length is bounded.
pub fn read<T: DeserializeOwned>(version: Version, text: &[u8]) -> Result<T, serde_json::Error> {
    let wrong = <serde_json::Error as serde::de::Error>::custom;
    let mut value: Value = serde_json::from_slice(text)?;
    if has_long_text(&value) {
        return Err(wrong("a text is longer than 1,024 bytes".to_owned()));
    }
    match version {
        Version::V2 => read_second(&mut value),
        Version::V3 => third::read(&mut value),
    }
    .map_err(wrong)?;
    serde_json::from_value(value)
}

/// A message as a version has it.
pub fn write(version: Version, message: &impl Serialize) -> Vec<u8> {
    let written = match version {
        Version::V2 => serde_json::to_vec(message),
        Version::V3 => serde_json::to_value(message).and_then(|mut value| {
            third::write(&mut value, "");
            serde_json::to_vec(&value)
        }),
    };
    written.unwrap_or_default()
}

/// The factsheet of a file, with the names of 2.x or of 3.0.
pub fn factsheet(mut value: Value) -> Result<Factsheet, serde_json::Error> {
    third::read_any(&mut value);
    serde_json::from_value(value)
}

/// Members that 3.0 has added to orders and instant actions: in 2.x they say nothing.
const ADDED: [&str; 5] =
    ["retriable", "reachOrientationBeforeEntering", "releaseRequired", "releaseLossBehavior", "orderDescription"];

fn read_second(value: &mut Value) -> Result<(), String> {
    let mut wrong = None;
    each_object(value, &mut |object| {
        for (schema, document) in [("actionName", "actionType"), ("allowedDeviationXy", "allowedDeviationXY")] {
            if let Some(old) = object.remove(schema) {
                object.entry(document).or_insert(old);
            }
        }
        ADDED.iter().for_each(|name| drop(object.remove(*name)));
        if object.get("blockingType").is_some_and(|word| word == "SINGLE") {
            wrong = Some("blockingType SINGLE is of 3.0");
        }
        if object.get("allowedDeviationXY").is_some_and(Value::is_object) {
            wrong = Some("allowedDeviationXY is a number in 2.x");
        }
    });
    wrong.map_or(Ok(()), |why| Err(why.to_owned()))
}

fn has_long_text(value: &Value) -> bool {
    match value {
        Value::String(text) => text.len() > TEXT_BYTES,
        Value::Array(values) => values.iter().any(has_long_text),
        Value::Object(object) => object.iter().any(|(key, value)| *key != "value" && has_long_text(value)),
        _ => false,
    }
}

fn each_object(value: &mut Value, change: &mut impl FnMut(&mut Map<String, Value>)) {
    match value {
        Value::Object(object) => {
            change(object);
            // The value of an action's parameter is the application's.
            object.iter_mut().filter(|(key, _)| *key != "value").for_each(|(_, value)| each_object(value, change));
        }
        Value::Array(values) => values.iter_mut().for_each(|value| each_object(value, change)),
        _ => {}
    }
}
