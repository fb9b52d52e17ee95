//! Values as programs write them in JSON: a list is an array, a record an object.
//!
//! A single int, float or bool is a number or truth value, several are an array, text is text, and bytes are text of
//! two hexadecimal digits each. A float that JSON has no number for is `"NaN"`, `"inf"` or `"-inf"`.
//!
//! An optional value, `T?` or `T[..1]`, is the value alone or null, and a field of a record that has none is left out. As an
//! argument it may also be an array of at most one. `T??` is an array.

use std::fmt::Write;

use cara_core::distribution::function::VariableSpec;
use cara_core::distribution::parameters::{IntoValue, ListWriter, ParametersView, RecordWriter, Target, Type, Value};
use cara_core::error::Error;
use serde_json::Value as Json;

/// Why a JSON value is not one of a variable's type.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
#[error("{path}: expected {expected}, got {found}")]
pub struct BadValue {
    /// Where it is, as in `nodes[3].x`.
    pub path: String,
    /// The type that is expected there.
    pub expected: String,
    /// What is there.
    pub found: String,
}

/// A value as JSON.
pub fn to_json(value: &Value<'_>) -> Json {
    let several = |values: Vec<Json>| match <[Json; 1]>::try_from(values) {
        Ok([one]) if value.size() == 1 => one,
        Ok(one) => Json::Array(one.into()),
        Err(values) => Json::Array(values),
    };
    match value.kind() {
        Type::Int => several(value.ints().map(Json::from).collect()),
        Type::Float => several(value.floats().map(float).collect()),
        Type::Bool => several(value.bools().map(Json::from).collect()),
        Type::String => value.text().unwrap_or_default().into(),
        Type::Bytes => value.raw().iter().fold(String::new(), hexadecimal).into(),
        Type::List if is_optional(value.spec()) => {
            value.elements().next().map_or(Json::Null, |element| to_json(&element))
        }
        Type::List => value.elements().map(|element| to_json(&element)).collect(),
        Type::Record => {
            let fields = value.fields().map(|field| (field.name.to_owned(), field.value));
            let present = fields.filter(|(_, value)| !is_optional(value.spec()) || !value.elements().is_empty());
            present.map(|(name, value)| (name, to_json(&value))).collect()
        }
    }
}

/// Whether a variable is a value that may be absent. An optional value that is itself optional remains a list, or nothing would
/// tell which of the two is absent.
pub fn is_optional(spec: VariableSpec<'_>) -> bool {
    let is_one = |spec: VariableSpec<'_>| spec.kind == Type::List && spec.size == 1;
    is_one(spec) && !spec.element().is_some_and(is_one)
}

/// The elements of a list, and their type; `None` for JSON that is no list, or is too long.
fn listed<'s, 'j>(spec: VariableSpec<'s>, json: &'j Json) -> Option<(VariableSpec<'s>, &'j [Json])> {
    let element = spec.element()?;
    let elements = match json {
        Json::Null if is_optional(spec) => &[],
        // `[x]` for one value, unless the array itself is the value.
        Json::Array(one) if is_optional(spec) && (one.len() > 1 || check(element, json).is_ok()) => {
            std::slice::from_ref(json)
        }
        Json::Array(elements) => elements,
        _ if is_optional(spec) => std::slice::from_ref(json),
        _ => return None,
    };
    (elements.len() <= spec.size as usize).then_some((element, elements))
}

/// Sets the variable that `spec` names; [`BadValue`] as an error of its own, before anything is set.
pub fn set(
    parameters: &mut ParametersView,
    spec: VariableSpec<'_>,
    json: &Json,
) -> Result<Result<(), Error>, BadValue> {
    check(spec, json)?;
    Ok(set_checked(parameters, spec, json))
}

/// The same for a value that [`check`] has accepted.
pub(super) fn set_checked(parameters: &mut ParametersView, spec: VariableSpec<'_>, json: &Json) -> Result<(), Error> {
    match spec.kind {
        Type::List => parameters.set_list(spec.name, |list| elements(list, spec, json)),
        Type::Record => parameters.set_record(spec.name, |record| fields(record, spec, json)),
        _ => leaf(spec, json).map_or(Ok(()), |leaf| parameters.set_value(spec.name, leaf)),
    }
}

