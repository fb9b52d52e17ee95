//! `cara doctor` names the right cause first, and no wrong one, in each case that is set up here for real: units over
//! loopback, programs beside them, and network namespaces with interfaces and firewalls of their own.

#[path = "doctor/datagrams.rs"]
mod datagrams;
#[path = "doctor/joining.rs"]
mod joining;
#[path = "doctor/namespace.rs"]
mod namespace;
#[path = "doctor/secured.rs"]
mod secured;
#[path = "doctor/support.rs"]
mod support;

use std::net::{Ipv4Addr, UdpSocket};
use std::time::Duration;

use crate::datagrams::{MANAGER, Search};
use crate::namespace::Peer;
use crate::support::{Clinic, until, while_running};
use cara_processes::network::{filter, ip};

#[test]
fn a_program_that_does_not_share_the_port_is_named_with_its_process() {
    let clinic = Clinic::new();
    let _other = UdpSocket::bind((Ipv4Addr::UNSPECIFIED, clinic.port)).unwrap();
    for arguments in [&["agv"][..], &[]] {
        let reported = clinic.doctor(arguments);
        reported.is(&["port-in-use"], 4);
        let process = format!("process {}", std::process::id());
        assert!(
            reported.found(0).contains(&process) && reported.found(0).contains(&clinic.port.to_string()),
            "{reported:?}"
        );
    }
}

#[test]
fn a_node_of_another_fleet_is_told_with_both_fleets() {
    let clinic = Clinic::new();
    let _manager = clinic.manager("boss", 64);
    let other = clinic.fleet.wrapping_add(1);
    let _agv = clinic.started(clinic.unit("agv", 7, "boss").fleet(other));
    let reported = clinic.doctor(&["agv"]);
    reported.is(&["other-fleet"], 4);
    let both = [clinic.fleet, other].map(|fleet| format!("fleet {fleet}"));
    assert!(both.iter().all(|fleet| reported.found(0).contains(fleet)), "{reported:?}");
}

#[test]
fn a_manager_of_another_fleet_is_why_its_node_waits() {
    let clinic = Clinic::new();
    let _agv = clinic.started(clinic.unit("agv", 7, "boss"));
    let far = clinic.system("boss").fleet(clinic.fleet.wrapping_add(1)).build().unwrap();
    far.start().unwrap();
    let reported = clinic.doctor(&["agv"]);
    reported.is(&["other-fleet"], 4);
    assert!(reported.found(0).starts_with("boss/1 "), "{reported:?}");
}

#[test]
fn a_node_of_another_manager_is_told_with_both_names() {
    let clinic = Clinic::new();
    let _manager = clinic.manager("boss", 64);
    let _agv = clinic.started(clinic.unit("agv", 7, "chief"));
    let reported = clinic.doctor(&["agv/7"]);
    reported.is(&["wrong-manager"], 4);
    assert!(["chief/1", "boss/1"].iter().all(|name| reported.found(0).contains(name)), "{reported:?}");
}

#[test]
fn a_node_whose_manager_does_not_run_waits_for_it() {
    let clinic = Clinic::new();
    let _agv = clinic.started(clinic.unit("agv", 7, "boss"));
    clinic.doctor(&["agv"]).is(&["no-manager"], 4);
}

#[test]
fn a_node_of_another_version_is_told_with_its_version() {
    let clinic = Clinic::new();
    let _manager = clinic.manager("boss", 64);
    let search = clinic.search("agv", 7, 1).of_version(9);
    while_running(
        || search.send(),
        || {
            let reported = clinic.doctor(&["agv"]);
            reported.is(&["other-version"], 4);
            assert!(reported.found(0).contains("version 9"), "{reported:?}");
        },
    );
}

#[test]
fn of_two_nodes_with_one_identity_the_manager_tells() {
    let clinic = Clinic::new();
    let manager = clinic.manager("boss", 64);
    let _first = clinic.started(clinic.unit("agv", 7, "boss"));
    until("the first has come", || manager.number_of_s_units() == 1);
    let _second = clinic.started(clinic.unit("agv", 7, "boss"));
    until("the second was refused", || !manager.findings().is_empty());
    // That the first one is connected is no comfort.
    clinic.doctor(&["agv"]).is(&["duplicate"], 4);
    clinic.doctor(&["--listen", "3s"]).is(&["duplicate"], 4);
}

