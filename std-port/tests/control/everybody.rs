//! A stop of all reaches m_units as well, which are on no roster: doors, lifts.

use cara_std::control::Control;
use cara_std::control::protocol::{Answer, Question};
use cara_std::{
    Builder, CommunicationSystem, Identity, Interfaces, MUnit, ParametersView, Served, ServiceError, ServiceOptions,
};

use crate::keyed::keyed;
use crate::support::{Depot, ask, until};

/// So long that nothing here ends by time.
const LEASE: cara_std::Duration = cara_std::Duration::from_secs(600);

fn m_unit(own: &Identity, other: &Identity, fleet: u32) -> Builder<(), MUnit> {
    let builder = CommunicationSystem::builder(own.name(), own.id()).unwrap().interfaces(Interfaces::Loopback);
    keyed(builder, fleet, own, std::slice::from_ref(other))
}

#[test]
fn a_stop_of_all_reaches_those_that_are_on_no_roster() {
    let [manager, doors] = [("manager", 1), ("doors", 2)].map(|(name, id)| Identity::m_unit(name, id).unwrap());
    let depot = Depot::of(|fleet, directory| {
        m_unit(&manager, &doors, fleet).control(Control::Path(directory.join("manager.sock")))
    });
    let unit = m_unit(&doors, &manager, depot.fleet).build().unwrap();
    let nothing = |_: &Served, _: &mut ParametersView| -> Result<(), ServiceError> { Ok(()) };
    let wing = unit.my_function_list().actuator(|| {}).unwrap();
    let services =
        [("open()", ServiceOptions::new().moves(&wing, LEASE)), ("halt()", ServiceOptions::new().stops(&wing))];
    for (definition, options) in services {
        unit.my_function_list().add_service(&definition.parse().unwrap(), options, nothing).unwrap();
    }
    unit.publish_my_function_list().unwrap();
    unit.start().unwrap();
    until("it has published", || depot.system.nodes_offering("halt").len() == 1);
    let answers = ask(&mut depot.client(), Question::Stop { node: None }).unwrap();
    let [Answer::Called { node, id: 2, error: None, .. }] = &answers[..] else { panic!("{answers:?}") };
    assert_eq!((node.as_str(), wing.latch().map(|latch| latch.by)), ("doors", Some(1)));
    unit.stop();
}
