//! Functions and values in the form of the page. Whole numbers are text there: a page's numbers are exact to 53 bits only.
//! Every other type has the form of the control socket, so that a type that comes later passes through as it is.

use cara_std::control::protocol::{Argument, CallQuestion, FunctionInfo};
use cara_std::{Definition, Shown};
use serde_json::{Value, json};

/// A function with what it takes and returns, each with name, type and size; null where its signature cannot be read.
pub(crate) fn function(info: &FunctionInfo) -> Value {
    let mut told = json!(info);
    if !info.help.is_empty() {
        told["help"] = Shown(&info.help).to_string().into();
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
    told["inputs"] = variables(false).into();
    told["outputs"] = variables(true).into();
    told
}

/// A variable as the page shows it.
pub(crate) fn shown(argument: &Argument) -> Value {
    let mut told = json!(argument);
    if told["type"] == "int" {
        let numbers = told["value"].as_array().map(Vec::as_slice).unwrap_or_default();
        told["value"] = numbers.iter().map(ToString::to_string).collect();
    }
    told
}

/// A call as a page asks for it: as on the control socket, with whole numbers as text.
pub(crate) fn call(mut asked: Value) -> Result<CallQuestion, String> {
    let arguments = asked.get_mut("arguments").and_then(Value::as_array_mut);
    for argument in arguments.into_iter().flatten().filter(|argument| argument["type"] == "int") {
        let name = argument["name"].to_string();
        for number in argument.get_mut("value").and_then(Value::as_array_mut).into_iter().flatten() {
            if let Some(text) = number.as_str() {
                let whole: i64 = text.trim().parse().map_err(|_| {
                    format!("{name}: `{text}` is no whole number between {} and {}", i64::MIN, i64::MAX)
                })?;
                *number = whole.into();
            }
        }
    }
    serde_json::from_value(asked).map_err(|error| format!("that is no call: {error}"))
}

#[cfg(test)]
mod tests {
    use cara_std::control::protocol::ArgumentValue;

    use super::*;

    fn asked(value: Value) -> Value {
        json!({
            "node": "agv/1", "function": "go_to", "asynchronous": false, "timeout_ms": null, "priority": null,
            "best_effort": false, "arguments": [{ "name": "position", "size": 2, "type": "int", "value": value }],
        })
    }

    #[test]
    fn whole_numbers_keep_all_their_digits() {
        let call = call(asked(json!(["9223372036854775807", "-1"]))).unwrap();
        assert_eq!(call.arguments[0].value, ArgumentValue::Int(vec![i64::MAX, -1]));
        assert_eq!(shown(&call.arguments[0])["value"], json!(["9223372036854775807", "-1"]));
    }

    #[test]
    fn what_is_no_call_is_told() {
        let told = call(asked(json!(["1.5", "2"]))).unwrap_err();
        assert!(told.contains("position") && told.contains("`1.5`"), "{told}");
        assert!(call(asked(json!("x"))).unwrap_err().starts_with("that is no call"));
        assert!(call(json!([])).is_err() && call(json!({ "arguments": 1 })).is_err());
    }

    #[test]
    fn a_function_has_its_variables() {
        let info =
            serde_json::from_value(json!({ "name": "f", "signature": "f(a: int[2]) -> (b: string[8])", "help": "Does.", "units": { "a": "m" } }))
                .unwrap();
        let told = function(&info);
        assert_eq!(
            (&told["help"], &told["inputs"]),
            (&json!("Does."), &json!([{ "name": "a", "type": "int", "size": 2, "unit": "m" }]))
        );
        assert_eq!(told["outputs"], json!([{ "name": "b", "type": "string", "size": 8 }]));
        let later = serde_json::from_value(json!({ "name": "f", "signature": "f(a: tree)" })).unwrap();
        assert_eq!(function(&later)["inputs"], Value::Null);
    }
}
