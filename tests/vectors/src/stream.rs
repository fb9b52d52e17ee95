//! The bytes of a stream as the core's own link takes them apart.

use cara_core::error::CloseReason;
use cara_core::host::connections::{Inbound, Link};
use cara_core::host::frame::first_frame_length;
use cara_core::host::mailman::LinkId;
use cara_core::host::secure::Plain;
use cara_core::storage::{Pool, Storage};
use serde_json::{Value, json};

use crate::decoded;
use crate::vector::Context;

/// Boxed slices as the storage of the core's machines.
#[derive(Debug, Clone, Copy)]
pub(crate) enum Boxed {}

impl Storage for Boxed {
    type Slice<T: 'static> = Box<[T]>;
}

/// Some buffers for whole messages.
pub(crate) fn buffers(count: usize, bytes: usize) -> Pool<Boxed> {
    Pool::new((0..count).map(|_| Some(vec![0; bytes].into_boxed_slice())).collect())
}

/// Everything that the stream's bytes complete, in order, up to the violation that ends the link or the incomplete
/// frame at the end.
pub(crate) fn decode(context: &Context, bytes: &[u8]) -> Value {
    let message_limit = context.message_limit.unwrap_or(4096);
    let mut pool = buffers(3, message_limit.max(8192));
    let small = vec![0; 512].into_boxed_slice();
    let mut link: Link<Boxed, Plain> =
        Link::new(LinkId(0), Plain, small, context.chunk_limit.unwrap_or(4096), message_limit);
    let mut seen = Vec::new();
    let mut rest = bytes.to_vec();
    while !rest.is_empty() {
        let length = first_frame_length(&rest).unwrap_or(rest.len()).min(rest.len());
        let whole = first_frame_length(&rest).is_some_and(|length| length <= rest.len());
        let mut frame: Vec<u8> = rest.drain(..length).collect();
        match link.receive(&mut pool, &mut frame) {
            Err(reason) => return ended(seen, reason),
            Ok(received) => {
                let Some(inbound) = received.inbound else {
                    if !whole {
                        seen.push(json!({ "incomplete": frame.len() }));
                    }
                    continue;
                };
                match value(&link, inbound, &frame) {
                    Some(value) => seen.push(value),
                    None => return ended(seen, CloseReason::Protocol),
                }
            }
        }
    }
    seen.into()
}

fn ended(mut seen: Vec<Value>, reason: CloseReason) -> Value {
    let word = if reason == CloseReason::Oversize { "oversize" } else { "protocol" };
    seen.push(json!({ "violation": word }));
    seen.into()
}

/// `None` for what ends the link. An unreadable hello is refused and an unreadable session body dropped, so both show
/// their bytes.
fn value(link: &Link<Boxed, Plain>, inbound: Inbound, lent: &[u8]) -> Option<Value> {
    Some(match inbound {
        Inbound::Hello(place) => {
            let bytes = link.view(place, lent);
            json!({ "hello": decoded::hello(bytes).unwrap_or_else(|| unreadable(bytes)) })
        }
        Inbound::Refuse(code) => json!({ "refuse": code }),
        Inbound::Close(code) => json!({ "close": code }),
        Inbound::Ping => json!("ping"),
        Inbound::Pong => json!("pong"),
        Inbound::Skipped => json!("skipped"),
        // Of secured links only.
        Inbound::Proof(_) | Inbound::Confirm(_) => return None,
        Inbound::Session(place) => {
            let bytes = link.view(place, lent);
            json!({ "session": decoded::session_body(bytes).unwrap_or_else(|| unreadable(bytes)) })
        }
        Inbound::Message(priority, place) => json!({
            "priority": priority.word(),
            "message": decoded::message(link.view(place, lent))?,
        }),
    })
}

fn unreadable(bytes: &[u8]) -> Value {
    json!({ "unreadable": decoded::hex(bytes) })
}
