//! State shared by the links of a unit: known nodes, and the functions published to each.
//!
//! A session enters the hub by itself, through the [`Door`] in its [`Context`](super::Context), when a peer has
//! introduced itself or has shown that it is alive. Effects on another link, the port takes from [`Node::poll`] and
//! passes on with [`Session::direct`](super::session::Session::direct), while it does not hold the hub.

use crate::distribution::connection_handler::Node;

use super::Port;
use super::publications::Publications;

/// One unit's membership and publications.
pub struct Hub<P: Port> {
    /// Finds nodes and decides which links are taken.
    pub node: Node<P>,
    /// The functions published to each node.
    pub publications: Publications<P::Storage>,
}

/// The way of a session to its hub. The hub itself is one; a port that shares it between threads locks it, and nothing is
/// locked inside.
pub trait Door<P: Port> {
    /// Lends the hub.
    fn enter(&mut self, act: &mut dyn FnMut(&mut Hub<P>));
}

impl<P: Port> Door<P> for Hub<P> {
    fn enter(&mut self, act: &mut dyn FnMut(&mut Self)) {
        act(self);
    }
}
