//! DISTRIBUTION (paper, section 2): the IDL, the encoding of messages, discovery and the table of nodes.

pub mod identity;
pub mod block;
pub mod function;
pub mod function_list;
pub mod parameters;
pub mod text;
pub mod value;
