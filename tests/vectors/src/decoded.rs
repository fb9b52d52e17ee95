//! What bytes mean, as JSON: the core's decoders, and nothing beside them.

use cara_core::config::{Mode, Priority, Versions};
use cara_core::distribution::block;
use cara_core::distribution::datagram::{Announce, Datagram, DatagramError, WhoHas};
use cara_core::distribution::function::{Attributes, Signature, VariableSpec};
use cara_core::distribution::hello::{ClaimReport, Hello, HelloError, Manager};
use cara_core::distribution::identity::{Fleet, Identity};
use cara_core::distribution::items::{Item, Items, Malformed};
use cara_core::distribution::message::{
    Control, FailureDetails, Message, SampleHeader, SessionBody, SubscriptionRefusal,
};
use cara_core::distribution::parameters::{Parameters, Type, Value as Variable};
use cara_core::error::{Error, ServiceError};
use cara_core::host::connections::Report;
use cara_core::host::secure::Plain;
use cara_core::services::lease::{LastOrder, Latch, LeaseEnd};
use serde_json::{Value, json};

use crate::stream;
use crate::vector::{Context, Kind};

/// The value of `bytes`; `None` where the core refuses them.
pub(crate) fn decode(kind: Kind, context: &Context, bytes: &[u8]) -> Option<Value> {
    match kind {
        Kind::Hello => hello(bytes),
        Kind::Message => message(bytes),
        Kind::Signature => Signature::decode(bytes).ok().map(signature),
        Kind::Attributes => Attributes::decode(bytes).ok().map(|attributes| self::attributes(&attributes)),
        Kind::Block => block(context, bytes),
        Kind::SessionBody => session_body(bytes),
        Kind::Datagram => datagram(context.fleet.unwrap_or_default(), bytes),
        Kind::Stream => Some(stream::decode(context, bytes)),
    }
}

pub(crate) fn hex(bytes: &[u8]) -> String {
    bytes.iter().map(|byte| format!("{byte:02x}")).collect()
}

pub(crate) fn hello(bytes: &[u8]) -> Option<Value> {
    match Hello::decode(bytes, Mode::Plain) {
        Ok(hello) => Some(json!({
            "versions": versions(hello.versions),
            "capabilities": hello.capabilities,
            "fleet": hello.fleet.0,
            "identity": identity(&hello.identity),
            "wanted": manager(hello.wanted.as_ref()),
            "epoch": hello.epoch.0,
            "claim": claim(hello.claim.as_ref()),
            "obeyed": claim(hello.obeyed.as_ref()),
            "nonce": hello.nonce,
            "message_size": hello.limits.message_size,
            "chunk_size": hello.limits.chunk_size,
            "calls": hello.limits.calls,
            "minimum_interval": hello.limits.minimum_interval,
            "link": hello.link,
            "udp_port": hello.udp_port,
            "stamp": hello.stamp,
            "keep_alive": hello.keep_alive,
            "skipped": hello.skipped,
        })),
        Err(HelloError::Version(theirs)) => Some(json!({ "other_versions": versions(theirs) })),
        Err(HelloError::Magic | HelloError::Mode | HelloError::Suite | HelloError::Malformed) => None,
    }
}

fn versions(versions: Versions) -> Value {
    json!([versions.first, versions.last])
}

fn identity(identity: &Identity) -> Value {
    json!({ "id": identity.id(), "name": identity.name(), "role": identity.role().as_str() })
}

fn manager(manager: Option<&Manager>) -> Value {
    manager.map_or(Value::Null, |manager| json!({ "name": manager.name.as_str(), "id": manager.id }))
}