/// Whether `json` is a value of the variable, all of it.
pub fn check(spec: VariableSpec<'_>, json: &Json) -> Result<(), BadValue> {
    check_at(spec, json, &mut spec.name.to_owned())
}

fn check_at(spec: VariableSpec<'_>, json: &Json, path: &mut String) -> Result<(), BadValue> {
    let length = path.len();
    match (spec.kind, listed(spec, json), json) {
        (Type::List, Some((element, elements)), _) => {
            for (index, json) in elements.iter().enumerate() {
                if !is_optional(spec) {
                    // Writing to a string does not fail.
                    let _ = write!(path, "[{index}]");
                }
                check_at(element, json, path)?;
                path.truncate(length);
            }
            Ok(())
        }
        (Type::Record, _, Json::Object(object)) => {
            for field in spec.fields() {
                path.push('.');
                path.push_str(field.name);
                match object.get(field.name) {
                    Some(json) => check_at(field, json, path)?,
                    None if is_optional(field) => {}
                    None => return Err(bad(path, field, "nothing".to_owned())),
                }
                path.truncate(length);
            }
            match object.keys().find(|key| spec.fields().named(key).is_none()) {
                None => Ok(()),
                Some(unknown) => Err(BadValue {
                    path: format!("{path}.{unknown}"),
                    expected: "no such field".to_owned(),
                    found: found(spec, object.get(unknown).unwrap_or(&Json::Null)),
                }),
            }
        }
        (Type::List | Type::Record, ..) => Err(bad(path, spec, found(spec, json))),
        _ if leaf(spec, json).is_some() => Ok(()),
        _ => Err(bad(path, spec, found(spec, json))),
    }
}

fn bad(path: &str, spec: VariableSpec<'_>, found: String) -> BadValue {
    let of_its_type = VariableSpec { name: "", ..spec }.to_string();
    let expected = of_its_type.trim_start_matches(": ").to_owned();
    BadValue { path: path.to_owned(), expected, found }
}

fn found(spec: VariableSpec<'_>, json: &Json) -> String {
    match json {
        Json::Null => "null".to_owned(),
        Json::Bool(_) => "bool".to_owned(),
        Json::Number(number) if number.is_f64() => "float".to_owned(),
        Json::Number(number) if number.as_i64().is_some() => "int".to_owned(),
        Json::Number(_) => "a number above 64 bits".to_owned(),
        Json::String(text) if matches!(spec.kind, Type::String) => format!("{} bytes", text.len()),
        Json::String(_) => "string".to_owned(),
        Json::Array(elements) => format!("a list of {}", elements.len()),
        Json::Object(_) => "a record".to_owned(),
    }
}

fn elements(list: &mut ListWriter<'_>, spec: VariableSpec<'_>, json: &Json) -> Result<(), Error> {
    let Some((element, values)) = listed(spec, json) else { return Ok(()) };
    values.iter().try_for_each(|json| match element.kind {
        Type::List => list.push_list(|list| elements(list, element, json)),
        Type::Record => list.push_record(|record| fields(record, element, json)),
        _ => leaf(element, json).map_or(Ok(()), |leaf| list.push(leaf)),
    })
}

fn fields(record: &mut RecordWriter<'_>, spec: VariableSpec<'_>, json: &Json) -> Result<(), Error> {
    spec.fields().try_for_each(|field| {
        let json = json.get(field.name).unwrap_or(&Json::Null);
        match field.kind {
            Type::List => record.set_list(field.name, |list| elements(list, field, json)),
            Type::Record => record.set_record(field.name, |record| fields(record, field, json)),
            _ => leaf(field, json).map_or(Ok(()), |leaf| record.set(field.name, leaf)),
        }
    })
}

