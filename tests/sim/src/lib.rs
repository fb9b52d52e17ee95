//! A network that exists only in memory, on a clock that only moves when something happens.
//!
//! It is for testing what a fleet does when links, power or processes fail: hours of virtual time pass in seconds, a
//! run depends on nothing but its seed, and a failing seed can be replayed step by step. It opens no socket, starts no
//! thread and reads no clock.
//!
//! [`Network`] has hosts, datagrams, streams and timers, and does to them what networks do: loss, delay, jitter,
//! reordering, duplication, limited bandwidth, partitions, frozen links, crashes, changed addresses. Each injected
//! fault is counted by its name in [`FaultCounts`]. [`FaultPlan`] draws random schedules of faults from a seed.
//!
//! ```
//! use cara_sim::{NetEvent, Network};
//!
//! let mut network = Network::new(1);
//! let (agv, manager) = (network.add_host(), network.add_host());
//! network.listen(manager, 7000);
//! let mut address = network.address(manager);
//! address.set_port(7000);
//! network.connect(agv, address);
//! let mut heard = Vec::new();
//! while let Some(event) = network.next_event() {
//!     match event {
//!         NetEvent::Connected { stream, .. } => assert_eq!(network.write(stream, &[b"hello"]), Ok(5)),
//!         NetEvent::Readable { stream, .. } => {
//!             network.read(stream, |bytes| {
//!                 heard.extend_from_slice(bytes);
//!                 bytes.len()
//!             });
//!         }
//!         _ => (),
//!     }
//! }
//! assert_eq!(heard, b"hello");
//! ```

mod event;
mod faults;
mod network;
mod path;
mod pipe;
mod plan;
mod queue;
mod storage;
mod world;

pub use event::{HostId, NetEvent, StreamId};
pub use faults::{Fault, FaultCounts};
pub use network::{Broken, Direction, Network};
pub use path::{Chance, Path};
pub use plan::{Action, Crash, FaultPlan};
pub use storage::Boxed;
pub use world::{
    BoxedParameters, Call, NewUnit, Outcome, Peer, Service, UnitEvent, UnitHandle, World, boxed_parameters, seeds,
};
