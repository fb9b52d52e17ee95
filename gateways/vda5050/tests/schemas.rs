//! Each message is what the standard's schemas say: generated with all members and with the least, read, written and validated.

use std::path::Path;

use cara_vda5050::message::{Connection, Factsheet, InstantActions, Order, State, Visualization, read};
use serde::Serialize;
use serde::de::DeserializeOwned;
use serde_json::{Map, Value, json};

/// Where the document counts, and not the schema: these members are added to generated messages.
const HEADER: [&str; 5] = ["headerId", "timestamp", "version", "manufacturer", "serialNumber"];

fn schema(version: &str, topic: &str) -> Value {
    let file = Path::new(env!("CARGO_MANIFEST_DIR")).join(format!("schemas/{version}/{topic}.schema"));
    serde_json::from_slice(&std::fs::read(file).unwrap()).unwrap()
}

/// A message of a schema, with all its members or only those that it requires. `turn` chooses among words and types.
fn generated(schema: &Value, root: &Value, all: bool, turn: usize) -> Value {
    let schema = match schema.get("$ref").and_then(Value::as_str) {
        Some(path) => root.pointer(path.trim_start_matches('#')).unwrap(),
        None => schema,
    };
    if let Some(words) = schema.get("enum").and_then(Value::as_array) {
        return words[turn % words.len()].clone();
    }
    let kind = match &schema["type"] {
        Value::Array(kinds) => kinds[turn % kinds.len()].as_str().unwrap(),
        kind => kind.as_str().unwrap(),
    };
    match kind {
        "object" => {
            let required: Vec<&str> = schema
                .get("required")
                .and_then(Value::as_array)
                .into_iter()
                .flatten()
                .filter_map(Value::as_str)
                .collect();
            let members = schema.get("properties").and_then(Value::as_object);
            let wanted = members.into_iter().flatten().filter(|(name, of)| {
                // The factsheet's schema gives the words of an array's elements to the array, which nothing satisfies.
                let is_possible = of["type"] != "array" || of.get("enum").is_none();
                is_possible && all
                    || required.contains(&name.as_str())
                    || HEADER.contains(&name.as_str())
                    || *name == "actions"
            });
            Value::Object(
                wanted.map(|(name, of)| (name.clone(), generated(of, root, all, turn))).collect::<Map<_, _>>(),
            )
        }
        "array" => match schema.get("items") {
            Some(items) => (turn..turn + 3).map(|turn| generated(items, root, all, turn)).collect(),
            None => json!([]),
        },
        "string" if schema["format"] == "date-time" => json!("2026-11-28T09:30:00.12Z"),
        "string" => json!(format!("text-{turn}")),
        "integer" => json!(turn + 1),
        "number" => json!(0.25 + 0.125 * (turn % 4) as f64),
        "boolean" => json!(turn.is_multiple_of(2)),
        other => panic!("{other}"),
    }
}

/// Reads and writes messages of a topic in a version; nothing is lost, nothing is added, and what is written is valid.
fn round_trip<T: Serialize + DeserializeOwned>(version: &str, topic: &str, known: impl Fn(&str) -> String) {
    let schema = schema(version, topic);
    let validator = jsonschema::validator_for(&schema).unwrap();
    for (all, turn) in [(true, 0), (true, 1), (true, 2), (true, 3), (true, 4), (true, 5), (false, 0)] {
        let message = generated(&schema, &schema, all, turn);
        assert!(validator.is_valid(&message), "{version} {topic}: the generator is wrong");
        let written = serde_json::to_value(read::<T>(message.to_string().as_bytes()).unwrap()).unwrap();
        let expected: Value = serde_json::from_str(&known(&message.to_string())).unwrap();
        assert_eq!(sorted(&written), sorted(&expected), "{version} {topic}");
        if expected == message {
            assert!(validator.is_valid(&written), "{version} {topic}");
        }
        for name in schema["required"].as_array().into_iter().flatten().filter_map(Value::as_str) {
            let mut lacking = message.clone();
            lacking.as_object_mut().unwrap().remove(name);
            assert!(read::<T>(lacking.to_string().as_bytes()).is_err(), "{version} {topic} without {name}");
        }
    }
}

/// Whole numbers are written as they are, so a float that is whole compares as one.
fn sorted(value: &Value) -> Value {
    match value {
        Value::Number(number) => json!(number.as_f64()),
        Value::Array(values) => values.iter().map(sorted).collect(),
        Value::Object(object) => {
            let mut members: Vec<_> = object.iter().map(|(name, value)| (name.clone(), sorted(value))).collect();
            members.sort_by(|one, other| one.0.cmp(&other.0));
            Value::Object(members.into_iter().collect())
        }
        other => other.clone(),
    }
}

#[test]
fn messages_are_those_of_the_schemas() {
    for version in ["2.0.0", "2.1.0"] {
        // What 2.0's schemas call otherwise than its document.
        let document = |message: &str| {
            message.replace("allowedDeviationXy", "allowedDeviationXY").replace("actionName", "actionType")
        };
        round_trip::<Order>(version, "order", document);
        round_trip::<InstantActions>(version, "instantActions", document);
        round_trip::<State>(version, "state", str::to_owned);
        round_trip::<Connection>(version, "connection", str::to_owned);
        round_trip::<Visualization>(version, "visualization", str::to_owned);
    }
    // 2.0's schema of the factsheet has its members beside `properties`, and so demands names without saying what they are.
    round_trip::<Factsheet>("2.1.0", "factsheet", str::to_owned);
}

#[test]
fn members_may_be_null() {
    let schema = schema("2.1.0", "order");
    let text = generated(&schema, &schema, true, 0).to_string().replace("\"text-0\"", "null");
    let text = text.replace("\"zoneSetId\":null", "\"zoneSetId\":null,\"unheardOf\":1");
    // The identifiers are null as well, which is refused.
    assert!(read::<Order>(text.as_bytes()).is_err());
    let mut order: Value = generated(&schema, &schema, true, 0);
    for pointer in ["/zoneSetId", "/nodes/0/nodePosition", "/edges/0/maxSpeed", "/edges/0/trajectory"] {
        *order.pointer_mut(pointer).unwrap() = Value::Null;
    }
    let order: Order = read(order.to_string().as_bytes()).unwrap();
    assert_eq!((&order.zone_set_id, &order.nodes[0].node_position, order.edges[0].max_speed), (&None, &None, None));
}