#[test]
fn two_lives_of_one_identity_at_the_same_time_are_two_nodes() {
    let clinic = Clinic::new();
    let duplicates = [1, 2].map(|epoch| clinic.search("agv", 7, epoch));
    let say = || duplicates.iter().for_each(Search::send);
    while_running(say, || clinic.doctor(&["agv"]).is(&["duplicate"], 4));
}

#[test]
fn a_full_manager_is_told_by_itself_and_by_what_it_says_on_the_network() {
    let clinic = Clinic::new();
    let manager = clinic.manager("boss", 1);
    let _first = clinic.started(clinic.unit("first", 1, "boss"));
    until("the first has come", || manager.number_of_s_units() == 1);
    let _second = clinic.started(clinic.unit("second", 2, "boss"));
    until("the second was refused", || !manager.findings().is_empty());
    clinic.doctor(&["second"]).is(&["full"], 4);
    // As from another host: the manager cannot be asked.
    let reported = clinic.doctor_elsewhere(&["second"]);
    // If it kept silent for so long, it could be connected as well.
    assert!(matches!(reported.ids()[..], ["full"] | ["full", "ask-its-manager"]), "{reported:?}");
    clinic.doctor(&["first"]).is(&["connected"], 0);
    let reported = clinic.doctor(&["--listen", "3s"]);
    reported.is(&["full"], 4);
    assert!(reported.found(0).contains("boss/1") && reported.found(0).contains("second/2"), "{reported:?}");
}

/// `agv/9` has no link, and looks for its manager where all hear it.
#[test]
fn a_name_of_several_nodes_is_refused() {
    let clinic = Clinic::new();
    let _manager = clinic.manager("boss", 64);
    let _agv = clinic.started(clinic.unit("agv", 7, "boss"));
    let search = clinic.search("agv", 9, 1);
    while_running(
        || search.send(),
        || {
            let (code, _, errors) = clinic.output(&["agv"]);
            assert_eq!(code, 2, "{errors}");
            assert!(errors.contains("several nodes are called `agv`: write agv/7 or agv/9"), "{errors}");
        },
    );
    clinic.doctor(&["agv/7"]).is(&["connected"], 0);
}

/// Of two that hear each other one steps down. This second one hears nothing, as behind a switch that passes one way only.
#[test]
fn of_two_managers_with_one_name_is_told_first() {
    let clinic = Clinic::new();
    let first = clinic.manager("boss", 64);
    let _agv = clinic.started(clinic.unit("agv-8", 8, "boss"));
    until("a vehicle has come", || first.number_of_s_units() == 1);
    let second = clinic.search("boss", 1, 1).of_m_unit();
    while_running(
        || second.send(),
        || {
            // Also beside a vehicle that has joined one of them.
            clinic.doctor(&["agv-8"]).is(&["duplicate"], 4);
            clinic.doctor(&["boss"]).is(&["duplicate"], 4);
            assert_eq!(clinic.doctor(&["agv", "--listen", "4s"]).ids()[0], "duplicate");
            clinic.doctor(&["--listen", "3s"]).is(&["duplicate"], 4);
        },
    );
}

/// Two that hear each other: the lower claim steps down, and the doctor hears one. That it refused the other one is told.
#[test]
fn of_two_managers_that_hear_each_other_one_is_left() {
    let clinic = Clinic::new();
    let first = clinic.manager("boss", 64);
    let second = clinic.system("boss").control(cara_std::control::Control::Off).beside_another();
    let second = second.build().unwrap();
    let [of_first, of_second] = [first.events(), second.events()];
    second.start().unwrap();
    let is_fenced = |events: &std::sync::mpsc::Receiver<cara_std::UnitEvent>| {
        events.try_iter().any(|event| matches!(event, cara_std::UnitEvent::Fenced { .. }))
    };
    until("one has stepped down", || is_fenced(&of_first) || is_fenced(&of_second));
    let reported = clinic.doctor(&["--listen", "3s"]);
    let is_live = |at: usize| reported.ids()[at] == "fenced" || reported.found(at).starts_with("two live nodes ");
    assert!(!(0..reported.ids().len()).any(is_live), "{reported:?}");
}

