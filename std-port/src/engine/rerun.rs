//! Runs a [recorded](super::tape) session again: a fresh core takes the same inputs, and has to do the same.

use std::net::SocketAddr;
use std::str::{FromStr, SplitAsciiWhitespace};

use cara_core::config::{Constraints, Mode, Priority};
use cara_core::distribution::connection_handler::{Node, NodeConfig, Target};
use cara_core::distribution::function_list::{Entry, FunctionList, Slot};
use cara_core::distribution::hello::Hello;
use cara_core::distribution::parameters::ParametersView;
use cara_core::distribution::value::Type;
use cara_core::error::CloseReason;
use cara_core::host::mailman::{LinkId, Mailman};
use cara_core::services::Context;
use cara_core::services::call::Callee;
use cara_core::services::heart::Renew;
use cara_core::services::hub::Hub;
use cara_core::services::publications::Publications;
use cara_core::services::requests::{CallId, Made};
use cara_core::services::session::{Delivery, RequestOptions, Session, SessionConfig};
use cara_core::time::{Duration, Instant};
use cara_secure::link::Cipher;

use super::link::{Linux, SEALED_AHEAD};
use super::tables::{node_storage, session_storage};
use super::tape::{HEAD, Outputs, REASONS, values};
use super::{arena, message_buffer_bytes};
use crate::config::{Capacities, check};
use crate::handler::Handler;
use crate::pool::MessagePool;
use crate::storage::{Boxed, filled, filled_with};

/// Largest capacity that a recording may ask for.
const MOST: usize = 1 << 16;

/// A recorded session that did the same again.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Rerun {
    /// How many inputs it took.
    pub inputs: usize,
    /// A hash of all outputs and events.
    pub hash: u64,
    /// Why the recording ended before its link did.
    pub cut: Option<String>,
}

/// Why a recorded session was not run again, or did something else.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
#[non_exhaustive]
pub enum RerunError {
    /// No recording of this version.
    #[error("line {0} is not one of a recorded core session of this version: record it anew")]
    Malformed(usize),
    /// The core did something else than when it was recorded.
    #[error(
        "the core differs from the recording at line {line}, input `{input}`: hash {now:016x}, recorded {recorded:016x}"
    )]
    Differs {
        /// The line of the file.
        line: usize,
        /// The input, shortened.
        input: String,
        /// The hash of what came of it now.
        now: u64,
        /// The recorded one.
        recorded: u64,
    },
}

/// Answers as the network did, or not at all where the core asks more often.
struct Replayed<'a> {
    answers: std::str::Split<'a, char>,
    outputs: Outputs,
}

impl Replayed<'_> {
    fn sent(&mut self) -> bool {
        self.answers.next() == Some("1")
    }
}

impl Mailman<SocketAddr> for Replayed<'_> {
    fn write(&mut self, _link: LinkId, slices: &[&[u8]]) -> Result<usize, CloseReason> {
        self.outputs.write(slices);
        let answer = self.answers.next().unwrap_or_default();
        let failed = answer.strip_prefix('e').and_then(|index| REASONS.get(index.parse::<usize>().ok()?));
        let most = slices.iter().map(|slice| slice.len()).sum();
        failed.map_or_else(|| Ok(answer.parse::<usize>().unwrap_or(0).min(most)), |reason| Err(*reason))
    }

    fn seals_ahead(&self) -> usize {
        SEALED_AHEAD
    }

    fn send_to(&mut self, to: SocketAddr, datagram: &[u8]) -> bool {
        self.outputs.datagram(Some(to), datagram);
        self.sent()
    }

    fn broadcast(&mut self, datagram: &[u8]) -> bool {
        self.outputs.datagram(None, datagram);
        self.sent()
    }
}

/// A session outside of any unit.
struct Player {
    session: Session<Linux>,
    hub: Hub<Linux>,
    functions: FunctionList<Boxed, Handler<()>>,
    pool: MessagePool,
    made: Vec<Made>,
    arguments: Box<ParametersView>,
}

