//! Vehicles of CARA under VDA 5050 2.0, 2.1 and, as a preview, 3.0.
//!
//! [`machine`] decides, and has no I/O: orders ([`order`]), actions ([`actions`]), errors ([`errors`]) and the state that is reported
//! ([`state`]), by the rules of a [`version`]. [`driver`] writes its record ([`record`]) and tells the vehicle ([`vehicle`], [`stretch`]), [`mqtt`] and [`tls`] are the broker, [`gateway`] joins
//! them, [`recording`] records what goes over it, [`config`] is its file, [`metrics`] is for Prometheus. `docs/vda5050.md` says what of the standard is there.

pub mod actions;
pub mod config;
pub mod driver;
pub mod errors;
pub mod gateway;
pub mod log;
pub mod machine;
pub mod message;
pub mod metrics;
pub mod mqtt;
pub mod order;
pub mod record;
pub mod recording;
pub mod state;
pub mod stretch;
pub mod tls;
pub mod vehicle;
pub mod version;
