//! Control messages: what two units tell each other beside requests and replies. One table has them all: it makes the enum
//! and both directions of its encoding, an [item](super::items) each.

use super::claim::Claim;
use super::compact::{Reader, Writer};
use super::hello::ClaimReport;
use super::items::{Item, Malformed};
use crate::ability::STREAMS;
use crate::error::Error;

/// The kind of a message that has control items.
pub(super) const CONTROL: u8 = 3;

/// Makes [`Control`] of its table: each row is the item's kind, the variant and its fields in their order.
macro_rules! controls {
    ($($(#[$about:meta])* $kind:literal $(if $is_on:ident)? => $name:ident { $($(#[$field_about:meta])* $field:ident: $type:ty,)* })*) => {
        /// Messages between two units that are no requests: what they tell each other about their functions, limits and
        /// leases.
        #[derive(Clone, Copy, Debug, PartialEq, Eq)]
        pub enum Control<'b> {
            $($(#[$about])* $name { $($(#[$field_about])* $field: $type,)* },)*
        }

        impl<'b> Control<'b> {
            /// How many kinds there are.
            #[cfg(test)]
            pub(crate) const KINDS: u16 = [$($kind),*].len() as u16;

            fn put(&self, writer: &mut Writer<'_>) {
                match *self {
                    $(Self::$name { $($field),* } $(if $is_on)? => {
                        let item = writer.begin($kind);
                        $($field.put(writer);)*
                        writer.end(item);
                    })*
                    // None is made of an ability that is off.
                    _ => {}
                }
            }

            /// Reads an item of a control message; `None` for a kind that this version does not know.
            pub fn take(item: &Item<'b>) -> Result<Option<Self>, Malformed> {
                item.read(|reader| match item.kind {
                    $($kind $(if $is_on)? => Some(Self::$name { $($field: Field::take(reader)),* }),)*
                    _ => None,
                })
            }
        }
    };
}

controls! {
    /// A function of the sender may now be called.
    1 => Publish {
        /// Its slot.
        slot: u16,
        /// Its life.
        generation: u16,
        /// [`Attributes`](super::function::Attributes) in their wire form.
        attributes: &'b [u8],
        /// The encoded [`Signature`](super::function::Signature).
        signature: &'b [u8],
    }
    /// A function of the sender may no longer be called.
    2 => Withdraw {
        /// Its slot.
        slot: u16,
    }
    /// All publishing and withdrawing up to here is to be acknowledged.
    3 => ListEnd {
        /// Rises with each acknowledgement asked for.
        serial: u32,
    }
    /// The list up to `serial` was read.
    4 => ListAck {
        /// As in `ListEnd`.
        serial: u32,
        /// Functions that the reader keeps no room for.
        skipped: u16,
    }
    /// The sender's limits changed.
    5 => Limits {
        /// Longest message that the sender takes.
        message_size: u32,
        /// Least time between two requests to the sender, in microseconds.
        minimum_interval: u32,
        /// Calls of one peer that the sender holds.
        calls: u16,
    }
    /// The callee ended what a leased call started; renewals have no effect.
    6 => LeaseEnded {
        /// The caller's id of the call.
        call: u32,
        /// Why.
        why: LeaseEnd,
    }
    /// The state of what a function of the sender moves.
    7 => Actuator {
        /// Its slot.
        slot: u16,
        /// What keeps every order from beginning.
        latch: Option<Latch>,
        /// The order that it has, or had last.
        last: Option<LastOrder>,
    }
    /// The sender has raised its claim.
    10 => Claimed {
        /// What it is now.
        report: ClaimReport,
    }
    /// The sender wants values of a stream of the reader, or no more of them.
    8 if STREAMS => Subscribe {
        /// Its slot.
        slot: u16,
        /// Its life.
        generation: u16,
        /// Least time between two values in milliseconds; [`NO_SUBSCRIPTION`](super::message::NO_SUBSCRIPTION) ends it.
        interval: u32,
    }
    /// The answer to `Subscribe`.
    9 if STREAMS => Subscribed {
        /// Its slot.
        slot: u16,
        /// Its life.
        generation: u16,
        /// Least time between two values in milliseconds, [`NO_SUBSCRIPTION`](super::message::NO_SUBSCRIPTION) where it was ended or refused.
        interval: u32,
        /// Bytes of values of all streams that the sender sends in a second.
        bytes: u32,
        /// Why it was refused.
        refusal: SubscriptionRefusal,
    }
}

/// Why a subscription was refused.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
#[repr(u8)]
pub enum SubscriptionRefusal {
    /// It was not.
    None = 0,
    /// There is no such stream, or it was replaced. Also any reason that this version does not know.
    Unknown = 1,
    /// The access table does not let the subscriber have it.
    NotAllowed = 2,
    /// The subscriber has as many subscriptions as it may.
    Full = 3,
}

impl Field<'_> for SubscriptionRefusal {
    fn put(self, writer: &mut Writer<'_>) {
        writer.number(self as u64);
    }

    fn take(reader: &mut Reader<'_>) -> Self {
        match reader.u32() {
            0 => Self::None,
            2 => Self::NotAllowed,
            3 => Self::Full,
            _ => Self::Unknown,
        }
    }
}

impl Control<'_> {
    /// Encodes into `out`, whole message; `None` where it does not fit.
    pub fn encode<'o>(&self, out: &'o mut [u8]) -> Option<&'o [u8]> {
        let mut writer = Writer::new(out);
        writer.bytes(&[CONTROL, 0, 0, 0]);
        self.put(&mut writer);
        let used = writer.finish()?;
        out.get(..used)
    }
}