pub(crate) fn message(bytes: &[u8]) -> Option<Value> {
    Some(match Message::decode(bytes)? {
        Message::Request(header, block) => json!({ "request": {
            "id": header.id,
            "slot": header.slot.0,
            "generation": header.generation.0,
            "wants_reply": header.wants_reply,
            "wants_progress": header.wants_progress,
            "takes_over": header.takes_over,
            "operator": header.operator,
            "unknown": header.unknown,
            "remaining": header.remaining.as_micros(),
            "stamp": header.stamp,
            "since": header.since.as_micros(),
            "number": header.number,
            "block": hex(block),
        }}),
        Message::Reply(id, Ok(block)) => json!({ "reply": { "id": id, "block": hex(block) } }),
        Message::Reply(id, Err(error)) => json!({ "reply": failed(id, error, bytes) }),
        Message::Failure(id, error) => json!({ "failure": failed(id, error, bytes) }),
        Message::Progress(id, block) => json!({ "progress": { "id": id, "block": hex(block) } }),
        Message::Sample(SampleHeader { slot, generation, made }, block) => json!({ "sample": {
            "slot": slot.0, "generation": generation.0, "made": made, "block": hex(block),
        }}),
        Message::Control(items) => json!({ "control": controls(items)? }),
    })
}

/// An error, with what its service has said where that can be read.
fn failed(id: u32, error: Error, bytes: &[u8]) -> Value {
    let mut value = json!({ "id": id, "error": self::error(error) });
    if let Some(FailureDetails { text, values }) = FailureDetails::of(bytes) {
        value["details"] = json!({ "text": text, "values": hex(values) });
    }
    value
}

/// The errors that have a code of their own; all others read as malformed.
fn error(error: Error) -> Value {
    match error {
        Error::UnknownFunction => json!("unknown_function"),
        Error::StaleFunction => json!("stale_function"),
        Error::MissingArgument { index } => json!({ "missing_argument": { "index": index } }),
        Error::WrongType { index } => json!({ "wrong_type": { "index": index } }),
        Error::WrongSize { index, expected, found } => {
            json!({ "wrong_size": { "index": index, "expected": expected, "found": found } })
        }
        Error::Expired => json!("expired"),
        Error::Stale => json!("stale"),
        Error::Busy => json!("busy"),
        Error::Held { by, operator } => json!({ "held": { "by": by, "operator": operator } }),
        Error::Inhibited { by, reason } => json!({ "inhibited": { "by": by, "reason": reason } }),
        Error::Replaced => json!("replaced"),
        Error::NotAllowed => json!("not_allowed"),
        Error::WouldDeadlock => json!("would_deadlock"),
        Error::TooLarge { limit } => json!({ "too_large": { "limit": limit } }),
        Error::TooSoon { wait } => json!({ "too_soon": { "wait": wait.as_micros() } }),
        Error::ResultWouldNotFit { need, have } => {
            json!({ "result_would_not_fit": { "need": need, "have": have } })
        }
        Error::ResultLost => json!("result_lost"),
        Error::Unsupported => json!("unsupported"),
        Error::Service(ServiceError::Failed(code)) => json!({ "service_failed": { "code": code } }),
        Error::Service(ServiceError::Panicked) => json!("service_panicked"),
        Error::Service(ServiceError::NotReady) => json!("service_not_ready"),
        Error::Service(ServiceError::BadResults) => json!("service_bad_results"),
        _ => json!("malformed"),
    }
}

/// The items of a control message. One that is unknown is shown as it is, unless it must be understood.
fn controls(items: &[u8]) -> Option<Value> {
    const MUST_UNDERSTAND: u16 = 1 << 15;
    let value = |item: Result<Item<'_>, Malformed>| {
        let item = item.ok()?;
        match Control::take(&item).ok()? {
            Some(control) => Some(self::control(&control)),
            None if item.kind & MUST_UNDERSTAND != 0 => None,
            None => Some(json!({ "unknown": { "kind": item.kind, "body": hex(item.body) } })),
        }
    };
    Items::new(items).map(value).collect()
}

