//! The messages of other systems, from values to bytes, to JSON, and back.

use std::fmt::Debug;

use super::{lif, nav, vda};
use cara_core::distribution::block::{self, SliceWriter};
use cara_core::distribution::parameters::Parameters;
use cara_std::control::json as values;
use cara_std::{Definition, Variables};
use serde_json::{Value as Json, json};

type Large = Box<Parameters<65_536>>;

fn definition<V: Variables>() -> Definition {
    let mut parameters = Large::new(Parameters::sized());
    V::SPECS.iter().try_for_each(|spec| parameters.add_spec(*spec)).unwrap();
    Definition::new("f").unwrap().arguments(&*parameters).unwrap()
}

/// The value, through bytes.
fn through_bytes<V: Variables>(value: &V) -> V {
    let (mut sent, mut got) = (Large::new(Parameters::sized()), Large::new(Parameters::sized()));
    value.to_parameters(&mut sent).unwrap();
    let definition = definition::<V>();
    let specs = definition.signature().arguments();
    let mut bytes = vec![0; block::measure(specs, &sent).unwrap()];
    block::write(specs, &*sent, &mut SliceWriter::new(&mut bytes));
    block::read_arguments(specs, &bytes, &mut *got).unwrap();
    V::from_parameters(&got).unwrap()
}

fn to_json<V: Variables>(value: &V) -> Json {
    let mut parameters = Large::new(Parameters::sized());
    value.to_parameters(&mut parameters).unwrap();
    let shown = |name: &str| values::to_json(&parameters.value(name).unwrap());
    let all = V::SPECS.iter().map(|spec| (spec.name.to_owned(), shown(spec.name)));
    Json::Object(all.filter(|(_, value)| !value.is_null()).collect())
}

fn from_json<V: Variables>(json: &Json) -> V {
    let mut parameters = Large::new(Parameters::sized());
    for spec in V::SPECS {
        parameters.add_spec(*spec).unwrap();
        let given = json.get(spec.name).unwrap_or(&Json::Null);
        values::set(&mut parameters, *spec, given).unwrap_or_else(|bad| panic!("{bad}")).unwrap();
    }
    V::from_parameters(&parameters).unwrap()
}

fn survives<V: Variables + Debug + PartialEq>(value: &V) {
    assert_eq!(through_bytes(value), *value);
    assert_eq!(from_json::<V>(&to_json(value)), *value);
}

/// A document becomes the same one.
fn document_survives<V: Variables + Debug + PartialEq>(document: &Json) -> V {
    let read: V = from_json(document);
    survives(&read);
    assert_eq!(to_json(&read), *document);
    read
}

fn pose(x: f64) -> nav::Pose {
    nav::Pose {
        position: nav::Vector3 { x, y: -2.5, z: 0.0 },
        orientation: nav::Quaternion { x: 0.0, y: 0.0, z: 0.0, w: 1.0 },
    }
}

fn header(sec: i32) -> nav::Header {
    nav::Header { stamp: nav::Time { sec, nanosec: 999_999_999 }, frame_id: "map".into() }
}

#[test]
fn messages_of_ros_have_the_fields_of_their_definitions_and_survive() {
    const HEADER: &str = "header: {stamp: {sec: int, nanosec: int}, frame_id: string[64]}";
    const XYZ: &str = "{x: float, y: float, z: float}";
    const POSE: &str =
        "pose: {position: {x: float, y: float, z: float}, orientation: {x: float, y: float, z: float, w: float}}";
    assert_eq!(definition::<nav::Path>().to_string(), format!("f({HEADER}, poses: {{{HEADER}, {POSE}}}[..200])"));
    let twist = format!("twist: {{linear: {XYZ}, angular: {XYZ}}}");
    assert_eq!(
        definition::<nav::Odometry>().to_string(),
        format!(
            "f({HEADER}, child_frame_id: string[64], pose: {{{POSE}, covariance: float[36]}}, \
             twist: {{{twist}, covariance: float[36]}})"
        )
    );

    let stamped = |sec| nav::PoseStamped { header: header(sec), pose: pose(sec.into()) };
    for poses in [vec![], (0..200).map(stamped).collect()] {
        survives(&nav::Path { header: header(-1), poses });
    }
    let covariance = std::array::from_fn(|index| index as f64 / 8.0);
    let velocity = nav::Vector3 { x: 1.5, ..nav::Vector3::default() };
    survives(&nav::Odometry {
        header: header(i32::MAX),
        child_frame_id: "base_link".into(),
        pose: nav::PoseWithCovariance { pose: pose(1.0), covariance },
        twist: nav::TwistWithCovariance {
            twist: nav::Twist { linear: velocity, angular: nav::Vector3::default() },
            covariance,
        },
    });
}

