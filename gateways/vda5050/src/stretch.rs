//! The stretch of an order's released base that the vehicle has at a time, as the flat variables of `vda_drive`.

use crate::message::{Deviation, Edge, Node};

/// Most edges of a stretch.
pub const LEGS: usize = 8;
/// Most bytes of the names of edges, and of nodes, one a line: with all other variables the call is shorter than the 1,024 bytes
/// that a vehicle takes by default. Long names make shorter stretches.
pub const NAMES_BYTES: usize = 192;

/// An edge and the node at its end, as the vehicle sees them.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Leg {
    /// Its number. It is driven once.
    pub number: i64,
    /// Of the edge.
    pub edge: String,
    /// Of the node.
    pub node: String,
    /// The node's place in metres, if it is given.
    pub position: Option<[f64; 2]>,
    /// The vehicle's angle there, if it is given.
    pub theta: Option<f64>,
    /// How far the vehicle may be from the place and the angle; 0 where nothing is allowed.
    pub deviation: [f64; 2],
    /// Metres a second, if they are limited.
    pub max_speed: Option<f64>,
}

/// The variables of `vda_drive`.
#[derive(Clone, Debug, PartialEq)]
pub struct Stretch<'s> {
    /// Number of the first edge; those behind it follow.
    pub number: i64,
    /// How many edges.
    pub count: i64,
    /// Their names, one a line.
    pub edges: &'s str,
    /// Names of their end nodes, one a line.
    pub nodes: &'s str,
    /// x, y and the angle of each node.
    pub positions: [f64; 3 * LEGS],
    /// Of each node: whether x and y, and the angle, are given.
    pub given: [bool; 2 * LEGS],
    /// Of each node: how far from the place and the angle.
    pub deviations: [f64; 2 * LEGS],
    /// Of each edge; 0 is no limit.
    pub max_speeds: [f64; LEGS],
}

impl Stretch<'_> {
    /// Its edges; `None` if the variables do not fit each other.
    pub fn legs(&self) -> Option<Vec<Leg>> {
        let count = usize::try_from(self.count).ok().filter(|count| (1..=LEGS).contains(count))?;
        self.number.checked_add(self.count).filter(|_| self.number > 0)?;
        let (edges, nodes): (Vec<_>, Vec<_>) = (self.edges.split('\n').collect(), self.nodes.split('\n').collect());
        let is_place = |index: usize| self.positions[3 * index..3 * index + 2].iter().all(|metres| metres.is_finite());
        if edges.len() != count || nodes.len() != count || !(0..count).all(is_place) {
            return None;
        }
        let leg = |index: usize| Leg {
            number: self.number + index as i64,
            edge: edges[index].to_owned(),
            node: nodes[index].to_owned(),
            position: self.given[2 * index].then(|| [self.positions[3 * index], self.positions[3 * index + 1]]),
            theta: self.given[2 * index + 1].then_some(self.positions[3 * index + 2]),
            deviation: [self.deviations[2 * index], self.deviations[2 * index + 1]],
            max_speed: Some(self.max_speeds[index]).filter(|speed| *speed > 0.0),
        };
        Some((0..count).map(leg).collect())
    }
}

/// Whether the names of a stretch fit if these are added.
pub(crate) fn fits(legs: &[(Edge, Node)], edge: &Edge, node: &Node) -> bool {
    let bytes = |name: fn(&(Edge, Node)) -> usize| legs.iter().map(|leg| name(leg) + 1).sum::<usize>();
    let edges = bytes(|(edge, _)| edge.edge_id.len()) + edge.edge_id.len();
    let nodes = bytes(|(_, node)| node.node_id.len()) + node.node_id.len();
    edges.max(nodes) <= NAMES_BYTES
}

/// What the gateway sends: the stretch without its names, the names of edges and nodes, and the map of all nodes.
pub fn of_order(number: i64, legs: &[(Edge, Node)]) -> (Stretch<'static>, [String; 2], &str) {
    let mut stretch = Stretch {
        number,
        count: legs.len() as i64,
        edges: "",
        nodes: "",
        positions: [0.0; 3 * LEGS],
        given: [false; 2 * LEGS],
        deviations: [0.0; 2 * LEGS],
        max_speeds: [0.0; LEGS],
    };
    let mut map = "";
    for (index, (edge, node)) in legs.iter().take(LEGS).enumerate() {
        stretch.max_speeds[index] = edge.max_speed.unwrap_or(0.0);
        let Some(at) = &node.node_position else { continue };
        map = &at.map_id;
        stretch.positions[3 * index..][..3].copy_from_slice(&[at.x, at.y, at.theta.unwrap_or(0.0)]);
        stretch.given[2 * index..][..2].copy_from_slice(&[true, at.theta.is_some()]);
        let radius = at.allowed_deviation_xy.map(Deviation::radius);
        let deviation = [radius, at.allowed_deviation_theta].map(Option::unwrap_or_default);
        stretch.deviations[2 * index..][..2].copy_from_slice(&deviation);
    }
    let names = |name: fn(&(Edge, Node)) -> &str| legs.iter().map(name).collect::<Vec<_>>().join("\n");
    (stretch, [names(|(edge, _)| &edge.edge_id), names(|(_, node)| &node.node_id)], map)
}

#[cfg(test)]
mod tests {
    use super::{Leg, of_order};
    use crate::message::{Edge, Node, NodePosition};

    fn leg(name: &str, theta: Option<f64>, max_speed: Option<f64>) -> (Edge, Node) {
        let at = NodePosition { x: 1.0, y: 2.0, theta, map_id: "hall".into(), ..NodePosition::default() };
        let edge = Edge { edge_id: format!("to {name}"), max_speed, ..Edge::default() };
        (edge, Node { node_id: name.into(), node_position: Some(at), ..Node::default() })
    }

    #[test]
    fn the_vehicle_reads_what_the_gateway_has_written() {
        let sent = [leg("b", None, Some(0.5)), leg("c", Some(3.0), None)];
        let (stretch, [edges, nodes], map) = of_order(7, &sent);
        let mut stretch = super::Stretch { edges: &edges, nodes: &nodes, ..stretch };
        let read = stretch.legs().unwrap();
        let first = Leg {
            number: 7,
            edge: "to b".into(),
            node: "b".into(),
            position: Some([1.0, 2.0]),
            max_speed: Some(0.5),
            ..Leg::default()
        };
        assert_eq!((&read[0], read[1].theta, read[1].number, map), (&first, Some(3.0), 8, "hall"));
        for (count, number) in [(1, 7), (3, 7), (0, 7), (-1, 7), (9, 7), (2, i64::MAX), (2, 0)] {
            (stretch.count, stretch.number) = (count, number);
            assert_eq!(stretch.legs(), None, "{count} {number}");
        }
    }
}
