//! Each message is what the standard's schemas say: generated with all members and with the least, read, written and validated.

use std::path::Path;

use cara_vda5050::message::{
    Connection, Deviation, Factsheet, InstantActions, Order, Responses, State, Visualization, ZoneSetMessage, read,
    write,
};
use cara_vda5050::version::Version;
use serde::de::{DeserializeOwned, MapAccess, SeqAccess, Visitor};
use serde::{Deserialize, Deserializer, Serialize};
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

/// What 3.0 has in messages of the vehicle, and the gateway never writes.
const NEVER_WRITTEN: [&str; 8] = [
    "plannedPath",
    "intermediatePath",
    "zoneSets",
    "zoneRequests",
    "edgeRequests",
    "zoneActionStates",
    "errorDescriptionTranslations",
    "errorHintTranslations",
];
/// Needed in 3.0 and absent from 2.x: optional where the gateway writes them only.
const FILLED_IN: [&str; 2] = ["instantActionStates", "referenceStateHeaderId"];

fn without_never_written(value: &mut Value) {
    match value {
        Value::Object(object) => {
            object.retain(|name, _| !NEVER_WRITTEN.contains(&name.as_str()));
            object.values_mut().for_each(without_never_written);
        }
        Value::Array(values) => values.iter_mut().for_each(without_never_written),
        _ => {}
    }
}

