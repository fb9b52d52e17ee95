//! What a full socket, an empty pool, a time-out and an end leave behind: rules of links and calls that are seen from
//! inside a unit alone.

use std::io::Write;
use std::net::{Ipv4Addr, TcpStream};
use std::sync::atomic::{AtomicUsize, Ordering};
use std::sync::mpsc::{channel, sync_channel};
use std::sync::{Arc, Mutex};

use cara_core::config::{Constraints, LONGEST_KEEP_ALIVE, Mode};
use cara_core::distribution::datagram::session_header;
use cara_core::distribution::hello::Hello;
use cara_core::distribution::identity::Epoch;
use cara_core::distribution::message::SessionBody;
use cara_core::distribution::parameters::ParametersView;
use cara_core::error::Error;
use cara_core::host::connections::{LinkCounter, Report};
use cara_core::host::frame::{self, Frame};
use cara_core::services::session::RequestOptions;
use cara_core::time::{Duration, Instant};
use rustix::net::sockopt;

use super::accounts::{Group, Reading};
use super::*;
use crate::locks::lock;
use crate::sys::datagram::Socket;
use crate::sys::epoll::wait_readable;
use crate::testing::{Pair, fleet, until};
use crate::threads::Driven;
use crate::{CommunicationSystem, Interfaces, Parameters, Served, ServiceError, ServiceOptions, Unit, UnitEvent};

/// Too long for the buffer that a link has of its own.
const LONG: usize = 16_000;
/// Nothing that a test waits for comes by a time-out.
const PATIENT: Duration = Duration::from_secs(60);

/// A text under the name `text`.
fn text(length: usize) -> Box<Parameters<{ 48 * 1024 }>> {
    let mut text = Box::new(Parameters::sized());
    text.add_string("text", length as u32).unwrap();
    text.set_value("text", "x".repeat(length).as_str()).unwrap();
    text
}

fn options(timeout: Duration) -> RequestOptions {
    RequestOptions { timeout: Some(timeout), ..RequestOptions::default() }
}

fn value(readings: &[Reading], group: Group, name: &str) -> u64 {
    readings.iter().find(|reading| (reading.group, reading.name) == (group, name)).unwrap().value
}

/// All buffers of a unit's pool, once none is in use: one that came back later could keep an answer.
fn drain(pool: &MessagePool) -> Vec<Box<[u8]>> {
    until(|| pool.counters().in_use == 0);
    std::iter::from_fn(|| pool.take()).collect()
}

/// What the socket did not take goes out when it has room: no other event or timer moves it on.
#[test]
fn a_full_socket_is_watched_for_room_each_time() {
    let constraints = Constraints { keep_alive: LONGEST_KEEP_ALIVE, request_timeout: PATIENT, ..Constraints::M_UNIT };
    let taken = Arc::new(AtomicUsize::new(0));
    let counted = taken.clone();
    let take = move |_: &Served, _: &mut ParametersView| -> Result<(), ServiceError> {
        counted.fetch_add(1, Ordering::SeqCst);
        Ok(())
    };
    let pair = Pair::new(constraints, |agv| {
        agv.my_function_list().add_function("take", &text(LONG), take).unwrap();
    });
    let (near, far) = (pair.near(), pair.far());
    sockopt::set_socket_send_buffer_size(&near.stream, 8 * 1024).unwrap();
    let mut sent = 0;
    for _ in 0..3 {
        let frozen = far.freeze();
        loop {
            let state = near.lock();
            if state.session.wants_to_write() {
                assert!(state.registration.writable, "bytes wait, and the link is not watched for room");
                break;
            }
            drop(state);
            pair.peer.request("take", &text(LONG)).unwrap();
            sent += 1;
        }
        drop(frozen);
        until(|| taken.load(Ordering::SeqCst) == sent);
        until(|| !near.lock().registration.writable);
    }
}

