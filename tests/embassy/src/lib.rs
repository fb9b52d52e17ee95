//! Boards without hardware: tasks of embassy's kind over embassy-net stacks, on an Ethernet switch in memory, all in
//! virtual time on one thread.
//!
//! A [`Bench`] is a switch with boards. Each [`Board`] has a network stack of its own, and tasks that end when it loses
//! power. Time stands still unless [`Bench::run_until`] lets it pass: it polls what was woken and jumps to the next
//! timer or frame. A [`Wire`] joins two boards by a serial line in place of the switch. Benches on several threads do not know of
//! each other, so tests run side by side.
//!
//! ```
//! use cara_core::time::Duration;
//! use cara_embassy_host::Bench;
//!
//! let bench = Bench::new(1);
//! let board = bench.board();
//! let stack = board.stack();
//! assert!(bench.run_until(|| stack.is_config_up() && stack.is_link_up(), Duration::from_secs(1)));
//! board.set_cable(false);
//! assert!(bench.run_until(|| !stack.is_link_up(), Duration::from_secs(1)));
//! ```

mod bench;
mod clock;
mod driver;
mod dropping;
mod gate;
mod security;
mod tasks;
mod values;
mod wire;

pub use bench::{Bench, Board, SOCKETS};
pub use cara_ethernet::{Fault, FaultCounts, Faults};
pub use clock::now;
pub use dropping::{dropping, hold, is_held};
pub use security::{keys, security};
pub use values::number;
pub use wire::{Wire, WireCounts};