fn control(control: &Control<'_>) -> Value {
    match *control {
        Control::Publish { slot, generation, attributes, signature } => json!({ "publish": {
            "slot": slot, "generation": generation, "attributes": hex(attributes), "signature": hex(signature),
        }}),
        Control::Withdraw { slot } => json!({ "withdraw": { "slot": slot } }),
        Control::ListEnd { serial } => json!({ "list_end": { "serial": serial } }),
        Control::ListAck { serial, skipped } => json!({ "list_ack": { "serial": serial, "skipped": skipped } }),
        Control::Limits { message_size, minimum_interval, calls } => json!({ "limits": {
            "message_size": message_size, "minimum_interval": minimum_interval, "calls": calls,
        }}),
        Control::Claimed { report } => json!({ "claimed": claim(Some(&report)) }),
        Control::HandOver { name, id } => {
            json!({ "hand_over": { "name": hex(name), "id": id } })
        }
        Control::HandedOver { refusal } => json!({ "handed_over": { "refusal": refusal.map_or(0, |why| why as u8) } }),
        Control::LeaseEnded { call, why } => json!({ "lease_ended": { "call": call, "why": why.word() } }),
        Control::Subscribe { slot, generation, interval } => json!({ "subscribe": {
            "slot": slot, "generation": generation, "interval": interval,
        }}),
        Control::Subscribed { slot, generation, interval, bytes, refusal } => {
            let refusal = match refusal {
                SubscriptionRefusal::None => "none",
                SubscriptionRefusal::Unknown => "unknown",
                SubscriptionRefusal::NotAllowed => "not_allowed",
                SubscriptionRefusal::Full => "full",
            };
            json!({ "subscribed": {
                "slot": slot, "generation": generation, "interval": interval, "bytes": bytes, "refusal": refusal,
            }})
        }
        Control::Actuator { slot, latch, last } => {
            let latch = latch.map(|Latch { by, reason }| json!({ "by": by, "reason": reason }));
            let last = last.map(|LastOrder { holder, link, call, claim, end }| {
                let claim = [claim.term, claim.claimant];
                json!({ "holder": holder, "link": link, "call": call, "claim": claim, "end": end.map(LeaseEnd::word) })
            });
            json!({ "actuator": { "slot": slot, "latch": latch, "last": last } })
        }
    }
}

fn signature(signature: Signature<'_>) -> Value {
    let variables =
        |specs: cara_core::distribution::function::VariableSpecs<'_>| -> Value { specs.map(self::spec).collect() };
    let mut value = json!({
        "name": signature.name(),
        "arguments": variables(signature.arguments()),
        "results": variables(signature.results()),
        "text": signature.to_string(),
    });
    for (name, specs) in [("progress", signature.progress()), ("failure", signature.failure())] {
        if { specs }.next().is_some() {
            value[name] = variables(specs);
        }
    }
    if !signature.help().is_empty() {
        value["help"] = signature.help().into();
    }
    let units: Vec<_> = signature.units().collect();
    if !units.is_empty() {
        value["units"] = json!(units);
    }
    value
}

/// A variable, or an element, which has no name.
fn spec(spec: VariableSpec<'_>) -> Value {
    let mut shown = json!({ "type": spec.kind.word(), "size": spec.size });
    let more = match spec.kind {
        Type::List => spec.element().map(|element| ("element", self::spec(element))),
        Type::Record => Some(("fields", spec.fields().map(self::spec).collect())),
        _ => None,
    };
    let name = (!spec.name.is_empty()).then(|| ("name", spec.name.into()));
    for (key, value) in more.into_iter().chain(name) {
        shown[key] = value;
    }
    shown
}

fn attributes(attributes: &Attributes) -> Value {
    let mut shown = json!({
        "priority": attributes.priority.word(),
        "actuator": attributes.actuator,
        "lease": attributes.lease.map(|lease| lease.as_millis()),
        "stream": attributes.stream,
    });
    for flag in Attributes::FLAGS {
        shown[flag.word()] = flag.is_set(attributes).into();
    }
    shown
}

fn block(context: &Context, bytes: &[u8]) -> Option<Value> {
    let encoded = context.signature_bytes();
    let signature = Signature::decode(&encoded).ok()?;
    let specs = if context.part == Some("results") { signature.results() } else { signature.arguments() };
    let mut parameters: Box<Parameters<32_768>> = Box::new(Parameters::sized());
    block::read_arguments(specs, bytes, &mut *parameters).ok()?;
    specs.map(|spec| parameters.value(spec.name).ok().map(|value| (spec.name.to_owned(), variable(value)))).collect()
}

