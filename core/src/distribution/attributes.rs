//! Attributes of a function: priority, lease, flags and others, and their encoding (docs/concepts.md, "Interfaces").

use core::fmt;

use crate::ability::STREAMS;
use crate::config::Priority;
use crate::error::Error;
use crate::time::Duration;

/// Declares [`Attributes`] and the table of its flags. Each flag is defined here once, with its bit on the wire: derive, ports,
/// control socket, page and command read [`Attributes::FLAGS`].
macro_rules! attributes {
    ($($name:ident = $bit:literal, $means:literal;)+) => {
        /// How a function is to be called.
        #[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
        pub struct Attributes {
            /// The priority of calls that do not set one.
            pub priority: Priority,
            /// How long the motion that a call has started may continue after the call, or its last renewal, was made; in whole
            /// milliseconds. Renewals are at least 5 ms apart, so a lease of less than 20 ms cannot be kept.
            pub lease: Option<Duration>,
            /// Functions of one unit with the same number share an actuator; 0 is none. A unit assigns the numbers when it
            /// publishes its functions: those that share a lease get the same.
            pub actuator: u8,
            /// The function is a stream: its results are values that change, sent to subscribers at least this many milliseconds
            /// apart. It has no arguments and cannot be called.
            pub stream: Option<u16>,
            $(#[doc = $means] pub $name: bool,)+
        }

        impl Attributes {
            /// The default, as a constant.
            pub const NORMAL: Self = Self {
                priority: Priority::Normal,
                lease: None,
                actuator: 0,
                stream: None,
                $($name: false,)+
            };
            /// The flags, in the order in which they are shown.
            pub const FLAGS: &'static [Flag] = &[$(Flag {
                word: stringify!($name),
                get: |attributes| attributes.$name,
                set: |attributes, is_set| attributes.$name = is_set,
            },)+];

            const fn flags(&self) -> u8 {
                0 $(| if self.$name { 1 << $bit } else { 0 })+
            }

            const fn set_flags(&mut self, bits: u8) {
                $(self.$name = bits & (1 << $bit) != 0;)+
            }
        }
    };
}

attributes! {
    stop = 3, "A call of it ends the orders of its actuator, or of all, and inhibits new ones until a function with `reset` has answered with results.";
    reset = 4, "A call of it that its service answers with results lets its actuator, or all, move again.";
    idempotent = 2, "Running it twice is as good as running it once.";
}

/// A flag: a `bool` field of [`Attributes`], by name, for code that reads, writes or shows all flags.
#[derive(Clone, Copy, Debug)]
pub struct Flag {
    word: &'static str,
    get: fn(&Attributes) -> bool,
    set: fn(&mut Attributes, bool),
}

impl Flag {
    /// The field's name, which is also its attribute in an interface and its key in JSON.
    pub const fn word(&self) -> &'static str {
        self.word
    }

    /// Whether it is set.
    pub fn is_set(&self, attributes: &Attributes) -> bool {
        (self.get)(attributes)
    }

    /// Sets or clears it.
    pub fn set(&self, attributes: &mut Attributes, is_set: bool) {
        (self.set)(attributes, is_set);
    }
}

impl Attributes {
    /// Bytes of the encoded form.
    pub const WIRE_BYTES: usize = 8;
    const PRIORITY: u8 = 0b11;
    const STREAM: u8 = 1 << 5;

    /// Whether it is a [stream](Self::stream) and not a function.
    pub const fn is_stream(&self) -> bool {
        STREAMS && self.stream.is_some()
    }

    /// Whether a call in this class may use reserved capacity: a stop, or an emergency call of an emergency service.
    pub fn is_urgent(&self, class: Priority) -> bool {
        self.stop || class == Priority::Emergency && self.priority == Priority::Emergency
    }

    /// Encodes: bits 0 and 1, priority; bits 2 to 4, flags; bit 5, stream; then the actuator, u8; the least interval of a stream
    /// in milliseconds, u16 little-endian, otherwise zero; the lease in milliseconds, u32 little-endian, 0 for none. A lease is
    /// rounded down, but not to zero, and limited to 49 days.
    pub fn encode(&self) -> [u8; Self::WIRE_BYTES] {
        let flags = self.priority as u8 | self.flags();
        let flags = flags | if self.is_stream() { Self::STREAM } else { 0 };
        let [low, high] = self.stream.unwrap_or(0).to_le_bytes();
        let lease = self.lease.map_or(0, |lease| u32::try_from(lease.as_millis()).unwrap_or(u32::MAX).max(1));
        let [a, b, c, d] = lease.to_le_bytes();
        [flags, self.actuator, low, high, a, b, c, d]
    }