#[test]
fn a_manager_that_stands_still_is_told_and_nobody_is_to_start_a_second_one() {
    let clinic = Clinic::new();
    let manager = clinic.manager_of_few_files(1024);
    until("it is up", || clinic.doctor(&["boss", "--listen", "0s"]).ids() == ["answers"]);
    manager.stand_still();
    let of_unit = ["--unit", "boss/1", "--listen", "3s"];
    for arguments in [&["agv", "--listen", "3s"][..], &["boss"], &["--listen", "3s"], &of_unit] {
        let reported = clinic.doctor(arguments);
        reported.is(&["unit-hangs"], 4);
        assert!(reported.found(0).starts_with("boss/1 "), "{reported:?}");
    }
}

#[test]
fn a_node_that_was_lost_is_told_with_time_and_reason() {
    let clinic = Clinic::new();
    let manager = clinic.manager("boss", 64);
    let agv = clinic.started(clinic.unit("agv", 7, "boss"));
    until("it has come", || manager.number_of_s_units() == 1);
    agv.stop();
    until("it has left", || manager.number_of_s_units() == 0);
    let reported = clinic.doctor(&["agv", "--listen", "3s"]);
    reported.is(&["lost"], 4);
    assert!(reported.found(0).starts_with("agv/7 left boss/1 "), "{reported:?}");
    // Without a named node it is no error: its operator stopped it.
    clinic.doctor(&["--listen", "3s"]).is(&["lost"], 0);
}

#[test]
fn a_node_that_is_not_there_at_all_is_not_heard() {
    let clinic = Clinic::new();
    let _manager = clinic.manager("boss", 64);
    let _other = clinic.started(clinic.unit("agv-8", 8, "boss"));
    let reported = clinic.doctor(&["agv-7", "--listen", "3s"]);
    reported.is(&["not-heard"], 4);
    assert!(reported.found(0).contains("there is agv-8/8"), "{reported:?}");
    // Another host cannot know.
    clinic.doctor_elsewhere(&["agv-7", "--listen", "3s"]).is(&["ask-its-manager"], 4);
}

#[test]
fn a_node_that_is_connected_is_told_with_its_address() {
    let clinic = Clinic::new();
    let manager = clinic.manager("boss", 64);
    let _agv = clinic.started(clinic.unit("agv", 7, "boss"));
    until("it has come", || manager.number_of_s_units() == 1);
    let address = manager.s_unit("agv").unwrap().address().unwrap().to_string();
    for name in ["agv", "agv/7", "#7"] {
        let reported = clinic.doctor(&[name]);
        reported.is(&["connected"], 0);
        assert!(reported.found(0).contains(&address) && reported.found(0).contains("boss/1"), "{reported:?}");
    }
    clinic.doctor(&["boss"]).is(&["answers"], 0);
    clinic.doctor_elsewhere(&["boss"]).is(&["answers"], 0);
    clinic.doctor(&["--listen", "3s"]).is(&[], 0);
}

#[test]
fn a_node_that_starts_again_and_again_is_restarting() {
    let clinic = Clinic::new();
    let manager = clinic.manager("boss", 64);
    let life = || {
        let agv = clinic.started(clinic.unit("agv", 7, "boss"));
        until("it has come", || agv.is_connected());
        std::thread::sleep(Duration::from_millis(1200));
        agv.stop();
    };
    while_running(life, || {
        let reported = clinic.doctor(&["agv"]);
        assert_eq!(reported.ids()[0], "restarting", "{reported:?}");
        assert!(reported.ids()[1..].iter().all(|id| *id == "connected"), "{reported:?}");
        assert_eq!(reported.code, 4);
    });
    assert_eq!(manager.number_of_m_units(), 0);
}

#[test]
fn a_manager_that_may_open_too_few_files_is_told_with_its_limit() {
    let clinic = Clinic::new();
    let _manager = clinic.manager_of_few_files(120);
    // It is up once it has a socket.
    until("it is up", || clinic.doctor(&["boss", "--listen", "0s"]).ids() == ["answers"]);
    let reported = clinic.doctor(&["--listen", "3s"]);
    reported.is(&["few-descriptors"], 4);
    assert!(reported.found(0).contains("may have 120 files open"), "{reported:?}");
}