/// A link that has ended is among the sums of the ended ones while the table still has it.
#[test]
fn what_a_link_has_counted_counts_once_when_it_ends() {
    let pair = Pair::new(Constraints::M_UNIT, |agv| {
        let echo = |_: &Served, _: &mut ParametersView| -> Result<(), ServiceError> { Ok(()) };
        agv.my_function_list().add_function("take", &text(1), echo).unwrap();
    });
    for _ in 0..3 {
        pair.peer.block_request("take", &mut text(1)).unwrap();
    }
    let (engine, near) = (pair.manager.engine(), pair.near());
    let cell = near.peer.get().unwrap();
    let sent = || {
        let of_peer = value(&engine.accounts.of_peer(cell), Group::Link, "RequestsSent");
        (value(&engine.readings(), Group::Links, "RequestsSent"), of_peer)
    };
    assert_eq!(sent(), (3, 3));
    for _ in 0..2 {
        engine.accounts.retire(&near);
        assert_eq!((sent(), value(&engine.readings(), Group::Unit, "LinksOpen")), ((3, 3), 0));
    }
    pair.agv.stop();
    until(|| engine.links.get(near.id).is_none());
    assert_eq!(sent(), (3, 3));
}

/// Of links whose peers have not joined, one that has proven who it is never makes room for another one.
#[test]
fn a_proven_link_gives_way_to_none() {
    // The vehicle is silent for as long as the test takes, also on a machine that is slow: neither of its lives is lost.
    let pair = Pair::new(Constraints { keep_alive: LONGEST_KEEP_ALIVE, ..Constraints::M_UNIT }, |_| {});
    let (engine, near, far) = (pair.manager.engine(), pair.near(), pair.far());
    let dial = || TcpStream::connect((Ipv4Addr::LOCALHOST, engine.sockets.tcp_port())).unwrap();
    // Another life of the vehicle waits until the first one has been asked, and that one does not answer.
    let frozen = far.freeze();
    let earlier = near.lock().session.hello().unwrap().clone();
    let hello = Hello { epoch: Epoch(earlier.epoch.0 + 1), nonce: earlier.nonce + 1, ..earlier };
    let (mut bytes, mut framed) = ([0; 256], [0; 512]);
    let length = hello.encode(Mode::Plain, &mut bytes).unwrap();
    let length = frame::encode(&Frame::Hello(&bytes[..length]), 0, &mut framed);
    let mut proven = dial();
    proven.write_all(&framed[..length]).unwrap();
    let newest = || engine.links.all().into_iter().max_by_key(|link| link.serial).unwrap();
    until(|| newest().serial != near.serial && newest().lock().session.is_proven());
    let newcomer = newest();
    assert!(!engine.make_room(), "all have proven themselves");
    let _silent = dial();
    until(|| newest().serial != newcomer.serial);
    let unproven = newest();
    assert!(engine.make_room() && !engine.make_room());
    until(|| engine.links.get(unproven.id).is_none());
    assert!(engine.links.get(newcomer.id).is_some_and(|link| Arc::ptr_eq(&link, &newcomer)));
    drop(frozen);
}

/// The caller has given up, and no buffer comes free for the answer: the call ends, and its thread with it.
#[test]
fn an_answer_that_cannot_be_kept_is_dropped_with_its_deadline() {
    let fill = |_: &Served, results: &mut ParametersView| -> Result<(), ServiceError> {
        results.set_value("text", "x".repeat(LONG).as_str()).map_err(|_| ServiceError::BadResults)
    };
    let pair = Pair::new(Constraints::M_UNIT, |agv| {
        let definition = "fill() -> (text: string[16000])".parse().unwrap();
        agv.my_function_list().add_service(&definition, ServiceOptions::new(), fill).unwrap();
    });
    let (pool, far) = (&pair.agv.engine().pool, pair.far());
    let buffers = drain(pool);
    // Long enough for the call to be run on a busy machine: one that comes too late has no results.
    let call = || pair.peer.call("fill", &mut text(LONG)).with(options(Duration::from_secs(2))).wait();
    let mut outcome = call();
    // What comes in two parts has no buffer to be put together in.
    while outcome == Err(Error::Busy.into()) {
        outcome = call();
    }
    assert_eq!(outcome, Err(Error::TimedOut.into()));
    until(|| far.lock().session.counters().value(LinkCounter::RepliesDropped) == 1);
    assert_eq!(far.lock().session.calls_held(), 0);
    buffers.into_iter().for_each(|buffer| pool.give(buffer));
    pair.peer.call("fill", &mut text(LONG)).with(options(PATIENT)).wait().unwrap();
}

