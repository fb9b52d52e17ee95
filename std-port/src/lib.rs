//! CARA on Linux: the paper's `Communication_System` and `Unit` over sockets and threads.
//!
//! A manager is a [`CommunicationSystem`], a vehicle a [`Unit`]. Their handles can be used from any thread. A few threads of
//! the unit read all links and run handlers; the thread that waits for a reply reads it itself. All rules are in `cara-core`:
//! this crate gives it sockets, time, threads and files.
//!
//! Units prove their identity, and encrypt and authenticate their frames. A unit's [keys] are in a file that `cara keys`
//! makes; without one, building the unit is an error that names the command. [`Builder::insecure`] opts out.
//!
//! A vehicle and its manager share a trait, of which [`interface`](macro@interface) makes a server and a client:
//!
//! ```no_run
//! use std::time::Duration;
//! use cara_std::{CommunicationSystem, Unit, interface};
//!
//! #[interface]
//! trait Agv {
//!     /// Tells its charge in percent.
//!     #[returns(percent)]
//!     fn battery(&mut self) -> i64;
//! }
//!
//! struct Vehicle {
//!     charge: i64,
//! }
//!
//! impl Agv for Vehicle {
//!     fn battery(&mut self) -> i64 {
//!         self.charge
//!     }
//! }
//!
//! let vehicle = Unit::builder("agv-17", 17, "depot", 1)?.state(Vehicle { charge: 80 }).build()?;
//! vehicle.my_function_list().serve(AgvServer)?;
//! vehicle.publish_my_function_list()?;
//! vehicle.start()?;
//!
//! let depot = CommunicationSystem::new("depot", 1)?;
//! depot.start()?;
//! let agv = depot.wait_for_s_unit("agv-17", Duration::from_secs(10))?;
//! agv.wait_for_function("battery", Duration::from_secs(10));
//! println!("{} %", AgvClient::at(&agv).battery().wait()?);
//! # Ok::<(), Box<dyn std::error::Error>>(())
//! ```
//!
//! What moves has a lease and a heart: see [`Heart`] and [`Actuator`]. Values that change are streams: see [`Stream`].
//!
//! Functions can also be named and found at run time, as in the paper's listing:
//!
//! ```no_run
//! use cara_std::{CommunicationSystem, Parameters};
//!
//! let agv_manager = CommunicationSystem::new("AGV_manager", 1)?;
//! agv_manager.start()?;
//! while agv_manager.number_of_s_units() < 1 {
//!     agv_manager.broadcast();
//!     std::thread::sleep(std::time::Duration::from_secs(2));
//! }
//! print!("{}", agv_manager.s_units()[0].their_function_list().show_functions());
//! let mut pos = Parameters::new();
//! pos.add_int("position", 2)?;
//! agv_manager.s_units()[0].block_request("pos_info", &mut pos)?;
//! # Ok::<(), cara_std::BuildError>(())
//! ```

pub mod access;
mod actuator;
#[cfg(feature = "async")]
pub mod asynchronous;
mod authority;
mod builder;
mod claims;
mod clock;
mod communication_system;
mod config;
#[cfg(feature = "control")]
pub mod control;
mod engine;
mod error;
mod event;
mod executor;
mod file_name;
mod growing;
mod handle;
mod handler;
mod heart;
mod interfaces;
pub mod keys;
mod latch;
mod lease;
mod line_queue;
mod locks;
mod log;
#[cfg(feature = "metrics")]
pub mod metrics;
mod my_function_list;
mod name_and_id;
mod news;
mod occupancy;
mod peer;
mod pool;
mod safe_hook;
mod seldom;
mod storage;
mod stream;
pub mod survey;
#[doc(hidden)]
pub mod sys;
#[cfg(test)]
mod testing;
mod threads;
mod timers;
mod unit;

pub use actuator::Actuator;
#[cfg(feature = "async")]
pub use asynchronous::{CallGivenUp, EventStream, EventsLost, SampleStream};
pub use authority::{Authority, Key};
pub use builder::{BuildError, Builder};
pub use cara_core::config::{
    Constraints, DEPTH, HAND_OVER_TIMEOUT, Mode, PLAIN_PORT, Priority, SECURED_PORT, Scheduling,
};
pub use cara_core::distribution::claim::Claim;
pub use cara_core::distribution::connection_handler::{HandOverStage, NodeCounter};
pub use cara_core::distribution::failure::Failure;
pub use cara_core::distribution::function::{Attributes, Definition, Signature, VariableSpec, VariableSpecs};
pub use cara_core::distribution::hello::{Limits, Manager};
pub use cara_core::distribution::identity::{Epoch, Fleet, Identity, Role};
pub use cara_core::distribution::message::HandOverRefusal;
pub use cara_core::distribution::name::{Shown, is_hidden};
pub use cara_core::distribution::parameters::{
    Elements, Fields, ListWriter, Parameters, ParametersView, RecordWriter, Type, Value,
};
pub use cara_core::error::{Cause, CloseReason, Error, Limit, Refusal, ServiceError};
pub use cara_core::host::connections::LinkCounter;
pub use cara_core::services::call::{Call, Held, Reply};
pub use cara_core::services::heart::Renew;
pub use cara_core::services::lease::{ActuatorState, Ended, LastOrder, Latch, LeaseEnd, OrderOutcome, Stage};
pub use cara_core::services::requests::CallId;
pub use cara_core::services::session::{Delivery, RequestOptions};
pub use cara_core::time::Duration;
pub use cara_core::typed::{self, AnyCall, AsyncState, Mismatch, TypedCall, Variables};
#[cfg(feature = "derive")]
pub use cara_derive::{VariablesStd as Variables, interface_std as interface};
pub use communication_system::{CallToAll, CommunicationSystem, WeakSystem};
pub use config::Capacities;
pub use engine::clocks::ClockOffset;
pub use engine::details::Canceller;
pub use engine::rerun::{Rerun, RerunError, rerun};
pub use error::{CallError, HandOverError, StartError};
pub use event::{Finding, UnitEvent};
pub use file_name::escape as file_name;
pub use growing::{CallParameters, GrowingParameters};
pub use handle::{Handle, MUnit, SUnit, WeakHandle};
pub use handler::{IntoHandler, Served, ServiceOptions};
pub use heart::{Heart, Hold};
pub use lease::{LeaseEnded, LeaseWatch};
pub use line_queue::LineQueue;
pub use log::Log;
pub use my_function_list::MyFunctionList;
pub use name_and_id::NameAndId;
pub use peer::{Peer, TheirFunction, TheirFunctionList};
pub use stream::{Publisher, Relay, Sample, Stream, Subscription, TheirStream};
pub use sys::interfaces::{Interface, Interfaces};
pub use threads::Threads;
pub use unit::{Unit, WeakUnit};
