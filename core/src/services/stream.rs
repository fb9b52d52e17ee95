//! Streams: named values that change. A unit publishes the newest value; each subscriber gets it at its own interval, after
//! pending calls. Nothing is queued: a new value replaces one that was not sent.
//!
//! A stream is a function without arguments whose [attributes](crate::distribution::function::Attributes::stream) mark it, and
//! whose handler has a [`Source`]. [`Newest`] stores the value; a port puts a lock around it if it needs one.
//!
//! # Ages
//! The age of a value is never underestimated. It counts from publishing to sending on the publisher's clock, and from arrival on
//! the subscriber's. Queueing and travel are bounded like the age of a request: by the subscriber's clock as the publisher last
//! received it. The age is therefore too high by at most the travel time of a keep-alive.

use crate::bytes;
use crate::distribution::block::{self, SliceWriter};
use crate::distribution::function::Signature;
use crate::distribution::parameters::ParametersView;
use crate::error::Error;
use crate::time::{Duration, Instant};

/// The newest value of a stream, lent by its source.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Value<'v> {
    /// Increases with each value.
    pub version: u32,
    /// When it was published.
    pub published: Instant,
    /// Its age at that time: zero unless the value was received and passed on.
    pub age: Duration,
    /// The encoded values.
    pub block: &'v [u8],
}

impl Value<'_> {
    /// Its age at `now`.
    pub(crate) fn age_at(&self, now: Instant) -> Duration {
        self.age + now.since(self.published)
    }
}

/// Where a unit keeps the newest value of one stream.
pub trait Source {
    /// Differs for each value; 0 before the first.
    fn version(&self) -> u32;
    /// Lends the newest value, if there is one.
    fn newest(&self, look: &mut dyn FnMut(&Value<'_>));
    /// A link has sent the newest value, or skipped it as too long: a source whose values follow each other may publish the next.
    fn taken(&self) {}
}

/// Stores the newest value of a stream in lent bytes.
#[derive(Clone, Debug)]
pub struct Newest<B> {
    bytes: B,
    length: usize,
    version: u32,
    published: Instant,
    age: Duration,
}

impl<B: AsRef<[u8]> + AsMut<[u8]>> Newest<B> {
    /// Without a value; `bytes` should hold the [`longest`](block::longest) results of the stream.
    pub const fn new(bytes: B) -> Self {
        Self { bytes, length: 0, version: 0, published: Instant::START, age: Duration::ZERO }
    }

    /// Replaces the value. `age` is zero for a value of this unit's own.
    ///
    /// On an error the previous value stays: [`Error::MissingArgument`], [`Error::WrongType`] and [`Error::WrongSize`] if
    /// `values` do not match the stream's signature, [`Error::TooLarge`] if there are too few bytes.
    pub fn publish(
        &mut self,
        now: Instant,
        age: Duration,
        signature: Signature<'_>,
        values: &ParametersView,
    ) -> Result<(), Error> {
        let length = block::measure(signature.results(), values)?;
        let room = self.bytes.as_mut();
        let limit = room.len() as u32;
        let place = room.get_mut(..length).ok_or(Error::TooLarge { limit })?;
        block::write(signature.results(), values, &mut SliceWriter::new(place));
        self.was_published(now, age, length);
        Ok(())
    }

    /// As [`publish`](Self::publish), for the encoded value of a stream that is passed on.
    pub fn pass_on(&mut self, now: Instant, age: Duration, encoded: &[u8]) -> Result<(), Error> {
        let room = self.bytes.as_mut();
        let limit = room.len() as u32;
        bytes::copy(encoded, room.get_mut(..encoded.len()).ok_or(Error::TooLarge { limit })?);
        self.was_published(now, age, encoded.len());
        Ok(())
    }

    fn was_published(&mut self, now: Instant, age: Duration, length: usize) {
        (self.published, self.age, self.length) = (now, age, length);
        self.version = self.version.wrapping_add(1).max(1);
    }

    /// Differs for each value; 0 before the first.
    pub const fn version(&self) -> u32 {
        self.version
    }

    /// The newest value, if there is one.
    pub fn value(&self) -> Option<Value<'_>> {
        let block = self.bytes.as_ref().get(..self.length).unwrap_or_default();
        let value = Value { version: self.version, published: self.published, age: self.age, block };
        (self.version != 0).then_some(value)
    }
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used)]
    use super::*;
    use crate::distribution::function::Definition;
    use crate::distribution::parameters::Parameters;

    #[test]
    fn the_newest_value_replaces_the_one_before() {
        let pose = Definition::stream("pose(x: int)").unwrap();
        let mut newest = Newest::new([0; 8]);
        assert_eq!((newest.value(), newest.version()), (None, 0));
        let mut values = Parameters::<64>::sized();
        values.add_int("x", 1).unwrap();
        for (version, x) in [(1, 5_i64), (2, 6)] {
            values.set_value("x", x).unwrap();
            newest.publish(Instant::from_micros(10), Duration::ZERO, pose.signature(), &values).unwrap();
            let value = newest.value().unwrap();
            assert_eq!((value.version, value.block), (version, &x.to_le_bytes()[..]));
        }
        newest.pass_on(Instant::from_micros(20), Duration::from_micros(7), &[0; 8]).unwrap();
        assert_eq!(newest.value().unwrap().age_at(Instant::from_micros(25)), Duration::from_micros(12));
    }

    #[test]
    fn what_the_stream_does_not_declare_changes_nothing() {
        let pose = Definition::stream("pose(x: int[2])").unwrap();
        let mut newest = Newest::new([0; 8]);
        let mut values = Parameters::<64>::sized();
        let publish = |newest: &mut Newest<_>, values: &Parameters<64>| {
            newest.publish(Instant::START, Duration::ZERO, pose.signature(), values)
        };
        assert_eq!(publish(&mut newest, &values), Err(Error::MissingArgument { index: 0 }));
        values.add_int("x", 2).unwrap();
        assert_eq!(publish(&mut newest, &values), Err(Error::TooLarge { limit: 8 }));
        assert_eq!(newest.pass_on(Instant::START, Duration::ZERO, &[0; 9]), Err(Error::TooLarge { limit: 8 }));
        assert_eq!(newest.version(), 0);
    }
}
