//! Records what one session takes, so that it can be [run again](super::rerun): a text file for each link of a manager in plain
//! mode. All inputs pass here in the order in which the session takes them, since the link's lock is held.
//!
//! Each line has the time in microseconds, a hash of all that came of the input (bytes, datagrams, what the call returned, what
//! the session shows: deadline, peer, its list, counters), what the network did with the bytes, and the input. An input that has
//! no text ends the recording with a line `cut` that says why.

use std::fmt::{Debug, Write as _};
use std::fs::{File, OpenOptions};
use std::io::{BufWriter, Write as _};
use std::ops::Deref;
use std::os::unix::fs::OpenOptionsExt;
use std::path::Path;

use cara_core::config::{Constraints, Mode, Priority};
use cara_core::distribution::connection_handler::Directive;
use cara_core::distribution::failure::Failure;
use cara_core::distribution::function_list::{Function, Slot};
use cara_core::distribution::hello::Hello;
use cara_core::distribution::parameters::ParametersView;
use cara_core::error::{CloseReason, Error};
use cara_core::host::mailman::{LinkId, Mailman};
use cara_core::services::Context;
use cara_core::services::RunningCall;
use cara_core::services::call::Callee;
use cara_core::services::heart::Renew;
use cara_core::services::requests::{CallId, Made, Pending};
use cara_core::services::session::{Delivery, Event, Incoming, Receipt, RequestOptions, Session};
use cara_core::time::{Duration, Instant};
use core::net::SocketAddr;
use crc::{CRC_64_XZ, Crc, Digest};

use super::link::Linux;
use crate::config::Capacities;

/// The first line of a recording.
pub(super) const HEAD: &str = "CARA core session 1";
/// Reasons for an end that a recording can name, by their index.
pub(super) const REASONS: [CloseReason; 14] = [
    CloseReason::Stopped,
    CloseReason::Reset,
    CloseReason::Silent,
    CloseReason::PeerRestarted,
    CloseReason::Protocol,
    CloseReason::Oversize,
    CloseReason::HelloTimeout,
    CloseReason::DialFailed,
    CloseReason::Exhausted,
    CloseReason::Unproven,
    CloseReason::BadProof,
    CloseReason::StoppedHere,
    CloseReason::StreamDead { long: false },
    CloseReason::StreamDead { long: true },
];
/// Longest recording of one session.
const MOST_BYTES: usize = 64 * 1024 * 1024;
/// Why calls of the peer end a recording.
pub(super) const OFFERS: &str = "the unit offers functions of its own";
/// Why new limits end a recording.
pub(super) const LIMITS: &str = "the unit's constraints have changed";
/// Longest hello in plain mode.
const HELLO_BYTES: usize = 320;

static CRC: Crc<u64> = Crc::<u64>::new(&CRC_64_XZ);

/// A session and its recording, if there is one. Only what changes nothing passes by the recording.
pub(crate) struct TapedSession {
    session: Session<Linux>,
    tape: Option<Box<Tape>>,
}

/// The recording of a session.
pub(crate) struct Tape {
    file: BufWriter<File>,
    written: usize,
    /// What a line without a time of its own has.
    now: Instant,
    made: Vec<Made>,
    is_cut: bool,
}

/// The hash of what comes of one input.
pub(super) struct Outputs(Digest<'static, u64>);

impl Outputs {
    pub(super) fn new() -> Self {
        Self(CRC.digest())
    }

    pub(super) fn write(&mut self, slices: &[&[u8]]) {
        slices.iter().for_each(|slice| self.0.update(slice));
    }

    pub(super) fn datagram(&mut self, to: Option<SocketAddr>, datagram: &[u8]) {
        self.0.update(format!("{to:?}").as_bytes());
        self.0.update(datagram);
    }

    pub(super) fn sum(self) -> u64 {
        self.0.finalize()
    }

    pub(super) fn end(mut self, returned: &dyn Debug, session: &Session<Linux>) -> u64 {
        let (deadline, hears, heard) = (session.deadline().as_micros(), session.hears_datagrams(), session.is_heard());
        let (hello, counters) = (session.hello(), session.counters());
        let seen = format!("{returned:?} {deadline} {hears:?} {heard} {hello:?} {counters:?}");
        self.0.update(seen.as_bytes());
        for function in session.their_function_list().iter() {
            let Function { slot, generation, signature, attributes, .. } = function;
            self.0.update(format!("{slot:?} {generation:?} {signature:?} {attributes:?}").as_bytes());
        }
        self.0.finalize()
    }
}

/// Hands on what the session sends, and notes what the network answers.
struct Recorded<'m> {
    mailman: &'m mut dyn Mailman<SocketAddr>,
    outputs: Outputs,
    answers: String,
    /// The network answered what a recording cannot name.
    is_unknown: bool,
}

