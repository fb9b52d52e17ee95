//! A port of CARA directly on smoltcp, for programs without an executor, threads or an allocator: the example to start
//! from for a new transport. `docs/porting.md` goes through it step by step.
//!
//! It has one s_unit with one link. The program owns clock, network device and main loop, and calls
//! [`SUnit::poll`] in it, which never blocks; the unit calls the program back through [`Program`]. It
//! never waits, is never a manager, and runs handlers only inside of `poll`.
//!
//! ```no_run
//! use cara_core::distribution::connection_handler::Target;
//! use cara_core::distribution::function::{Attributes, Definition};
//! use cara_core::distribution::function_list::Slot;
//! use cara_core::distribution::hello::Manager;
//! use cara_core::distribution::parameters::ParametersView;
//! use cara_core::error::ServiceError;
//! use cara_core::services::session::Incoming;
//! use cara_core::time::Instant;
//! use cara_smoltcp::{Program, Resources, SUnit, Outcome, Settings};
//!
//! struct Agv([i64; 2]);
//!
//! impl Program for Agv {
//!     fn serve(&mut self, _: &Incoming, position: &mut ParametersView) -> Outcome {
//!         Outcome::Now(position.set_value("position", self.0).map_err(|_| ServiceError::BadResults))
//!     }
//!     fn make_safe(&mut self, _: Slot) {}
//! }
//!
//! # fn now() -> Instant { Instant::START }
//! # fn run(mut device: impl smoltcp::phy::Device, resources: &'static mut Resources, epoch: u64) {
//! let manager = Manager::new("AGV_manager", 1).expect("a name");
//! let settings = Settings::new("agv-07", 7, Target::Manager(manager), [10, 0, 0, 7], 24, epoch).expect("a name");
//! let mut unit = SUnit::new(now(), settings, [2, 0, 0, 0, 0, 7], &mut device, resources);
//! let pos_info = Definition::parse("pos_info() -> (position: int[2])").expect("a signature");
//! unit.offer(now(), &pos_info, Attributes::default(), None).expect("room for one");
//! let mut agv = Agv([3, 4]);
//! loop {
//!     let due = unit.poll(now(), &mut device, &mut agv);
//!     // Do the program's own work; sleep until `due` or the device's interrupt.
//!     # let _ = due;
//! }
//! # }
//! ```
#![no_std]

mod links;
mod program;
mod resources;
mod settings;
mod stack;
mod unit;

pub use program::{Outcome, Program};
pub use resources::Resources;
pub use settings::Settings;
pub use unit::SUnit;
