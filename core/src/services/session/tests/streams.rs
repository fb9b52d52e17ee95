//! Streams between two ends: the newest value wins, ages, pace, limits, and that samples delay no call.

use core::cell::{Cell, RefCell};
use std::rc::Rc;
use std::vec;
use std::vec::Vec;

use super::super::{Event, GrantedStream};
use super::pair::Pair;
use super::setup::{Handler, Run, Setup};
use super::side::{Side, Table, context};
use super::{none, text, x};
use crate::config::{Constraints, Priority};
use crate::distribution::function::{Attributes, Definition};
use crate::distribution::function_list::Slot;
use crate::error::{Error, Limit};
use crate::host::connections::LinkCounter;
use crate::services::Context;
use crate::services::access::{Functions, Rate, Rule, Verbs, Who};
use crate::services::stream::{Newest, Source, Value};
use crate::time::Duration;

/// The values of a stream of a test, and how many of them were taken.
#[derive(Clone)]
pub(super) struct Values(Rc<RefCell<Newest<Vec<u8>>>>, Rc<Cell<u64>>);

impl Source for Values {
    fn version(&self) -> u32 {
        self.0.borrow().version()
    }

    fn newest(&self, look: &mut dyn FnMut(&Value<'_>)) {
        if let Some(value) = self.0.borrow().value() {
            look(&value);
        }
    }

    fn taken(&self) {
        self.1.set(self.1.get() + 1);
    }
}

const MS: Duration = Duration::from_millis(1);
const fn ms(count: u64) -> Duration {
    Duration::from_millis(count)
}

const POSE: &str = "pose(x: int)";

impl Side {
    fn add_stream(&mut self, definition: &str, least: u16) -> Slot {
        let definition = Definition::stream(definition).unwrap();
        let attributes = Attributes { priority: Priority::Low, stream: Some(least), ..Attributes::default() };
        let values = Values(Rc::new(RefCell::new(Newest::new(vec![0; 20_100]))), Rc::default());
        let mut handler = Handler::new(Run::Now(|_| Ok(())), None);
        handler.values = Some(values);
        self.functions.add_function(&definition, attributes, handler).unwrap()
    }

    fn put(&mut self, slot: Slot, value: i64) {
        self.put_all(slot, &x(value));
    }

    fn put_all(&mut self, slot: Slot, values: &crate::distribution::parameters::ParametersView) {
        let function = self.functions.function(slot).unwrap();
        let newest = function.handler.values.as_ref().unwrap();
        newest.0.borrow_mut().publish(self.now, Duration::ZERO, function.signature, values).unwrap();
        self.session.stream_changed(self.now);
    }

    fn subscribe(&mut self, stream: &str, interval: Duration) -> Result<Slot, Error> {
        self.session.subscribe(context!(self), stream, interval)
    }

    fn values(&self) -> Vec<i64> {
        self.samples.iter().map(|(x, _)| *x).collect()
    }