/// Runs a recorded session again, as the text of its file has it.
pub fn rerun(recording: &str) -> Result<Rerun, RerunError> {
    // A process that was killed leaves half a line.
    let (whole, half) = recording.rsplit_once('\n').unwrap_or(("", recording));
    let mut lines = (1..).zip(whole.lines());
    let mut player = Player::new(&mut lines)?;
    let (mut inputs, mut hash) = (0, Outputs::new());
    let mut cut = (!half.is_empty()).then(|| "the process ended".to_owned());
    for (number, line) in lines {
        if let Some(why) = line.strip_prefix("cut ") {
            cut = Some(why.to_owned());
            break;
        }
        let (now, recorded) = player.take(line).ok_or(RerunError::Malformed(number))?;
        if now != recorded {
            let input = line.splitn(4, ' ').nth(3).unwrap_or_default().chars().take(60).collect();
            return Err(RerunError::Differs { line: number, input, now, recorded });
        }
        hash.write(&[&now.to_be_bytes()]);
        inputs += 1;
    }
    Ok(Rerun { inputs, hash: hash.sum(), cut })
}

/// The next word as a value.
fn next<T: FromStr>(words: &mut SplitAsciiWhitespace<'_>) -> Option<T> {
    words.next()?.parse().ok()
}

fn span(words: &mut SplitAsciiWhitespace<'_>) -> Option<Duration> {
    next(words).map(Duration::from_micros)
}

fn size(words: &mut SplitAsciiWhitespace<'_>) -> Option<usize> {
    next(words).filter(|size| *size <= MOST)
}

fn bytes(words: &mut SplitAsciiWhitespace<'_>) -> Option<Vec<u8>> {
    match words.next()? {
        "-" => Some(Vec::new()),
        word => hex::decode(word).ok(),
    }
}

fn text(words: &mut SplitAsciiWhitespace<'_>) -> Option<String> {
    String::from_utf8(bytes(words)?).ok()
}

fn optional<T: FromStr>(words: &mut SplitAsciiWhitespace<'_>) -> Option<Option<T>> {
    match words.next()? {
        "-" => Some(None),
        word => word.parse().ok().map(Some),
    }
}

fn constraints(words: &mut SplitAsciiWhitespace<'_>) -> Option<Constraints> {
    let (request_timeout, minimum_interval) = (span(words)?, span(words)?);
    let (keep_alive, handover) = (span(words)?, span(words)?);
    let constraints = Constraints {
        request_timeout,
        minimum_interval,
        keep_alive,
        handover,
        maximum_nodes: next(words)?,
        message_size: next(words)?,
        chunk_size: next(words)?,
        calls_per_peer: next(words)?,
        subscriptions_per_peer: next(words)?,
        stream_bytes: next(words)?,
        // Only for calls of the peer, which are in no recording.
        ..Constraints::M_UNIT
    };
    check(&constraints).ok().map(|()| constraints)
}

fn capacities(words: &mut SplitAsciiWhitespace<'_>) -> Option<Capacities> {
    Some(Capacities {
        functions: size(words)?,
        calls_in_flight: size(words)?,
        calls_running: size(words)?,
        their_functions: size(words)?,
        their_signature_bytes: size(words)?,
        message_buffers: size(words)?,
        ..Capacities::default()
    })
}

