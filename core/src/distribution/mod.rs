//! DISTRIBUTION (paper, section 2): the IDL, the encoding of messages, discovery and the table of nodes.

pub mod identity;
