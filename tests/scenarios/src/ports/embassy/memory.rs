//! The memory of boards: static on a controller, so here it is never given back.

use cara_core::error::Error;
use cara_embassy::{Config, Handle, Limits, Runner, resources};
use embassy_net::Stack;

use crate::Spec;

/// Links of a manager, one of them to refuse a node by name.
const LINKS: usize = 12;
/// Message sizes above this want the memory of a larger board.
const SHORT: u32 = 2 * 1024;
/// Those above this are only tried with few links.
const LONG: u32 = 32 * 1024 + 1;
/// Fewer message buffers than this are wanted by scenarios about few of them.
const FEW: usize = 6;

const AGV: Limits = Limits {
    links: 2,
    message_size: SHORT,
    message_buffers: FEW,
    stream: 4096,
    functions: 16,
    their_functions: 48,
    calls: 10,
    calls_waiting: 256,
    tasks: 4,
    arguments: 8_192,
    ..Limits::S_UNIT
};
/// One call of its manager runs at a time, and a slot is kept for emergencies.
const ONE_AT_A_TIME: Limits = Limits { calls: 2, ..AGV };
const MANAGER: Limits = Limits {
    links: LINKS,
    message_size: 32 * 1024,
    message_buffers: 12,
    stream: 8192,
    functions: 32,
    calls: 66,
    arguments: 90_000,
    ..AGV
};
const FORGETFUL: Limits = Limits { their_functions: 4, ..MANAGER };
const TIGHT: Limits = Limits { message_buffers: 2, ..MANAGER };
/// For messages that are not for boards at all.
const HUGE: Limits =
    Limits { links: 3, message_size: 128 * 1024, message_buffers: 3, arguments: 130_000, tasks: 1, ..MANAGER };

macro_rules! unit {
    ($limits:ident, $stack:expr, $config:expr) => {
        cara_embassy::new($stack, Box::leak(Box::new(<resources!((), $limits)>::new())), $config, ())
    };
}

/// A unit in memory that suits its description.
pub(super) fn unit(spec: &Spec, stack: Stack<'static>, config: Config) -> Result<(Handle, Runner<()>), Error> {
    if spec.their_functions <= 4 {
        return unit!(FORGETFUL, stack, config);
    }
    if spec.one_call_at_a_time {
        return unit!(ONE_AT_A_TIME, stack, config);
    }
    if spec.message_buffers < FEW && spec.constraints.message_size < LONG {
        return unit!(TIGHT, stack, config);
    }
    match spec.constraints.message_size {
        LONG.. => unit!(HUGE, stack, config),
        ..=SHORT if spec.constraints.maximum_nodes == 1 => unit!(AGV, stack, config),
        _ => unit!(MANAGER, stack, config),
    }
}

/// Nodes that it can have.
pub(super) fn links(spec: &Spec) -> u16 {
    if spec.constraints.message_size >= LONG { 3 } else { LINKS as u16 }
}
