//! Streams on one link: samples of this unit's streams to the peer, and of the peer's to this unit.
//!
//! There is no queue of samples: a subscription records which version was sent last and when the next may follow. A sample is
//! made from the newest value when it is due and the send queue is empty, so that at most one waits, in the lowest class.

use super::permitting::decide;
use super::publishing::Advertised;
use super::subscription::{Pace, Subscription};
use super::wire::Wire;
use super::{Event, Phase, Results};
use crate::ability::{Ability, Begins, STREAMS, State, Streams};
use crate::config::Priority;
use crate::distribution::block;
use crate::distribution::function_list::{Function, Generation, Slot};
use crate::distribution::message::{Control, NO_SUBSCRIPTION, SAMPLE_BYTES, SampleHeader, SubscriptionRefusal};
use crate::error::{Error, Limit};
use crate::host::connections::{LinkCounter, Span};
use crate::services::access::{Decision, Verb};
use crate::services::stream::{Source, Value};
use crate::services::{Context, Port};
use crate::time::{Duration, Instant};

/// How long to wait before retrying a sample that found no buffer.
const RETRY: Duration = Duration::from_millis(10);
/// One second in microseconds.
const SECOND: u64 = 1_000_000;

/// A value of a stream of the peer, still in the lent bytes.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Sample {
    /// The peer's stream.
    pub slot: Slot,
    /// Its age on arrival; never underestimated.
    pub age: Duration,
    /// The values, for [`Session::results`](super::Session::results).
    pub values: Results,
}

/// A subscription of this unit, as the peer has granted it.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Granted {
    /// Least time between two values.
    pub interval: Duration,
    /// Most bytes per second of all streams together that the peer sends.
    pub bytes: u32,
}

/// The streams of one link.
#[derive(Clone, Copy)]
pub(super) struct Streaming {
    /// How many subscriptions the peer has.
    active: u16,
    /// The slot to begin with: streams take turns if not all samples can be sent.
    first: usize,
    /// The byte limit is used up to this time; sending may continue after it.
    paid: Instant,
    answers_due: bool,
    wishes_due: bool,
}

impl Begins for Streaming {
    const BEGIN: &'static Self =
        &Self { active: 0, first: 0, paid: Instant::START, answers_due: false, wishes_due: false };
}

impl Streaming {
    pub(super) const fn has_news(&self) -> bool {
        self.answers_due || self.wishes_due
    }
}

/// The outcome of an attempt to send a sample.
enum Attempt {
    Sent,
    /// Not before this time.
    Later(Instant),
    /// The send queue is not empty.
    Blocked,
    /// The subscription has ended for this reason.
    Ended(SubscriptionRefusal),
}

/// The streams of a link; without state in builds that leave streams out.
pub(super) type StreamsPart = State<Streaming, { STREAMS as usize }>;

impl StreamsPart {
    /// Subscribes to a stream of the peer, or ends the subscription if `interval` is `None`.
    pub(super) fn wish<P: Port>(
        &mut self,
        wire: &mut Wire<P>,
        cx: &mut Context<'_, P>,
        stream: &str,
        interval: Option<Duration>,
    ) -> Result<Slot, Error> {
        let longest = NO_SUBSCRIPTION.saturating_sub(1);
        let interval = interval.map_or(NO_SUBSCRIPTION, |interval| {
            u32::try_from(interval.as_millis()).map_or(longest, |interval| interval.min(longest))
        });
        if wire.phase != Phase::Live {
            return Err(Error::NotConnected);
        }
        let known = wire.theirs.named(stream).filter(|function| function.attributes.is_stream());
        let slot = known.ok_or(Error::UnknownFunction)?.slot;
        if let Some(wish) = wire.theirs.wish_mut(slot) {
            wish.interval = interval;
            self.change(|streaming| streaming.wishes_due = true);
        }
        self.pump(wire, cx);
        Ok(slot)
    }

    /// Schedules a new value of one of this unit's streams. Returns whether the peer has any subscription.
    pub(super) fn changed<P: Port>(&self, wire: &mut Wire<P>, now: Instant) -> bool {
        let wanted = self.active > 0;
        if wanted {
            wire.pace_samples(Pace { due: wire.pace.due.min(now), ..*wire.pace });
        }
        wanted
    }

