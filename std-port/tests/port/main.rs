//! The port over real sockets on loopback, one file per topic.
//!
//! Each test has a random fleet of its own, so that they run side by side. Waiting is waiting for a condition, with an
//! end; nothing is assumed to have happened because time has passed.

#[cfg(feature = "access")]
mod access;
mod actuators;
#[cfg(feature = "async")]
mod asynchronous;
mod authority;
mod callbacks;
mod claims;
mod clocks;
mod constraints;
mod details;
mod growing;
mod handlers;
mod hearts;
mod hosts;
mod in_use;
mod junk;
#[path = "../keyed/mod.rs"]
mod keyed;
mod latches;
mod leases;
mod many;
mod members;
mod orders;
mod outcomes;
mod processes;
mod readers;
mod standby;
mod stopping;
mod stuck;
mod support;

mod threads;
mod typed;
