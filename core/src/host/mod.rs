//! HOST INFRASTRUCTURE (paper, section 2): messages over links, links over the port's TCP and UDP.
//!
//! | module | paper's name | is |
//! |---|---|---|
//! | [`mailman`] | `Mailman` | the trait through which bytes leave; the port implements it |
//! | [`connections`] | `Connections` | one link: what waits to be written, and whether the peer is alive |
//! | [`frame`] | | frames of a stream, and the chunks of a message (`docs/wire.md`, sections 5 and 6) |
//! | [`secure`] | | the trait of the cipher, and plain mode; the crate `cara-secure` implements it with Noise |
//! | [`port`], [`endpoint`] | | the types that a port chooses: storage, cipher, address |
//!
//! This layer knows nothing of functions or requests: it carries whole messages in both directions.

pub mod connections;
pub mod endpoint;
pub mod frame;
pub mod line;
pub mod mailman;
pub mod port;
pub mod secure;