    /// How many streams of this unit the peer subscribes to.
    pub(super) fn active(&self) -> u16 {
        self.active
    }

    /// Sends this unit's subscriptions, and answers to those of the peer.
    pub(super) fn pump<P: Port>(&mut self, wire: &mut Wire<P>, cx: &mut Context<'_, P>) {
        while P::CALLS && self.wishes_due {
            let Some((slot, generation, interval)) = wire.theirs.untold_wish() else {
                self.change(|streaming| streaming.wishes_due = false);
                break;
            };
            if !wire.send_control(cx, &Control::Subscribe { slot: slot.0, generation: generation.0, interval }) {
                break;
            }
            if let Some(wish) = wire.theirs.wish_mut(slot) {
                wish.advertised = interval;
            }
        }
        if self.answers_due {
            let are_due = !Self::send_answers(wire, cx);
            self.change(|streaming| streaming.answers_due = are_due);
        }
    }

    /// Answers each subscription that has no answer yet; `false` if capacity ran out.
    fn send_answers<P: Port>(wire: &mut Wire<P>, cx: &mut Context<'_, P>) -> bool {
        let bytes = wire.constraints.stream_bytes;
        for slot in wire.publishing.all_slots() {
            let Some(&mut Subscription { interval, generation, answer: Some(refusal), .. }) =
                wire.publishing.subscription(slot)
            else {
                continue;
            };
            let answer = Control::Subscribed { slot: slot.0, generation: generation.0, interval, bytes, refusal };
            if !wire.send_control(cx, &answer) {
                return false;
            }
            if let Some(subscription) = wire.publishing.subscription(slot) {
                subscription.answer = None;
            }
        }
        true
    }

    /// The peer subscribes to a stream of this unit, changes the interval, or unsubscribes.
    pub(super) fn subscription_arrived<P: Port>(
        &mut self,
        wire: &mut Wire<P>,
        cx: &mut Context<'_, P>,
        slot: Slot,
        generation: Generation,
        interval: u32,
    ) {
        let granted = match interval {
            NO_SUBSCRIPTION => Ok(NO_SUBSCRIPTION),
            _ => self.check_subscription(wire, cx, slot, generation).map(|least| interval.max(least)),
        };
        if granted.is_err() {
            wire.link.counters.add(LinkCounter::SubscriptionsRefused, 1);
        }
        let Some(subscription) = wire.publishing.subscription(slot) else { return };
        // If only the interval changes, the peer already has the newest value.
        let (version, due) = match subscription.is_active() && subscription.generation == generation {
            true => (subscription.version, subscription.due.min(cx.now + millis(interval))),
            false => (0, cx.now),
        };
        let answer = Some(granted.err().unwrap_or(SubscriptionRefusal::None));
        let interval = granted.unwrap_or(NO_SUBSCRIPTION);
        *subscription = Subscription { interval, version, generation, answer, due };
        let active = wire.publishing.count_subscriptions();
        self.change(|streaming| (streaming.active, streaming.answers_due) = (active, true));
        wire.pace_samples(Pace { due: cx.now, ..*wire.pace });
        self.pump(wire, cx);
    }

    /// Whether the peer may subscribe to a stream; returns the interval granted, in milliseconds.
    fn check_subscription<P: Port>(
        &self,
        wire: &mut Wire<P>,
        cx: &Context<'_, P>,
        slot: Slot,
        generation: Generation,
    ) -> Result<u32, SubscriptionRefusal> {
        let stream = Self::stream(wire, cx, slot, generation).ok_or(SubscriptionRefusal::Unknown)?;
        if !Self::decide_stream(wire, cx, &stream).is_allowed() {
            return Err(SubscriptionRefusal::NotAllowed);
        }
        let is_new = wire.publishing.subscription(slot).is_some_and(|subscription| !subscription.is_active());
        if is_new && self.active >= wire.constraints.subscriptions_per_peer {
            return Err(SubscriptionRefusal::Full);
        }
        Ok(u32::from(stream.attributes.stream.unwrap_or(0)))
    }