    /// The inverse of [`encode`](Self::encode). Ignores other bits and further bytes, which are of a later version, and the
    /// stream without the feature `streams`; [`Error::Malformed`] for fewer bytes.
    pub fn decode(bytes: &[u8]) -> Result<Self, Error> {
        let &[flags, actuator, low, high, a, b, c, d, ..] = bytes else { return Err(Error::Malformed) };
        let lease = u32::from_le_bytes([a, b, c, d]);
        let mut attributes = Self {
            priority: Priority::from_wire(flags & Self::PRIORITY).ok_or(Error::Malformed)?,
            lease: (lease != 0).then(|| Duration::from_millis(u64::from(lease))),
            actuator,
            stream: (STREAMS && flags & Self::STREAM != 0).then_some(u16::from_le_bytes([low, high])),
            ..Self::NORMAL
        };
        attributes.set_flags(flags);
        Ok(attributes)
    }
}

/// For people, as in `high, lease 400 ms, actuator 1, idempotent`.
impl fmt::Display for Attributes {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(self.priority.word())?;
        if let Some(lease) = self.lease {
            write!(f, ", lease {} ms", lease.as_millis())?;
        }
        match self.stream {
            Some(0) => f.write_str(", stream")?,
            Some(least) => write!(f, ", stream every {least} ms at most")?,
            None => {}
        }
        if self.actuator != 0 {
            write!(f, ", actuator {}", self.actuator)?;
        }
        Self::FLAGS.iter().filter(|flag| flag.is_set(self)).try_for_each(|flag| write!(f, ", {}", flag.word()))
    }
}

#[cfg(test)]
mod tests {
    #![allow(
        clippy::indexing_slicing,
        clippy::unwrap_used,
        clippy::expect_used,
        clippy::panic,
        clippy::arithmetic_side_effects
    )]

    use std::string::ToString;

    use super::*;

    #[test]
    fn attributes_travel() {
        let usual = Attributes::default();
        assert_eq!(usual.encode(), [2, 0, 0, 0, 0, 0, 0, 0]);
        let leased = Attributes {
            priority: Priority::Emergency,
            lease: Some(Duration::from_millis(0x1234)),
            actuator: 7,
            ..usual
        };
        let all = Attributes { idempotent: true, stop: true, reset: true, ..leased };
        assert_eq!(all.encode(), [0x1C, 7, 0, 0, 0x34, 0x12, 0, 0]);
        assert_eq!(Attributes::decode(&all.encode()), Ok(all));
        let short = Attributes { lease: Some(Duration::from_micros(1)), ..usual };
        assert_eq!(Attributes::decode(&short.encode()).unwrap().lease, Some(Duration::from_millis(1)));
        let later = [0x1C | 0xC0, 7, 9, 9, 0x34, 0x12, 0, 0, 7, 7];
        assert_eq!(Attributes::decode(&later), Ok(all), "a later version says more");
        assert_eq!(Attributes::decode(&later[..7]), Err(Error::Malformed));
    }

    #[cfg(feature = "streams")]
    #[test]
    fn a_stream_says_how_often() {
        let pose = Attributes { priority: Priority::Low, stream: Some(0x0201), ..Attributes::default() };
        assert_eq!(pose.encode(), [0x23, 0, 1, 2, 0, 0, 0, 0]);
        assert_eq!(Attributes::decode(&pose.encode()), Ok(pose));
        assert_eq!(pose.to_string(), "low, stream every 513 ms at most");
    }

    #[test]
    fn each_flag_has_a_bit_of_its_own_and_travels() {
        let mut bits = 0;
        for flag in Attributes::FLAGS {
            let mut attributes = Attributes { priority: Priority::Emergency, ..Attributes::NORMAL };
            flag.set(&mut attributes, true);
            let [encoded, ..] = attributes.encode();
            assert!(encoded.is_power_of_two() && encoded & (bits | 0b0010_0011) == 0, "{}", flag.word());
            bits |= encoded;
            assert_eq!(Attributes::decode(&attributes.encode()), Ok(attributes));
            assert_eq!(attributes.to_string(), std::format!("emergency, {}", flag.word()));
            flag.set(&mut attributes, false);
            assert!(!flag.is_set(&attributes));
        }
    }

    #[test]
    fn attributes_are_told_in_words() {
        let leased = Attributes { lease: Some(Duration::from_millis(400)), ..Attributes::default() };
        assert_eq!(Attributes::default().to_string(), "normal");
        assert_eq!(leased.to_string(), "normal, lease 400 ms");
        let all = Attributes { priority: Priority::High, idempotent: true, ..leased };
        assert_eq!(all.to_string(), "high, lease 400 ms, idempotent");
        let drive = Attributes { actuator: 2, ..leased };
        assert_eq!(drive.to_string(), "normal, lease 400 ms, actuator 2");
        let stop = Attributes { stop: true, priority: Priority::Emergency, ..Attributes::default() };
        assert_eq!(stop.to_string(), "emergency, stop");
    }
}
