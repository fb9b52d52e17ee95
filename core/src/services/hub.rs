//! State shared by the links of a unit: known nodes, and the functions published to each.
//!
//! A session enters the hub by itself, through the [`Door`] in its [`Context`](super::Context), when a peer has
//! introduced itself or has shown that it is alive. Effects on another link, the port takes from [`Node::poll`] and
//! passes on with [`Session::direct`](super::unit::Session::direct), while it does not hold the hub.

use crate::distribution::connection_handler::Node;
use crate::storage::Storage;

use super::publications::Publications;

/// One unit's membership and publications.
pub struct Hub<S: Storage> {
    /// Finds nodes and decides which links are taken.
    pub node: Node<S>,
    /// The functions published to each node.
    pub publications: Publications<S>,
}

/// The way of a session to its hub. The hub itself is one; a port that shares it between threads locks it, and nothing is
/// locked inside.
pub trait Door<S: Storage> {
    /// Lends the hub.
    fn enter(&mut self, act: &mut dyn FnMut(&mut Hub<S>));
}

impl<S: Storage> Door<S> for Hub<S> {
    fn enter(&mut self, act: &mut dyn FnMut(&mut Self)) {
        act(self);
    }
}
