//! State that all links of a unit share: known nodes, and the functions published to each.
//!
//! A session enters the hub through the [`Door`] in its [`Context`](super::Context) when a peer has introduced itself or shown
//! that it is alive. If another link is affected, [`Node::poll`] returns a command, which the port passes to
//! [`Session::direct`](super::session::Session::direct) after it has unlocked the hub.

use crate::distribution::connection_handler::Node;

use super::Port;
use super::publications::Publications;

/// A unit's membership and publications.
pub struct Hub<P: Port> {
    /// Finds nodes and decides which links are admitted.
    pub node: Node<P>,
    /// The functions published to each node.
    pub publications: Publications<P::Storage>,
}

/// A session's access to its hub. The hub itself implements it; a port with threads puts a lock around it. While the hub is lent,
/// no other lock is taken.
pub trait Door<P: Port> {
    /// Lends the hub.
    fn enter(&mut self, act: &mut dyn FnMut(&mut Hub<P>));
}

impl<P: Port> Door<P> for Hub<P> {
    fn enter(&mut self, act: &mut dyn FnMut(&mut Self)) {
        act(self);
    }
}