    fn answers(&self) -> Vec<Result<GrantedStream, Error>> {
        let answer = |event: &Event| match event {
            Event::Subscribed(_, answer) => Some(*answer),
            _ => None,
        };
        self.happened.iter().filter_map(answer).collect()
    }
}

fn pair_with(setup: &Setup, least: u16) -> (Pair, Slot) {
    let mut pair = Pair::with(setup);
    let slot = pair.agv.add_stream(POSE, least);
    pair.publish();
    (pair, slot)
}

/// A pair whose AGV has a stream `pose(x: int)`.
fn pair() -> (Pair, Slot) {
    pair_with(&Setup::default(), 0)
}

#[test]
fn values_go_to_a_subscriber_and_to_no_other() {
    let (mut pair, pose) = pair();
    pair.agv.put(pose, 1);
    pair.run(ms(10));
    assert_eq!(pair.manager.values(), []);
    pair.manager.subscribe("pose", Duration::ZERO).unwrap();
    pair.run(ms(10));
    for value in 2..5 {
        pair.agv.put(pose, value);
        pair.run(MS);
    }
    assert_eq!(pair.manager.values(), [1, 2, 3, 4]);
    pair.manager.session.unsubscribe(context!(pair.manager), "pose");
    pair.run(MS);
    pair.agv.put(pose, 5);
    pair.run(MS);
    assert_eq!((pair.manager.values(), pair.agv.session.subscriptions()), (vec![1, 2, 3, 4], 0));
    let taken = pair.agv.functions.function(pose).unwrap().handler.values.as_ref().unwrap().1.get();
    assert_eq!((pair.agv.counter(LinkCounter::SamplesSent), taken), (4, 4));
    assert_eq!(pair.manager.counter(LinkCounter::SamplesReceived), 4);
}

#[test]
fn a_late_subscriber_gets_the_last_value_with_its_age() {
    let (mut pair, pose) = pair();
    pair.agv.put(pose, 7);
    pair.run(Duration::from_secs(4_000));
    pair.manager.subscribe("pose", Duration::ZERO).unwrap();
    pair.run(MS);
    let [(7, age)] = pair.manager.samples[..] else { panic!("{:?}", pair.manager.samples) };
    assert!(age >= Duration::from_secs(4_000) && age <= Duration::from_secs(4_001), "{age:?}");
}

/// A delayed value is never taken for a new one.
#[test]
fn an_age_counts_the_time_on_the_way() {
    let (mut pair, pose) = pair();
    pair.manager.subscribe("pose", Duration::ZERO).unwrap();
    pair.run(ms(2_000));
    pair.agv.put(pose, 1);
    pair.agv.net.frozen = true;
    pair.run(ms(700));
    pair.agv.net.frozen = false;
    pair.run(MS);
    let (_, age) = pair.manager.samples[0];
    assert!(age >= ms(700) && age < ms(710), "{age:?}");
}

/// A sample that waited for capacity has the newest value when it is sent; its age counts from when the value was made.
#[test]
fn the_newest_value_wins() {
    let (mut pair, pose) = pair();
    pair.manager.subscribe("pose", Duration::ZERO).unwrap();
    pair.settle();
    pair.agv.net.capacity = 0;
    pair.agv.net.frozen = true;
    for value in 1..=20 {
        pair.agv.put(pose, value);
        pair.run(ms(10));
    }
    (pair.agv.net.capacity, pair.agv.net.frozen) = (1 << 20, false);
    pair.run(ms(10));
    // The value that was in the queue, and the newest.
    assert_eq!(pair.manager.values(), [1, 20]);
    assert!(pair.manager.samples[0].1 >= ms(200));
    assert_eq!(pair.agv.counter(LinkCounter::SamplesReplaced), 18);
}

#[test]
fn a_stream_keeps_the_pace_that_was_asked_for() {
    let (mut pair, pose) = pair_with(&Setup::default(), 20);
    pair.manager.subscribe("pose", ms(50)).unwrap();
    pair.settle();
    let count = |pair: &mut Pair, values: i64| {
        let before = pair.manager.samples.len();
        for value in 0..values {
            pair.agv.put(pose, value);
            pair.run(ms(5));
        }
        pair.manager.samples.len() - before
    };
    assert!((20..=21).contains(&count(&mut pair, 200)));
    // No faster than the publisher's own interval. The changed subscription has had the newest value already.
    pair.manager.subscribe("pose", MS).unwrap();
    pair.run(MS);
    assert!((49..=51).contains(&count(&mut pair, 200)));
    let granted = pair.manager.answers().into_iter().map(|answer| answer.unwrap().interval);
    assert_eq!(granted.collect::<Vec<_>>(), [ms(50), ms(20)]);
}

#[test]
fn subscriptions_are_limited_and_refused_with_the_reason() {
    let agv = Constraints { subscriptions_per_peer: 1, ..Setup::default().agv };
    let (mut pair, _) = pair_with(&Setup { agv, ..Setup::default() }, 0);
    let battery = pair.agv.add_stream("battery(x: int)", 0);
    pair.agv.offer("pos_info() -> (x: int)", |_| Ok(()));
    pair.publish();
    pair.agv.put(battery, 1);
    pair.manager.subscribe("pose", MS).unwrap();
    pair.manager.subscribe("battery", MS).unwrap();
    pair.run(MS);
    assert_eq!(pair.manager.answers()[1], Err(Error::Full(Limit::Subscriptions)));
    assert_eq!((pair.manager.values(), pair.agv.session.subscriptions()), (vec![], 1));
    assert_eq!(pair.agv.counter(LinkCounter::SubscriptionsRefused), 1);
    assert_eq!(pair.manager.subscribe("pos_info", MS), Err(Error::UnknownFunction), "it is no stream");
    assert_eq!(pair.manager.call("pose", &none()), Err(Error::UnknownFunction), "it is no function");
}

/// The bytes per second for a peer are limited: intermediate values are skipped, the newest arrives.
#[test]
fn bytes_a_second_are_limited() {
    let agv = Constraints { stream_bytes: 2_400, ..Setup::default().agv };
    let (mut pair, pose) = pair_with(&Setup { agv, ..Setup::default() }, 0);
    pair.manager.subscribe("pose", Duration::ZERO).unwrap();
    pair.settle();
    for value in 0..1_000 {
        pair.agv.put(pose, value);
        pair.run(MS);
    }
    pair.run(ms(10));
    // A sample of one int has 24 bytes.
    assert!((99..=102).contains(&pair.manager.samples.len()), "{}", pair.manager.samples.len());
    assert_eq!(pair.manager.values().last(), Some(&999));
}

#[test]
fn the_access_table_is_kept_while_a_subscription_goes_on() {
    let (mut pair, pose) = pair();
    let rule = |verbs, rate| {
        let functions = Functions::Named(vec!["pose"]);
        Some(Table(vec![Rule { who: Who::ANYBODY, functions, verbs, rate }]))
    };
    pair.agv.table = rule(Verbs::LIST, None);
    pair.manager.subscribe("pose", Duration::ZERO).unwrap();
    pair.agv.put(pose, 1);
    pair.run(MS);
    assert_eq!((pair.manager.answers(), pair.manager.values()), (vec![Err(Error::NotAllowed)], vec![]));
    pair.agv.table = rule(Verbs::CALL, Some(Rate::per_second(2)));
    pair.manager.subscribe("pose", Duration::ZERO).unwrap();
    for value in 0..1_000 {
        pair.agv.put(pose, value);
        pair.run(MS);
    }
    // A burst of two, and two a second.
    assert!((3..=4).contains(&pair.manager.samples.len()), "{:?}", pair.manager.values());
    pair.agv.table = rule(Verbs::LIST, None);
    pair.run(ms(1_000));
    let count = pair.manager.samples.len();
    pair.agv.put(pose, 5);
    pair.run(ms(1_000));
    assert_eq!((pair.manager.samples.len(), pair.agv.session.subscriptions()), (count, 0));
    assert_eq!(pair.manager.answers().last(), Some(&Err(Error::NotAllowed)));
}

/// An answer that is made while a sample waits is sent first, and at most one sample waits.
#[test]
fn a_call_goes_before_a_sample() {
    let (mut pair, _) = pair();
    let image = pair.agv.add_stream("image(text: string[20000], x: int)", 0);
    let pose = Slot(0);
    pair.agv.offer("pos_info() -> (x: int)", |view| view.set_value("x", 3));
    pair.publish();
    for stream in ["pose", "image"] {
        pair.manager.subscribe(stream, Duration::ZERO).unwrap();
    }
    pair.settle();
    let mut values = text(20_000);
    values.add_int("x", 1).unwrap();
    pair.agv.net.capacity = 0;
    pair.agv.net.frozen = true;
    pair.agv.put_all(image, &values);
    pair.run(MS);
    let queued = pair.agv.session.wire.link.queued();
    pair.agv.put(pose, 1);
    pair.run(MS);
    assert_eq!(pair.agv.session.wire.link.queued(), queued, "a second one waits");
    let call = pair.manager.call("pos_info", &none()).unwrap();
    pair.run(MS);
    (pair.agv.net.capacity, pair.agv.net.frozen) = (1_000, false);
    for _ in 0..3 {
        pair.step();
    }
    assert!(pair.manager.outcome(call).is_some_and(|outcome| outcome.is_ok()), "the call waits for the sample");
    assert_eq!(pair.manager.values(), []);
    // The time that the long value took from the limit of bytes per second.
    pair.run(ms(500));
    assert_eq!(pair.manager.values(), [0, 1]);
}

#[test]
fn a_stream_that_is_replaced_ends_its_subscription() {
    let (mut pair, pose) = pair();
    pair.manager.subscribe("pose", Duration::ZERO).unwrap();
    pair.settle();
    pair.agv.functions.remove("pose").unwrap();
    assert_eq!(pair.agv.add_stream("pose(x: int, y: int)", 0), pose);
    pair.agv.publish();
    pair.settle();
    let two = super::parameters(|values| {
        for name in ["x", "y"] {
            values.add_int(name, 1).unwrap();
        }
    });
    pair.agv.put_all(pose, &two);
    pair.run(MS);
    assert_eq!((pair.manager.values(), pair.agv.session.subscriptions()), (vec![], 0));
    // As a port does at each change of the list.
    pair.manager.subscribe("pose", Duration::ZERO).unwrap();
    pair.run(MS);
    assert_eq!(pair.manager.values(), [0]);
}