/// A value that is no list or record, of its variable's type and size.
enum Leaf<'j> {
    Ints(Vec<i64>),
    Floats(Vec<f64>),
    Bools(Vec<bool>),
    Text(&'j str),
    Bytes(Vec<u8>),
}

impl IntoValue for Leaf<'_> {
    fn into_value(self, target: Target<'_>) -> Result<(), Error> {
        match self {
            Self::Ints(ints) => ints.as_slice().into_value(target),
            Self::Floats(floats) => floats.as_slice().into_value(target),
            Self::Bools(bools) => bools.as_slice().into_value(target),
            Self::Text(text) => text.into_value(target),
            Self::Bytes(bytes) => bytes.as_slice().into_value(target),
        }
    }
}

fn leaf<'j>(spec: VariableSpec<'_>, json: &'j Json) -> Option<Leaf<'j>> {
    let one = std::slice::from_ref(json);
    let elements = json.as_array().map_or(one, Vec::as_slice);
    let size = spec.size as usize;
    if spec.kind.is_fixed() && elements.len() != size {
        return None;
    }
    match spec.kind {
        Type::Int => elements.iter().map(Json::as_i64).collect::<Option<_>>().map(Leaf::Ints),
        Type::Float => elements.iter().map(as_float).collect::<Option<_>>().map(Leaf::Floats),
        Type::Bool => elements.iter().map(Json::as_bool).collect::<Option<_>>().map(Leaf::Bools),
        Type::String => json.as_str().filter(|text| text.len() <= size).map(Leaf::Text),
        Type::Bytes => json.as_str().and_then(from_hexadecimal).filter(|bytes| bytes.len() <= size).map(Leaf::Bytes),
        Type::List | Type::Record => None,
    }
}

fn float(number: f64) -> Json {
    if number.is_finite() { number.into() } else { number.to_string().into() }
}

fn hexadecimal(mut text: String, byte: &u8) -> String {
    // Writing to a string does not fail.
    let _ = write!(text, "{byte:02x}");
    text
}

fn as_float(json: &Json) -> Option<f64> {
    match json.as_str() {
        None => json.as_f64(),
        Some("NaN") => Some(f64::NAN),
        Some("inf") => Some(f64::INFINITY),
        Some("-inf") => Some(f64::NEG_INFINITY),
        Some(_) => None,
    }
}

fn from_hexadecimal(text: &str) -> Option<Vec<u8>> {
    let digit = |byte: &u8| char::from(*byte).to_digit(16);
    let (pairs, []) = text.as_bytes().as_chunks::<2>() else { return None };
    pairs.iter().map(|[high, low]| u8::try_from(digit(high)? * 16 + digit(low)?).ok()).collect()
}

#[cfg(test)]
mod tests {
    use cara_core::distribution::function::Definition;
    use cara_core::distribution::parameters::Parameters;
    use serde_json::json;

    use super::*;

    const ORDER: &str = "f(nodes: {id: string[4], x: float, marks: bool[2], parts: bytes[2][..2]}[..4])";

    fn node() -> Json {
        json!({ "id": "a", "x": 1.5, "marks": [true, false], "parts": ["01ff", ""] })
    }

    #[test]
    fn a_list_of_records_survives_both_ways() {
        let definition = Definition::parse(ORDER).unwrap();
        let spec = definition.signature().arguments().named("nodes").unwrap();
        let mut parameters = Parameters::new();
        parameters.add_spec(spec).unwrap();
        let nodes = json!([node(), { "id": "", "x": "-inf", "marks": [false, false], "parts": [] }]);
        assert_eq!(set(&mut parameters, spec, &nodes), Ok(Ok(())));
        assert_eq!(to_json(&parameters.value("nodes").unwrap()), nodes);
    }