/// The thread that is to run a call may come when the call's order has ended.
#[test]
fn no_handler_runs_for_an_order_that_has_ended() {
    let (notify, reported) = channel();
    let notify = Mutex::new(notify);
    let go = move |call: &Served, _: &mut ParametersView| -> Result<(), ServiceError> {
        lock(&notify).send(call.clone()).unwrap();
        Ok(())
    };
    let pair = Pair::new(Constraints::M_UNIT, |agv| {
        let options = ServiceOptions::new().lease(Duration::from_secs(3_600), || {});
        agv.my_function_list().add_service(&"go()".parse().unwrap(), options, go).unwrap();
    });
    pair.peer.call("go", &mut Parameters::new()).with(options(PATIENT)).wait().unwrap();
    let reported = reported.recv().unwrap();
    let runs = AtomicUsize::new(0);
    let run = || {
        serving::guarded(&reported, None, || {
            runs.fetch_add(1, Ordering::Relaxed);
            Ok(())
        })
    };
    assert_eq!(run(), Ok(()), "its order lasts");
    pair.peer.release("go").unwrap();
    until(|| !reported.lease.as_ref().unwrap().is_live());
    assert_eq!((run(), runs.into_inner()), (Err(Error::Expired), 1));
}

#[test]
fn an_event_that_finds_no_room_is_counted_for_its_subscriber_and_the_unit() {
    let pair = Pair::new(Constraints::M_UNIT, |_| {});
    let engine = pair.manager.engine();
    let lost = || value(&engine.readings(), Group::Unit, "EventsLost");
    let (slow, slow_events) = sync_channel(1);
    let (quick, quick_events) = sync_channel(8);
    let (lost_by_slow, lost_by_quick) = (engine.events.subscribe(slow), engine.events.subscribe(quick));
    let event = UnitEvent::NetworkChanged { up: Vec::new() };
    (0..4).for_each(|_| engine.notify(event.clone()));
    let counted = [&lost_by_slow, &lost_by_quick].map(|lost| lost.load(Ordering::Relaxed));
    assert_eq!((counted, lost()), ([3, 0], 3));
    assert_eq!((slow_events.try_iter().count(), quick_events.try_iter().count()), (1, 4));
    drop(slow_events);
    engine.notify(event);
    assert_eq!((lost_by_slow.load(Ordering::Relaxed), lost()), (3, 3), "one that is gone loses nothing");
}

