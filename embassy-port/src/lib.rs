//! CARA on microcontrollers: s_units and m_units over embassy-net.
//!
//! [`new`] makes a unit from a network stack and static memory ([`resources!`], as much as its [`Limits`] say): a
//! [`Handle`], which every task may copy, and a [`Runner`], which wants a task of its own and drives everything. Nothing
//! allocates, and nothing is sized at run time.
//!
//! ```no_run
//! use cara_core::services::lease::Lease;
//! use cara_core::time::Duration;
//! use cara_embassy::{Config, Handle, Handler, Limits, Network, Runner, Security, ServiceOptions, resources};
//!
//! /// The application's state, which services get.
//! #[derive(Default)]
//! struct Agv { position: [i64; 2], target: Option<[i64; 2]> }
//!
//! /// Read by the motor's interrupt as well: `GO_TO.is_live(cara_embassy::now())`.
//! static GO_TO: Lease = Lease::new();
//!
//! /// `embassy_net::StackResources<{ LIMITS.sockets() }>` has the sockets for it, and goes to `cara_embassy::network`.
//! const LIMITS: Limits = Limits { message_size: 512, ..Limits::S_UNIT };
//! /// A static of it, `StaticCell<AgvResources>`, is made with `RESOURCES.init_with(Resources::new)`.
//! type AgvResources = resources!(Agv, LIMITS);
//!
//! fn start(
//!     network: Network<{ LIMITS.sockets() }>,
//!     resources: &'static mut AgvResources,
//!     security: Security,
//! ) -> Result<(Handle<Agv>, Runner<Agv>), cara_core::error::Error> {
//!     let config = Config::s_unit("agv-07", 7, "manager", 1, security)?;
//!     let (unit, runner) = cara_embassy::new(network, resources, config, Agv::default())?;
//!     let pos_info = Handler::method(&|agv: &mut Agv, _, p| Ok(p.set_value("position", agv.position)?));
//!     unit.my_function_list().add_service("pos_info() -> (position: int[2])", ServiceOptions::new(), pos_info)?;
//!     let forget: &'static cara_embassy::Hook<Agv> = &|agv| agv.target = None;
//!     // The hook makes safe, and waits for nothing; what needs the state comes after it.
//!     let leased = ServiceOptions::new().lease(Duration::from_millis(400), &GO_TO, &cut_power).then(forget);
//!     unit.my_function_list().add_service("go_to(position: int[2])", leased, Handler::task())?;
//!     unit.on_manager_lost(forget);
//!     unit.publish_my_function_list()?;
//!     Ok((unit, runner))
//! }
//!
//! fn cut_power() {
//!     // A pin, or a static that the motors' interrupt reads.
//! }
//!
//! /// A task that drives, and answers when the vehicle has arrived.
//! async fn drive(unit: Handle<Agv>) -> Result<(), cara_core::error::Error> {
//!     let mut parameters = cara_core::distribution::parameters::Parameters::new();
//!     loop {
//!         let call = unit.next_call("go_to", &mut parameters).await?;
//!         let target = parameters.variable::<[i64; 2]>("position")?;
//!         // … await the motors on their way to the target, as long as the lease is live …
//!         unit.with_state(|agv| agv.position = target)?;
//!         call.reply(Ok(&parameters)).await;
//!     }
//! }
//! ```
//!
//! If no task runs any more, the lease still stops the vehicle, since a motor's interrupt reads it; if a handler or a task
//! hangs, the watchdog resets the board. See `docs/boards.md`, "What stops the motors", and "Beside the unit" for what
//! interrupts and other cores may use.

#![no_std]

/// A log line through `defmt`, or nothing.
macro_rules! log {
    ($($arg:tt)*) => {{
        #[cfg(feature = "defmt")]
        ::defmt::info!($($arg)*);
        #[cfg(not(feature = "defmt"))]
        { let _ = ::core::format_args!($($arg)*); }
    }};
}

/// A warning, likewise.
macro_rules! warning {
    ($($arg:tt)*) => {{
        #[cfg(feature = "defmt")]
        ::defmt::warn!($($arg)*);
        #[cfg(not(feature = "defmt"))]
        { let _ = ::core::format_args!($($arg)*); }
    }};
}

mod calls;
mod config;
mod connection;
#[cfg_attr(not(feature = "details"), path = "no_details.rs")]
mod details;
mod driving;
mod event;
mod functions;
mod handle;
mod handler;
mod interfaces;
mod lease;
mod limits;
#[cfg(feature = "line")]
pub mod line;
mod link;
#[cfg(feature = "logs")]
mod log;
mod machine;
mod mail;
#[cfg(feature = "net")]
mod net;
mod owned;
mod peer;
mod port;
mod publishing;
#[cfg(feature = "streams")]
mod readings;
mod replies;
mod resources;
mod runner;
mod security;
#[cfg(feature = "streams")]
mod stream_cell;
#[cfg(feature = "streams")]
mod streams;
#[cfg(feature = "streams")]
mod subscriptions;
mod taken;
#[cfg(feature = "details")]
mod taking;
mod task_slots;
mod time;
mod waiting;

pub use calls::{CallError, Hold};
#[cfg(feature = "details")]
pub use cara_core::distribution::failure::Failure;
pub use cara_core::services::call::{Call, Held, Reply};
#[cfg(feature = "details")]
pub use cara_core::typed::TypedCall;
pub use cara_core::typed::{self, AnyCall, AsyncState, Variables};
#[cfg(feature = "derive")]
pub use cara_derive::{VariablesEmbassy as Variables, interface_embassy as interface};
pub use config::Config;
pub use event::{Name, UnitEvent};
pub use functions::MyFunctionList;
pub use handle::Handle;
pub use handler::{Free, Handler, Hook, Method, Safe, Served, ServiceOptions};
pub use interfaces::Actuator;
pub use lease::LeaseWatch;
pub use limits::Limits;
#[cfg(feature = "logs")]
pub use log::{LOG_BYTES, Log, LogCell, LogStream};
#[doc(hidden)]
pub use mail::Carrier;
pub use mail::Transport;
#[cfg(feature = "net")]
pub use net::{Network, network};
pub use peer::{Peer, TheirFunctionList};
#[cfg(feature = "streams")]
pub use readings::{SubscriptionCell, SubscriptionInner};
pub use resources::{Memory, Resources, new};
pub use runner::Runner;
pub use security::Security;
#[cfg(feature = "streams")]
pub use stream_cell::StreamCell;
#[cfg(feature = "streams")]
pub use streams::{Publisher, Stream};
#[cfg(feature = "streams")]
pub use subscriptions::Subscription;
pub use taken::TakenCall;
#[cfg(feature = "details")]
pub use taking::{LongCall, TypedTaken};
pub use time::now;
