//! Vehicles of CARA under VDA 5050 2.0 and 2.1.

pub mod message;
