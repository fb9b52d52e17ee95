//! Attackers on real sockets. No attacker is a unit: each speaks the wire protocol through raw sockets, and takes from
//! CARA only the encoders of frames and codes, so that what it sends is valid, or nearly.
//!
//! - [`speaker`]: one end of a link, step by step, with any key;
//! - [`ground`]: the keys of a fleet, and those that an attacker may have instead;
//! - [`target`]: the unit under attack; [`linux`] has those of the Linux port;
//! - [`links`]: the attacks on links; they know of a target only what [`target::Target`] tells;
//! - [`between`]: an attacker between two genuine ends; [`discovery`], [`kept_away`], [`floods`] and [`permission`]: the other
//!   attacks;
//! - [`tally`]: attempts, successes, and the counters that record them.

pub mod between;
pub mod discovery;
pub mod event_log;
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