    #[test]
    fn what_does_not_fit_is_told_with_its_path() {
        let definition = Definition::parse(ORDER).unwrap();
        let spec = definition.signature().arguments().named("nodes").unwrap();
        let reported = |json: Json| check(spec, &json).map_err(|bad| bad.to_string()).unwrap_err();
        let with = |field: &str, json: Json| {
            let mut last = node();
            last[field] = json;
            reported(json!([node(), node(), node(), last]))
        };
        assert_eq!(with("x", json!("one")), "nodes[3].x: expected float, got string");
        assert_eq!(with("id", json!("12345")), "nodes[3].id: expected string[4], got 5 bytes");
        assert_eq!(with("id", json!(1)), "nodes[3].id: expected string[4], got int");
        assert_eq!(with("marks", json!([true])), "nodes[3].marks: expected bool[2], got a list of 1");
        assert_eq!(with("parts", json!(["01", "0"])), "nodes[3].parts[1]: expected bytes[2], got string");
        assert_eq!(with("parts", json!(["", "", ""])), "nodes[3].parts: expected bytes[2][..2], got a list of 3");
        assert_eq!(with("y", json!(null)), "nodes[3].y: expected no such field, got null");
        assert_eq!(reported(json!([{ "id": "a" }])), "nodes[0].x: expected float, got nothing");
        assert!(reported(json!({})).ends_with("got a record"));
    }

    /// What becomes of a JSON value that is set and shown again.
    fn there_and_back(kind: &str, json: Json) -> Json {
        let definition = Definition::parse(&format!("f(a: {kind})")).unwrap();
        let spec = definition.signature().arguments().named("a").unwrap();
        let mut parameters = Parameters::<4096>::sized();
        parameters.add_spec(spec).unwrap();
        assert_eq!(set(&mut parameters, spec, &json), Ok(Ok(())), "{kind}: {json}");
        to_json(&parameters.value("a").unwrap())
    }

    #[test]
    fn an_optional_value_is_the_value_or_null_or_left_out() {
        let same = |kind, json: Json| assert_eq!(there_and_back(kind, json.clone()), json, "{kind}");
        same("int?", json!(null));
        same("int?", json!(7));
        same("int?[..3]", json!([1, null, 3]));
        same("int[2]?", json!([1, 2]));
        same("string[4][..2]?", json!(null));
        same("string[4][..2]?", json!([]));
        same("string[4][..2]?", json!(["a"]));
        same("int[..2][..2]?", json!([[]]));
        same("int??", json!([null]));
        same("{a: int?, b: {c: bool?}?, d: int??}", json!({ "b": {}, "d": [] }));
        same("{a: int?, b: {c: bool?}?, d: int??}", json!({ "a": 1, "b": { "c": true }, "d": [5] }));
        // A choice.
        same("{text: string[8]?, number: float?}[..2]", json!([{ "text": "high" }, { "number": 0.5 }]));
        // As programs write it that know lists only.
        for (kind, list, one) in [
            ("int[..1]", json!([]), json!(null)),
            ("int[..1]", json!([7]), json!(7)),
            ("int[2][..1]", json!([[1, 2]]), json!([1, 2])),
            ("{a: string[4][..1]}", json!({ "a": ["x"] }), json!({ "a": "x" })),
            ("{a: string[4]?}", json!({ "a": null }), json!({})),
        ] {
            assert_eq!(there_and_back(kind, list), one, "{kind}");
        }
    }

    #[test]
    fn a_wrong_optional_value_is_told_as_what_it_would_be() {
        let definition = Definition::parse("f(a: {b: int?, c: {d: float?}?[..2]})").unwrap();
        let spec = definition.signature().arguments().named("a").unwrap();
        let reported = |json: Json| check(spec, &json).map_err(|bad| bad.to_string()).unwrap_err();
        assert_eq!(reported(json!({ "b": "x", "c": [] })), "a.b: expected int, got string");
        assert_eq!(reported(json!({ "b": [1, 2], "c": [] })), "a.b: expected int, got a list of 2");
        assert_eq!(reported(json!({ "c": [null, { "d": "x" }] })), "a.c[1].d: expected float, got string");
        assert_eq!(reported(json!({ "b": 1 })), "a.c: expected {d: float?}?[..2], got nothing");
    }
}
