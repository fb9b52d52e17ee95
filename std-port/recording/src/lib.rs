//! Recordings of what a manager reports, as MCAP files: [`Recorder`] writes them in a thread of its own, [`Ring`] keeps the last
//! minutes in memory, [`Reading`] reads them, and `layout` says which answer of a control socket becomes which message of which channel.

mod file;
mod layout;
mod reading;
mod recorder;
mod ring;
mod stage;

#[cfg(test)]
mod tests;

pub use file::{Limits, StartError};
pub use layout::{event_of, values};
pub use reading::{Damage, End as ReadingEnd, Message, Reading};
pub use recorder::{Outcome, Recorder};
pub use ring::{Line, Ring, write};
pub use stage::Stage;

/// What a program that reads a recording finds in its header.
const LIBRARY: &str = concat!("cara ", env!("CARGO_PKG_VERSION"));
