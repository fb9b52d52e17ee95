//! A simulator of whole fleets: the real core of CARA on a network that exists only in memory and a clock that only
//! moves when something happens.
//!
//! It is for testing what a fleet does when links, power or processes fail: hours of virtual time pass in seconds, a
//! run depends on nothing but its seed, and a failing seed can be replayed step by step. It opens no socket, starts no
//! thread by itself and reads no clock. It does not measure speed: computing takes no virtual time.
//!
//! # A fleet
//! ```
//! use cara_core::distribution::parameters::Parameters;
//! use cara_core::error::Error;
//! use cara_core::time::Duration;
//! use cara_sim::{Crash, Service, World};
//!
//! let mut world = World::new(1);
//! let manager = world.m_unit("manager", 1).start();
//! let agv = world.s_unit("agv", 7).joins("manager", 1);
//! let agv = agv.program(|unit| {
//!     let pos_info = Service::new(|_, parameters| {
//!         parameters.set_value("position", [3, 4]).expect("the signature declares it");
//!         Ok(())
//!     });
//!     unit.my_function_list().add_service("pos_info() -> (position: int[2])", pos_info).unwrap();
//!     unit.publish_my_function_list().unwrap();
//! });
//! let agv = agv.start();
//! assert!(world.run_until(|_| manager.knows("agv", "pos_info"), Duration::from_secs(5)));
//!
//! let mut pos = Parameters::new();
//! pos.add_int("position", 2).unwrap();
//! world.block_request(&manager, "agv", "pos_info", &mut pos).unwrap();
//! assert_eq!(pos.variable("position"), Ok([3, 4]));
//!
//! world.crash(&agv, Crash::PowerCut);
//! assert_eq!(world.block_request(&manager, "agv", "pos_info", &mut pos), Err(Error::TimedOut));
//! world.restart(&agv);
//! assert!(world.run_until(|_| agv.is_connected(&manager), Duration::from_secs(10)));
//! ```
//!
//! - [`World`] makes units, runs them and injects faults; nothing moves unless it is told to run.
//! - [`UnitHandle`] has what the real ports have, in the same words; what blocks there is a future here.
//! - [`Service`] is a closure or a future, with priority, lease and safe hook; it may sleep, and call any unit back. What
//!   several services move is an [`Actuator`]; a caller's loop has a [`Heart`].
//! - A program ([`NewUnit::program`]) runs at each start of its unit, so that a restart loses what a real one loses.
//! - [`LogEvent`]s tell what each unit saw, with its time.
//!
//! If a test panics, its world prints the seed; `CARA_SIM_SEED=…` replays it. [`seeds`] and [`for_each_seed`] run a
//! test over many seeds; `CARA_SIM_SEEDS=…` says over how many.
//!
//! # The network
//! [`Network`] has hosts, datagrams, streams and timers, and does to them what networks do: loss, delay, jitter,
//! reordering, duplication, limited bandwidth, partitions, frozen links, crashes, changed addresses. Each injected
//! fault is counted by its name in [`FaultCounts`], so that one that was never injected shows. [`FaultPlan`] draws
//! random schedules of faults from a seed. It can be used by itself:
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
//!
//! Streams are simpler than TCP: no congestion control and no fast retransmission, so a lost segment costs 200 ms and
//! more; headers cost no bandwidth; each direction between two hosts has a bandwidth of its own.

mod event;
mod faults;
mod hub;
mod network;
mod path;
mod pipe;
mod plan;
mod queue;
mod storage;
mod world;

pub use event::{HostId, NetEvent, StreamId};
pub use faults::{Fault, FaultCounts};
pub use hub::hub;
pub use network::{Broken, Direction, Network};
pub use path::{Chance, Path};
pub use plan::{Action, Crash, FaultPlan};
pub use storage::Boxed;
pub use world::{
    Actuator, BoxedParameters, CallError, Heart, Hold, LeaseWatch, LogEvent, MyFunctionList, NewUnit, Outcome, Peer,
    Ring, Sample, Served, Service, Storing, UnitEvent, UnitHandle, Watched, World, boxed_parameters, for_each_seed,
    seeds,
};