/// Why nothing begins on a lease that is inhibited.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Latch {
    /// The ID number of the unit that stopped it; 0 for this one.
    pub by: u32,
    /// Why, as this unit numbers its reasons; 0 for a function that stops.
    pub reason: u16,
}

/// The state of what a service moves, as callers are told without asking.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct ActuatorState {
    /// What keeps every order from beginning.
    pub latch: Option<Latch>,
    /// The order that has it, or had it last; `None` when there was none since the unit's start.
    pub last: Option<LastOrder>,
}

/// The order that a service has, or had last. An operator's is not told from one of the program of the same unit.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct LastOrder {
    /// The ID number of its caller.
    pub holder: u32,
    /// The low half of the nonce in its caller's hello on the link that it came by; 0 for other units than its caller.
    pub link: u32,
    /// Its caller's id of the call on that link; 0 for other units than its caller.
    pub call: u32,
    /// The claim that its caller had; none for other units than its caller, and for a caller without one.
    pub claim: Claim,
    /// How it ended; `None` while it has not.
    pub end: Option<LeaseEnd>,
}

impl LastOrder {
    /// For any other unit than its caller.
    pub(crate) const fn of_another(self) -> Self {
        Self { link: 0, call: 0, claim: Claim::NONE, ..self }
    }

    /// Its trace id: [`trace_id`] of link and call, 0 for other units than its caller. A program that wrote down the trace ids
    /// of its calls knows them again after a start or on another host.
    pub const fn trace(&self) -> u64 {
        trace_id(self.link, self.call)
    }
}

/// The trace id of a call: the lower half of the nonce in its caller's hello, and its id on that link.
pub const fn trace_id(link: u32, call: u32) -> u64 {
    (link as u64) << 32 | call as u64
}

/// What a node tells of a call that moved something there, or was to: of one that was [interrupted](Error::Interrupted).
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum OrderOutcome {
    /// It has not ended.
    Runs,
    /// It began, and ended so.
    Ended(LeaseEnd),
    /// It has not begun, and does not any more, because its link has ended.
    NotStarted,
    /// The node cannot tell, and it may have run: it was started since, or has done something for another caller, or by an earlier link.
    Unknown,
}

impl ActuatorState {
    /// What it tells of the newest call that a caller made by one of its links.
    pub fn outcome_of(&self, link: u32, call: u32) -> OrderOutcome {
        match self.last {
            Some(last) if last.link != link || last.call == 0 => OrderOutcome::Unknown,
            Some(LastOrder { call: started, .. }) if started < call => OrderOutcome::NotStarted,
            Some(LastOrder { end: None, .. }) => OrderOutcome::Runs,
            Some(LastOrder { end: Some(end), .. }) => OrderOutcome::Ended(end),
            None => OrderOutcome::Unknown,
        }
    }
}

impl From<Latch> for Error {
    fn from(Latch { by, reason }: Latch) -> Self {
        Self::Inhibited { by, reason }
    }
}

/// Why the callee ended what a leased call started.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash)]
#[repr(u8)]
#[non_exhaustive]
pub enum LeaseEnd {
    /// The service has done what was asked for.
    Finished,
    /// It was not renewed in time, or the callee stopped it: the safe hook runs there. Also any reason that this version
    /// does not know.
    Expired,
    /// A newer call goes on in its place.
    Replaced,
    /// What it moved was stopped: the safe hook runs there, and nothing moves it before a reset.
    Stopped,
    /// Its caller gave it up: the safe hook runs there. It is no news to that caller, whose events do not have it.
    Released,
    /// Never told by a callee, which did not answer renewals for the length of the lease: it is renewed no more, and ends
    /// there within another one.
    Unanswered,
}

impl LeaseEnd {
    pub(crate) const ALL: [Self; 5] = [Self::Finished, Self::Expired, Self::Replaced, Self::Stopped, Self::Released];

    /// By its number on the wire; a reason of a later version is an end all the same.
    pub fn of(number: u32) -> Self {
        Self::ALL.get(number as usize).copied().unwrap_or(Self::Expired)
    }

    /// `finished`, `expired`, `replaced`, `stopped`, `released`, `unanswered`.
    pub const fn word(self) -> &'static str {
        match self {
            Self::Finished => "finished",
            Self::Expired => "expired",
            Self::Replaced => "replaced",
            Self::Stopped => "stopped",
            Self::Released => "released",
            Self::Unanswered => "unanswered",
        }
    }
}