#[test]
fn without_a_name_all_that_is_strange_is_listed() {
    let clinic = Clinic::new();
    let _manager = clinic.manager("boss", 64);
    let _lost = clinic.started(clinic.unit("lost", 3, "bos"));
    let _far = clinic.started(clinic.unit("far", 4, "boss").fleet(clinic.fleet.wrapping_add(1)));
    let old = clinic.search("old", 5, 1).of_version(9);
    let say = || {
        old.send();
        clinic.send(b"not ours");
    };
    while_running(say, || {
        clinic.doctor(&[]).is(&["wrong-manager", "other-version", "foreign-datagrams", "other-fleet"], 4)
    });
}

#[test]
fn a_directory_of_sockets_that_others_can_write_to_is_told() {
    let clinic = Clinic::new();
    let _manager = clinic.manager("boss", 64);
    clinic.let_others_write_sockets();
    clinic.doctor(&["agv", "--listen", "3s"]).is(&["ask-its-manager", "control-refused"], 4);
}

#[test]
fn mistakes_on_the_command_line_are_told_and_nothing_is_looked_at() {
    let clinic = Clinic::new();
    for (arguments, code) in [
        (&["--as", "boss/1"][..], 2),
        (&["agv", "--listen", "soon"], 2),
        (&[""], 2),
        (&["#x"], 2),
        (&["agv/x"], 2),
        (&["--unit", "nobody/1"], 3),
    ] {
        let (found, _, errors) = clinic.output(arguments);
        assert_eq!(found, code, "{arguments:?}: {errors}");
        assert!(!errors.is_empty());
    }
}

#[test]
fn a_host_without_an_interface_is_told_so() {
    namespace::inside("a_host_without_an_interface_is_told_so", &[], || {
        let clinic = Clinic::on_all_interfaces();
        clinic.doctor(&["agv"]).is(&["no-interface"], 4);
        // With loopback alone it still listens, for units of its own.
        ip("link set lo up");
        clinic.doctor(&["agv", "--listen", "3s"]).is(&["no-interface"], 4);
    });
}

#[test]
fn an_interface_that_is_down_is_told_by_its_name() {
    namespace::inside("an_interface_that_is_down_is_told_by_its_name", &[], || {
        ip("link set lo up");
        ip("link add v0 type veth peer name v1");
        ip("address add 10.77.0.1/24 dev v0");
        let clinic = Clinic::on_all_interfaces();
        let reported = clinic.doctor(&["agv", "--listen", "3s"]);
        reported.is(&["interface-down"], 4);
        assert!(reported.found(0).contains("v0"), "{reported:?}");
    });
}

#[test]
fn a_firewall_that_drops_the_tcp_port_is_told_with_the_port() {
    namespace::inside("a_firewall_that_drops_the_tcp_port_is_told_with_the_port", &["nft"], || {
        ip("link set lo up");
        let clinic = Clinic::new();
        let manager = clinic.manager("boss", 64);
        filter("inet cara", "input", &format!("tcp dport {} drop", manager.tcp_port())).unwrap();
        let _agv = clinic.started(clinic.unit("agv", 7, "boss"));
        let reported = clinic.doctor(&["agv"]);
        reported.is(&["tcp-blocked"], 4);
        assert!(reported.found(0).contains(&format!("TCP port {}", manager.tcp_port())), "{reported:?}");
    });
}

#[test]
fn a_firewall_that_rejects_the_tcp_port_is_told_with_the_port() {
    namespace::inside("a_firewall_that_rejects_the_tcp_port_is_told_with_the_port", &["nft"], || {
        ip("link set lo up");
        let clinic = Clinic::new();
        let manager = clinic.manager("boss", 64);
        filter("inet cara", "input", &format!("tcp dport {} reject with tcp reset", manager.tcp_port())).unwrap();
        let _agv = clinic.started(clinic.unit("agv", 7, "boss"));
        clinic.doctor(&["agv"]).is(&["tcp-blocked"], 4);
    });
}

#[test]
fn broadcasts_that_the_own_firewall_drops_are_told() {
    namespace::inside("broadcasts_that_the_own_firewall_drops_are_told", &["nft"], || {
        ip("link set lo up");
        let clinic = Clinic::new();
        filter("inet cara", "input", &format!("udp dport {} drop", clinic.port)).unwrap();
        clinic.doctor(&["agv", "--listen", "3s"]).is(&["broadcast-lost"], 4);
    });
}

#[test]
fn broadcasts_that_the_own_firewall_does_not_let_out_are_told() {
    namespace::inside("broadcasts_that_the_own_firewall_does_not_let_out_are_told", &["nft"], || {
        ip("link set lo up");
        let clinic = Clinic::new();
        filter("inet cara", "output", &format!("udp dport {} drop", clinic.port)).unwrap();
        clinic.doctor(&["agv"]).is(&["send-refused"], 4);
    });
}

