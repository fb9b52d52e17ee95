//! The memory of boards: static on a controller, so here it is never given back.

use cara_core::error::Error;
use cara_embassy::{Config, Handle, Resources, Runner, message_buffer};
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

const SMALL: usize = message_buffer(SHORT);
const HUGE: usize = message_buffer(128 * 1024);
const LARGE: usize = message_buffer(32 * 1024);

type Agv = Resources<(), 2, SMALL, FEW, 4096, 16, 48, 10, 4, 8_192>;
type Manager = Resources<(), LINKS, LARGE, 12, 8192, 32, 48, 66, 4, 90_000>;
type Forgetful = Resources<(), LINKS, LARGE, 12, 8192, 32, 4, 66, 4, 90_000>;
type Tight = Resources<(), LINKS, LARGE, 2, 8192, 32, 48, 66, 4, 90_000>;
/// For messages that are not for boards at all.
type Huge = Resources<(), 3, HUGE, 3, 8192, 8, 8, 66, 1, 130_000>;

macro_rules! unit {
    ($memory:ty, $stack:expr, $config:expr) => {
        cara_embassy::new($stack, Box::leak(Box::new(<$memory>::new())), $config, ())
    };
}

/// A unit in memory that suits its description.
pub(super) fn unit(spec: &Spec, stack: Stack<'static>, config: Config) -> Result<(Handle, Runner<()>), Error> {
    if spec.their_functions <= 4 {
        return unit!(Forgetful, stack, config);
    }
    if spec.message_buffers < FEW && spec.constraints.message_size < LONG {
        return unit!(Tight, stack, config);
    }
    match spec.constraints.message_size {
        LONG.. => unit!(Huge, stack, config),
        ..=SHORT if spec.constraints.maximum_nodes == 1 => unit!(Agv, stack, config),
        _ => unit!(Manager, stack, config),
    }
}

/// Nodes that it can have.
pub(super) fn links(spec: &Spec) -> u16 {
    if spec.constraints.message_size >= LONG { 3 } else { LINKS as u16 }
}