impl Player {
    fn new<'a>(lines: &mut impl Iterator<Item = (usize, &'a str)>) -> Result<Self, RerunError> {
        let mut head = |word: &str| {
            let (number, line) = lines.next().unwrap_or((1, ""));
            let words = line.strip_prefix(word).map(str::split_ascii_whitespace);
            Ok((number, words.ok_or(RerunError::Malformed(number))?))
        };
        head(HEAD)?;
        let (number, mut session) = head("session ")?;
        let (second, mut limits) = head("constraints ")?;
        let (third, mut sizes) = head("capacities ")?;
        let limits = constraints(&mut limits).ok_or(RerunError::Malformed(second))?;
        let sizes = capacities(&mut sizes).ok_or(RerunError::Malformed(third))?;
        Self::with(&mut session, limits, &sizes).ok_or(RerunError::Malformed(number))
    }

    fn with(words: &mut SplitAsciiWhitespace<'_>, constraints: Constraints, sizes: &Capacities) -> Option<Self> {
        let now = Instant::from_micros(next(words)?);
        let (dialed, address) = (next::<u8>(words)? == 1, next(words)?);
        let hello = Hello::decode(&bytes(words)?, Mode::Plain).ok()?;
        let config = NodeConfig {
            identity: hello.identity.clone(),
            fleet: hello.fleet,
            epoch: hello.epoch,
            target: Target::Everybody,
            tcp_port: 0,
            udp_port: hello.udp_port,
            constraints,
            seed: 0,
        };
        let links = usize::from(hello.link) + 1;
        let mut node = Node::new(now, config, node_storage(usize::from(constraints.maximum_nodes), links));
        if let Some(claim) = hello.claim {
            node.set_claim(claim.tagged);
        }
        let publications = Publications::new(filled(sizes.functions, false), filled(sizes.published_to_one, None));
        let link = LinkId(hello.link);
        let config = SessionConfig { link, dialed, address, nonce: hello.nonce, constraints };
        let cipher = Cipher::new(Mode::Plain);
        let mut session = Session::new(now, config, cipher, session_storage(sizes, 0));
        session.let_list_grow(sizes.their_functions, sizes.their_signature_bytes);
        let buffers = sizes.message_buffers;
        Some(Self {
            session,
            hub: Hub { node, publications },
            functions: FunctionList::new(filled_with(sizes.functions, Entry::empty), filled(sizes.signature_bytes, 0)),
            pool: MessagePool::new(message_buffer_bytes(&constraints, Mode::Plain), buffers, buffers),
            made: Vec::new(),
            arguments: arena(constraints.message_size as usize),
        })
    }

    /// Takes the input of a line; the hash of what comes of it, and the recorded one.
    fn take(&mut self, line: &str) -> Option<(u64, u64)> {
        let mut words = line.split_ascii_whitespace();
        let now = Instant::from_micros(next(&mut words)?);
        let recorded = u64::from_str_radix(words.next()?, 16).ok()?;
        let mut mailman = Replayed { answers: words.next()?.split(','), outputs: Outputs::new() };
        let mut buffers = &self.pool;
        let mut cx = Context {
            now,
            mailman: &mut mailman,
            buffers: &mut buffers,
            functions: &self.functions,
            access: None,
            hub: &mut self.hub,
            keys: &mut (),
        };
        let returned = act(&mut self.session, &mut cx, &mut self.made, &mut self.arguments, &mut words)?;
        Some((mailman.outputs.end(&Text(returned), &self.session), recorded))
    }
}

/// What a call returned, as `Debug` wrote it.
struct Text(String);

impl std::fmt::Debug for Text {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.write_str(&self.0)
    }
}

