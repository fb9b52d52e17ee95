//! The names of 3.0 for what the model has with those of 2.1.
//!
//! The document of 3.0 counts where it and the schemas differ: an edge's `maximumRotationSpeed` is read under the name of the schema as
//! well, `maxRotationSpeed`.

use serde_json::{Map, Value};

/// The member that an object or a list of objects is the value of (empty: any), a name in the model, and in 3.0.
const NAMES: [(&str, &str, &str); 53] = [
    // Order and state.
    ("", "nodeDescription", "nodeDescriptor"),
    ("", "edgeDescription", "edgeDescriptor"),
    ("actions", "actionDescription", "actionDescriptor"),
    ("actionStates", "actionDescription", "actionDescriptor"),
    ("instantActionStates", "actionDescription", "actionDescriptor"),
    ("maps", "mapDescription", "mapDescriptor"),
    ("information", "infoDescription", "infoDescriptor"),
    ("edges", "maxSpeed", "maximumSpeed"),
    ("edges", "maxHeight", "maximumMobileRobotHeight"),
    ("edges", "minHeight", "minimumLoadHandlingDeviceHeight"),
    ("edges", ROTATION_OF_SCHEMA, "maximumRotationSpeed"),
    ("corridor", "corridorRefPoint", "corridorReferencePoint"),
    ("", "resultDescription", "actionResult"),
    ("", "agvPosition", "mobileRobotPosition"),
    ("agvPosition", "positionInitialized", "localized"),
    ("", "batteryState", "powerSupply"),
    ("batteryState", "batteryCharge", "stateOfCharge"),
    ("batteryState", "reach", "range"),
    ("safetyState", "eStop", "activeEmergencyStop"),
    // Factsheet.
    ("", "agvGeometry", "mobileRobotGeometry"),
    ("", "vehicleConfig", "mobileRobotConfiguration"),
    ("", "agvActions", "mobileRobotActions"),
    ("typeSpecification", "agvKinematic", "mobileRobotKinematics"),
    ("typeSpecification", "agvClass", "mobileRobotClass"),
    ("typeSpecification", "maxLoadMass", "maximumLoadMass"),
    ("physicalParameters", "speedMin", "minimumSpeed"),
    ("physicalParameters", "speedMax", "maximumSpeed"),
    ("physicalParameters", "accelerationMax", "maximumAcceleration"),
    ("physicalParameters", "decelerationMax", "maximumDeceleration"),
    ("physicalParameters", "heightMin", "minimumHeight"),
    ("physicalParameters", "heightMax", "maximumHeight"),
    ("protocolLimits", "maxStringLens", "maximumStringLengths"),
    ("protocolLimits", "maxArrayLens", "maximumArrayLengths"),
    ("maxStringLens", "msgLen", "maximumMessageLength"),
    ("maxStringLens", "topicSerialLen", "maximumTopicSerialLength"),
    ("maxStringLens", "topicElemLen", "maximumTopicElementLength"),
    ("maxStringLens", "idLen", "maximumIdLength"),
    ("maxStringLens", "loadIdLen", "maximumLoadIdLength"),
    ("timing", "minOrderInterval", "minimumOrderInterval"),
    ("timing", "minStateInterval", "minimumStateInterval"),
    ("envelopes2d", "set", "envelope2dId"),
    ("envelopes2d", "polygonPoints", "vertices"),
    ("envelopes3d", "set", "envelope3dId"),
    ("loadSets", "maxWeight", "maximumWeight"),
    ("loadSets", "minLoadhandlingHeight", "minimumLoadhandlingHeight"),
    ("loadSets", "maxLoadhandlingHeight", "maximumLoadhandlingHeight"),
    ("loadSets", "minLoadhandlingDepth", "minimumLoadhandlingDepth"),
    ("loadSets", "maxLoadhandlingDepth", "maximumLoadhandlingDepth"),
    ("loadSets", "minLoadhandlingTilt", "minimumLoadhandlingTilt"),
    ("loadSets", "maxLoadhandlingTilt", "maximumLoadhandlingTilt"),
    ("loadSets", "agvSpeedLimit", "maximumSpeed"),
    ("loadSets", "agvAccelerationLimit", "maximumAcceleration"),
    ("loadSets", "agvDecelerationLimit", "maximumDeceleration"),
];
const ROTATION_OF_SCHEMA: &str = "maxRotationSpeed";

/// A member, a word of it in the model, and in 3.0.
const WORDS: [(&str, &str, &str); 8] = [
    ("actionType", "initPosition", "initializePosition"),
    ("connectionState", "CONNECTIONBROKEN", "CONNECTION_BROKEN"),
    ("corridorRefPoint", "KINEMATICCENTER", "KINEMATIC_CENTER"),
    ("operatingMode", "TEACHIN", "TEACH_IN"),
    ("agvKinematic", "DIFF", "DIFFERENTIAL"),
    ("agvKinematic", "OMNI", "OMNIDIRECTIONAL"),
    ("agvKinematic", "THREEWHEEL", "THREE_WHEEL"),
    ("navigationTypes", "AUTONOMOUS", "FREELY_NAVIGATING"),
];

