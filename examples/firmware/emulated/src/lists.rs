//! For test images only: a service that takes an order with lists, as large as a board's `Limits::arguments` has room for.

use cara_core::error::Error;
use cara_embassy::{Variables, interface};
use cara_vehicle::{Agv, Vehicle};
use heapless::{String, Vec};

/// What is to be done in a place or on a way.
#[derive(Variables)]
pub struct Action {
    kind: String<8>,
    id: u32,
}

/// A place of an order.
#[derive(Variables)]
pub struct Node {
    id: String<8>,
    x: f32,
    y: f32,
    actions: Vec<Action, 1>,
}

/// A way from one place to the next.
#[derive(Variables)]
pub struct Edge {
    id: String<8>,
    actions: Vec<Action, 1>,
}

/// What the order comes to.
#[derive(Variables)]
pub struct Followed {
    /// Of the ways, first along x, then along y.
    length: f32,
    /// The sum of the actions' numbers.
    actions: u32,
    /// The last place.
    last: String<8>,
}

/// What the test image serves beside the AGV's services.
#[interface]
pub trait Follow {
    /// Tells what an order comes to; it drives nowhere.
    #[idempotent]
    fn follow(&mut self, nodes: Vec<Node, 3>, edges: Vec<Edge, 2>) -> Followed;
}

impl Follow for Agv {
    fn follow(&mut self, nodes: Vec<Node, 3>, edges: Vec<Edge, 2>) -> Followed {
        let ways = nodes.iter().zip(nodes.iter().skip(1));
        let length = ways.map(|(from, to)| (to.x - from.x).abs() + (to.y - from.y).abs()).sum();
        let actions = nodes.iter().flat_map(|node| &node.actions).chain(edges.iter().flat_map(|edge| &edge.actions));
        let last = nodes.last().map(|node| node.id.clone()).unwrap_or_default();
        Followed { length, actions: actions.map(|action| action.id).sum(), last }
    }
}

/// Offers it.
pub fn offer(vehicle: Vehicle) -> Result<(), Error> {
    vehicle.my_function_list().serve(FollowServer)?;
    vehicle.publish_my_function_list()
}
