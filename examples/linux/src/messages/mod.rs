//! Messages of other systems as Rust structs, to be arguments, results or values of streams: copy what you need.
//!
//! The sizes in `#[size]` are examples. The longest of these messages have more bytes than the 32 KiB of
//! `Constraints::message_size`, which can be raised.
#![allow(missing_docs, reason = "fields mean what they mean in those systems")]

pub mod lif;
pub mod nav;
pub mod vda;

#[cfg(test)]
mod tests;