impl Recorded<'_> {
    fn note(&mut self, answer: impl std::fmt::Display) {
        let comma = if self.answers.is_empty() { "" } else { "," };
        // Writing to a string cannot fail.
        let _ = write!(self.answers, "{comma}{answer}");
    }
}

impl Mailman<SocketAddr> for Recorded<'_> {
    fn write(&mut self, link: LinkId, slices: &[&[u8]]) -> Result<usize, CloseReason> {
        self.outputs.write(slices);
        let taken = self.mailman.write(link, slices);
        match taken {
            Ok(bytes) => self.note(bytes),
            Err(reason) => match index_of(reason) {
                Some(index) => self.note(format_args!("e{index}")),
                None => self.is_unknown = true,
            },
        }
        taken
    }

    fn seals_ahead(&self) -> usize {
        self.mailman.seals_ahead()
    }

    fn send_to(&mut self, to: SocketAddr, datagram: &[u8]) -> bool {
        self.outputs.datagram(Some(to), datagram);
        let sent = self.mailman.send_to(to, datagram);
        self.note(u8::from(sent));
        sent
    }

    fn broadcast(&mut self, datagram: &[u8]) -> bool {
        self.outputs.datagram(None, datagram);
        let sent = self.mailman.broadcast(datagram);
        self.note(u8::from(sent));
        sent
    }
}

fn index_of(reason: CloseReason) -> Option<usize> {
    REASONS.iter().position(|known| *known == reason)
}

impl Tape {
    /// A recording of a session that begins, whose hello is the one of the unit's node now.
    pub(super) fn start(
        path: &Path,
        now: Instant,
        hello: &Hello,
        (dialed, address): (bool, SocketAddr),
        constraints: &Constraints,
        capacities: &Capacities,
    ) -> std::io::Result<Self> {
        let mut bytes = [0; HELLO_BYTES];
        let length = hello.encode(Mode::Plain, &mut bytes).unwrap_or(0);
        let mut file = BufWriter::new(OpenOptions::new().write(true).create_new(true).mode(0o600).open(path)?);
        let micros = now.as_micros();
        writeln!(file, "{HEAD}")?;
        writeln!(file, "session {micros} {} {address} {}", u8::from(dialed), hex::encode(&bytes[..length]))?;
        let c = constraints;
        let spans = [c.request_timeout, c.minimum_interval, c.keep_alive, c.handover].map(Duration::as_micros);
        let [timeout, interval, keep_alive, handover] = spans;
        let Constraints { maximum_nodes, message_size, chunk_size, calls_per_peer, .. } = c;
        let Constraints { subscriptions_per_peer, stream_bytes, .. } = c;
        writeln!(
            file,
            "constraints {timeout} {interval} {keep_alive} {handover} {maximum_nodes} {message_size} {chunk_size} \
             {calls_per_peer} {subscriptions_per_peer} {stream_bytes}"
        )?;
        let Capacities { functions, calls_in_flight, calls_running, their_functions, .. } = capacities;
        let Capacities { their_signature_bytes, message_buffers, .. } = capacities;
        writeln!(
            file,
            "capacities {functions} {calls_in_flight} {calls_running} {their_functions} {their_signature_bytes} \
             {message_buffers}"
        )?;
        Ok(Self { file, written: 0, now, made: Vec::new(), is_cut: false })
    }

    /// The recording ends here.
    fn cut(&mut self, why: &str) {
        if !self.is_cut {
            self.is_cut = true;
            tracing::warn!("the recording of a core session ends early: {why}");
            // Nothing is left to be done about a full disk.
            let _ = writeln!(self.file, "cut {why}").and_then(|()| self.file.flush());
        }
    }

    fn line(&mut self, hash: u64, answers: &str, input: &str, ended: bool) {
        let answers = if answers.is_empty() { "-" } else { answers };
        let line = format!("{} {hash:016x} {answers} {input}\n", self.now.as_micros());
        self.written = self.written.saturating_add(line.len());
        if self.written > MOST_BYTES {
            return self.cut("it is too long");
        }
        let flushed = |file: &mut BufWriter<File>| if ended { file.flush() } else { Ok(()) };
        if let Err(error) = self.file.write_all(line.as_bytes()).and_then(|()| flushed(&mut self.file)) {
            self.cut(&format!("it cannot be written: {error}"));
        }
    }