/// Reads and writes messages of a topic in a version; nothing is lost, nothing is added, and what is written is valid.
fn round_trip<T: Serialize + DeserializeOwned>(version: &str, topic: &str, known: impl Fn(&str) -> String) {
    let schema = schema(version, topic);
    let of = Version::of(version).unwrap_or(Version::V3);
    let validator = jsonschema::validator_for(&schema).unwrap();
    for (all, turn) in [(true, 0), (true, 1), (true, 2), (true, 3), (true, 4), (true, 5), (false, 0)] {
        let mut message = generated(&schema, &schema, all, turn);
        without_never_written(&mut message);
        assert!(validator.is_valid(&message), "{version} {topic}: the generator is wrong");
        let taken = read::<T>(of, message.to_string().as_bytes()).unwrap_or_else(|error| panic!("{topic}: {error}"));
        let written: Value = serde_json::from_slice(&write(of, &taken)).unwrap();
        let expected: Value = serde_json::from_str(&known(&message.to_string())).unwrap();
        assert_eq!(sorted(&written), sorted(&expected), "{version} {topic}");
        if expected == message {
            assert!(validator.is_valid(&written), "{version} {topic}");
        }
        let needed = schema["required"].as_array().into_iter().flatten().filter_map(Value::as_str);
        for name in needed.filter(|name| !FILLED_IN.contains(name)) {
            let mut lacking = message.clone();
            lacking.as_object_mut().unwrap().remove(name);
            assert!(read::<T>(of, lacking.to_string().as_bytes()).is_err(), "{version} {topic} without {name}");
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

/// The schemas of tag 3.0.0 cannot be used: three of them are no JSON.
const THIRD: &str = "main-0b2ae43";

#[test]
fn messages_of_3_are_those_of_the_later_commit() {
    // The document calls it so, and the schema otherwise.
    let document = |message: &str| message.replace("\"maxRotationSpeed\"", "\"maximumRotationSpeed\"");
    round_trip::<Order>(THIRD, "order", document);
    round_trip::<InstantActions>(THIRD, "instantActions", str::to_owned);
    round_trip::<State>(THIRD, "state", str::to_owned);
    round_trip::<Connection>(THIRD, "connection", str::to_owned);
    round_trip::<Visualization>(THIRD, "visualization", str::to_owned);
    round_trip::<Responses>(THIRD, "responses", str::to_owned);
    round_trip::<Factsheet>(THIRD, "factsheet", str::to_owned);
}

/// It is refused, so that no more of it is read than its name.
#[test]
fn a_zone_set_is_read_by_its_name() {
    let zone = json!({
        "zoneId": "z1", "zoneType": "RELEASE", "releaseLossBehavior": "STOP",
        "vertices": [{"x": 0.0, "y": 0.0}, {"x": 1.0, "y": 0.0}, {"x": 0.0, "y": 1.0}],
    });
    let message = json!({
        "headerId": 1, "timestamp": "2026-11-29T09:30:00.12Z", "version": "3.0.0", "manufacturer": "KIT",
        "serialNumber": "0001", "zoneSet": {"zoneSetId": "s1", "mapId": "hall", "zones": [zone]},
    });
    assert!(jsonschema::validator_for(&schema(THIRD, "zoneSet")).unwrap().is_valid(&message));
    let read = read::<ZoneSetMessage>(Version::V3, message.to_string().as_bytes()).unwrap();
    assert_eq!(read.zone_set.zone_set_id, "s1");
}

/// A limit under a name that 3.0 does not have would be one that nobody keeps.
#[test]
fn names_of_another_version_are_refused() {
    let schemas = [("2.1.0", schema("2.1.0", "order")), ("3.0.0", schema(THIRD, "order"))];
    let orders = schemas.map(|(version, schema)| (version, generated(&schema, &schema, true, 0)));
    let spoilt = [
        (0, "/nodes/0/actions/0/blockingType", json!("SINGLE"), "SINGLE is of 3.0"),
        (0, "/nodes/0/nodePosition/allowedDeviationXY", json!({"a": 1, "b": 1, "theta": 0}), "a number in 2.x"),
        (1, "/edges/0/maxSpeed", json!(1.0), "maxSpeed is called maximumSpeed"),
        (1, "/edges/0/rotationAllowed", json!(false), "rotationAllowed is not in 3.0"),
        (1, "/nodes/0/nodePosition/allowedDeviationXY", json!(1.0), "an ellipse in 3.0"),
        (1, "/zoneSetId", json!("zones"), "zoneSetId is not in 3.0"),
        (1, "/edges/0/corridor/corridorReferencePoint", json!("KINEMATICCENTER"), "unknown variant"),
    ];
    for (which, pointer, value, named) in spoilt {
        let (version, mut order) = orders[which].clone();
        let of = Version::of(version).unwrap();
        assert!(read::<Order>(of, order.to_string().as_bytes()).is_ok());
        let (parent, name) = pointer.rsplit_once('/').unwrap();
        order.pointer_mut(parent).unwrap().as_object_mut().unwrap().insert(name.into(), value);
        let error = read::<Order>(of, order.to_string().as_bytes()).unwrap_err().to_string();
        assert!(error.contains(named), "{pointer}: {error}");
    }
}

/// What stops a vehicle is not refused for the name of a description.
#[test]
fn a_pause_with_a_name_of_2_is_read() {
    let schema = schema(THIRD, "instantActions");
    let text = generated(&schema, &schema, true, 0).to_string().replace("actionDescriptor", "actionDescription");
    let message = read::<InstantActions>(Version::V3, text.as_bytes()).unwrap();
    assert_eq!(message.actions[0].action_description.as_deref(), Some("text-0"));
}

#[test]
fn members_may_be_null() {
    let schema = schema("2.1.0", "order");
    let text = generated(&schema, &schema, true, 0).to_string().replace("\"text-0\"", "null");
    let text = text.replace("\"zoneSetId\":null", "\"zoneSetId\":null,\"unheardOf\":1");
    // The identifiers are null as well, which is refused.
    assert!(read::<Order>(Version::V2, text.as_bytes()).is_err());
    let mut order: Value = generated(&schema, &schema, true, 0);
    *order.pointer_mut("/nodes/1/nodePosition/allowedDeviationXY").unwrap() = json!(2);
    for pointer in ["/zoneSetId", "/nodes/0/nodePosition", "/edges/0/maxSpeed", "/edges/0/trajectory"] {
        *order.pointer_mut(pointer).unwrap() = Value::Null;
    }
    let order: Order = read(Version::V2, order.to_string().as_bytes()).unwrap();
    let deviation = order.nodes[1].node_position.as_ref().unwrap().allowed_deviation_xy.unwrap();
    assert_eq!(deviation, Deviation::Radius(2.0), "a whole number is a number");
    assert_eq!((&order.zone_set_id, &order.nodes[0].node_position, order.edges[0].max_speed), (&None, &None, None));
}

/// JSON whose members keep their order.
#[derive(Clone)]
enum Ordered {
    Object(Vec<(String, Ordered)>),
    List(Vec<Ordered>),
    Other(Value),
}

impl<'de> Deserialize<'de> for Ordered {
    fn deserialize<D: Deserializer<'de>>(deserializer: D) -> Result<Self, D::Error> {
        struct Any;
        impl<'de> Visitor<'de> for Any {
            type Value = Ordered;
            fn expecting(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
                f.write_str("JSON")
            }
            fn visit_map<A: MapAccess<'de>>(self, mut map: A) -> Result<Ordered, A::Error> {
                let mut members = Vec::new();
                while let Some(member) = map.next_entry()? {
                    members.push(member);
                }
                Ok(Ordered::Object(members))
            }
            fn visit_seq<A: SeqAccess<'de>>(self, mut list: A) -> Result<Ordered, A::Error> {
                let mut elements = Vec::new();
                while let Some(element) = list.next_element()? {
                    elements.push(element);
                }
                Ok(Ordered::List(elements))
            }
            fn visit_bool<E>(self, value: bool) -> Result<Ordered, E> {
                Ok(Ordered::Other(value.into()))
            }
            fn visit_i64<E>(self, value: i64) -> Result<Ordered, E> {
                Ok(Ordered::Other(value.into()))
            }
            fn visit_u64<E>(self, value: u64) -> Result<Ordered, E> {
                Ok(Ordered::Other(value.into()))
            }
            fn visit_f64<E>(self, value: f64) -> Result<Ordered, E> {
                Ok(Ordered::Other(value.into()))
            }
            fn visit_str<E>(self, value: &str) -> Result<Ordered, E> {
                Ok(Ordered::Other(value.into()))
            }
        }
        deserializer.deserialize_any(Any)
    }
}

