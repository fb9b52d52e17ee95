//! The attributes of a function as the control socket and `cara` write them in JSON: each is a key beside those of the function.

use std::collections::BTreeMap;

use cara_core::config::Priority;
use cara_core::distribution::function::Attributes;
use cara_core::time::Duration;
use serde::de::{DeserializeOwned, Error};
use serde::ser::SerializeMap;
use serde::{Deserialize, Deserializer, Serializer};
use serde_json::Value;

pub(super) fn serialize<S: Serializer>(attributes: &Attributes, to: S) -> Result<S::Ok, S::Error> {
    let mut map = to.serialize_map(None)?;
    map.serialize_entry("priority", attributes.priority.word())?;
    map.serialize_entry("lease_us", &attributes.lease.map(Duration::as_micros))?;
    map.serialize_entry("actuator", &attributes.actuator)?;
    for flag in Attributes::FLAGS {
        map.serialize_entry(flag.word(), &flag.is_set(attributes))?;
    }
    if let Some(least) = attributes.stream {
        map.serialize_entry("stream_ms", &least)?;
    }
    map.end()
}

/// What an older unit does not say has its default; what this version does not know is passed over.
pub(super) fn deserialize<'de, D: Deserializer<'de>>(from: D) -> Result<Attributes, D::Error> {
    let mut said = BTreeMap::<String, Value>::deserialize(from)?;
    let mut attributes = Attributes {
        actuator: take(&mut said, "actuator")?,
        lease: take::<Option<u64>, _>(&mut said, "lease_us")?.map(Duration::from_micros),
        stream: take(&mut said, "stream_ms")?,
        ..Attributes::NORMAL
    };
    if let Some(word) = take::<Option<String>, _>(&mut said, "priority")? {
        attributes.priority = priority_of(&word).ok_or_else(|| D::Error::custom(format!("no priority: '{word}'")))?;
    }
    for flag in Attributes::FLAGS {
        flag.set(&mut attributes, take(&mut said, flag.word())?);
    }
    Ok(attributes)
}

fn take<T: DeserializeOwned + Default, E: Error>(said: &mut BTreeMap<String, Value>, key: &str) -> Result<T, E> {
    said.remove(key).map_or(Ok(T::default()), |value| serde_json::from_value(value).map_err(E::custom))
}

/// The class of a word.
pub(super) fn priority_of(word: &str) -> Option<Priority> {
    Priority::ALL.into_iter().find(|class| class.word() == word)
}
