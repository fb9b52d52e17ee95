//! The attributes of a function as the control socket and `cara` write them in JSON.

use cara_core::config::Priority;
use cara_core::distribution::function::Attributes;
use cara_core::time::Duration;
use serde::de::Error as _;
use serde::{Deserialize, Deserializer, Serialize, Serializer};

/// Each attribute is a key beside those of the function. One that an older unit does not tell has its default.
#[derive(Serialize, Deserialize)]
#[serde(remote = "Attributes")]
pub(super) struct Form {
    #[serde(default, with = "class")]
    priority: Priority,
    #[serde(default, with = "micros", rename = "lease_us")]
    lease: Option<Duration>,
    #[serde(default)]
    idempotent: bool,
    #[serde(default)]
    actuator: u8,
    #[serde(default)]
    stop: bool,
    #[serde(default)]
    reset: bool,
    #[serde(default, rename = "stream_ms", skip_serializing_if = "Option::is_none")]
    stream: Option<u16>,
}

mod class {
    use super::*;

    pub(super) fn serialize<S: Serializer>(priority: &Priority, to: S) -> Result<S::Ok, S::Error> {
        priority.word().serialize(to)
    }

    pub(super) fn deserialize<'de, D: Deserializer<'de>>(from: D) -> Result<Priority, D::Error> {
        let word = String::deserialize(from)?;
        super::super::describe::priority_of(&word).ok_or_else(|| D::Error::custom(format!("no priority: '{word}'")))
    }
}

mod micros {
    use super::*;

    pub(super) fn serialize<S: Serializer>(span: &Option<Duration>, to: S) -> Result<S::Ok, S::Error> {
        span.map(Duration::as_micros).serialize(to)
    }

    pub(super) fn deserialize<'de, D: Deserializer<'de>>(from: D) -> Result<Option<Duration>, D::Error> {
        Ok(Option::deserialize(from)?.map(Duration::from_micros))
    }
}
