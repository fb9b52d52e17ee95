//! Recordings of what a manager reports, as MCAP files: [`Recorder`] writes them in a thread of its own, [`Ring`] keeps the last
//! minutes in memory, [`Reading`] reads them, and [`layout`] says which answer of a control socket becomes which message of which channel.

mod file;
mod layout;
mod reading;
mod recorder;
mod ring;
mod stage;

#[cfg(test)]
mod tests;

pub(crate) use file::Limits;
pub(crate) use layout::event_of;
pub(crate) use reading::{End as ReadingEnd, Reading};
pub(crate) use recorder::Recorder;
pub(crate) use ring::{Line, Ring, write};
pub(crate) use stage::Stage;

/// What a program that reads a recording finds in its header.
const LIBRARY: &str = concat!("cara ", env!("CARGO_PKG_VERSION"));
