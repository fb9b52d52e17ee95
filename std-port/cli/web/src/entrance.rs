//! What a request comes to, without a server and a manager: for `tests/fuzz/page`.

use std::path::Path;

use axum::http::{HeaderMap, HeaderName, HeaderValue, Method};
use cara_std::control::protocol::CallQuestion;
use serde_json::{Value, json};

use crate::guard::{Guard, Outside};
use crate::{form, users};

/// Whom a page lets in.
pub struct Entrance(Guard);

impl Entrance {
    /// The users of a token file, and where browsers see the page behind a proxy.
    pub fn new(tokens: &str, outside: Option<&str>) -> anyhow::Result<Self> {
        let users = users::read(Path::new("tokens"), tokens)?;
        let outside = outside.map(|outside| outside.parse::<Outside>().map_err(anyhow::Error::msg)).transpose()?;
        Ok(Self(Guard::new(users, false, &[], outside.as_slice())))
    }

    /// Whether a request for data may pass.
    pub fn lets_in(&self, method: &str, headers: &[(&'static str, &[u8])]) -> bool {
        let Ok(method) = method.parse::<Method>() else { return false };
        let one = |(name, value): &(&'static str, &[u8])| {
            Some((HeaderName::from_static(name), HeaderValue::from_bytes(value).ok()?))
        };
        // One whose headers are none is no request.
        let headers: Option<HeaderMap> = headers.iter().map(one).collect();
        headers.is_some_and(|headers| self.0.check(&method, &headers, true).is_ok())
    }
}

/// The address that is shown for one that was given.
pub fn address(given: &str) -> Option<String> {
    given.parse::<Outside>().ok().map(|outside| outside.url())
}

/// The call that a page asks for, and whether it is to be held.
pub fn call(body: &[u8]) -> Result<(CallQuestion, bool), String> {
    form::call(serde_json::from_slice(body).map_err(|error| error.to_string())?)
}

/// The same call as a page writes it.
pub fn written(call: &CallQuestion) -> Value {
    let mut written = json!(call);
    written["arguments"] = call.arguments.iter().map(form::shown).collect();
    written
}
