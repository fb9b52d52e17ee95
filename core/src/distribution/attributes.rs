//! How a function wants to be called: priority, lease, idempotence, and their form on the wire.

use core::fmt;

use crate::config::Priority;
use crate::error::Error;
use crate::time::Duration;

/// How a function wants to be called.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct Attributes {
    /// Priority of calls that name none.
    pub priority: Priority,
    /// How long what the function starts goes on after the last call or renewal, in whole milliseconds. Renewals are at
    /// least 5 ms apart: a lease of less than 20 ms cannot be kept.
    pub lease: Option<Duration>,
    /// Running it twice is as good as running it once.
    pub idempotent: bool,
    /// Functions of one unit with the same number, which is not 0, move the same thing. Of a unit's own functions it is
    /// told by the leases that they share.
    pub actuator: u8,
    /// A call of it ends the orders of its actuator, or of all, and inhibits new ones until a function with `reset` is called.
    pub stop: bool,
    /// A call of it that its service answers with results lets its actuator, or all, move again.
    pub reset: bool,
    /// It is a stream, whose results are values that change: subscribers get them, at least so many milliseconds apart. It
    /// has no arguments, and is not called.
    #[cfg(feature = "streams")]
    pub stream: Option<u16>,
}

impl Attributes {
    /// The default, for constants.
    pub const NORMAL: Self = Self {
        priority: Priority::Normal,
        lease: None,
        idempotent: false,
        actuator: 0,
        stop: false,
        reset: false,
        #[cfg(feature = "streams")]
        stream: None,
    };
    /// Bytes of the encoded form.
    pub const WIRE_BYTES: usize = 8;
    const PRIORITY: u8 = 0b11;
    const IDEMPOTENT: u8 = 1 << 2;
    const STOP: u8 = 1 << 3;
    const RESET: u8 = 1 << 4;
    #[cfg(feature = "streams")]
    const STREAM: u8 = 1 << 5;

    /// Whether a call in this class has a place where other calls find none: it stops, or is an emergency of an emergency
    /// service.
    pub fn is_urgent(&self, class: Priority) -> bool {
        self.stop || class == Priority::Emergency && self.priority == Priority::Emergency
    }

    /// Bits 0 and 1: priority; bits 2 to 5: idempotent, stop, reset, stream; actuator, u8; of a stream the least interval in
    /// milliseconds, u16 little-endian, otherwise zero; the lease in milliseconds, u32 little-endian, 0 for none. A lease is rounded down, but never to none.
    pub fn encode(&self) -> [u8; Self::WIRE_BYTES] {
        let bit = |set, bit| if set { bit } else { 0 };
        let flags = self.priority as u8
            | bit(self.idempotent, Self::IDEMPOTENT)
            | bit(self.stop, Self::STOP)
            | bit(self.reset, Self::RESET);
        #[cfg(not(feature = "streams"))]
        let [low, high] = [0; 2];
        #[cfg(feature = "streams")]
        let flags = flags | bit(self.stream.is_some(), Self::STREAM);
        #[cfg(feature = "streams")]
        let [low, high] = self.stream.unwrap_or(0).to_le_bytes();
        let lease = self.lease.map_or(0, |lease| u32::try_from(lease.as_millis()).unwrap_or(u32::MAX).max(1));
        let [a, b, c, d] = lease.to_le_bytes();
        [flags, self.actuator, low, high, a, b, c, d]
    }

    /// The inverse of [`encode`](Self::encode). Other bits, and bytes that follow, are of a later version and passed over;
    /// [`Error::Malformed`] for fewer bytes.
    pub fn decode(bytes: &[u8]) -> Result<Self, Error> {
        let &[flags, actuator, low, high, a, b, c, d, ..] = bytes else { return Err(Error::Malformed) };
        #[cfg(not(feature = "streams"))]
        let _ = (low, high);
        let lease = u32::from_le_bytes([a, b, c, d]);
        Ok(Self {
            priority: Priority::from_wire(flags & Self::PRIORITY).ok_or(Error::Malformed)?,
            lease: (lease != 0).then(|| Duration::from_millis(u64::from(lease))),
            idempotent: flags & Self::IDEMPOTENT != 0,
            actuator,
            stop: flags & Self::STOP != 0,
            reset: flags & Self::RESET != 0,
            #[cfg(feature = "streams")]
            stream: (flags & Self::STREAM != 0).then_some(u16::from_le_bytes([low, high])),
        })
    }
}

/// In words, as `high, lease 400 ms, actuator 1, idempotent`.
impl fmt::Display for Attributes {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(self.priority.word())?;
        if let Some(lease) = self.lease {
            write!(f, ", lease {} ms", lease.as_millis())?;
        }
        #[cfg(feature = "streams")]
        match self.stream {
            Some(0) => f.write_str(", stream")?,
            Some(least) => write!(f, ", stream every {least} ms at most")?,
            None => {}
        }
        if self.actuator != 0 {
            write!(f, ", actuator {}", self.actuator)?;
        }
        let words = [(self.stop, ", stop"), (self.reset, ", reset"), (self.idempotent, ", idempotent")];
        words.iter().filter(|(set, _)| *set).try_for_each(|(_, word)| f.write_str(word))
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
        let all = Attributes {
            priority: Priority::Emergency,
            lease: Some(Duration::from_millis(0x1234)),
            idempotent: true,
            actuator: 7,
            stop: true,
            reset: true,
            #[cfg(feature = "streams")]
            stream: usual.stream,
        };
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