fn act(
    session: &mut Session<Linux>,
    cx: &mut Context<'_, Linux>,
    made: &mut Vec<Made>,
    arguments: &mut ParametersView,
    words: &mut SplitAsciiWhitespace<'_>,
) -> Option<String> {
    let reason = |words: &mut SplitAsciiWhitespace<'_>| REASONS.get(next::<usize>(words)?).copied();
    Some(match words.next()? {
        "connected" => format!("{:?}", session.connected(cx)),
        "receive" => {
            let arguments = (next::<u8>(words)? == 1).then_some(arguments);
            let mut lent = bytes(words)?;
            let receipt = session.receive(cx, &mut lent, arguments);
            format!("{:?}", (receipt, values(session, receipt.event.as_ref(), &lent)))
        }
        "datagram" => format!("{:?}", session.datagram(cx, next(words)?, next(words)?, &mut bytes(words)?)),
        "failure" => format!("{:?}", session.failure(&bytes(words)?)),
        "writable" => format!("{:?}", session.writable(cx)),
        "poll" => format!("{:?}", session.poll(cx)),
        "publish" => format!("{:?}", session.publish(cx)),
        "make" => {
            made.push(session.make());
            format!("{:?}", made.last()?)
        }
        "request" => request(session, cx, made, words)?,
        "cancel" => format!("{:?}", session.cancel(cx, CallId(next(words)?))),
        "cancel_but_wait" => format!("{:?}", session.cancel_but_wait(cx, CallId(next(words)?))),
        "release" => format!("{:?}", session.release(cx, Slot(next(words)?))),
        "ping" => format!("{:?}", session.ping(cx)),
        "flush" => format!("{:?}", session.flush_gathered(cx)),
        "subscribe" => format!("{:?}", session.subscribe(cx, &text(words)?, span(words)?)),
        "unsubscribe" => format!("{:?}", session.unsubscribe(cx, &text(words)?)),
        "close" => format!("{:?}", session.close(cx, reason(words)?)),
        "disconnected" => format!("{:?}", session.disconnected(reason(words)?)),
        "lend_calls" => {
            drop(session.lend_calls(filled(size(words)?, None)));
            format!("{:?}", ())
        }
        _ => return None,
    })
}

fn request(
    session: &mut Session<Linux>,
    cx: &mut Context<'_, Linux>,
    made: &[Made],
    words: &mut SplitAsciiWhitespace<'_>,
) -> Option<String> {
    let name = text(words)?;
    let flags: [bool; 5] = words.next()?.bytes().map(|flag| flag == b'1').collect::<Vec<_>>().try_into().ok()?;
    let [wants_reply, best_effort, take_over, operator, progress] = flags;
    let timeout = optional(words)?.map(Duration::from_micros);
    let priority = match optional(words)? {
        None => None,
        Some(byte) => Some(Priority::from_wire(byte)?),
    };
    let renew = if next::<u8>(words)? == 1 { Renew::Process } else { Renew::Never };
    let made = match optional::<usize>(words)? {
        None => None,
        Some(index) => Some(*made.get(index)?),
    };
    let delivery = if best_effort { Delivery::BestEffort } else { Delivery::Reliable };
    let options = RequestOptions {
        timeout,
        priority,
        delivery,
        renew,
        take_over,
        operator,
        made,
        progress,
        ..Default::default()
    };
    let mut parameters = arena(MOST);
    for word in words {
        add(&mut parameters, word)?;
    }
    let callee = Callee::from(name.as_str());
    Some(format!("{:?}", session.request(cx, callee, &parameters, &options, wants_reply)))
}

/// One variable of a call.
fn add(parameters: &mut ParametersView, word: &str) -> Option<()> {
    let [name, kind, size, raw]: [&str; 4] = word.split(':').collect::<Vec<_>>().try_into().ok()?;
    let name = String::from_utf8(hex::decode(name).ok()?).ok()?;
    let raw = hex::decode(raw).ok()?;
    let kind = Type::FLAT.into_iter().find(|known| known.word() == kind)?;
    parameters.add(&name, kind, size.parse().ok()?).ok()?;
    let words = || raw.chunks_exact(8).filter_map(|word| word.try_into().ok());
    match kind {
        Type::Int => parameters.set_value(&name, &words().map(i64::from_le_bytes).collect::<Vec<_>>()[..]),
        Type::Float => parameters.set_value(&name, &words().map(f64::from_le_bytes).collect::<Vec<_>>()[..]),
        Type::Bool => parameters.set_value(&name, &raw.iter().map(|byte| *byte != 0).collect::<Vec<_>>()[..]),
        Type::String => parameters.set_value(&name, std::str::from_utf8(&raw).ok()?),
        _ => parameters.set_value(&name, &raw[..]),
    }
    .ok()
}
