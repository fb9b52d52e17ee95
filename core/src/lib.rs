//! The core of CARA: state machines for calling services between AGVs and their managers, which a port polls.
//!
//! It decides everything that both ends must agree on: which nodes are found and admitted, what may be called, how long a call
//! or a motion lasts. It has no sockets, clock, threads, allocator or `async`, and forbids `unsafe`. A program uses a port
//! (`cara-std`, `cara-embassy`, the simulator); this crate is for authors of ports.
//!
//! # Layers
//! Each layer calls the one below; results come up as return values.
//!
//! | layer (paper, section 2) | holds |
//! |---|---|
//! | [`services`] | one link's conversation ([`Session`]), requests, calls, leases, access, publications |
//! | [`distribution`] | parameters, signatures, function lists, messages, discovery and membership ([`Node`]) |
//! | [`host`] | links: frames, chunks, liveness; the traits [`Mailman`] and [`Secure`](host::secure::Secure) |
//!
//! Beside them stand [`config`], [`error`], [`time`] and [`storage`], which every layer may use.
//!
//! # From one application to the other
//! ```text
//! request -> function list (find, check) -> message (encode in place) -> link -> frame -> Mailman => network
//! network => Session::receive -> frame -> link -> message (decode, borrowed) -> Event::Incoming | Event::Reply | …
//! ```
//!
//! # Polling
//! The port calls a state machine when bytes have arrived, when a stream can be written to again, and at its deadline. Each
//! call is lent the time and everything else that it may touch, in a [`Context`]. After each call the port takes events until
//! there are none, and asks for the next deadline. A session that is not polled keeps its state and sends nothing.
//!
//! ```
//! use cara_core::time::Instant;
//! use cara_core::{Context, Event, Port, Session};
//!
//! /// Does what is due on a link; returns when to call it again.
//! fn poll<P: Port>(session: &mut Session<P>, cx: &mut Context<'_, P>) -> Instant {
//!     while let Some(event) = session.poll(cx) {
//!         match event {
//!             Event::LeaseExpired(_function) => { /* its safe hook, before anything else */ }
//!             Event::Closed(_reason) => { /* close the stream, tell the node that it left */ }
//!             _ => { /* replies, news: to the application */ }
//!         }
//!     }
//!     session.deadline()
//! }
//!
//! /// Passes received bytes to a session; returns how many it consumed. Pass the rest again later.
//! fn read<P: Port>(session: &mut Session<P>, cx: &mut Context<'_, P>, bytes: &mut [u8]) -> usize {
//!     let receipt = session.receive(cx, bytes, None);
//!     if let Some(Event::Reply(_call, Ok(results))) = receipt.event {
//!         let _block = session.results(&results, bytes); /* to its caller */
//!     }
//!     receipt.consumed
//! }
//! ```
//!
//! The whole contract is on the front page of [`services`], the way to a new port in `docs/porting.md`, and the bytes that
//! travel in `docs/wire.md`.
#![no_std]

#[cfg(test)]
extern crate std;

pub mod ability;
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

pub use distribution::connection_handler::Node;
pub use distribution::function::{Definition, Signature};
pub use distribution::identity::Identity;
pub use distribution::parameters::{Parameters, ParametersView};
pub use error::{Error, ServiceError};
pub use host::mailman::Mailman;
pub use services::hub::Hub;
pub use services::session::{Event, Session};
pub use services::typed;
pub use services::typed::{AnyCall, AsyncState, TypedCall, Variables};

#[cfg(feature = "derive")]
pub use cara_derive::{Variables, interface};
pub use services::{Context, Port};
