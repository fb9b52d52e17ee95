//! HOST INFRASTRUCTURE (paper, section 2): messages over links, links over the port's TCP and UDP.

pub mod connections;
pub mod endpoint;
pub mod frame;
pub mod mailman;
pub mod port;
pub mod secure;