/// What a field of a control message may be.
trait Field<'b> {
    fn put(self, writer: &mut Writer<'_>);
    fn take(reader: &mut Reader<'b>) -> Self;
}

impl Field<'_> for ClaimReport {
    fn put(self, writer: &mut Writer<'_>) {
        self.put_fields(writer);
    }

    fn take(reader: &mut Reader<'_>) -> Self {
        Self::take(reader)
    }
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
        Self::of(reader.u32())
    }
}

/// The reason and 1, or 0 for none; then by whom.
impl Field<'_> for Option<Latch> {
    fn put(self, writer: &mut Writer<'_>) {
        writer.number(self.map_or(0, |latch| u64::from(latch.reason).saturating_add(1)));
        writer.number(self.map_or(0, |latch| latch.by).into());
    }

    fn take(reader: &mut Reader<'_>) -> Self {
        let (reason, by) = (reader.u32(), reader.u32());
        reason.checked_sub(1).map(|reason| Latch { by, reason: u16::try_from(reason).unwrap_or(u16::MAX) })
    }
}

/// 0 for none, 1 for one that has not ended, 2 and how it has; then holder, link, call and claim.
impl Field<'_> for Option<LastOrder> {
    fn put(self, writer: &mut Writer<'_>) {
        let LastOrder { holder, link, call, claim, end } =
            self.unwrap_or(LastOrder { holder: 0, link: 0, call: 0, claim: Claim::NONE, end: None });
        let how = end.map_or(u64::from(self.is_some()), |end| (end as u64).saturating_add(2));
        for number in [how, holder.into(), link.into(), call.into(), claim.term, claim.claimant] {
            writer.number(number);
        }
    }

    fn take(reader: &mut Reader<'_>) -> Self {
        let [how, holder, link, call] = [(); 4].map(|()| reader.u32());
        let claim = Claim { term: reader.u64(), claimant: reader.u64() };
        let end = how.checked_sub(2).map(LeaseEnd::of);
        (how != 0).then_some(LastOrder { holder, link, call, claim, end })
    }
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used, clippy::indexing_slicing, clippy::panic)]
    use proptest::prelude::*;

    use super::super::items::Items;
    use super::super::message::{CONTROL_BYTES, Message, PUBLISH_BYTES};
    use super::*;

    /// The only item of a message.
    fn read(bytes: &[u8]) -> Option<Control<'_>> {
        let Some(Message::Control(items)) = Message::decode(bytes) else { panic!("no control message") };
        let item = Items::new(items).next().unwrap().unwrap();
        Control::take(&item).ok().flatten()
    }

    proptest! {
        #[test]
        fn what_is_read_is_written_again(kind in 0..9_u16, body in prop::collection::vec(prop_oneof![any::<u8>(), 0..8_u8], 0..40)) {
            if let Ok(Some(control)) = Control::take(&Item { kind, body: &body }) {
                let mut out = [0; 80];
                prop_assert_eq!(read(control.encode(&mut out).unwrap()), Some(control));
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
            Control::Publish { slot: u16::MAX, generation: u16::MAX, attributes: &[255; 8], signature: &signature };
        let mut out = [0; PUBLISH_BYTES + 300];
        assert_eq!(read(publish.encode(&mut out).unwrap()), Some(publish));
    }

    #[test]
    fn only_what_is_certain_of_an_order_is_told() {
        let last = LastOrder { holder: 1, link: 9, call: 7, claim: Claim::NONE, end: Some(LeaseEnd::Finished) };
        let reported = |last| ActuatorState { latch: None, last }.outcome_of(9, 7);
        assert_eq!(reported(None), OrderOutcome::Unknown, "the node was started since");
        assert_eq!(reported(Some(last)), OrderOutcome::Ended(LeaseEnd::Finished));
        assert_eq!(reported(Some(LastOrder { end: None, ..last })), OrderOutcome::Runs);
        assert_eq!(reported(Some(LastOrder { call: 6, ..last })), OrderOutcome::NotStarted);
        assert_eq!(reported(Some(LastOrder { link: 8, ..last })), OrderOutcome::Unknown, "of another link");
        let others = LastOrder { holder: 2, ..last.of_another() };
        assert_eq!(reported(Some(others)), OrderOutcome::Unknown);
    }

    #[test]
    fn a_later_version_may_say_more() {
        let ended = Control::LeaseEnded { call: 7, why: LeaseEnd::Replaced };
        let longer = Item { kind: 6, body: &[7, 2, 99, 99] };
        assert_eq!(Control::take(&longer), Ok(Some(ended)));
        assert_eq!(Control::take(&Item { kind: 6, body: &[7] }), Err(Malformed));
        assert_eq!(Control::take(&Item { kind: 700, body: &[7] }), Ok(None));
    }
}