impl Ordered {
    fn value(&self) -> Value {
        match self {
            Self::Object(members) => {
                members.iter().map(|(name, value)| (name.clone(), value.value())).collect::<Map<_, _>>().into()
            }
            Self::List(elements) => elements.iter().map(Self::value).collect(),
            Self::Other(value) => value.clone(),
        }
    }

    /// It with each object in it in turn, and each word, in another shape: a list of the members as serde would read them, and an
    /// object. What is in values of the application is theirs.
    fn spoilt(&self, within: &str) -> Vec<Value> {
        match self {
            _ if ["value", "data"].contains(&within) => Vec::new(),
            Self::Object(members) => {
                let list = members.iter().map(|(_, value)| value.value()).collect();
                let with = |index: usize, other: Value| {
                    let mut object = self.value();
                    object[&members[index].0] = other;
                    object
                };
                let inside = members.iter().enumerate().flat_map(|(index, (name, value))| {
                    value.spoilt(name).into_iter().map(move |other| with(index, other))
                });
                inside.chain([list]).collect()
            }
            Self::List(elements) => {
                let with = |index: usize, other: Value| {
                    let mut list = self.value();
                    list[index] = other;
                    list
                };
                let inside = elements
                    .iter()
                    .enumerate()
                    .flat_map(|(index, value)| value.spoilt(within).into_iter().map(move |other| with(index, other)));
                inside.collect()
            }
            Self::Other(Value::String(word)) if word.bytes().all(|letter| letter.is_ascii_uppercase()) => {
                vec![json!({word: null})]
            }
            Self::Other(_) => Vec::new(),
        }
    }
}

fn is_one_shape_read<T: Serialize + DeserializeOwned>(schemas: &str, topic: &str) {
    let schema = schema(schemas, topic);
    let mut message = generated(&schema, &schema, true, 0);
    without_never_written(&mut message);
    let version = Version::of(schemas).unwrap_or(Version::V3);
    let message: T = read(version, message.to_string().as_bytes()).unwrap();
    // In the model's order of members, and with its names.
    let ordered: Ordered = serde_json::from_str(&serde_json::to_string(&message).unwrap()).unwrap();
    assert!(serde_json::from_value::<T>(ordered.value()).is_ok(), "{topic}");
    let spoilt = ordered.spoilt("");
    assert!(spoilt.len() > usize::from(topic != "connection"), "{topic}");
    for value in spoilt {
        assert!(serde_json::from_value::<T>(value.clone()).is_err(), "{schemas} {topic}: {value}");
    }
}

/// A list would go past all that looks at the names of members.
#[test]
fn an_object_is_read_from_an_object_only() {
    for schemas in ["2.0.0", "2.1.0", THIRD] {
        is_one_shape_read::<Order>(schemas, "order");
        is_one_shape_read::<InstantActions>(schemas, "instantActions");
        is_one_shape_read::<State>(schemas, "state");
        is_one_shape_read::<Connection>(schemas, "connection");
        is_one_shape_read::<Visualization>(schemas, "visualization");
    }
    is_one_shape_read::<Factsheet>("2.1.0", "factsheet");
    is_one_shape_read::<Factsheet>(THIRD, "factsheet");
    is_one_shape_read::<Responses>(THIRD, "responses");
    is_one_shape_read::<ZoneSetMessage>(THIRD, "zoneSet");
    // As it comes: an edge with a limit that 3.0 calls otherwise, and a circle that is an ellipse.
    let schema = schema(THIRD, "order");
    let mut order = generated(&schema, &schema, true, 0);
    order["edges"][0] = json!(["e1", 1, true, "a", "b", [], null, 0.1]);
    assert!(read::<Order>(Version::V3, order.to_string().as_bytes()).is_err());
    let mut order = serde_json::to_value(Order::default()).unwrap();
    order["nodes"] = json!([{"nodeId": "a", "sequenceId": 0, "released": true, "actions": [],
        "nodePosition": {"x": 0.0, "y": 0.0, "mapId": "hall", "allowedDeviationXY": [9.0, 9.0, 0.0]}}]);
    assert!(read::<Order>(Version::V2, order.to_string().as_bytes()).is_err());
}
