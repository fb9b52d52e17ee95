//! Control messages: notifications between two units beside requests and replies (docs/wire.md). A table generates the enum, its
//! encoder and its decoder; each message is an [item](super::items).

use super::claim::Claim;
use super::compact::{Reader, Writer};
use super::hello::ClaimReport;
use super::items::{Item, Malformed};
use crate::ability::{HAND_OVER, STREAMS};
use crate::error::Error;

/// The message kind of control messages.
pub(super) const CONTROL: u8 = 3;

/// Generates [`Control`]: each row has the item's kind, the variant, and the fields in wire order.
macro_rules! controls {
    ($($(#[$about:meta])* $kind:literal $(if $is_on:ident)? => $name:ident { $($(#[$field_about:meta])* $field:ident: $type:ty,)* })*) => {
        /// A notification between two units: about functions, limits, leases, claims or streams.
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
                    // Variants of abilities that this build lacks are never made.
                    _ => {}
                }
            }

            /// Decodes an item; `None` for a kind that this version does not know.
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
        /// Its generation.
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
    /// Asks for an acknowledgement of everything published and withdrawn so far.
    3 => ListEnd {
        /// Increases with each such request.
        serial: u32,
    }
    /// The list was processed up to `serial`.
    4 => ListAck {
        /// As in `ListEnd`.
        serial: u32,
        /// How many functions did not fit the reader's table.
        skipped: u16,
    }
    /// The sender's limits changed.
    5 => Limits {
        /// Longest message that the sender accepts.
        message_size: u32,
        /// Least time between two requests to the sender, in microseconds.
        minimum_interval: u32,
        /// Most calls of one peer at a time.
        calls: u16,
    }
    /// The callee has ended a call's lease; renewals have no effect.
    6 => LeaseEnded {
        /// The caller's id of the call.
        call: u32,
        /// Why.
        why: LeaseEnd,
    }
    /// The state of the actuator of one of the sender's functions.
    7 => Actuator {
        /// Its slot.
        slot: u16,
        /// The latch, if the actuator is stopped.
        latch: Option<Latch>,
        /// The present or last order.
        last: Option<LastOrder>,
    }
    /// The sender has raised its claim.
    10 => Claimed {
        /// The new claim.
        report: ClaimReport,
    }
    /// The reader is to leave the sender, its manager, for another one.
    11 if HAND_OVER => HandOver {
        /// The name of the new manager.
        name: &'b [u8],
        /// Its ID number.
        id: u32,
    }
    /// The answer to `HandOver`. After consent the sender ends the link.
    12 if HAND_OVER => HandedOver {
        /// Why not; `None`: it leaves.
        refusal: Option<HandOverRefusal>,
    }
    /// The sender subscribes to a stream of the reader, or ends the subscription.
    8 if STREAMS => Subscribe {
        /// Its slot.
        slot: u16,
        /// Its generation.
        generation: u16,
        /// Least time between two values in milliseconds; [`NO_SUBSCRIPTION`](super::message::NO_SUBSCRIPTION) ends it.
        interval: u32,
    }
    /// The answer to `Subscribe`.
    9 if STREAMS => Subscribed {
        /// Its slot.
        slot: u16,
        /// Its generation.
        generation: u16,
        /// Least time between two values in milliseconds; [`NO_SUBSCRIPTION`](super::message::NO_SUBSCRIPTION): ended or refused.
        interval: u32,
        /// Most bytes of stream values that the sender sends in a second.
        bytes: u32,
        /// Why it was refused.
        refusal: SubscriptionRefusal,
    }
}

/// Why a subscription was refused.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
#[repr(u8)]
pub enum SubscriptionRefusal {
    /// It was not refused.
    None = 0,
    /// There is no such stream, or it was replaced. Also stands for reasons that this version does not know.
    Unknown = 1,
    /// The access table forbids it.
    NotAllowed = 2,
    /// The subscriber has its limit of subscriptions.
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

/// Why a vehicle stays with its manager.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash, thiserror::Error)]
#[repr(u8)]
#[non_exhaustive]
pub enum HandOverRefusal {
    /// Something moves, stops or waits to move.
    #[error("the vehicle moves: release its orders first")]
    Moves = 1,
    /// It has no key for the new manager, or is in plain mode.
    #[error("the vehicle has no key for that manager: add one with `cara keys`, and try again")]
    NoKey = 2,
    /// It dials its manager at a fixed address.
    #[error("the vehicle dials its manager at a fixed address: change its configuration instead")]
    Fixed = 3,
    /// It cannot store to whom it belongs.
    #[error("the vehicle cannot store to whom it belongs: give it a folder of state, or forget a claim")]
    NotStored = 4,
    /// An earlier hand-over has not ended.
    #[error("an earlier hand-over of the vehicle has not ended: try again later")]
    Underway = 5,
    /// Its own manager was named, the name is not valid, or a reason that this version does not know.
    #[error("the vehicle cannot go to that manager: check the name and id")]
    Other = 6,
}

/// 0 for none.
impl Field<'_> for Option<HandOverRefusal> {
    fn put(self, writer: &mut Writer<'_>) {
        writer.number(self.map_or(0, |refusal| refusal as u64));
    }

    fn take(reader: &mut Reader<'_>) -> Self {
        use HandOverRefusal::{Fixed, Moves, NoKey, NotStored, Other, Underway};
        match reader.u32() {
            0 => None,
            1 => Some(Moves),
            2 => Some(NoKey),
            3 => Some(Fixed),
            4 => Some(NotStored),
            5 => Some(Underway),
            _ => Some(Other),
        }
    }
}

impl Control<'_> {
    /// Encodes the message into `out`; `None` if it does not fit.
    pub fn encode<'o>(&self, out: &'o mut [u8]) -> Option<&'o [u8]> {
        let mut writer = Writer::new(out);
        writer.bytes(&[CONTROL, 0, 0, 0]);
        self.put(&mut writer);
        let used = writer.finish()?;
        out.get(..used)
    }
}

