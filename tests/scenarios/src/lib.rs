//! Every rule of CARA as a scenario: written once, run on the simulator, on Linux over loopback, on boards with embassy-net on
//! a switch in memory, and on two boards on a serial line.
//!
//! A [`Scenario`] is a function of a [`World`]: it builds a fleet in a few lines, lets time pass, injects faults, and
//! asserts what the rule says. `cargo test` runs each once on every port that can; the program `seeds` runs each for
//! many seeds on the simulator with faults on; `table` writes `docs/scenarios.md`.
//!
//! ```
//! use cara_scenarios::{Spec, Service, ports, secs};
//! let mut world = ports::simulator(1, cara_scenarios::FaultProfile::Rough, cara_core::config::Mode::Secured);
//! let world = &mut *world;
//! let manager = world.add(Spec::manager("manager", 1));
//! world.add(Spec::agv("agv", 7).service(&Service::new("ping()")));
//! world.wait("the AGV offers ping", || manager.knows("agv", "ping"), secs(20));
//! ```

mod measured;
pub mod ports;
pub mod recorded;
mod rules;
pub mod run;
mod scenario;
mod service;
mod spec;
pub mod suite;
pub mod table;
mod unknown_client;
mod values;
mod world;

pub use measured::measurements;
pub use rules::all;
pub use scenario::{FaultProfile, Need, Scenario};
pub use service::{Asked, CallLog, Gate, Service};
pub use spec::{Spec, SpecRole};
pub use unknown_client::UnknownClient;
pub use values::{boxed, millis, number, numbers, position, secs, text, variable};
pub use world::{Fault, Heart, Node, Pending, PendingAll, Port, Seen, Unit, Unsupported, Watched, World};
