//! DISTRIBUTION (paper, section 2): the IDL, the encoding of messages, discovery and the table of nodes.

mod attributes;
pub mod authenticator;
pub mod block;
pub mod claim;
pub(crate) mod compact;
pub mod connection_handler;
mod control;
pub mod datagram;
mod display;
mod element;
#[cfg(feature = "details")]
pub mod failure;
pub mod function;
pub mod function_list;
pub mod hello;
mod help;
pub mod identity;
pub mod items;
pub mod latch;
pub mod message;
pub mod name;
pub mod nested;
pub mod parameters;
pub mod presence;
mod table;
pub mod text;
pub mod typed;
pub mod value;
mod writer;
