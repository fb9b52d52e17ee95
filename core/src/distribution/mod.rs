//! DISTRIBUTION (paper, section 2): the IDL, the encoding of messages, discovery and the table of nodes.

pub mod block;
pub mod function;
pub mod function_list;
pub mod identity;
pub mod message;
pub mod parameters;
pub mod text;
pub mod value;
mod attributes;
mod element;
mod name;
mod table;