    #[cold]
    fn input<R: Debug>(
        &mut self,
        session: &mut Session<Linux>,
        cx: &mut Context<'_, Linux>,
        input: Result<String, &'static str>,
        act: impl FnOnce(&mut Session<Linux>, &mut Context<'_, Linux>) -> R,
    ) -> R {
        let input = input.and_then(|input| foreign(cx).map_or(Ok(input), Err));
        let input = match input {
            Ok(input) if !self.is_cut => input,
            Ok(_) => return act(session, cx),
            Err(why) => {
                self.cut(why);
                return act(session, cx);
            }
        };
        self.now = cx.now;
        let (outputs, answers) = (Outputs::new(), String::new());
        let mut mailman = Recorded { mailman: &mut *cx.mailman, outputs, answers, is_unknown: false };
        let mut recorded = Context {
            now: cx.now,
            mailman: &mut mailman,
            buffers: &mut *cx.buffers,
            functions: cx.functions,
            access: cx.access,
            hub: &mut *cx.hub,
            keys: &mut *cx.keys,
        };
        let returned = act(session, &mut recorded);
        let Recorded { outputs, answers, is_unknown, .. } = mailman;
        if is_unknown {
            self.cut("the stream failed in another way");
        } else {
            self.line(outputs.end(&returned, session), &answers, &input, session.is_ended());
        }
        returned
    }

    /// An input that needs no context.
    #[cold]
    fn aside<R: Debug>(
        &mut self,
        session: &mut Session<Linux>,
        input: Result<String, &'static str>,
        act: impl FnOnce(&mut Session<Linux>) -> R,
    ) -> R {
        let returned = act(session);
        match input {
            Err(why) => self.cut(why),
            Ok(_) if self.is_cut => {}
            Ok(input) => self.line(Outputs::new().end(&returned, session), "", &input, session.is_ended()),
        }
        returned
    }
}

/// What a session can be told that is in no recording.
fn foreign(cx: &Context<'_, Linux>) -> Option<&'static str> {
    if cx.access.is_some() {
        return Some("the unit has an access table");
    }
    let offers = (0..cx.functions.places()).any(|slot| cx.functions.function(Slot(slot)).is_some());
    offers.then_some(OFFERS)
}

fn ended(word: &str, reason: CloseReason) -> Result<String, &'static str> {
    let index = index_of(reason).ok_or("the link ended for another reason")?;
    Ok(format!("{word} {index}"))
}

/// A call in words; text is in hexadecimal, as names may have any letters.
fn request(
    made: &[Made],
    callee: &Callee<'_>,
    parameters: &ParametersView,
    options: &RequestOptions,
    wants_reply: bool,
) -> Result<String, &'static str> {
    let number = |number: Option<u64>| number.map_or_else(|| "-".to_owned(), |number| number.to_string());
    let renew = match options.renew {
        Renew::Never => 0,
        Renew::Process => 1,
        Renew::Heart(_) => return Err("a call is renewed by a heart"),
    };
    let made = match options.made {
        None => None,
        Some(place) => {
            let index = made.iter().position(|known| *known == place);
            Some(index.ok_or("a call was made before the recording")? as u64)
        }
    };
    let flags =
        [wants_reply, options.delivery == Delivery::BestEffort, options.take_over, options.operator, options.progress];
    let mut text = format!("request {} ", hex::encode(callee.name()));
    text.extend(flags.map(|flag| if flag { '1' } else { '0' }));
    let timeout = number(options.timeout.map(Duration::as_micros));
    let priority = number(options.priority.map(Priority::to_wire).map(u64::from));
    // Writing to a string cannot fail.
    let _ = write!(text, " {timeout} {priority} {renew} {}", number(made));
    for variable in parameters.iter() {
        if variable.kind.is_nested() {
            return Err("a call has a list or a record among its parameters");
        }
        let (name, value) = (hex::encode(variable.name), hex::encode(variable.value.raw()));
        let _ = write!(text, " {name}:{}:{}:{value}", variable.kind.word(), variable.size);
    }
    Ok(text)
}

