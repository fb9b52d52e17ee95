//! Parameters as programs read and write them: one JSON object, a variable a key.
//!
//! A single int, float or bool is a number or truth value, several are an array, text is text, and bytes are text of
//! two hexadecimal digits each. A float that JSON has no number for is `"NaN"`, `"inf"` or `"-inf"`.

use std::fmt::Write;

use cara_std::{Error, ParametersView, Signature, Type, Value};
use serde_json::Value as Json;

/// Why a program's output is not the results of its function.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
pub(super) enum BadOutput {
    #[error("its output is no JSON: {0}")]
    NotJson(String),
    #[error("its output is no JSON object, as {{\"minutes\": 20}}")]
    NotAnObject,
    #[error("its output lacks the result `{0}`")]
    Missing(String),
    #[error("its output has for the result `{name}` something else than {expected}")]
    Wrong { name: String, expected: String },
}

/// The arguments of a call.
pub(super) fn arguments(signature: Signature<'_>, parameters: &ParametersView) -> Json {
    let named = signature.arguments().filter_map(|argument| {
        let variable = parameters.iter().find(|variable| variable.name == argument.name)?;
        Some((argument.name.to_owned(), value(variable.size, variable.value)))
    });
    named.collect()
}

fn value(size: u32, value: Value<'_>) -> Json {
    let several = |values: Vec<Json>| match <[Json; 1]>::try_from(values) {
        Ok([one]) if size == 1 => one,
        Ok(one) => Json::Array(one.into()),
        Err(values) => Json::Array(values),
    };
    match value.kind() {
        Type::Int => several(value.ints().map(Json::from).collect()),
        Type::Float => several(value.floats().map(float).collect()),
        Type::Bool => several(value.bools().map(Json::from).collect()),
        Type::String => value.text().unwrap_or_default().into(),
        Type::Bytes => value.raw().iter().fold(String::new(), hexadecimal).into(),
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

/// Sets the results of a call from a program's output. A result that is an argument as well may be absent and keeps its
/// value; what is no result is not looked at.
pub(super) fn set_results(
    signature: Signature<'_>,
    output: &[u8],
    parameters: &mut ParametersView,
) -> Result<(), BadOutput> {
    if signature.results().next().is_none() {
        return Ok(());
    }
    let output: Json = serde_json::from_slice(output).map_err(|error| BadOutput::NotJson(error.to_string()))?;
    let Json::Object(output) = output else { return Err(BadOutput::NotAnObject) };
    for result in signature.results() {
        match (output.get(result.name), signature.arguments().named(result.name)) {
            (None, Some(_)) => {}
            (None, None) => return Err(BadOutput::Missing(result.name.to_owned())),
            (Some(json), _) => set(result.name, result.kind, json, parameters)
                .map_err(|_| BadOutput::Wrong { name: result.name.to_owned(), expected: result.to_string() })?,
        }
    }
    Ok(())
}

/// `Err` for whatever does not fit the variable.
fn set(name: &str, kind: Type, json: &Json, parameters: &mut ParametersView) -> Result<(), Error> {
    let wrong = Error::OutOfRange;
    let one = std::slice::from_ref(json);
    let elements = json.as_array().map_or(one, Vec::as_slice);
    match kind {
        Type::Int => {
            let ints: Option<Vec<_>> = elements.iter().map(Json::as_i64).collect();
            parameters.set_value(name, &ints.ok_or(wrong)?[..])
        }
        Type::Float => {
            let floats: Option<Vec<_>> = elements.iter().map(as_float).collect();
            parameters.set_value(name, &floats.ok_or(wrong)?[..])
        }
        Type::Bool => {
            let bools: Option<Vec<_>> = elements.iter().map(Json::as_bool).collect();
            parameters.set_value(name, &bools.ok_or(wrong)?[..])
        }
        Type::String => parameters.set_value(name, json.as_str().ok_or(wrong)?),
        Type::Bytes => {
            let bytes = json.as_str().and_then(from_hexadecimal).ok_or(wrong)?;
            parameters.set_value(name, &bytes[..])
        }
    }
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