#[test]
fn layouts_survive_with_all_that_may_be_absent_and_without() {
    let action = json!({ "actionType": "pick", "actionDescription": "lift it", "requirementType": "REQUIRED",
        "blockingType": "HARD", "actionParameters": [{ "key": "height", "value": "0.1" }] });
    let fewest = json!({ "nodeId": "n2", "nodePosition": { "x": 0.0, "y": -1.0 }, "vehicleTypeNodeProperties":
        [{ "vehicleTypeId": "acme.tug", "actions": [] }] });
    let nodes: lif::Nodes = document_survives(&json!({
        "layoutId": "hall", "layoutName": "Hall 1", "layoutVersion": "1", "layoutLevelId": "0", "layoutDescription": "north",
        "nodes": [
            { "nodeId": "n1", "nodeName": "dock", "nodeDescription": "a dock", "mapId": "m", "nodePosition": { "x": 1.5, "y": 2.0 },
              "vehicleTypeNodeProperties": [{ "vehicleTypeId": "acme.tug", "theta": 0.5, "actions": [action] }] },
            fewest,
        ],
        "stations": [
            { "stationId": "s1", "interactionNodeIds": ["n1", "n2"], "stationName": "S", "stationDescription": "a station",
              "stationHeight": 0.25, "stationPosition": { "x": 1.0, "y": 2.0, "theta": 3.0 } },
            { "stationId": "s2", "interactionNodeIds": ["n1"] },
        ],
    }));
    assert_eq!(
        (nodes.nodes[1].map_id.as_ref(), nodes.nodes[0].vehicle_type_node_properties[0].theta),
        (None, Some(0.5))
    );

    let all = json!({ "vehicleTypeId": "acme.tug", "vehicleOrientation": 0.0, "orientationType": "TANGENTIAL",
        "rotationAllowed": false, "rotationAtStartNodeAllowed": "CCW", "rotationAtEndNodeAllowed": "BOTH", "maxSpeed": 1.5,
        "maxRotationSpeed": 0.5, "minHeight": 0.0, "maxHeight": 2.0,
        "loadRestriction": { "unloaded": true, "loaded": true, "loadSetNames": ["EPAL"] }, "actions": [action],
        "trajectory": { "degree": 1, "knotVector": [0.0, 0.0, 1.0, 1.0], "controlPoints":
            [{ "x": 0.0, "y": 0.0, "weight": 1.0 }, { "x": 1.0, "y": 0.0, "weight": 1.0 }] }, "reentryAllowed": true });
    document_survives::<lif::Edges>(&json!({
        "layoutId": "hall", "layoutVersion": "1",
        "edges": [
            { "edgeId": "e1", "edgeName": "aisle", "edgeDescription": "an aisle", "startNodeId": "n1", "endNodeId": "n2",
              "vehicleTypeEdgeProperties": [all] },
            { "edgeId": "e2", "startNodeId": "n2", "endNodeId": "n1", "vehicleTypeEdgeProperties":
                [{ "vehicleTypeId": "acme.tug", "rotationAllowed": true, "actions": [] }] },
        ],
    }));
}

#[test]
fn action_parameters_are_of_several_types() {
    let value = |value: Json| json!({ "key": "k", "value": value });
    let visits: vda::Visits = document_survives(
        &json!({ "orderId": "o-1", "nodes": [{ "nodeId": "n1", "sequenceId": 0,
        "released": true, "actions": [{ "actionType": "pick", "actionId": "a-1", "blockingType": "SOFT", "actionParameters": [
            value(json!({ "string": "left" })), value(json!({ "integer": 9_007_199_254_740_993_i64 })),
            value(json!({ "number": 0.5 })), value(json!({ "boolean": false })), value(json!({ "json": "[1, {}]" })),
        ] }] }] }),
    );
    let parameters = &visits.nodes[0].actions[0].action_parameters;
    assert_eq!(parameters[1].value, vda::ActionValue::Integer(9_007_199_254_740_993));
    // As deep as there is.
    let text = definition::<vda::Visits>().to_string();
    let deeper = text.replacen("f(orderId", "f(all: {orderId", 1).replacen(')', "})", 1);
    assert!(Definition::parse(&text).is_ok() && Definition::parse(&deeper).is_err(), "{deeper}");
}