/// Floats as the hexadecimal digits of their bits, highest first, so that nothing depends on how they are printed.
fn variable(value: Variable<'_>) -> Value {
    match value.kind() {
        Type::Int => value.ints().collect(),
        Type::Float => value.floats().map(|float| format!("{:016x}", float.to_bits())).collect(),
        Type::String => value.text().into(),
        Type::Bool => value.bools().collect(),
        Type::Bytes => hex(value.raw()).into(),
        Type::List => value.elements().map(variable).collect(),
        Type::Record => value.fields().map(|field| (field.name.to_owned(), variable(field.value))).collect(),
    }
}

pub(crate) fn session_body(bytes: &[u8]) -> Option<Value> {
    Some(match SessionBody::decode(bytes)? {
        SessionBody::KeepAlive { stamp, report: Report { received, hears, holds, misses } } => json!({ "keep_alive": {
            "stamp": stamp, "received": received, "hears": hears, "holds": holds, "misses": misses,
        }}),
        SessionBody::Ping => json!({ "ping": {} }),
        SessionBody::Pong(Report { received, hears, holds, misses }) => {
            json!({ "pong": { "received": received, "hears": hears, "holds": holds, "misses": misses } })
        }
        SessionBody::Close(code) => json!({ "close": { "code": code } }),
        SessionBody::Renew(renewal) => json!({ "renew": {
            "class": renewal.class.word(),
            "call": renewal.call,
            "stamp": renewal.stamp,
            "since": renewal.since.as_micros(),
            "age": renewal.age.as_micros(),
        }}),
        SessionBody::Renewed(call) => json!({ "renewed": { "call": call } }),
        SessionBody::Release(release) => {
            json!({ "release": { "class": release.class.word(), "call": release.call } })
        }
        SessionBody::Cancel(release) => {
            json!({ "cancel": { "class": release.class.word(), "call": release.call } })
        }
        SessionBody::ReleaseAll(slot, call) => json!({ "release_all": { "slot": slot.0, "call": call } }),
        SessionBody::Message(byte, message) => json!({ "message": {
            "priority": Priority::from_wire(byte)?.word(), "message": self::message(message)?,
        }}),
    })
}

pub(crate) fn datagram(fleet: u32, bytes: &[u8]) -> Option<Value> {
    match Datagram::decode(bytes, Fleet(fleet), &Plain) {
        Ok(Datagram::WhoHas(search)) => Some(json!({ "who_has": who_has(&search) })),
        Ok(Datagram::Announce(answer)) => Some(json!({ "announce": announce(&answer) })),
        Ok(Datagram::Session { link, nonce, body }) => {
            Some(json!({ "session": { "link": link, "nonce": nonce, "body": session_body(body)? } }))
        }
        Err(DatagramError::Version(theirs)) => Some(json!({ "other_versions": versions(theirs) })),
        Err(DatagramError::Fleet(fleet)) => Some(json!({ "other_fleet": fleet.0 })),
        Err(DatagramError::Magic | DatagramError::Forged | DatagramError::NotForUs | DatagramError::Malformed) => None,
    }
}

fn who_has(search: &WhoHas) -> Value {
    json!({
        "identity": identity(&search.identity),
        "epoch": search.epoch.0,
        "sequence": search.sequence,
        "nonce": search.nonce,
        "wanted": manager(search.wanted.as_ref()),
        "tcp_port": search.tcp_port,
        "expected": search.expected,
        "known": search.known.as_slice(),
        "standby": search.standby,
        "skipped": search.skipped,
    })
}

fn claim(report: Option<&ClaimReport>) -> Value {
    let Some(ClaimReport { tagged, since }) = report else { return Value::Null };
    let tag = tagged.tag.iter().map(|byte| format!("{byte:02x}")).collect::<String>();
    json!({ "term": tagged.claim.term, "claimant": tagged.claim.claimant, "tag": tag, "since": since })
}

fn announce(answer: &Announce) -> Value {
    json!({
        "identity": identity(&answer.identity),
        "epoch": answer.epoch.0,
        "claim": claim(answer.claim.as_ref()),
        "obeyed": claim(answer.obeyed.as_ref()),
        "sequence": answer.sequence,
        "nonce": answer.nonce,
        "tcp_port": answer.tcp_port,
        "room": answer.room,
        "expected": answer.expected,
        "skipped": answer.skipped,
    })
}