    /// A stream of this unit that was published to the peer.
    fn stream<'f, P: Port>(
        wire: &Wire<P>,
        cx: &Context<'f, P>,
        slot: Slot,
        generation: Generation,
    ) -> Option<Function<'f, dyn crate::services::lease::Service>> {
        let function = cx.functions.lookup(slot, generation).ok()?;
        let is_advertised = matches!(wire.publishing.advertised(slot, generation), Advertised::Now);
        (is_advertised && function.attributes.is_stream()).then_some(function)
    }

    fn decide_stream<P: Port>(
        wire: &Wire<P>,
        cx: &Context<'_, P>,
        stream: &Function<'_, dyn crate::services::lease::Service>,
    ) -> Decision {
        decide(cx.table(), wire.remote.as_ref(), stream.name(), Verb::Call)
    }

    /// Sends all samples that are due while the send queue stays empty. So no sample delays a call that this end sends later, and
    /// each is the newest when it is sent.
    pub(super) fn send_samples<P: Port>(&mut self, wire: &mut Wire<P>, cx: &mut Context<'_, P>) {
        wire.pace_samples(*Pace::BEGIN);
        if self.active == 0 || wire.phase != Phase::Live {
            return;
        }
        let slots = wire.publishing.slots();
        let first = self.first;
        let mut pace = *Pace::BEGIN;
        for index in (first..slots).chain(0..first.min(slots)) {
            let slot = Slot(index as u16);
            let Some(&mut subscription) = wire.publishing.subscription(slot) else { continue };
            if !subscription.is_active() {
                continue;
            }
            match self.attempt(wire, cx, slot, &subscription) {
                Attempt::Sent => self.change(|streaming| streaming.first = index.saturating_add(1)),
                Attempt::Later(due) => pace.due = pace.due.min(due),
                Attempt::Ended(why) => self.end_subscription(wire, slot, why),
                Attempt::Blocked => {
                    pace.blocked = cx.now;
                    break;
                }
            }
        }
        wire.pace_samples(pace);
        self.pump(wire, cx);
    }

    fn attempt<P: Port>(
        &mut self,
        wire: &mut Wire<P>,
        cx: &mut Context<'_, P>,
        slot: Slot,
        subscription: &Subscription,
    ) -> Attempt {
        let Some(stream) = Self::stream(wire, cx, slot, subscription.generation) else {
            return Attempt::Ended(SubscriptionRefusal::Unknown);
        };
        let Some(source) = stream.handler.stream() else { return Attempt::Ended(SubscriptionRefusal::Unknown) };
        if source.version() == subscription.version {
            return Attempt::Later(Instant::FAR_FUTURE);
        }
        let due = subscription.due.max(self.paid);
        if due > cx.now {
            return Attempt::Later(due);
        }
        // Flush gathered messages first.
        if wire.link.queued() > 0 {
            wire.flush(cx);
        }
        if wire.link.queued() > 0 || wire.phase != Phase::Live {
            return Attempt::Blocked;
        }
        match Self::decide_stream(wire, cx, &stream) {
            Decision::Denied => return Attempt::Ended(SubscriptionRefusal::NotAllowed),
            Decision::Allowed { rate: None, .. } => {}
            Decision::Allowed { rate: Some(rate), .. } => {
                let bucket = wire.publishing.bucket(slot);
                if let Some(Err(Error::TooSoon { wait })) = bucket.map(|bucket| bucket.take(cx.now, rate)) {
                    return Attempt::Later(cx.now + wait);
                }
            }
        }
        self.send_sample(wire, cx, slot, subscription, source)
    }

    fn send_sample<P: Port>(
        &mut self,
        wire: &mut Wire<P>,
        cx: &mut Context<'_, P>,
        slot: Slot,
        subscription: &Subscription,
        source: &dyn Source,
    ) -> Attempt {
        let (stamp, since) = wire.clock.stamp(cx.now);
        let most = wire.peer_message_size() as usize;
        let mut sent = None;
        source.newest(&mut |value: &Value<'_>| {
            let total = SAMPLE_BYTES.saturating_add(value.block.len());
            let made = micros(stamp).saturating_add(micros(since.as_micros()));
            let made = made.saturating_sub(micros(value.age_at(cx.now).as_micros()));
            let header = SampleHeader { slot, generation: subscription.generation, made };
            // Skip a value that is too long for the peer; the next one may be shorter.
            let result = match value.block.len() > most {
                true => Err(Error::TooLarge { limit: most as u32 }),
                false => wire.send(cx, Priority::Low, total, &mut |writer| {
                    writer.put(&header.encode());
                    writer.put(value.block);
                }),
            };
            sent = Some((result, value.version, total));
        });
        let Some((result, version, total)) = sent else { return Attempt::Later(Instant::FAR_FUTURE) };
        if matches!(result, Err(Error::Full(_))) {
            return Attempt::Later(cx.now + RETRY);
        }
        source.taken();
        if result.is_ok() {
            wire.link.counters.add(LinkCounter::SamplesSent, 1);
            let second = (total as u64).saturating_mul(SECOND);
            let cost = second.checked_div(u64::from(wire.constraints.stream_bytes)).unwrap_or(SECOND);
            self.change(|streaming| streaming.paid = cx.now + Duration::from_micros(cost));
        }
        if subscription.version != 0 {
            let replaced = version.wrapping_sub(subscription.version).saturating_sub(1);
            wire.link.counters.add(LinkCounter::SamplesReplaced, replaced.into());
        }
        if let Some(span) = wire.publishing.subscription(slot) {
            span.version = version;
            // Count from when this one was due, so that late polls do not lower the rate.
            let interval = millis(subscription.interval);
            span.due =
                if subscription.due + interval > cx.now { subscription.due + interval } else { cx.now + interval };
        }
        Attempt::Sent
    }

    /// Ends a subscription of the peer, and notifies it.
    fn end_subscription<P: Port>(&mut self, wire: &mut Wire<P>, slot: Slot, why: SubscriptionRefusal) {
        if let Some(subscription) = wire.publishing.subscription(slot) {
            *subscription =
                Subscription { answer: Some(why), generation: subscription.generation, ..Subscription::NONE };
            self.change(|streaming| streaming.answers_due = true);
        }
        let active = wire.publishing.count_subscriptions();
        self.change(|streaming| streaming.active = active);
    }

    /// A sample of a stream of the peer has arrived.
    pub(super) fn sample_arrived<P: Port>(
        wire: &mut Wire<P>,
        now: Instant,
        header: &SampleHeader,
        block: Span,
        lent: &[u8],
    ) -> Option<Event> {
        let SampleHeader { slot, generation, made } = *header;
        let stream = wire.theirs.function(slot).filter(|function| function.generation == generation);
        let known =
            stream.is_some_and(|stream| block::check(stream.signature.results(), wire.link.view(block, lent)).is_ok());
        let wanted = wire.theirs.wish_mut(slot).is_some_and(|wish| wish.interval != NO_SUBSCRIPTION);
        if !known || !wanted {
            wire.link.counters.add(LinkCounter::SamplesDropped, 1);
            return None;
        }
        wire.link.counters.add(LinkCounter::SamplesReceived, 1);
        let age = micros(now.as_micros()).saturating_sub(made);
        let age = Duration::from_micros(u64::try_from(age).unwrap_or(0));
        let values = Results { slot, generation, block, step: wire.step };
        Streams::of(Sample { slot, age, values }).map(Event::Sample)
    }

    /// The peer has answered a subscription of this unit.
    pub(super) fn subscription_answered<P: Port>(
        wire: &mut Wire<P>,
        slot: Slot,
        generation: Generation,
        granted: Granted,
        refusal: SubscriptionRefusal,
    ) -> Option<Event> {
        wire.theirs.function(slot).filter(|function| function.generation == generation)?;
        let wish = wire.theirs.wish_mut(slot).filter(|wish| wish.interval != NO_SUBSCRIPTION)?;
        let error = match refusal {
            SubscriptionRefusal::None if granted.interval >= millis(NO_SUBSCRIPTION) => return None,
            SubscriptionRefusal::None => return event(slot, Ok(granted)),
            SubscriptionRefusal::Unknown => Error::StaleFunction,
            SubscriptionRefusal::NotAllowed => Error::NotAllowed,
            SubscriptionRefusal::Full => Error::Full(Limit::Subscriptions),
        };
        (wish.interval, wish.advertised) = (NO_SUBSCRIPTION, NO_SUBSCRIPTION);
        event(slot, Err(error))
    }
}

fn event(slot: Slot, result: Result<Granted, Error>) -> Option<Event> {
    Streams::of(result).map(|result| Event::Subscribed(slot, result))
}

const fn millis(interval: u32) -> Duration {
    Duration::from_millis(interval as u64)
}

fn micros(time: u64) -> i64 {
    i64::try_from(time).unwrap_or(i64::MAX)
}
