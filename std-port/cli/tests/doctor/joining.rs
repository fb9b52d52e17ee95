//! Vehicles that run and do not join: what the doctor knows of them on either host, and what they say themselves.

use std::path::Path;
use std::time::Duration;

use cara_processes::Process;
use cara_processes::network::{filter, ip};
use cara_std::{Identity, Interfaces};

use crate::datagrams::{MANAGER, VEHICLE};
use crate::namespace::{self, Peer};
use crate::support::{Clinic, until};

/// Longest wait for a line of a log.
const PATIENCE: Duration = Duration::from_secs(180);

/// A far host at 10.77.0.2, this one at 10.77.0.1, and a cable between.
fn cable(far: &Peer) -> cara_processes::network::Namespace {
    for command in
        ["link set lo up", "link add v0 type veth peer name v1", "link set v0 up", "address add 10.77.0.1/24 dev v0"]
    {
        ip(command);
    }
    ip(&format!("link set v1 netns {}", far.process()));
    let there = far.network();
    there.run("ip link set v1 up").unwrap();
    there.run("ip address add 10.77.0.2/24 dev v1").unwrap();
    there
}

/// It left in an orderly way, and runs again behind a firewall: that it searches is known, so that nobody is to start it.
#[test]
fn a_vehicle_that_runs_again_behind_a_firewall_is_not_called_lost() {
    namespace::inside("joining::a_vehicle_that_runs_again_behind_a_firewall_is_not_called_lost", &["nft"], || {
        ip("link set lo up");
        let clinic = Clinic::new();
        let manager = clinic.manager("boss", 64);
        let agv = clinic.started(clinic.unit("agv", 7, "boss"));
        until("it has come", || manager.number_of_s_units() == 1);
        let known = manager.s_unit("agv").unwrap();
        assert_eq!(known.searched(), None, "it is connected");
        agv.stop();
        until("it has left", || manager.number_of_s_units() == 0);
        assert_eq!(known.searched(), None, "it has searched before it left");
        filter("inet cara", "input", &format!("tcp dport {} reject with tcp reset", manager.tcp_port())).unwrap();
        let _again = clinic.started(clinic.unit("agv", 7, "boss"));
        until("it is heard", || known.searched().is_some());
        clinic.doctor(&["agv"]).is(&["tcp-blocked"], 4);
        // Without a firewall here that the doctor could see, it tells what the manager has heard.
        let reported = clinic.doctor(&["--listen", "3s"]);
        assert!(!reported.ids().contains(&"lost"), "{reported:?}");
    });
}

/// The vehicle's host keeps its connection in: on the manager's host that one is not sent to the manager's host.
#[test]
fn on_the_managers_host_it_is_told_that_the_vehicle_is_heard() {
    namespace::inside("joining::on_the_managers_host_it_is_told_that_the_vehicle_is_heard", &["nft"], || {
        let clinic = Clinic::on_all_interfaces();
        let far = clinic.peer(VEHICLE, &Identity::s_unit("agv", 7).unwrap());
        let there = cable(&far);
        there.within(|| filter("inet cara", "output", "tcp dport 1-65535 drop")).unwrap();
        let manager = clinic.system("boss").interfaces(Interfaces::All).build().unwrap();
        manager.start().unwrap();
        far.go();
        let heard = || manager.roster().into_iter().find_map(|peer| peer.searched());
        until("it is heard", || heard().is_some());
        assert_eq!(heard().unwrap().1.ip().to_string(), "10.77.0.2");
        let reported = clinic.doctor(&["agv", "--listen", "6s"]);
        reported.is(&["not-joining"], 4);
        assert!(!reported.advice(0).contains("cara doctor"), "{reported:?}");
    });
}

/// As a manager that was started with what a trial on one host needs.
#[test]
fn a_manager_that_uses_loopback_alone_is_told() {
    namespace::inside("joining::a_manager_that_uses_loopback_alone_is_told", &[], || {
        let clinic = Clinic::on_all_interfaces();
        let far = clinic.peer(VEHICLE, &Identity::s_unit("agv", 7).unwrap());
        cable(&far);
        let _manager = clinic.manager("boss", 64);
        far.go();
        let reported = clinic.doctor(&["agv"]);
        reported.is(&["loopback-only"], 4);
        assert!(reported.found(0).starts_with("boss/1 is heard over loopback alone"), "{reported:?}");
    });
}

