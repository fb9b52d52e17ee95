//! Ports that others have, and limits of a unit's own lists.

use std::net::{Ipv4Addr, TcpListener, UdpSocket};

use cara_std::{BuildError, Capacities, CommunicationSystem, Error, Limit};

use crate::support::{ask, fleet, meet, number, service, system, unit};

/// Another program has the port: the unit is not made, and the one that runs does not notice.
#[test]
fn a_port_in_use_is_an_error_that_says_what_to_do() {
    let fleet = fleet();
    let manager = system(fleet).build().unwrap();
    let agv = unit("agv", 7, fleet).build().unwrap();
    agv.my_function_list().add_function("echo", &number(0), service(|number| number)).unwrap();
    let (peer, _) = meet(&manager, &agv);

    let refused = |system: Result<CommunicationSystem, BuildError>| match system.map(drop).unwrap_err() {
        BuildError::Unit(error) => error,
        other => panic!("{other}"),
    };
    let stream = TcpListener::bind((Ipv4Addr::LOCALHOST, 0)).unwrap();
    let taken = stream.local_addr().unwrap().port();
    assert_eq!(refused(system(fleet).tcp_port(taken).build()), Error::PortInUse);
    assert_eq!(refused(system(fleet).tcp_port(manager.tcp_port()).build()), Error::PortInUse);
    let datagrams = UdpSocket::bind((Ipv4Addr::UNSPECIFIED, 0)).unwrap();
    let taken = datagrams.local_addr().unwrap().port();
    assert_eq!(refused(system(fleet).discovery_port(taken).build()), Error::PortInUse);
    assert!(Error::PortInUse.to_string().contains("choose another port"));
    assert_eq!(ask(&peer, "echo", 5), Ok(5));
}

/// Functions and signatures beyond what the unit has room for.
#[test]
fn a_full_list_of_functions_names_the_setting_that_raises_it() {
    let fleet = fleet();
    let manager = system(fleet).build().unwrap();
    let agv = unit("agv", 7, fleet).capacities(Capacities { functions: 2, ..Capacities::default() });
    let agv = agv.build().unwrap();
    let add = |name: &str| agv.my_function_list().add_function(name, &number(0), service(|number| number));
    assert_eq!((add("echo"), add("second")), (Ok(()), Ok(())));
    let full = add("third").unwrap_err();
    assert_eq!(full, Error::Full(Limit::Functions));
    assert!(full.to_string().contains("Capacities::functions"), "{full}");
    let (peer, _) = meet(&manager, &agv);
    assert_eq!(ask(&peer, "echo", 5), Ok(5));
    agv.my_function_list().remove("second").unwrap();
    assert_eq!(add("third"), Ok(()));
}
