//! Vehicles of CARA under VDA 5050 2.0 and 2.1.

pub mod actions;
pub mod errors;
pub mod machine;
pub mod message;
pub mod order;
pub mod state;
