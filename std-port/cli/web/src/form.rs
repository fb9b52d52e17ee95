//! Functions and values in the form of the page. Whole numbers are text there, since a page's numbers are exact to 53 bits only,
//! and lists and records are the text of their JSON as a whole, members in the order of the signature. Every other type has the
//! form of the control socket, so that a type that comes later passes through as it is.

use cara_std::control::protocol::{Argument, ArgumentValue, CallQuestion, FunctionInfo};
use cara_std::{Definition, Shown};
use serde_json::{Value, json};

/// A function with what it takes and returns, each with name, type and size; null where its signature cannot be read.
pub(crate) fn function(info: &FunctionInfo) -> Value {
    let mut reported = json!(info);
    if !info.help.is_empty() {
        reported["help"] = Shown(&info.help).to_string().into();
    }
    let definition = Definition::parse(&info.signature).ok();
    let variables = |results: bool| {
        let signature = definition.as_ref()?.signature();
        let specs = if results { signature.results() } else { signature.arguments() };
        Some(
            specs
                .map(|spec| {
                    let mut variable = json!({ "name": spec.name, "type": spec.kind.to_string(), "size": spec.size });
                    if let Some(unit) = info.units.get(spec.name) {
                        variable["unit"] = Shown(unit).to_string().into();
                    }
                    variable
                })
                .collect::<Value>(),
        )
    };
    reported["inputs"] = variables(false).into();
    reported["outputs"] = variables(true).into();
    reported
}

/// A variable as the page shows it.
pub(crate) fn shown(argument: &Argument) -> Value {
    let mut reported = json!(argument);
    match &argument.value {
        ArgumentValue::Int(numbers) => reported["value"] = numbers.iter().map(ToString::to_string).collect(),
        ArgumentValue::List(value) | ArgumentValue::Record(value) => reported["value"] = format!("{value:#}").into(),
        _ => {}
    }
    reported
}

/// The value of a stream's variable: its name, the value, and whether that is JSON as text.
fn streamed(argument: &Argument) -> Value {
    let value = shown(argument)["value"].take();
    match &argument.value {
        ArgumentValue::List(_) | ArgumentValue::Record(_) => json!([argument.name, value, true]),
        _ => json!([argument.name, value]),
    }
}

/// The values of a stream, in the order of its signature. Of a piece of a log, which takes a firmware that is not there, only how
/// long it is.
pub(crate) fn streamed_all(stream: &str, values: &[Argument]) -> Value {
    let is_log = stream.split('(').next() == Some("log");
    let one = |value: &Argument| match &value.value {
        ArgumentValue::Bytes(digits) if is_log => {
            json!([value.name, format!("{} bytes, whose firmware is not known", digits.len() / 2), true])
        }
        ArgumentValue::Int(build) if is_log && value.name == "build" => {
            json!([value.name, build.iter().map(|build| format!("{build:016x}")).collect::<String>(), true])
        }
        _ => streamed(value),
    };
    values.iter().map(one).collect()
}

/// A call as a page asks for it: as on the control socket, with values in the page's form; and whether it is to be held.
pub(crate) fn call(mut asked: Value) -> Result<(CallQuestion, bool), String> {
    let is_held = asked.as_object_mut().and_then(|asked| asked.remove("hold")) == Some(Value::Bool(true));
    // Of a signature that the page cannot read.
    if let Some(text) = asked["arguments"].as_str() {
        asked["arguments"] =
            serde_json::from_str(text).map_err(|error| format!("the arguments are no JSON: {error}"))?;
    }
    for argument in asked.get_mut("arguments").and_then(Value::as_array_mut).into_iter().flatten() {
        let name = argument["name"].to_string();
        let is_int = argument["type"] == "int";
        let is_json = argument["type"] == "list" || argument["type"] == "record";
        match argument.get_mut("value") {
            Some(Value::Array(numbers)) if is_int => {
                for number in numbers {
                    if let Some(text) = number.as_str() {
                        let whole: i64 = text.trim().parse().map_err(|_| {
                            format!("{name}: `{text}` is no whole number between {} and {}", i64::MIN, i64::MAX)
                        })?;
                        *number = whole.into();
                    }
                }
            }
            Some(value) if is_json && value.is_string() => {
                let text = value.as_str().unwrap_or_default();
                *value = serde_json::from_str(text).map_err(|error| format!("{name}: no JSON: {error}"))?;
            }
            _ => {}
        }
    }
    let call = serde_json::from_value(asked).map_err(|error| format!("that is no call: {error}"))?;
    Ok((call, is_held))
}

