//! Attackers on real sockets. Nothing here is a unit: an attacker speaks the wire through raw sockets, and has of CARA
//! only what writes valid frames and codes, so that it can write nearly valid ones.
//!
//! - [`speaker`]: one end of a link, step by step, with whatever key;
//! - [`ground`]: the keys of a fleet, and those that an attacker may have instead;
//! - [`target`]: what is attacked; [`linux`] has units of the Linux port;
//! - [`links`]: the attacks on links; they know of a target only what [`target::Target`] tells;
//! - [`between`]: an attacker between two genuine ends; [`discovery`], [`kept_away`], [`floods`] and [`permission`]: the other
//!   attacks;
//! - [`tally`]: attempts, successes, and the counters that tell of them.

pub mod between;
pub mod diary;
pub mod discovery;
pub mod floods;
pub mod ground;
pub mod kept_away;
pub mod links;
pub mod linux;
pub mod permission;
pub mod speaker;
pub mod tally;
pub mod target;
pub mod trial;
