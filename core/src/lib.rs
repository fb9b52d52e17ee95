//! The core of CARA: discovery, links, requests and leases as state machines without IO.
//!
//! It has no operating system, allocator, clock, socket, thread or `unsafe`. A port lends it memory
//! ([`storage`]), the current time ([`time::Instant`]), random numbers and a [`Mailman`](host::mailman::Mailman) for bytes,
//! and polls it; time passes only through arguments. Three layers, of which each uses only those below it:
//!
//! - [`services`]: a [`Session`](services::unit::Session) is one link with a peer: requests, replies, published functions,
//!   leases, access control;
//! - [`distribution`]: a [`Node`](distribution::connection_handler::Node) finds peers and decides which links are dialled,
//!   accepted and refused; functions, parameters and messages and their encoding;
//! - [`host`]: frames, chunks, send queues and the interface of the cipher.
//!
//! Limits are in [`config`], errors in [`error`]. Applications use a port, such as `cara-std` or `cara-embassy`.
//! `docs/porting.md` shows how one is written, `ARCHITECTURE.md` where everything is.
#![no_std]

#[cfg(test)]
extern crate std;

mod bytes;
pub mod config;
pub mod counters;
pub mod error;
#[macro_use]
mod fmt;
pub mod random;
pub mod storage;
pub mod time;

pub mod distribution;
pub mod host;
pub mod services;
