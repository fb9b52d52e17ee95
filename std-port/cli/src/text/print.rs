//! From values to text that can be read again.

use cara_std::control::protocol::{Argument, ArgumentValue, Number};

use cara_tools::output::json;
use serde_json::Value;

/// A call, or results in the form of one: `go_to(position: [1, 2])`.
pub(crate) fn show_call(function: &str, arguments: &[Argument]) -> String {
    format!("{function}({})", show_arguments(arguments))
}

/// Arguments or results without what surrounds them: `position: [1, 2]`.
fn show_arguments(arguments: &[Argument]) -> String {
    let shown = arguments.iter().map(|argument| format!("{}: {}", argument.name, value(&argument.value)));
    shown.collect::<Vec<_>>().join(", ")
}

fn value(value: &ArgumentValue) -> String {
    match value {
        ArgumentValue::Int(ints) => elements(ints.iter().map(i64::to_string)),
        ArgumentValue::Float(floats) => elements(floats.iter().map(float)),
        ArgumentValue::Bool(truths) => elements(truths.iter().map(bool::to_string)),
        ArgumentValue::String(text) => quoted(text),
        ArgumentValue::Bytes(digits) => format!("0x{digits}"),
        ArgumentValue::List(json) | ArgumentValue::Record(json) => nested(json),
    }
}

/// JSON without quotes around names.
fn nested(value: &Value) -> String {
    match value {
        Value::Array(elements) => format!("[{}]", elements.iter().map(nested).collect::<Vec<_>>().join(", ")),
        Value::Object(fields) => {
            let fields = fields.iter().map(|(name, value)| format!("{name}: {}", nested(value)));
            format!("{{{}}}", fields.collect::<Vec<_>>().join(", "))
        }
        Value::String(text) => quoted(text),
        other => other.to_string(),
    }
}

/// A float as JSON has it.
pub(super) fn json_of(number: &Number) -> Value {
    match number {
        Number::Finite(value) => (*value).into(),
        Number::Other(word) => word.as_str().into(),
    }
}

/// One element alone, others in brackets.
fn elements(elements: impl Iterator<Item = String>) -> String {
    let elements: Vec<_> = elements.collect();
    match elements.as_slice() {
        [one] => one.clone(),
        several => format!("[{}]", several.join(", ")),
    }
}

/// With the escapes of JSON, and with one for each hidden character that JSON leaves alone.
fn quoted(text: &str) -> String {
    json(&text).unwrap_or_default()
}

/// A float with a point or exponent, so that it is told from a whole number.
fn float(number: &Number) -> String {
    match number {
        Number::Finite(value) => format!("{value:?}"),
        Number::Other(word) => word.clone(),
    }
}

/// A float as JSON can hold it.
pub(crate) fn number(value: f64) -> Number {
    match value {
        value if value.is_finite() => Number::Finite(value),
        value if value.is_nan() => Number::Other("NaN".into()),
        value => Number::Other(if value > 0.0 { "inf" } else { "-inf" }.into()),
    }
}

/// `1 byte`, `2 bytes`.
pub(crate) fn plural(count: usize, word: &str) -> String {
    format!("{count} {word}{}", if count == 1 { "" } else { "s" })
}