/// The values that come with an event.
pub(super) fn values(session: &Session<Linux>, event: Option<&Event>, lent: &[u8]) -> Vec<u8> {
    let block = match event {
        Some(Event::Reply(_, Ok(results))) => session.results(results, lent),
        Some(Event::Sample(sample)) => session.results(&sample.values, lent),
        Some(Event::Progress(_, values)) => session.progress_values(values, lent),
        _ => return Vec::new(),
    };
    block.map_or_else(|_| Vec::new(), |block| block.bytes().to_vec())
}

impl Deref for TapedSession {
    type Target = Session<Linux>;

    fn deref(&self) -> &Session<Linux> {
        &self.session
    }
}

impl TapedSession {
    pub(crate) fn new(session: Session<Linux>, tape: Option<Tape>) -> Self {
        Self { session, tape: tape.map(Box::new) }
    }

    #[inline]
    fn put<R: Debug>(
        &mut self,
        cx: &mut Context<'_, Linux>,
        input: impl FnOnce() -> Result<String, &'static str>,
        act: impl FnOnce(&mut Session<Linux>, &mut Context<'_, Linux>) -> R,
    ) -> R {
        match &mut self.tape {
            None => act(&mut self.session, cx),
            Some(tape) => tape.input(&mut self.session, cx, input(), act),
        }
    }

    #[inline]
    fn put_aside<R: Debug>(
        &mut self,
        input: impl FnOnce() -> Result<String, &'static str>,
        act: impl FnOnce(&mut Session<Linux>) -> R,
    ) -> R {
        match &mut self.tape {
            None => act(&mut self.session),
            Some(tape) => tape.aside(&mut self.session, input(), act),
        }
    }

    /// The session, for an input that no recording has: it ends the recording.
    #[inline]
    pub(crate) fn unrecorded(&mut self, why: &str) -> &mut Session<Linux> {
        if let Some(tape) = &mut self.tape {
            tape.cut(why);
        }
        &mut self.session
    }

    /// The link's cipher, which nothing is asked of here.
    #[cfg(feature = "control")]
    pub(crate) const fn cipher(&mut self) -> &cara_secure::link::Cipher {
        self.session.cipher()
    }

    pub(crate) fn connected(&mut self, cx: &mut Context<'_, Linux>) {
        self.put(cx, || Ok("connected".into()), Session::connected);
    }

    #[inline]
    pub(crate) fn receive(
        &mut self,
        cx: &mut Context<'_, Linux>,
        bytes: &mut [u8],
        arguments: Option<&mut ParametersView>,
    ) -> Receipt {
        // Before the session takes them, as it may change them.
        let input = self.tape.is_some().then(|| format!("receive {} {}", u8::from(arguments.is_some()), hex_of(bytes)));
        let is_taped = self.tape.is_some();
        let act = |session: &mut Session<Linux>, cx: &mut Context<'_, Linux>| {
            let receipt = session.receive(cx, bytes, arguments);
            (receipt, if is_taped { values(session, receipt.event.as_ref(), bytes) } else { Vec::new() })
        };
        self.put(cx, || Ok(input.unwrap_or_default()), act).0
    }

    pub(crate) fn datagram(
        &mut self,
        cx: &mut Context<'_, Linux>,
        from: SocketAddr,
        nonce: u64,
        body: &mut [u8],
    ) -> Option<Event> {
        let input = self.tape.is_some().then(|| format!("datagram {from} {nonce} {}", hex_of(body)));
        self.put(cx, || Ok(input.unwrap_or_default()), |session, cx| session.datagram(cx, from, nonce, body))
    }

    pub(crate) fn failure(&mut self, lent: &[u8]) -> Option<Failure> {
        self.put_aside(|| Ok(format!("failure {}", hex_of(lent))), |session| session.failure(lent))
    }

    pub(crate) fn writable(&mut self, cx: &mut Context<'_, Linux>) {
        self.put(cx, || Ok("writable".into()), Session::writable);
    }

    pub(crate) fn poll(&mut self, cx: &mut Context<'_, Linux>) -> Option<Event> {
        self.put(cx, || Ok("poll".into()), Session::poll)
    }

    pub(crate) fn direct(&mut self, cx: &mut Context<'_, Linux>, directive: Directive) -> Option<Event> {
        self.unrecorded("another link has the same identity").direct(cx, directive)
    }

    pub(crate) fn publish(&mut self, cx: &mut Context<'_, Linux>) -> u32 {
        self.put(cx, || Ok("publish".into()), Session::publish)
    }

