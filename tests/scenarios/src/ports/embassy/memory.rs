//! The memory of boards: static on a controller, so here it is never given back.

use cara_core::error::Error;
use cara_embassy::line::Line;
use cara_embassy::{Config, Handle, Limits, Network, Runner, resources};
use cara_embassy_host::SOCKETS;

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

/// On a line.
const fn with_one_link(limits: Limits) -> Limits {
    Limits { links: 1, ..limits }
}

/// On a network.
const fn with_its_links(limits: Limits) -> Limits {
    limits
}

/// A unit in memory that suits its description, with as many links as its transport carries.
macro_rules! unit {
    ($links:ident, $limits:ident, $transport:expr, $config:expr) => {
        cara_embassy::new($transport, Box::leak(Box::new(<resources!((), $links($limits))>::new())), $config, ())
    };
    ($links:ident, $spec:expr => $transport:expr, $config:expr) => {{
        let Spec { constraints, their_functions, message_buffers, one_call_at_a_time, .. } = $spec;
        match constraints.message_size {
            _ if *their_functions <= 4 => unit!($links, FORGETFUL, $transport, $config),
            _ if *one_call_at_a_time => unit!($links, ONE_AT_A_TIME, $transport, $config),
            ..LONG if *message_buffers < FEW => unit!($links, TIGHT, $transport, $config),
            LONG.. => unit!($links, HUGE, $transport, $config),
            ..=SHORT if constraints.maximum_nodes == 1 => unit!($links, AGV, $transport, $config),
            _ => unit!($links, MANAGER, $transport, $config),
        }
    }};
}

type Made = Result<(Handle, Runner<()>), Error>;

/// A unit on a network.
pub(super) fn on_network(spec: &Spec, network: Network<SOCKETS>, config: Config) -> Made {
    unit!(with_its_links, spec => network, config)
}

/// A unit on a line.
pub(super) fn on_line(spec: &Spec, line: Line, config: Config) -> Made {
    unit!(with_one_link, spec => line, config)
}

/// Nodes that it can have.
pub(super) fn links(spec: &Spec) -> u16 {
    if spec.constraints.message_size >= LONG { 3 } else { LINKS as u16 }
}
