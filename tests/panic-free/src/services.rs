//! Common services: a session from hello to close, leases, visibility of functions.

use core::mem::MaybeUninit;
use core::net::SocketAddrV4;

use cara_core::config::{Mode, VERSIONS};
use cara_core::distribution::datagram;
use cara_core::distribution::function::Signature;
use cara_core::distribution::function_list::FunctionList;
use cara_core::distribution::hello::{self, Hello};
use cara_core::distribution::identity::Identity;
use cara_core::distribution::items::Items;
use cara_core::distribution::message::Control;
use cara_core::distribution::parameters::{Parameters, ParametersView};
use cara_core::error::Refusal;
use cara_core::services::access::{self, Access, Bucket, Functions, Principal, Rate, Rule, Verbs, Who};
use cara_core::services::event::UnitEvent;
use cara_core::services::heart::Heart;
use cara_core::services::lease::{LastOrder, Lease, Service, trace_id};
use cara_core::services::publications::Publications;
use cara_core::services::requests::Requests;
use cara_core::services::session::{self, Event, ReplyBlock, Session, SessionConfig, SessionStorage};
use cara_core::services::stream::{Newest, Source};
use cara_core::services::{Context, OwnFunctions, Port, Ticket, slots_for};
use cara_core::storage::{Lent, Pool};

use crate::linkage::{keep, unknown, unknown_slice, unknown_text};
use crate::secure::AnyCipher;

/// A handler that may have a lease.
struct Handler;

impl Service for Handler {
    fn lease(&self) -> Option<&Lease> {
        *unknown()
    }

    fn stream(&self) -> Option<&dyn Source> {
        *unknown()
    }
}

/// A port of which nothing is known.
pub enum Any {}

impl Port for Any {
    type Storage = Lent;
    type Cipher = AnyCipher;
    type Endpoint = SocketAddrV4;
}

type AnySession = Session<Any>;
type AnyContext = Context<'static, Any>;

fn session() -> &'static mut AnySession {
    unknown()
}

fn context() -> &'static mut AnyContext {
    unknown()
}

fn parameters() -> &'static mut ParametersView {
    unknown::<Parameters<64>>()
}

/// A value moved out of nowhere.
fn taken<T: 'static>() -> Option<T> {
    unknown::<Option<T>>().take()
}

// What a session is lent, it calls through a table that is not known here.
entry!(own_functions, {
    let functions: &dyn OwnFunctions = unknown::<FunctionList<Lent, Handler>>();
    keep((functions.function(*unknown()).is_some(), functions.generation(*unknown())));
    keep((functions.places(), functions.stopped()));
    if let Ok(function) = functions.lookup(*unknown(), *unknown()) {
        let service = function.handler;
        keep((service.begin_lease(*unknown(), *unknown(), unknown()), service.renew_lease(*unknown(), *unknown())));
        service.inhibit(*unknown(), *unknown());
        service.reset(*unknown(), *unknown());
        keep((service.finish_lease(*unknown(), *unknown()), service.expire_lease(*unknown(), *unknown(), *unknown())));
        service.cut_lease(*unknown());
        if let Some(stream) = service.stream() {
            keep(stream.version());
            stream.newest(&mut |value| keep(value));
        }
    }
});