#[test]
fn a_link_on_which_signs_of_life_get_lost_is_told() {
    namespace::inside("a_link_on_which_signs_of_life_get_lost_is_told", &["nft"], || {
        ip("link set lo up");
        let clinic = Clinic::new();
        let manager = clinic.manager("boss", 64);
        let _agv = clinic.started(clinic.unit("agv", 7, "boss"));
        until("it has come", || manager.number_of_s_units() == 1);
        let agv = manager.s_unit("agv").unwrap();
        // Signs of life are datagrams beside the stream; discovery goes on. Each third is lost, either way: where none
        // passes for long, both ends ask in the stream with each one, none counts as missed, and the finding is another.
        filter("inet cara", "input", &format!("udp dport != {} numgen inc mod 3 0 drop", clinic.port)).unwrap();
        let count = |name| agv.counters().iter().find(|(known, _)| *known == name).map_or(0, |(_, count)| *count);
        until("signs of life are missed", || count("KeepAlivesMissed") >= 3);
        let reported = clinic.doctor(&["agv"]);
        assert_eq!((reported.ids()[0], reported.code), ("lossy-link", 4), "{reported:?}");
    });
}

/// Two hosts with a cable between them; the far one hears no broadcasts.
#[test]
fn broadcasts_that_do_not_reach_the_other_host_are_told() {
    namespace::inside("broadcasts_that_do_not_reach_the_other_host_are_told", &["nft"], || {
        let clinic = Clinic::on_all_interfaces();
        let far = Peer::start(&[
            MANAGER,
            &clinic.fleet.to_string(),
            &clinic.port.to_string(),
            clinic.key_file("boss").to_str().unwrap(),
        ]);
        for command in [
            "link set lo up",
            "link add v0 type veth peer name v1",
            "link set v0 up",
            "address add 10.77.0.1/24 broadcast + dev v0",
        ] {
            ip(command);
        }
        ip(&format!("link set v1 netns {}", far.process()));
        let there = far.network();
        there.run("ip address add 10.77.0.2/24 broadcast + dev v1").unwrap();
        there.run("ip link set v1 up").unwrap();
        let broadcasts = "meta pkttype broadcast udp dport 0-65535 drop";
        there.within(|| filter("inet cara", "input", broadcasts)).unwrap();
        far.go();
        let reported = clinic.doctor(&["boss"]);
        reported.is(&["broadcast-one-way"], 4);
        assert!(reported.found(0).contains("10.77.0.2:"), "{reported:?}");
        // Without what keeps them away it answers.
        there.run("nft flush ruleset").unwrap();
        clinic.doctor(&["boss"]).is(&["answers"], 0);
    });
}

/// Addresses as scripts give them: without a broadcast address, or with one that is no other host's, and no route beside that of
/// the network.
#[test]
fn hosts_without_a_broadcast_address_or_with_an_odd_one_hear_each_other() {
    let name = "hosts_without_a_broadcast_address_or_with_an_odd_one_hear_each_other";
    namespace::inside(name, &[], || {
        let clinic = Clinic::on_all_interfaces();
        let far = Peer::start(&[
            MANAGER,
            &clinic.fleet.to_string(),
            &clinic.port.to_string(),
            clinic.key_file("boss").to_str().unwrap(),
        ]);
        for command in ["link set lo up", "link add v0 type veth peer name v1", "link set v0 up"] {
            ip(command);
        }
        ip(&format!("link set v1 netns {}", far.process()));
        let there = far.network();
        there.run("ip link set v1 up").unwrap();
        for (near, beyond) in [("", ""), ("brd 10.77.0.77", ""), ("", "brd 255.255.255.255"), ("brd +", "brd 0.0.0.0")]
        {
            ip("address flush dev v0");
            ip(&format!("address add 10.77.0.1/24 {near} dev v0"));
            there.run("ip address flush dev v1").unwrap();
            there.run(&format!("ip address add 10.77.0.2/24 {beyond} dev v1")).unwrap();
            if near.is_empty() && beyond.is_empty() {
                far.go();
            }
            clinic.doctor(&["boss"]).is(&["answers"], 0);
        }
    });
}