    pub(crate) fn announce_claim(&mut self, cx: &mut Context<'_, Linux>) {
        self.unrecorded("the manager has raised its claim").announce_claim(cx);
    }

    pub(crate) fn make(&mut self) -> Made {
        let made = self.put_aside(|| Ok("make".into()), Session::make);
        if let Some(tape) = &mut self.tape {
            tape.made.push(made);
        }
        made
    }

    #[inline]
    pub(crate) fn request(
        &mut self,
        cx: &mut Context<'_, Linux>,
        callee: Callee<'_>,
        parameters: &ParametersView,
        options: &RequestOptions,
        wants_reply: bool,
    ) -> Result<CallId, Error> {
        let input = self.tape.as_ref().map(|tape| request(&tape.made, &callee, parameters, options, wants_reply));
        let act = |session: &mut Session<Linux>, cx: &mut Context<'_, Linux>| {
            session.request(cx, callee, parameters, options, wants_reply)
        };
        self.put(cx, || input.unwrap_or_else(|| Ok(String::new())), act)
    }

    pub(crate) fn cancel(&mut self, cx: &mut Context<'_, Linux>, id: CallId) {
        self.put(cx, || Ok(format!("cancel {}", id.0)), |session, cx| session.cancel(cx, id));
    }

    pub(crate) fn cancel_but_wait(&mut self, cx: &mut Context<'_, Linux>, id: CallId) {
        self.put(cx, || Ok(format!("cancel_but_wait {}", id.0)), |session, cx| session.cancel_but_wait(cx, id));
    }

    pub(crate) fn release(&mut self, cx: &mut Context<'_, Linux>, slot: Slot) -> Result<(), Error> {
        self.put(cx, || Ok(format!("release {}", slot.0)), |session, cx| session.release(cx, slot))
    }

    pub(crate) fn ping(&mut self, cx: &mut Context<'_, Linux>) -> Result<(), Error> {
        self.put(cx, || Ok("ping".into()), Session::ping)
    }

    pub(crate) fn flush_gathered(&mut self, cx: &mut Context<'_, Linux>) {
        self.put(cx, || Ok("flush".into()), Session::flush_gathered);
    }

    pub(crate) fn subscribe(
        &mut self,
        cx: &mut Context<'_, Linux>,
        stream: &str,
        interval: Duration,
    ) -> Result<Slot, Error> {
        let input = || Ok(format!("subscribe {} {}", hex::encode(stream), interval.as_micros()));
        self.put(cx, input, |session, cx| session.subscribe(cx, stream, interval))
    }

    pub(crate) fn unsubscribe(&mut self, cx: &mut Context<'_, Linux>, stream: &str) {
        let input = || Ok(format!("unsubscribe {}", hex::encode(stream)));
        self.put(cx, input, |session, cx| session.unsubscribe(cx, stream));
    }

    pub(crate) fn close(&mut self, cx: &mut Context<'_, Linux>, reason: CloseReason) {
        self.put(cx, || ended("close", reason), |session, cx| session.close(cx, reason));
    }

    pub(crate) fn disconnected(&mut self, reason: CloseReason) {
        self.put_aside(|| ended("disconnected", reason), |session| session.disconnected(reason));
    }

    pub(crate) fn lend_calls(&mut self, slots: Box<[Option<Pending>]>) -> Box<[Option<Pending>]> {
        let mut unused = Box::default();
        let input = format!("lend_calls {}", slots.len());
        self.put_aside(|| Ok(input), |session| unused = session.lend_calls(slots));
        unused
    }

    /// Without a call of the peer it changes nothing.
    #[inline]
    pub(crate) fn next_call(
        &mut self,
        cx: &mut Context<'_, Linux>,
        arguments: &mut ParametersView,
    ) -> Option<Incoming> {
        if self.session.calls_held() > 0 {
            return self.unrecorded(OFFERS).next_call(cx, arguments);
        }
        self.session.next_call(cx, arguments)
    }

    pub(crate) fn lend_running(&mut self, slots: Box<[Option<RunningCall>]>) -> Box<[Option<RunningCall>]> {
        self.unrecorded(OFFERS).lend_running(slots)
    }
}

/// Bytes as one word.
fn hex_of(bytes: &[u8]) -> String {
    if bytes.is_empty() { "-".into() } else { hex::encode(bytes) }
}
