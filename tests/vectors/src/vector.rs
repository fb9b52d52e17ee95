//! The committed file's form: what a vector is, and what is said about every byte of it.

use cara_core::distribution::function::Definition;
use serde::Serialize;
use serde_json::Value;

use crate::decoded;

/// Which part of the format a vector shows.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize)]
#[serde(rename_all = "snake_case")]
pub(crate) enum Kind {
    /// A hello, without its frame.
    Hello,
    /// A whole message.
    Message,
    /// An encoded signature.
    Signature,
    /// A function's attributes.
    Attributes,
    /// A block of parameters; its context is the signature.
    Block,
    /// A session body.
    SessionBody,
    /// A UDP datagram; its context is the receiver's fleet.
    Datagram,
    /// Bytes of a TCP stream; its context is the receiver's limits.
    Stream,
}

/// What a receiver must know beforehand.
#[derive(Clone, Debug, Default, Serialize)]
pub(crate) struct Context {
    /// The function's signature in its text form.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub(crate) signature_text: Option<&'static str>,
    /// The same, encoded.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub(crate) signature: Option<String>,
    /// `arguments` or `results`.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub(crate) part: Option<&'static str>,
    /// The receiver's fleet.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub(crate) fleet: Option<u32>,
    /// Longest frame body that the receiver takes.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub(crate) chunk_limit: Option<usize>,
    /// Longest message that the receiver takes, headers included.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub(crate) message_limit: Option<usize>,
}

impl Context {
    /// Arguments or results of a function.
    pub(crate) fn block(text: &'static str, part: &'static str) -> Self {
        let signature = Some(decoded::hex(definition(text).as_bytes()));
        Self { signature_text: Some(text), signature, part: Some(part), ..Self::default() }
    }

    /// A receiver of a fleet.
    pub(crate) fn fleet(fleet: u32) -> Self {
        Self { fleet: Some(fleet), ..Self::default() }
    }

    /// A receiver with limits.
    pub(crate) fn limits(chunk: usize, message: usize) -> Self {
        Self { chunk_limit: Some(chunk), message_limit: Some(message), ..Self::default() }
    }

    /// The signature's bytes; none without one.
    pub(crate) fn signature_bytes(&self) -> Vec<u8> {
        self.signature_text.map_or_else(Vec::new, |text| definition(text).as_bytes().to_vec())
    }
}

/// A function from its text form, which is known to be right.
pub(crate) fn definition(text: &str) -> Definition {
    Definition::parse(text).unwrap_or_else(|error| panic!("{text}: {error}"))
}

/// One vector.
#[derive(Clone, Debug, Serialize)]
pub(crate) struct Vector {
    pub(crate) name: &'static str,
    pub(crate) about: &'static str,
    pub(crate) kind: Kind,
    #[serde(skip_serializing_if = "is_empty")]
    pub(crate) context: Context,
    pub(crate) hex: String,
    /// What the bytes mean; null for bytes that are refused.
    pub(crate) value: Value,
    /// The value does not tell all of the bytes, so it can't be encoded to them again.
    #[serde(skip_serializing_if = "std::ops::Not::not")]
    pub(crate) lossy: bool,
    /// What every change of a single byte leads to.
    pub(crate) mutations: Mutations,
}

fn is_empty(context: &Context) -> bool {
    serde_json::to_value(context).is_ok_and(|value| value == Value::Object(serde_json::Map::new()))
}

impl Vector {
    /// A vector whose bytes must decode to `expected`.
    pub(crate) fn new(
        (name, about): (&'static str, &'static str),
        kind: Kind,
        context: Context,
        bytes: &[u8],
        expected: &Value,
    ) -> Self {
        let value = decoded::decode(kind, &context, bytes).unwrap_or(Value::Null);
        assert_eq!(canonical(&value), canonical(expected), "{name} decodes to something else than it was made from");
        let mutations = Mutations::of(kind, &context, bytes);
        Self { name, about, kind, context, hex: decoded::hex(bytes), value, lossy: false, mutations }
    }

