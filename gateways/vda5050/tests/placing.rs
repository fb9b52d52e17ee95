//! `initPosition`: where the vehicle is said to be.

mod fake;

use cara_vda5050::machine::Machine;
use cara_vda5050::message::ActionParameter;
use cara_vda5050::order::Capabilities;
use cara_vda5050::state::{Policy, Record};
use fake::{Pair, instant, order, policy};

/// Has driven from a to b.
fn done() -> Pair {
    let mut pair = Pair::new("a");
    pair.machine.order(order("o1", 3, 0, "a! b!"));
    pair.turns(10);
    assert_eq!(pair.left(), "");
    pair
}

#[test]
fn init_position_waits_for_no_order() {
    let mut pair = Pair::new("a");
    pair.machine.order(order("o1", 0, 0, "a! b! c"));
    pair.turns(10);
    pair.machine.instant_actions(instant("initPosition", "i1"));
    assert_eq!(pair.actions(), ["i1 FAILED"]);
}

#[test]
fn an_order_does_not_go_on_from_where_init_position_says() {
    let mut pair = done();
    let mut message = instant("initPosition", "i1");
    let parameter = ActionParameter { key: "lastNodeId".into(), value: "a".into() };
    message.actions[0].action_parameters = Some(vec![parameter]);
    pair.machine.instant_actions(message);
    pair.turn();
    assert_eq!(
        (pair.actions().last().unwrap().as_str(), pair.machine.record().last_node_sequence_id),
        ("i1 FINISHED", 0)
    );
    pair.machine.order(order("o1", 4, 0, "a! c!"));
    assert_eq!((pair.left(), pair.errors()), (String::new(), vec!["orderUpdateError"]));
    // Where nodes have no positions a new order begins there all the same, as it does before any order.
    let policy = Policy { can: Capabilities { needs_positions: false, ..policy().can }, ..policy() };
    for record in
        [pair.machine.record().clone(), Record { last_node_id: "a".into(), is_placed: true, ..Record::default() }]
    {
        let mut bare = order("o3", 0, 0, "a! c!");
        bare.nodes.iter_mut().for_each(|node| node.node_position = None);
        let mut machine = Machine::new(record, policy.clone(), pair.now);
        machine.status(pair.vehicle.status.clone());
        machine.order(bare);
        assert_eq!(machine.record().order_id, "o3", "{:?}", machine.record().errors);
    }
    pair.vehicle.status.position.as_mut().unwrap().x = fake::place("a");
    pair.turn();
    pair.machine.order(order("o2", 0, 0, "a! c!"));
    pair.turns(5);
    assert_eq!((pair.left(), pair.vehicle.reached.last().unwrap().0.as_str()), (String::new(), "c"));
}

#[test]
fn an_update_waits_for_init_position() {
    let mut pair = done();
    pair.machine.instant_actions(instant("initPosition", "i1"));
    pair.machine.order(order("o1", 4, 2, "b! c!"));
    assert_eq!((pair.left(), pair.errors()), (String::new(), vec!["orderError"]));
    pair.turn();
    pair.machine.order(order("o1", 4, 2, "b! c!"));
    pair.turns(5);
    assert_eq!(pair.vehicle.reached.last().unwrap().0, "c");
}