// What moves leaves its latch to what takes its place: only a list of handlers with leases gets there.
entry!(own_functions_changed, {
    let list = unknown::<FunctionList<Lent, Handler>>();
    if let Some(handler) = taken() {
        keep(list.add_signature(*unknown::<Signature<'static>>(), *unknown(), handler).is_ok());
    }
    if let Some(handler) = taken() {
        keep(list.replace_signature(*unknown::<Signature<'static>>(), *unknown(), handler).is_ok());
    }
    keep(list.remove(unknown_text()).is_ok());
});

entry!(session_made, {
    if let (Some(config), Some(storage)) = (taken::<SessionConfig<SocketAddrV4>>(), taken::<SessionStorage<Lent>>()) {
        unknown::<MaybeUninit<AnySession>>().write(Session::new(*unknown(), config, AnyCipher, storage));
    }
});

entry!(session_dismantled, {
    if let Some(session) = taken::<AnySession>() {
        let buffers: &mut Pool<Lent> = unknown();
        let storage = session.into_storage(buffers);
        keep((storage.small, storage.pending, storage.running));
        keep((storage.publications, storage.their_functions, storage.their_signatures));
    }
});

entry!(session_grown, {
    let session = session();
    keep((session.call_slots(), session.running_slots(), session.publication_slots()));
    keep(session.lend_calls(unknown_slice()));
    session.let_list_grow(*unknown(), *unknown());
    keep(session.lend_running(unknown_slice()));
    keep(session.lend_publications(unknown_slice()));
});

entry!(session_asked, {
    let session = session();
    keep((session.dialed(), session.is_live(), session.is_proven(), session.is_ended(), session.hello()));
    keep(session.version());
    keep(self::session().make());
    keep(session.cipher());
    keep((session.identity(), session.peer(), session.epoch(), session.address(), session.nonce(), session.deadline()));
    keep((
        session.their_function_list(),
        session.counters(),
        session.calls_in_flight(),
        session.calls_held(),
        session.moves(),
        session.moves_by(*unknown()),
    ));
    keep((
        session.wants_to_write(),
        session.has_next_call(),
        session.awaits_claim(),
        session.holds_received(),
        session.has_call_room(),
        session.is_acknowledged(*unknown()),
    ));
    keep((session.constraints(), session.silent_for(*unknown()), session.bytes_queued()));
    keep((session.stream_silent_for(*unknown()), session.hears_datagrams(), session.is_heard(), session.is_listed()));
    session.hold_back();
    self::session().announce_claim(context());
});

entry!(session_details, {
    keep(session().answer_failed(context(), *unknown(), unknown()));
    keep(session().progress(context(), *unknown(), parameters()));
    keep((session().failure(unknown_slice()), session().is_cancelled(*unknown()), session().is_answered(*unknown())));
    if let Event::Progress(_, values) = unknown::<Event>() {
        keep(session().progress_values(values, unknown_slice()).map(|block| block.bytes().len()));
    }
});

entry!(streams, {
    let session = session();
    keep(session.subscribe(context(), unknown_text(), *unknown()));
    session.unsubscribe(context(), unknown_text());
    keep((session.stream_changed(*unknown()), session.subscriptions()));
    let newest = unknown::<Newest<[u8; 64]>>();
    let values: &Parameters<64> = unknown();
    keep(newest.publish(*unknown(), *unknown(), *unknown(), values));
    keep(newest.pass_on(*unknown(), *unknown(), unknown_slice()));
    keep((newest.version(), newest.value()));
    unknown::<MaybeUninit<Newest<[u8; 64]>>>().write(Newest::new([0; 64]));
});

entry!(session_connected, {
    session().connected(context());
    keep(session().direct(context(), *unknown()));
    keep((session().ping(context()), session().round_trip()));
    keep((session().hand_over(context(), unknown()), session().hand_over_answer()));
    session().writable(context());
});

entry!(session_ended, {
    session().renew_every(*unknown());
    session().close(context(), *unknown());
    session().disconnected(*unknown());
});

entry!(session_receives, {
    keep(session().receive(context(), unknown_slice(), Some(parameters())));
    keep(session().receive(context(), unknown_slice(), None));
});

entry!(session_datagram, {
    keep(session().datagram(context(), *unknown(), *unknown(), unknown_slice()));
});

entry!(session_polled, {
    keep(session().poll(context()));
    session().flush_gathered(context());
});

entry!(session_set, {
    session().set_constraints(context(), *unknown());
    keep(session::buffer_bytes(*unknown(), *unknown()));
});

entry!(session_requests, {
    keep(session().request(context(), unknown_text().into(), parameters(), unknown(), *unknown()));
    session().cancel(context(), *unknown());
    keep((session().may_hold(*unknown()), Ticket::of(*unknown(), *unknown()).parts()));
    session().cancel_but_wait(context(), *unknown());
    keep((
        session().holds(*unknown()),
        session().renews(),
        session().last_order(),
        session().lease_left(*unknown(), *unknown()),
    ));
});

entry!(session_serves, {
    keep(session().next_call(context(), parameters()));
    keep((session().has_next_emergency(), session().next_emergency(context(), parameters())));
    keep(session().answer(context(), *unknown(), Ok(parameters())));
    keep(session().answer(context(), *unknown(), Err(*unknown())));
    session().drop_answer(*unknown());
});

entry!(session_revoked, {
    session().revoke(context());
});

entry!(session_publishes, {
    keep((session().publish(context()), session().is_behind(context())));
    keep(session().withdraw(context(), *unknown()));
});

entry!(call_slots, {
    keep(slots_for(*unknown()));
});

entry!(session_leases, {
    keep(session().end_order(context(), unknown(), *unknown()));
    keep(session().release(context(), *unknown()));
    session().release_beats(context(), *unknown());
});

entry!(replies, {
    if let Event::Reply(_, Ok(results)) = unknown::<Event>()
        && let Ok(block) = session().results(results, unknown_slice())
    {
        keep((block.read_into(parameters()), block.signature(), block.bytes(), results.function()));
    }
    keep(session().kept_results(*unknown(), *unknown(), unknown_slice()).is_ok());
    keep(unknown::<ReplyBlock<'static>>().read_into(parameters()));
});

entry!(events, {
    let functions: &dyn OwnFunctions = unknown::<FunctionList<Lent, Handler>>();
    keep(UnitEvent::<usize, (), SocketAddrV4>::of(*unknown(), session(), functions, str::len));
});

entry!(leases, {
    let lease = Lease::new();
    keep((lease.begin(*unknown(), *unknown()), lease.claim(*unknown(), *unknown(), unknown())));
    lease.inhibit(*unknown(), *unknown());
    lease.reset(*unknown(), *unknown());
    let latch: &cara_core::distribution::latch::LatchWord = unknown();
    keep((cara_core::distribution::latch::LatchWord::new(), latch.latch(), latch.is_inhibited()));
    latch.inhibit(*unknown(), *unknown());
    latch.reset(*unknown(), *unknown());
    latch.reset_by_parts(*unknown(), *unknown());
    keep((lease.latch(), lease.is_inhibited(), lease.awaits_hook()));
    keep((lease.renew(*unknown(), *unknown()), lease.lasts_beyond(*unknown())));
    keep((lease.is_live(*unknown()), lease.is_live_for(*unknown(), *unknown()), Lease::seen_end(*unknown())));
    keep((lease.left(*unknown()), lease.end(*unknown(), *unknown(), *unknown())));
    keep((lease.state(), lease.state().outcome_of(*unknown(), *unknown())));
    keep((unknown::<LastOrder>().trace(), trace_id(*unknown(), *unknown())));
    lease.set_ramp(*unknown());
    keep((lease.stage(*unknown()), lease.stage_for(*unknown(), *unknown())));
    lease.cut(*unknown());
    keep((lease.clear(*unknown()), lease.finish(*unknown(), *unknown())));
    keep(unknown::<Lease>().is_live(*unknown()));
    let heart = unknown::<Heart>();
    heart.set_period(*unknown());
    heart.beat(*unknown());
    keep((heart.beats(), Heart::new(*unknown()), session::RequestOptions::renewing(*unknown())));
    heart.stop();
});

entry!(publications, {
    keep(Publications::<Lent>::new(unknown_slice(), unknown_slice()));
    let publications: &mut Publications<Lent> = unknown();
    let identity: &Identity = unknown();
    keep(publications.publish_to_all(*unknown()));
    keep(publications.publish_to(identity, *unknown()));
    publications.withdraw(*unknown());
    keep(publications.is_visible(identity, *unknown()));
});

entry!(access, {
    let rate = Rate::per_second(*unknown());
    keep((rate.parts(), Rate::new(*unknown(), *unknown())));
    let rule = Rule::new(Who::node(unknown_text(), *unknown()), Functions::Named(*unknown()), *unknown()).at(rate);
    let principal: Principal<'static> = *unknown();
    let rules: &[Rule] = unknown_slice();
    keep((access::decide(rules, principal, unknown_text(), *unknown()), rule));
    keep(rules.decide(principal, unknown_text(), *unknown()).is_allowed());
    keep(unknown::<[Rule; 4]>().decide(principal, unknown_text(), *unknown()));
    keep((unknown::<Bucket>().take(*unknown(), rate), unknown::<Bucket>().is_full(*unknown())));
    keep((Verbs::ALL.and(*unknown()).contains(*unknown()), unknown::<[Rule; 4]>().may_log(*unknown())));
});

entry!(session_under_another_table, {
    keep(session().access_changed(context()));
});

entry!(requests, {
    let requests: Requests<Lent> = Requests::new(unknown_slice());
    keep((requests.in_flight(), requests));
});

entry!(hellos, {
    keep((Hello::decode(unknown_slice(), *unknown()), hello::suites(unknown_slice())));
    hello::offer(*unknown(), unknown_slice());
    keep((VERSIONS.common(*unknown()), unknown::<Mode>().suites()));
    keep(unknown::<Refusal>().to_wire());
    let mut items = Items::new(unknown_slice());
    while let Some(Ok(item)) = items.next() {
        keep(Control::take(&item));
    }
    keep(unknown::<Hello>().encode(*unknown(), unknown_slice()));
    keep(datagram::session_header(*unknown(), *unknown(), *unknown(), *unknown(), *unknown()));
});