/// A call that finds no buffer is tried again and again, to one node and to all: what is left of its time goes with it.
#[test]
fn the_deadline_of_a_call_is_that_of_its_first_try() {
    const TIMEOUT: Duration = Duration::from_secs(30);
    let (notify, reported) = channel();
    let notify = Mutex::new(notify);
    let take = move |call: &Served, _: &mut ParametersView| -> Result<(), ServiceError> {
        lock(&notify).send(call.deadline).unwrap();
        Ok(())
    };
    let pair = Pair::new(Constraints::M_UNIT, |agv| {
        agv.my_function_list().add_function("take", &text(LONG), take).unwrap();
    });
    let (pool, near) = (&pair.manager.engine().pool, pair.near());
    let tries = || near.lock().session.counters().value(LinkCounter::RequestsWithheld);
    let one = || pair.peer.call("take", &mut text(LONG)).with(options(TIMEOUT)).wait().unwrap();
    let all = || {
        let outcomes = pair.manager.call_all("take", &*text(LONG)).with(options(TIMEOUT)).wait();
        assert!(outcomes.len() == 1 && outcomes.iter().all(|(_, outcome)| outcome.is_ok()));
    };
    for call in [&one as &(dyn Fn() + Sync), &all] {
        let (buffers, before) = (drain(pool), tries());
        let latest: Instant = std::thread::scope(|scope| {
            scope.spawn(call);
            until(|| tries() > before);
            // It has begun, so that its time is over by then at the latest.
            let latest = pair.agv.engine().now() + TIMEOUT;
            until(|| tries() > before + 20);
            buffers.into_iter().for_each(|buffer| pool.give(buffer));
            latest
        });
        let deadline = reported.recv().unwrap();
        assert!(deadline <= latest, "{} us later", deadline.since(latest).as_micros());
    }
}

#[test]
fn nothing_is_left_of_a_call_that_has_timed_out() {
    let (open, gate) = channel::<()>();
    let gate = Mutex::new(gate);
    let wait = move |_: &Served, _: &mut ParametersView| -> Result<(), ServiceError> {
        let _ = lock(&gate).recv();
        Ok(())
    };
    let pair = Pair::new(Constraints::M_UNIT, |agv| {
        agv.my_function_list().add_function("wait", &text(1), wait).unwrap();
    });
    let (engine, near) = (pair.manager.engine(), pair.near());
    // It goes before the pair, whose end waits for the handlers.
    let open = open;
    for clock_is_held_up in [true, true, false] {
        // The clock ends the call, or the caller does where the clock waits for the node.
        let held_up = clock_is_held_up.then(|| engine.hub.freeze());
        engine.driver.wake();
        // Long enough for the call to be run on a busy machine: one that comes too late is answered.
        let outcome = pair.peer.call("wait", &mut text(1)).with(options(Duration::from_millis(500))).wait();
        assert_eq!(outcome, Err(Error::TimedOut.into()));
        drop(held_up);
        let state = near.lock();
        assert_eq!((state.waiters.len(), state.session.calls_in_flight()), (0, 0));
    }
    drop(open);
}

/// Units that one busy thread drives are due long before it comes to them. One of them asks for all.
#[test]
fn what_lies_unread_is_read_before_a_question_goes_out() {
    const UNITS: u32 = 20;
    let (fleet, mut port) = (fleet(), 0);
    let mut vehicle = |id| -> Unit {
        let unit = Unit::builder("agv", id, "manager", 1).unwrap().interfaces(Interfaces::Loopback);
        let unit = unit.fleet(fleet).discovery_port(port).insecure().build().unwrap();
        port = unit.engine().sockets.datagrams.discovery_port();
        unit
    };
    // None is started: this thread is their clock.
    let units: Vec<Unit> = (1..=UNITS).map(&mut vehicle).collect();
    let is_due = |unit: &Unit| unit.engine().hub.lock().hub.node.searches_at() <= unit.engine().now();
    until(|| units.iter().all(is_due));
    for (index, unit) in units.iter().enumerate() {
        if index > 0 {
            wait_readable(unit.engine().sockets.datagrams.fd(Socket::Shared), PATIENT).unwrap();
        }
        unit.engine().keep_time();
    }
    let asked = |unit: &Unit| value(&unit.engine().readings(), Group::Node, "WhoHasSent");
    assert_eq!(units.iter().map(asked).sum::<u64>(), 1);
}