/// What is known is that no manager is heard; another one, started for that, would be a second one.
#[test]
fn a_manager_that_is_not_heard_is_not_said_to_be_stopped() {
    namespace::inside("joining::a_manager_that_is_not_heard_is_not_said_to_be_stopped", &["nft"], || {
        let clinic = Clinic::on_all_interfaces();
        let far = clinic.peer(MANAGER, &Identity::m_unit("boss", 1).unwrap());
        let there = cable(&far);
        there.within(|| filter("inet cara", "input", "udp dport 1-65535 drop")).unwrap();
        there.within(|| filter("inet cara", "output", "udp dport 1-65535 drop")).unwrap();
        far.go();
        let _agv = clinic.started(clinic.unit("agv", 7, "boss").interfaces(Interfaces::All));
        let reported = clinic.doctor(&["agv"]);
        reported.is(&["no-manager"], 4);
        assert!(
            reported.found(0).contains(&format!("no manager of fleet {} was heard in ", clinic.fleet)),
            "{reported:?}"
        );
        let advice = reported.advice(0);
        assert!(advice.starts_with("look on its host") && advice.contains(&clinic.port.to_string()), "{reported:?}");
    });
}

#[test]
fn a_manager_that_does_not_exist_is_not_said_to_be_secured() {
    let clinic = Clinic::new();
    let _manager = clinic.manager("boss", 64);
    let _agv = clinic.started(clinic.unit("agv", 7, "bos").insecure());
    let reported = clinic.doctor(&["agv"]);
    reported.is(&["mode-mismatch"], 4);
    let found = reported.found(0);
    assert!(!found.contains("bos/1 is secured") && found.contains("bos/1, which was not heard"), "{reported:?}");
}

/// A vehicle as a process, with its log.
fn vehicle(clinic: &Clinic, folder: &Path) -> Process {
    let key_file = clinic.key_file_of(&Identity::s_unit("agv", 7).unwrap());
    let file = folder.join("agv.toml");
    let manager = "role = \"s_unit\"\nmanager = { name = \"boss\", id = 1 }\ninterfaces = \"lo\"\n";
    let numbers = format!("fleet = {}\ndiscovery_port = {}\n", clinic.fleet, clinic.port);
    std::fs::write(&file, format!("name = \"agv\"\nid = 7\n{numbers}{manager}keys = {key_file:?}\n")).unwrap();
    let arguments = ["-c", "exec \"$0\" node \"$1\" --state \"$2\" 2>&1", env!("CARGO_BIN_EXE_cara")];
    let paths = [file.as_path(), folder].map(|path| path.to_str().unwrap().to_owned());
    let arguments = arguments.map(str::to_owned).into_iter().chain(paths);
    Process::start("agv", Path::new("/bin/sh"), arguments).unwrap()
}

#[test]
fn a_vehicle_warns_once_for_each_reason_and_says_when_it_has_joined() {
    let clinic = Clinic::new();
    let folder = tempfile::tempdir().unwrap();
    let mut agv = vehicle(&clinic, folder.path());
    agv.expect("nothing was heard of its manager", PATIENCE).unwrap();
    // The reason stays the same for a while, in which the vehicle looks at it twice more.
    clinic.doctor(&["agv-8", "--listen", "8s"]);
    // There is no room for it.
    agv.freeze().unwrap();
    let manager = clinic.manager("boss", 1);
    let first = clinic.started(clinic.unit("first", 1, "boss"));
    until("the first has come", || manager.number_of_s_units() == 1);
    agv.thaw().unwrap();
    agv.expect("reason=127.0.0.1: ", PATIENCE).unwrap();
    first.stop();
    agv.expect("has joined its manager", PATIENCE).unwrap();
    let lines = agv.lines();
    let warnings: Vec<_> = lines.iter().filter(|line| line.text.contains("has no manager")).collect();
    let warned = |reason| warnings.iter().filter(|line| line.text.contains(reason)).count();
    let reasons = ["WARN", "nothing was heard of its manager", "raise its maximum_nodes"];
    assert_eq!(reasons.map(warned), [2, 1, 1], "{lines:?}");
}