    /// The same, of which a reader does not keep all.
    pub(crate) fn lossy(self) -> Self {
        Self { lossy: true, ..self }
    }
}

/// Longer vectors have single bits mutated only.
const LONG: usize = 64;
/// The same of streams, whose messages are vectors of their own.
const LONG_STREAM: usize = 24;

/// What becomes of a vector when one byte of it takes every other value.
#[derive(Clone, Debug, Serialize)]
pub(crate) struct Mutations {
    /// Each byte has one bit flipped at a time, lowest first, instead of taking all 256 values.
    pub(crate) bits_only: bool,
    /// For each byte in turn, how many of its values are accepted, as runs of "count x bytes".
    pub(crate) accepted: String,
    /// CRC-32 over the canonical JSON of the value of each accepted one, in the order of bytes and values.
    pub(crate) crc32: u32,
}

impl Mutations {
    fn of(kind: Kind, context: &Context, bytes: &[u8]) -> Self {
        let bits_only = bytes.len() > if kind == Kind::Stream { LONG_STREAM } else { LONG };
        let mut bytes = bytes.to_vec();
        let mut crc = Crc::new();
        let mut runs: Vec<(u32, u32)> = Vec::new();
        for place in 0..bytes.len() {
            let original = bytes[place];
            let mut count = 0;
            let flipped = (0..8).map(|bit| original ^ (1 << bit));
            let values: Vec<u8> = if bits_only { flipped.collect() } else { (0..=u8::MAX).collect() };
            for byte in values {
                bytes[place] = byte;
                if let Some(value) = decoded::decode(kind, context, &bytes) {
                    count += 1;
                    crc.add(canonical(&value).as_bytes());
                }
            }
            bytes[place] = original;
            match runs.last_mut() {
                Some((last, length)) if *last == count => *length += 1,
                _ => runs.push((count, 1)),
            }
        }
        let accepted: Vec<String> = runs.iter().map(|(count, length)| format!("{count}x{length}")).collect();
        Self { bits_only, accepted: accepted.join(" "), crc32: crc.finish() }
    }
}

/// JSON without spaces, keys in the order of their bytes.
pub(crate) fn canonical(value: &Value) -> String {
    match value {
        Value::Object(fields) => {
            let mut fields: Vec<_> = fields.iter().collect();
            fields.sort_by_key(|(key, _)| key.as_str());
            let fields = fields.into_iter().map(|(key, value)| format!("\"{key}\":{}", canonical(value)));
            format!("{{{}}}", fields.collect::<Vec<_>>().join(","))
        }
        Value::Array(items) => format!("[{}]", items.iter().map(canonical).collect::<Vec<_>>().join(",")),
        scalar => scalar.to_string(),
    }
}

/// CRC-32 of IEEE 802.3, as in zlib.
struct Crc {
    table: [u32; 256],
    state: u32,
}

impl Crc {
    fn new() -> Self {
        let step = |crc: u32, _: u32| if crc & 1 == 1 { (crc >> 1) ^ 0xEDB8_8320 } else { crc >> 1 };
        let mut table = [0; 256];
        for (index, entry) in (0_u32..).zip(&mut table) {
            *entry = (0..8).fold(index, step);
        }
        Self { table, state: u32::MAX }
    }

    fn add(&mut self, bytes: &[u8]) {
        for byte in bytes {
            let index = (self.state ^ u32::from(*byte)) & 0xFF;
            self.state = (self.state >> 8) ^ self.table[index as usize];
        }
    }

    fn finish(&self) -> u32 {
        !self.state
    }
}

#[cfg(test)]
mod tests {
    use super::Crc;

    #[test]
    fn the_checksum_is_that_of_zlib() {
        let mut crc = Crc::new();
        crc.add(b"1234");
        crc.add(b"56789");
        assert_eq!(crc.finish(), 0xCBF4_3926);
    }
}