/// Why no order begins on an inhibited lease.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Latch {
    /// The ID number of the unit that stopped it; 0 for the vehicle itself.
    pub by: u32,
    /// The vehicle's own number of the reason; 0 for a function that stops.
    pub reason: u16,
}

/// The state of an actuator, which callers get without asking.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct ActuatorState {
    /// The latch, if the actuator is stopped.
    pub latch: Option<Latch>,
    /// The present or last order; `None` if there was none since the unit started.
    pub last: Option<LastOrder>,
}

/// The present or last order of an actuator. Does not tell an operator's order from one of the same unit's program.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct LastOrder {
    /// The ID number of the calling unit.
    pub holder: u32,
    /// The lower half of the nonce in the caller's hello on the order's link; 0 if sent to another unit than the caller.
    pub link: u32,
    /// The caller's id of the call on that link; 0 if sent to another unit.
    pub call: u32,
    /// The caller's claim; none if it has none, or if sent to another unit.
    pub claim: Claim,
    /// How it ended; `None` if it has not.
    pub end: Option<LeaseEnd>,
}

impl LastOrder {
    /// The order as it is sent to any unit but its caller.
    pub(crate) const fn of_another(self) -> Self {
        Self { link: 0, call: 0, claim: Claim::NONE, ..self }
    }

    /// The [`trace_id`] of link and call; 0 at other units than the caller. A program that has stored the trace ids of its calls
    /// recognises them after a restart or on another host.
    pub const fn trace(&self) -> u64 {
        trace_id(self.link, self.call)
    }
}

/// The trace id of a call: the lower half of the nonce in its caller's hello, and its id on that link.
pub const fn trace_id(link: u32, call: u32) -> u64 {
    (link as u64) << 32 | call as u64
}

/// What became of an [interrupted](Error::Interrupted) call with a lease, as its callee knows it.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum OrderOutcome {
    /// It has not ended.
    Runs,
    /// It began, and ended like this.
    Ended(LeaseEnd),
    /// It has not begun, and will not, since its link has ended.
    NotStarted,
    /// The node does not know, so the call may have run: the node has restarted, or has had an order of another caller or link
    /// since.
    Unknown,
}

impl ActuatorState {
    /// What became of the newest call that a caller made on one of its links.
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

/// Why the callee ended an order.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash)]
#[repr(u8)]
#[non_exhaustive]
pub enum LeaseEnd {
    /// The service has finished it.
    Finished,
    /// It was not renewed in time, or the callee stopped it: the safe hook runs there. Also stands for reasons that this version
    /// does not know.
    Expired,
    /// A newer call has replaced it.
    Replaced,
    /// Its actuator was stopped: the safe hook runs there, and no order begins before a reset.
    Stopped,
    /// Its caller gave it up: the safe hook runs there. Not reported to that caller as an event.
    Released,
    /// Decided by the caller: the callee did not answer renewals for the length of the lease. Renewals end, so the order ends
    /// there within another length.
    Unanswered,
}

impl LeaseEnd {
    pub(crate) const ALL: [Self; 5] = [Self::Finished, Self::Expired, Self::Replaced, Self::Stopped, Self::Released];

    /// By its number on the wire. Numbers of later versions become `Expired`.
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

/// A field of a control message.
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

/// 0 for none, otherwise the reason plus 1; then by whom.
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

/// 0 for none, 1 for an order that has not ended, otherwise 2 plus how it ended; then holder, link, call and claim.
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
        fn what_is_read_is_written_again(kind in 0..=Control::KINDS, body in prop::collection::vec(prop_oneof![any::<u8>(), 0..8_u8], 0..40)) {
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
