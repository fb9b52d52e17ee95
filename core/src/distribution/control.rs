//! Control messages: what two units tell each other beside requests and replies. One table has them all: it makes the enum
//! and both directions of its encoding, which is postcard's.

#[cfg(test)]
use serde::{Deserialize, Serialize};

use super::compact::{Reader, Writer};
use super::message::CONTROL;

/// Makes [`Control`] of its table: each row is the kind on the wire, the variant and its fields in their order.
macro_rules! controls {
    ($($(#[$about:meta])* $kind:literal => $name:ident { $($(#[$field_about:meta])* $field:ident: $type:ty,)* })*) => {
        /// Messages between two units that are no requests: what they tell each other about their functions, limits and
        /// leases.
        #[derive(Clone, Copy, Debug, PartialEq, Eq)]
        #[cfg_attr(test, derive(Serialize, Deserialize))]
        pub enum Control<'b> {
            $($(#[$about])* $name { $($(#[$field_about])* $field: $type,)* },)*
        }

        impl<'b> Control<'b> {
            /// How many kinds there are.
            #[cfg(test)]
            pub(crate) const KINDS: u8 = [$($kind),*].len() as u8;

            fn put(&self, writer: &mut Writer<'_>) {
                match *self {
                    $(Self::$name { $($field),* } => {
                        writer.byte($kind);
                        $($field.put(writer);)*
                    })*
                }
            }

            /// Whether it could be read, and whether something follows, is known to the reader; `None` for an unknown kind.
            pub(crate) fn take(reader: &mut Reader<'b>) -> Option<Self> {
                Some(match reader.u32() {
                    $($kind => Self::$name { $($field: Field::take(reader)),* },)*
                    _ => return None,
                })
            }
        }
    };
}

controls! {
    /// A function of the sender may now be called.
    0 => Publish {
        /// Its slot.
        slot: u16,
        /// Its life.
        generation: u16,
        /// [`Attributes`](super::function::Attributes) in their wire form.
        attributes: [u8; 8],
        /// The encoded [`Signature`](super::function::Signature).
        #[cfg_attr(test, serde(borrow))]
        signature: &'b [u8],
    }
    /// A function of the sender may no longer be called.
    1 => Withdraw {
        /// Its slot.
        slot: u16,
    }
    /// All publishing and withdrawing up to here is to be acknowledged.
    2 => ListEnd {
        /// Rises with each acknowledgement asked for.
        serial: u32,
    }
    /// The list up to `serial` was read.
    3 => ListAck {
        /// As in `ListEnd`.
        serial: u32,
        /// Functions that the reader keeps no room for.
        skipped: u16,
    }
    /// The sender's limits changed.
    4 => Limits {
        /// Longest message that the sender takes.
        message_size: u32,
        /// Least time between two requests to the sender, in microseconds.
        minimum_interval: u32,
        /// Calls of one peer that the sender holds.
        calls: u16,
    }
    /// The callee ended what a leased call started; renewals have no effect.
    5 => LeaseEnded {
        /// The caller's id of the call.
        call: u32,
        /// Why.
        why: LeaseEnd,
    }
}

impl Control<'_> {
    /// Encodes into `out`, whole message; `None` where it does not fit.
    pub fn encode<'o>(&self, out: &'o mut [u8]) -> Option<&'o [u8]> {
        let mut writer = Writer::new(out);
        writer.byte(CONTROL);
        self.put(&mut writer);
        let used = writer.finish()?;
        out.get(..used)
    }
}

/// Why the callee ended what a leased call started.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash)]
#[repr(u8)]
#[cfg_attr(test, derive(Serialize, Deserialize))]
#[non_exhaustive]
pub enum LeaseEnd {
    /// The service has done what was asked for.
    Finished,
    /// It was not renewed in time, or the callee stopped it: the safe hook runs there.
    Expired,
    /// A newer call of the same function goes on in its place.
    Replaced,
}

impl LeaseEnd {
    pub(crate) const ALL: [Self; 3] = [Self::Finished, Self::Expired, Self::Replaced];

    /// `finished`, `expired`, `replaced`.
    pub const fn word(self) -> &'static str {
        match self {
            Self::Finished => "finished",
            Self::Expired => "expired",
            Self::Replaced => "replaced",
        }
    }
}

/// What a field of a control message may be.
trait Field<'b> {
    fn put(self, writer: &mut Writer<'_>);
    fn take(reader: &mut Reader<'b>) -> Self;
}

impl Field<'_> for u16 {
    fn put(self, writer: &mut Writer<'_>) {
        writer.number(self.into());
    }

    fn take(reader: &mut Reader<'_>) -> Self {
        reader.u16()
    }
}

impl Field<'_> for u32 {
    fn put(self, writer: &mut Writer<'_>) {
        writer.number(self.into());
    }

    fn take(reader: &mut Reader<'_>) -> Self {
        reader.u32()
    }
}

impl Field<'_> for [u8; 8] {
    fn put(self, writer: &mut Writer<'_>) {
        writer.bytes(&self);
    }

    fn take(reader: &mut Reader<'_>) -> Self {
        reader.bytes(8).try_into().unwrap_or_default()
    }
}

impl<'b> Field<'b> for &'b [u8] {
    fn put(self, writer: &mut Writer<'_>) {
        writer.text(self);
    }

    fn take(reader: &mut Reader<'b>) -> Self {
        reader.text()
    }
}

impl Field<'_> for LeaseEnd {
    fn put(self, writer: &mut Writer<'_>) {
        writer.number(self as u64);
    }

    fn take(reader: &mut Reader<'_>) -> Self {
        let why = reader.choice(Self::ALL.len() as u32);
        Self::ALL.get(why as usize).copied().unwrap_or(Self::Expired)
    }
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used, clippy::indexing_slicing, clippy::panic)]
    use proptest::prelude::*;

    use super::super::message::{CONTROL_BYTES, Message, PUBLISH_BYTES};
    use super::*;

    proptest! {
        #[test]
        fn control_messages_are_as_postcard_has_them(
            bytes in prop::collection::vec(prop_oneof![any::<u8>(), 0..8_u8], 0..40),
        ) {
            let mut reader = Reader::new(&bytes);
            let ours = Control::take(&mut reader);
            let ours = ours.filter(|_| reader.is_through());
            let theirs = postcard::take_from_bytes::<Control<'_>>(&bytes).ok();
            let theirs = theirs.and_then(|(control, rest)| rest.is_empty().then_some(control));
            prop_assert_eq!(ours, theirs);
            if let Some(control) = ours {
                let (mut ours, mut theirs) = ([0; 80], [0; 80]);
                let written = &control.encode(&mut ours).unwrap()[1..];
                prop_assert_eq!(written, &*postcard::to_slice(&control, &mut theirs).unwrap());
            }
        }
    }

    #[test]
    fn control_messages_fit_their_bound() {
        let worst = Control::Limits { message_size: u32::MAX, minimum_interval: u32::MAX, calls: u16::MAX };
        let mut out = [0; CONTROL_BYTES];
        assert!(worst.encode(&mut out).is_some());
        let signature = [1; 300];
        let publish =
            Control::Publish { slot: u16::MAX, generation: u16::MAX, attributes: [255; 8], signature: &signature };
        let mut out = [0; PUBLISH_BYTES + 300];
        let bytes = publish.encode(&mut out).unwrap();
        let Some(Message::Control(read)) = Message::decode(bytes) else { panic!() };
        assert_eq!(read, publish);
    }
}