/// A search that many answer keeps the hub busy, and neither a keep-alive nor an emergency waits for it.
#[test]
fn a_session_datagram_does_not_take_the_hubs_lock() {
    let pair = Pair::new(Constraints::M_UNIT, |_| {});
    let (engine, near, far) = (pair.manager.engine(), pair.near(), pair.far());
    let (to, nonce) = (near.id.0, far.lock().session.hello().unwrap().nonce);
    let header = session_header(Mode::Plain, cara_core::config::VERSIONS.last, engine.fleet, to, nonce);
    let mut bytes = [&header[..], &SessionBody::keep_alive(0, Report::default())].concat();
    let from = near.lock().session.address();
    let received = || near.lock().session.counters().value(LinkCounter::DatagramsReceived);
    std::thread::scope(|scope| {
        // The clock reads nothing meanwhile.
        let frozen = engine.hub.freeze();
        let before = received();
        let reading = scope.spawn(|| engine.datagram(from, &mut bytes));
        until(|| reading.is_finished());
        assert!(received() > before);
        drop(frozen);
    });
}

#[test]
fn a_unit_whose_clock_waits_does_not_keep_time() {
    let pair = Pair::new(Constraints::M_UNIT, |_| {});
    assert!(pair.manager.keeps_time(PATIENT));
    std::thread::scope(|scope| {
        let frozen = pair.manager.engine().hub.freeze();
        // A round that began before ends.
        until(|| !pair.manager.keeps_time(Duration::from_millis(20)));
        let asking = scope.spawn(|| pair.manager.keeps_time(PATIENT));
        drop(frozen);
        assert!(asking.join().unwrap());
    });
    pair.manager.stop();
    assert!(!pair.manager.keeps_time(Duration::from_millis(1)));
}

/// One that spins has to notice what wakes one that sleeps: the reply, the time-out and the end of the link.
#[test]
fn a_caller_that_spins_has_its_reply_its_time_out_and_the_end_of_the_link() {
    let (fleet, spin) = (fleet(), Duration::from_millis(1));
    let manager = CommunicationSystem::builder("manager", 1).unwrap().interfaces(Interfaces::Loopback);
    let manager = manager.fleet(fleet).insecure().spin(spin).build().unwrap();
    let agv = Unit::builder("agv", 1, "manager", 1).unwrap().interfaces(Interfaces::Loopback);
    let agv = agv.fleet(fleet).insecure().spin(spin).build().unwrap();
    let (begun, begins) = channel();
    let (release, released) = channel::<()>();
    let released = Mutex::new(released);
    let hang = move |_: &Served, _: &mut ParametersView| -> Result<(), ServiceError> {
        begun.send(()).map_err(|_| ServiceError::NotReady)?;
        lock(&released).recv().map_err(|_| ServiceError::NotReady)
    };
    let same = |_: &Served, _: &mut ParametersView| -> Result<(), ServiceError> { Ok(()) };
    agv.my_function_list().add_function("hang", &Parameters::new(), hang).unwrap();
    agv.my_function_list().add_function("same", &*text(10), same).unwrap();
    agv.publish_my_function_list().unwrap();
    manager.start().unwrap();
    agv.start().unwrap();
    until(|| manager.number_of_s_units() == 1);
    let peer = manager.s_unit("agv").unwrap();
    until(|| peer.their_function_list().len() == 2);
    for _ in 0..100 {
        peer.block_request("same", &mut *text(10)).unwrap();
    }
    let link = manager.engine().links.all().remove(0);
    let call = |timeout| peer.call("hang", &mut Parameters::new()).timeout(timeout).wait().map(drop);
    assert_eq!(call(Duration::from_millis(20)).unwrap_err().error, Error::TimedOut);
    assert!(link.stream.spun_in_vain() > 0, "it has not spun");
    release.send(()).unwrap();
    begins.recv().unwrap();
    std::thread::scope(|scope| {
        let waiting = scope.spawn(|| call(PATIENT));
        begins.recv().unwrap();
        manager.stop();
        assert_eq!(waiting.join().unwrap().unwrap_err().error, Error::Interrupted);
    });
    release.send(()).unwrap();
}
