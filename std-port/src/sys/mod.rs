//! The few system calls of the port, each behind a safe type: readiness, TCP streams, UDP datagrams, interfaces.
//!
//! It is public for this repository's tests, and no part of the port's interface. Nothing here knows the protocol, starts a thread or holds a lock across a call that may block.

pub(crate) mod alarm;
pub mod datagram;
pub mod epoll;
pub mod interfaces;
pub mod limits;
mod spinning;
pub(crate) mod stream;

use std::hash::{BuildHasher, Hasher, RandomState};

use cara_core::time::Duration;
use rustix::time::Timespec;

/// A span, or a time since the start of a clock, as the kernel takes it; [`Duration::MAX`] and the like become the longest span that it can hold.
fn timespec(span: Duration) -> Timespec {
    let micros = span.as_micros();
    Timespec {
        tv_sec: i64::try_from(micros / 1_000_000).unwrap_or(i64::MAX),
        tv_nsec: i64::try_from((micros % 1_000_000).saturating_mul(1_000)).unwrap_or(0),
    }
}

/// Bits that differ from process to process and from call to call, without a dependency for them.
pub(crate) fn random() -> u64 {
    RandomState::new().build_hasher().finish()
}