#[cfg(test)]
mod tests {
    use super::*;

    fn asked(value: Value) -> Value {
        json!({
            "node": "agv/1", "function": "go_to", "asynchronous": false, "timeout_ms": null, "priority": null,
            "best_effort": false, "arguments": [{ "name": "position", "size": 2, "type": "int", "value": value }],
        })
    }

    #[test]
    fn a_piece_of_a_log_that_was_not_read_is_its_length_and_its_build_id() {
        let value = |name: &str, value| Argument { name: name.to_owned(), size: 1, value };
        let piece = value("piece", ArgumentValue::Bytes("6f6e65ff".to_owned()));
        let log = [value("build", ArgumentValue::Int(vec![-7])), piece];
        let shown =
            json!([["build", "fffffffffffffff9", true], ["piece", "4 bytes, whose firmware is not known", true]]);
        assert_eq!(streamed_all("log() -> (build: int, piece: bytes[9])", &log), shown);
        assert_eq!(streamed_all("scan() -> (piece: bytes[9])", &log[1..]), json!([["piece", "6f6e65ff"]]));
    }

    #[test]
    fn whole_numbers_keep_all_their_digits() {
        let (call, _) = call(asked(json!(["9223372036854775807", "-1"]))).unwrap();
        assert_eq!(call.arguments[0].value, ArgumentValue::Int(vec![i64::MAX, -1]));
        assert_eq!(shown(&call.arguments[0])["value"], json!(["9223372036854775807", "-1"]));
    }

    #[test]
    fn lists_and_records_keep_all_digits_and_the_order_of_their_members() {
        let text = r#"{"stamp": 1460549358372198212, "at": [{"x": -9223372036854775808, "kg": 1.0}], "a": "7"}"#;
        let argument = json!({ "name": "l", "size": 1, "type": "record", "value": text });
        let mut asked = asked(json!(["1", "2"]));
        asked["arguments"] = json!([argument]);
        let (call, _) = call(asked).unwrap();
        let shown = shown(&call.arguments[0])["value"].as_str().unwrap().split_whitespace().collect::<String>();
        assert_eq!(shown, text.split_whitespace().collect::<String>());
        let streamed = streamed(&call.arguments[0]);
        assert!(
            streamed[0] == "l" && streamed[1].as_str().unwrap().contains("198212") && streamed[2] == true,
            "{streamed}"
        );
        let list = json!([{ "name": "n", "size": 2, "type": "list", "value": "[[9007199254740993]]" }]);
        let mut asked = super::tests::asked(json!([]));
        asked["arguments"] = list.to_string().into();
        let exact = Value::Array(vec![json!([9_007_199_254_740_993_i64])]);
        assert_eq!(super::call(asked).unwrap().0.arguments[0].value, ArgumentValue::List(exact));
    }

    #[test]
    fn what_is_no_call_is_told() {
        let reported = call(asked(json!(["1.5", "2"]))).unwrap_err();
        assert!(reported.contains("position") && reported.contains("`1.5`"), "{reported}");
        assert!(call(asked(json!("x"))).unwrap_err().starts_with("that is no call"));
        assert!(call(json!([])).is_err() && call(json!({ "arguments": 1 })).is_err());
        assert!(call(json!({ "arguments": "[" })).unwrap_err().contains("no JSON"));
        let list = json!([{ "name": "l", "size": 1, "type": "list", "value": "[" }]);
        assert!(call(json!({ "arguments": list })).unwrap_err().starts_with("\"l\": no JSON"));
    }

    #[test]
    fn a_function_has_its_variables() {
        let info =
            serde_json::from_value(json!({ "name": "f", "signature": "f(a: int[2]) -> (b: string[8])", "help": "Does.", "units": { "a": "m" } }))
                .unwrap();
        let reported = function(&info);
        assert_eq!(
            (&reported["help"], &reported["inputs"]),
            (&json!("Does."), &json!([{ "name": "a", "type": "int", "size": 2, "unit": "m" }]))
        );
        assert_eq!(reported["outputs"], json!([{ "name": "b", "type": "string", "size": 8 }]));
        let later = serde_json::from_value(json!({ "name": "f", "signature": "f(a: tree)" })).unwrap();
        assert_eq!(function(&later)["inputs"], Value::Null);
    }
}
