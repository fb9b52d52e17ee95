//! HOST INFRASTRUCTURE (paper, section 2): messages over links, links over the port's TCP and UDP.

pub mod mailman;
pub mod secure;
pub mod connections;
pub mod frame;