/// Members of the model that 3.0 lacks, and whether a message of 3.0 that has one all the same is refused: to ignore a limit is
/// dangerous.
const GONE: [(&str, &str, bool); 7] = [
    ("", "zoneSetId", true),
    ("edges", "rotationAllowed", true),
    ("edges", "startNodeId", false),
    ("edges", "endNodeId", false),
    ("nodePosition", "mapDescription", false),
    ("agvPosition", "mapDescription", false),
    ("maxStringLens", "enumLen", false),
];

/// Where members are limits.
const LIMITS: [&str; 2] = ["edges", "corridor"];

/// Whose content is the application's.
const OPAQUE: [&str; 2] = ["value", "data"];

fn names(within: &str) -> impl Iterator<Item = (&'static str, &'static str)> {
    NAMES.into_iter().filter(move |(place, ..)| place.is_empty() || *place == within).map(|(_, old, new)| (old, new))
}

/// From 3.0 to the model. An order that has a limit under its name of 2.x is refused: nobody would see that it limits nothing. Other
/// names of 2.x do no harm, and are no reason to refuse what stops a vehicle.
pub(super) fn read(message: &mut Value) -> Result<(), String> {
    adopt(message, "", true)?;
    join(message);
    Ok(())
}

/// The same of a factsheet that may have the names of 2.x or of 3.0.
pub(super) fn read_any(factsheet: &mut Value) {
    // Nothing is refused then.
    let _ = adopt(factsheet, "", false);
}

fn adopt(value: &mut Value, within: &str, is_strict: bool) -> Result<(), String> {
    match value {
        Value::Object(object) => {
            let is_limit = |(place, old, _): &(&str, &str, &str)| {
                *place == within && LIMITS.contains(place) && *old != ROTATION_OF_SCHEMA && object.contains_key(*old)
            };
            if let Some((_, old, new)) = NAMES.iter().find(|row| is_strict && is_limit(row)) {
                return Err(format!("{old} is called {new} in 3.0"));
            }
            for (old, new) in names(within) {
                if let Some(value) = object.remove(new) {
                    object.insert(old.into(), value);
                }
            }
            for (_, name, is_refused) in GONE.into_iter().filter(|(place, ..)| *place == within) {
                if object.remove(name).is_some() && is_refused && is_strict {
                    return Err(format!("{name} is not in 3.0"));
                }
            }
            if is_strict && object.get("allowedDeviationXY").is_some_and(Value::is_number) {
                return Err("allowedDeviationXY is an ellipse in 3.0".into());
            }
            inside(object).try_for_each(|(key, value)| adopt(value, key, is_strict))
        }
        Value::Array(values) => values.iter_mut().try_for_each(|value| adopt(value, within, is_strict)),
        Value::String(text) => {
            swap(text, within, is_strict);
            Ok(())
        }
        _ => Ok(()),
    }
}

/// 3.0 does not say which nodes an edge joins: those beside it (6.1.1).
fn join(order: &mut Value) {
    let ids: Vec<Value> = match order.get("nodes").and_then(Value::as_array) {
        Some(nodes) => nodes.iter().map(|node| node["nodeId"].clone()).collect(),
        None => return,
    };
    let edges = order.get_mut("edges").and_then(Value::as_array_mut);
    for (index, edge) in edges.into_iter().flatten().enumerate() {
        let Some(edge) = edge.as_object_mut() else { continue };
        for (name, node) in [("startNodeId", index), ("endNodeId", index + 1)] {
            // One edge too many is refused when the order is judged.
            edge.insert(name.into(), ids.get(node).cloned().unwrap_or_else(|| "".into()));
        }
    }
}

/// From the model to 3.0.
pub(super) fn write(value: &mut Value, within: &str) {
    match value {
        Value::Object(object) => {
            inside(object).for_each(|(key, value)| write(value, key));
            for (_, name, _) in GONE.into_iter().filter(|(place, ..)| *place == within) {
                object.remove(name);
            }
            for (old, new) in names(within) {
                if let Some(value) = object.remove(old) {
                    object.insert(new.into(), value);
                }
            }
            if within == "errorReferences" {
                name_reference(object);
            }
        }
        Value::Array(values) => values.iter_mut().for_each(|value| write(value, within)),
        Value::String(text) => swap(text, within, true),
        _ => {}
    }
}

/// A reference to a member of an order has the member's name.
fn name_reference(reference: &mut Map<String, Value>) {
    let key = reference.get("referenceKey").and_then(Value::as_str);
    let Some((old, new)) = key.and_then(|key| names("edges").find(|(old, _)| *old == key)) else { return };
    reference.insert("referenceKey".into(), new.into());
    if reference.get("referenceValue").is_some_and(|value| value == old) {
        reference.insert("referenceValue".into(), new.into());
    }
}

fn inside(object: &mut Map<String, Value>) -> impl Iterator<Item = (&str, &mut Value)> {
    object.iter_mut().map(|(key, value)| (key.as_str(), value)).filter(|(key, _)| !OPAQUE.contains(key))
}

/// A word of 3.0 becomes that of the model; and the other way round, so that a word of 2.x is none of 3.0, unless either may come.
fn swap(text: &mut String, member: &str, is_strict: bool) {
    for (_, old, new) in WORDS.into_iter().filter(|(place, ..)| *place == member) {
        if text == new || text == old && is_strict {
            *text = if text == new { old } else { new }.into();
            return;
        }
    }
}
