//! Distribution (paper, section 2): the IDL, the encoding of messages, discovery and the table of nodes.
//!
//! | modules | paper's name | are |
//! |---|---|---|
//! | [`parameters`], [`value`], [`nested`], [`typed`] | `Parameters` | variables by name, and Rust types that are variables |
//! | [`function`], [`function_list`], [`text`] | `Function`, `Function_list` | signatures, lists of functions, and a signature's text |
//! | [`block`], [`message`], [`items`], [`hello`], [`datagram`] | | what travels, byte by byte: `docs/wire.md`, sections 1, 3, 7, 9 and 10 |
//! | [`connection_handler`] | `Connection_handler` | discovery, admission, and the table of nodes |
//! | [`claim`], [`latch`], [`presence`] | | which manager commands, what is stopped, and that an identity runs only once |
//!
//! A block of parameters has the same layout in memory and on the wire, so a received message is read in place without copying.
//! Numbers in items are varints as in [postcard](https://postcard.jamesmunns.com/wire-format).

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
mod spec;
mod table;
pub mod text;
pub mod typed;
pub mod value;
mod writer;
