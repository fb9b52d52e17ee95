//! A warehouse of vehicles: the example that shows all of CARA. See its README for how to run it. What a vehicle is, and what
//! the units offer each other, is in [`cara_apps::warehouse`]: the emulated board has it as well.
//!
//! | module | answers |
//! |---|---|
//! | [`map`], [`orders`], [`text`] | what the files say, and what is wrong in them |
//! | [`distances`], [`plan`] | who goes where next |
//! | [`network`] | who the units are |
//! | [`vehicle`], [`host`], [`manager`], [`mechanic`] | the units, each kind a process |
//! | [`places`] | gates, lifts and crossings of several managers |
//! | [`book`] | what outlives a manager |
//! | [`faults`], [`run`] | what is broken in a run, and what came of it |

pub mod book;
pub mod distances;
pub mod faults;
pub mod files;
pub mod host;
pub mod manager;
pub mod map;
pub mod mechanic;
pub mod network;
pub mod orders;
pub mod places;
pub mod plan;
pub mod run;
pub mod text;
pub mod vehicle;
