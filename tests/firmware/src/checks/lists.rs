//! Orders with lists, for a board that has them and for one that does not.

use anyhow::{Context, Result, ensure};
use cara_std::{
    CallError, Definition, Error, ParametersView, Peer, Served, ServiceError, ServiceOptions, UnitEvent, Variables,
    interface,
};

use crate::board::{Bench, Who};
use crate::manager::{Manager, patiently, position};

/// The manager's orders are as large as VDA 5050's; a board's are as large as it has room for.
#[derive(Variables, Clone)]
struct Action {
    #[size(32)]
    kind: String,
    id: u32,
}

#[derive(Variables, Clone)]
struct Node {
    #[size(32)]
    id: String,
    x: f32,
    y: f32,
    #[size(4)]
    actions: Vec<Action>,
}

#[derive(Variables, Clone)]
struct Edge {
    #[size(32)]
    id: String,
    #[size(4)]
    actions: Vec<Action>,
}

#[derive(Variables, Clone, Debug, PartialEq)]
struct Followed {
    length: f32,
    actions: u32,
    #[size(32)]
    last: String,
}

#[interface]
trait Follow {
    #[idempotent]
    fn follow(&mut self, #[size(64)] nodes: Vec<Node>, #[size(63)] edges: Vec<Edge>) -> Followed;
}

/// So many nodes and the edges between them, each with an action.
fn order(nodes: u32) -> (Vec<Node>, Vec<Edge>) {
    let actions = |kind: &str, id| vec![Action { kind: kind.into(), id }];
    let node = |index: u32| {
        let (x, y) = (1.5 * index as f32, -0.25 * index as f32);
        Node { id: format!("node-{index:02}"), x, y, actions: actions("pick", 2 * index) }
    };
    let edge = |index: u32| Edge { id: format!("edge-{index:02}"), actions: actions("beep", 2 * index + 1) };
    ((0..nodes).map(node).collect(), (1..nodes).map(|index| edge(index - 1)).collect())
}

/// An order that the board has room for is followed; one of 50 nodes is refused here, and the board goes on answering.
pub(super) fn large_order(bench: &Bench, _: u32) -> Result<String> {
    let Some(bench) = bench.constant()? else { return Ok("not without the image that has lists".into()) };
    let cable = bench.cable()?;
    let manager = Manager::start(&bench.keys)?;
    let _board = bench.board(&cable, &Who::agv(17))?;
    let agv = manager.meet_offering(&Who::agv(17), "follow")?;
    let follows = |nodes, expected: Followed| {
        let mut reported = None;
        patiently(|| match follow(&agv, nodes) {
            Err(failed) if failed.mismatch().is_none() => Err(failed.error),
            followed => {
                reported = Some(followed);
                Ok(())
            }
        })?;
        ensure!(reported == Some(Ok(expected)), "of {nodes} nodes it tells {reported:?}");
        Ok(())
    };
    follows(2, Followed { length: 1.75, actions: 3, last: "node-01".into() })?;
    let sent = requests_sent(&agv)?;
    let refused = follow(&agv, 50);
    let too_long = Error::WrongSize { index: 0, expected: 3, found: 50 };
    ensure!(refused == Err(too_long.into()), "of 50 nodes it tells {refused:?}");
    ensure!(requests_sent(&agv)? == sent, "it was sent");
    follows(3, Followed { length: 3.5, actions: 10, last: "node-02".into() })?;
    Ok(format!("2 and 3 nodes arrive; of 50: {refused:?}"))
}

/// The AGV's image has no lists.
pub(super) fn unreadable_function(bench: &Bench, _: u32) -> Result<String> {
    let cable = bench.cable()?;
    let manager = Manager::start(&bench.keys)?;
    let route: Definition = "route(places: {x: float, y: float}[..8])".parse()?;
    let nothing = |_: &Served, _: &mut ParametersView| -> Result<(), ServiceError> { Ok(()) };
    manager.system.my_function_list().add_service(&route, ServiceOptions::new(), nothing)?;
    manager.system.publish_my_function_list()?;
    let _board = bench.board(&cable, &Who::agv(17))?;
    let agv = manager.meet(&Who::agv(17))?;
    let skips = |event: &UnitEvent| matches!(event, UnitEvent::FunctionsSkipped { skipped: 1, .. });
    manager.event("skipped function", skips)?;
    let unknown = follow(&agv, 2);
    ensure!(unknown == Err(Error::UnknownFunction.into()), "of an order with lists it tells {unknown:?}");
    position(&agv)?;
    Ok("it is counted, and the manager is told".into())
}

fn follow(agv: &Peer, nodes: u32) -> Result<Followed, CallError> {
    let (nodes, edges) = order(nodes);
    FollowClient::at(agv).follow(nodes, edges).wait()
}

fn requests_sent(agv: &Peer) -> Result<u64> {
    let counters = agv.counters();
    counters.iter().find(|(name, _)| *name == "RequestsSent").map(|(_, count)| *count).context("no such counter")
}
