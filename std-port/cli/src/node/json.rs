//! Parameters as programs read and write them: one JSON object, a variable a key.

use cara_std::control::json::{self, BadValue};
use cara_std::{Error, ParametersView, Signature};
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
    #[error("its output does not fit its results: {0}")]
    Wrong(BadValue),
    #[error("its output does not fit its results: {0}")]
    TooLong(Error),
}

/// The arguments of a call.
pub(super) fn arguments(signature: Signature<'_>, parameters: &ParametersView) -> Json {
    let named = signature.arguments().filter_map(|argument| {
        let value = parameters.value(argument.name).ok()?;
        Some((argument.name.to_owned(), json::to_json(&value)))
    });
    named.collect()
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
            (Some(json), _) => {
                json::set(parameters, result, json).map_err(BadOutput::Wrong)?.map_err(BadOutput::TooLong)?
            }
        }
    }
    Ok(())
}
