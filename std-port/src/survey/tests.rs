use std::net::Ipv4Addr;

use cara_core::config::Constraints;
use cara_core::distribution::hello::Manager;
use cara_core::host::secure::Plain;

use super::*;
use crate::keys::FleetKeys;

/// Longest wait for a datagram on loopback.
const PATIENCE: Duration = Duration::from_secs(30);

fn survey() -> Survey {
    Survey::open(Interfaces::Loopback, cara_processes::discovery_port()).unwrap()
}

/// A sender on loopback, and where the survey listens.
fn sender(survey: &Survey) -> (UdpSocket, SocketAddr) {
    let port = survey.reach()[0].port;
    (UdpSocket::bind((Ipv4Addr::LOCALHOST, 0)).unwrap(), (Ipv4Addr::LOCALHOST, port).into())
}

fn listen_until(survey: &mut Survey, enough: impl FnMut(&Survey) -> bool) {
    survey.listen_until(Instant::now().checked_add(PATIENCE), enough);
}

fn search(name: &str, epoch: u64) -> WhoHas {
    WhoHas {
        identity: Identity::s_unit(name, 7).unwrap(),
        epoch: Epoch(epoch),
        sequence: 1,
        nonce: 5,
        wanted: Some(Manager::new("boss", 1).unwrap()),
        tcp_port: 0,
        expected: 1,
        known: Default::default(),
        standby: false,
        skipped: 0,
    }
}

fn bytes(fleet: u32, search: &WhoHas) -> Vec<u8> {
    let mut out = [0; SEARCH_BYTES];
    search.encode(Fleet(fleet), &Plain, &mut out).unwrap().to_vec()
}

#[test]
fn whatever_is_heard_is_told_with_fleet_version_and_wanted_manager() {
    let ours = || VERSIONS.to_string();
    let mut survey = survey();
    let (sender, to) = sender(&survey);
    let mut other_version = bytes(8, &search("agv", 3));
    other_version[4] = 9;
    for datagram in
        [bytes(7, &search("agv", 3)), other_version, bytes(7, &search("agv", 4)), bytes(7, &search("agv", 3))]
    {
        sender.send_to(&datagram, to).unwrap();
    }
    listen_until(&mut survey, |survey| survey.heard().iter().map(|heard| heard.searches).sum::<u32>() == 4);
    let reported: Vec<_> = survey
        .heard()
        .iter()
        .map(|heard| (heard.versions.to_string(), heard.fleet.0, heard.epoch.unwrap().0, heard.searches))
        .collect();
    assert_eq!(reported, [(ours(), 7, 3, 2), ("9".to_owned(), 8, 3, 1), (ours(), 7, 4, 1)]);
    let first = &survey.heard()[0];
    assert_eq!(first.wanted, Some(Manager::new("boss", 1).unwrap()));
    assert_eq!((first.source, first.by_broadcast), (sender.local_addr().unwrap(), true));
    assert!(survey.foreign().is_empty() && survey.fleets().len() == 2);
}

#[test]
fn what_is_not_ours_is_told_apart_from_what_cannot_be_read() {
    let mut survey = survey();
    let (sender, to) = sender(&survey);
    sender.send_to(b"GET / HTTP/1.1", to).unwrap();
    sender.send_to(b"x", to).unwrap();
    let mut cut = bytes(7, &search("agv", 3));
    cut.truncate(14);
    sender.send_to(&cut, to).unwrap();
    listen_until(&mut survey, |survey| !survey.heard().is_empty());
    assert_eq!(survey.foreign(), [Foreign { source: sender.local_addr().unwrap(), datagrams: 2 }]);
    assert_eq!((survey.heard()[0].identity.as_ref(), survey.heard()[0].others), (None, 1));
}

#[test]
fn tables_are_bounded_and_what_is_dropped_is_counted() {
    let mut survey = survey();
    let source = SocketAddr::from((Ipv4Addr::new(127, 1, 2, 3), 9));
    for epoch in 0..HEARD as u64 + 10 {
        survey.note(source, &bytes(7, &search("agv", epoch)), Some(1));
    }
    for port in 0..FOREIGN as u16 + 5 {
        survey.note((Ipv4Addr::LOCALHOST, port).into(), b"junk", Some(1));
    }
    assert_eq!((survey.heard().len(), survey.foreign().len()), (HEARD, FOREIGN));
    // The survey's own port may be among the made-up ones only above 1023.
    assert_eq!(survey.dropped(), 15);
    survey.note(source, &bytes(7, &search("agv", 3)), Some(1));
    assert_eq!((survey.heard()[3].searches, survey.dropped()), (2, 15));
}

#[test]
fn a_manager_answers_and_own_broadcasts_come_back() {
    let mut survey = survey();
    let port = survey.reach()[0].port;
    let fleet = random() as u32;
    let manager = crate::CommunicationSystem::builder("boss", 1).unwrap().fleet(fleet).discovery_port(port);
    let manager = manager.insecure().interfaces(Interfaces::Loopback).build().unwrap();
    manager.start().unwrap();
    assert!(survey.ask(Fleet(fleet)));
    listen_until(&mut survey, |survey| survey.heard().iter().any(|heard| heard.answers > 0));
    let boss = survey.heard().iter().find(|heard| heard.answers > 0);
    let boss = boss.unwrap_or_else(|| panic!("no answer: {survey:?}; {:?}", manager.counters()));
    assert_eq!(boss.identity.as_ref(), Some(&manager.identity()));
    assert_eq!(boss.listens_at().map(|at| at.port()), Some(manager.tcp_port()));
    assert_eq!((boss.room, boss.to_us, boss.standing), (Some(Constraints::M_UNIT.maximum_nodes), 1, Standing::Plain));
    assert!(survey.reach().iter().any(|reach| reach.sent == 1 && reach.heard == 1), "{:?}", survey.reach());
    assert!(survey.heard().iter().all(|heard| heard.identity.as_ref() == Some(&manager.identity())));
}

#[test]
fn one_that_only_listens_sends_nothing() {
    let (mut asked, mut silent) = {
        let silent = survey();
        let asked = Survey::open(Interfaces::Loopback, silent.reach()[0].port).unwrap();
        (asked, silent)
    };
    silent.listen(Duration::from_millis(50));
    silent.ask(Fleet(1));
    listen_until(&mut asked, |asked| !asked.heard().is_empty());
    // The first thing that the other one heard is the question, and it is its only one.
    assert!(asked.heard().len() == 1 && asked.heard()[0].is_survey() && asked.heard()[0].searches == 1);
    asked.ask_at(Fleet(1), silent.voice.local_addr().unwrap()).unwrap();
    listen_until(&mut silent, |silent| !silent.heard().is_empty());
    assert!(!silent.heard()[0].by_broadcast);
}

/// Keys of `boss/1` and `agv/7` in a fleet.
fn fleet_keys(fleet: u32) -> FleetKeys {
    let mut keys = FleetKeys::draw(Fleet(fleet)).unwrap();
    keys.add(&Identity::m_unit("boss", 1).unwrap(), &[]).unwrap();
    keys.add(&Identity::s_unit("agv", 7).unwrap(), &[]).unwrap();
    keys
}

#[test]
fn a_secured_manager_answers_with_the_fleets_key_and_to_nobody_else() {
    let fleet = random() as u32;
    let root = fleet_keys(fleet);
    let ring = |identity: &Identity| root.ring(identity).unwrap();
    let boss = Identity::m_unit("boss", 1).unwrap();
    let mut keys = SurveyKeys::default();
    keys.add_ring(&ring(&Identity::s_unit("agv", 7).unwrap()));
    let mut survey = survey().with_keys(keys);
    let (port, mut other_keys) = (survey.reach()[0].port, SurveyKeys::default());
    other_keys.add_ring(&fleet_keys(fleet).ring(&boss).unwrap());
    let mut other = Survey::open(Interfaces::Loopback, port).unwrap().with_keys(other_keys);
    let manager = crate::CommunicationSystem::builder("boss", 1).unwrap().fleet(fleet).discovery_port(port);
    let manager = manager.interfaces(Interfaces::Loopback).keys(ring(&boss)).build().unwrap();
    manager.start().unwrap();
    assert!(other.ask(Fleet(fleet)) && survey.ask(Fleet(fleet)), "{:?}, {:?}", other.reach(), survey.reach());
    listen_until(&mut survey, |survey| survey.heard().iter().any(|heard| heard.to_us > 0));
    let answer = survey.heard().iter().find(|heard| heard.to_us > 0);
    let answer = answer.unwrap_or_else(|| panic!("no answer: {survey:?}; {:?}", manager.counters()));
    assert_eq!((answer.identity.as_ref(), answer.mode), (Some(&boss), Mode::Secured));
    assert_eq!(
        (answer.standing, answer.room),
        (Standing::Proven { generation: 1, root: 1 }, Some(Constraints::M_UNIT.maximum_nodes))
    );
    assert_eq!(answer.listens_at().map(|at| at.port()), Some(manager.tcp_port()));
    // The manager records no refusal of a survey.
    assert!(manager.findings().is_empty(), "{:?}", manager.findings());
    // What it asks of its own accord is heard by all, and trusted by none with other keys.
    listen_until(&mut other, |other| other.heard().iter().any(|heard| heard.identity.as_ref() == Some(&boss)));
    let of_boss = other.heard().iter().filter(|heard| heard.identity.as_ref() == Some(&boss));
    assert!(of_boss.clone().all(|heard| heard.standing == Standing::OtherKeys && heard.to_us == 0));
    assert!(of_boss.count() > 0);
}

#[test]
fn what_is_signed_otherwise_is_another_ones() {
    let fleet = random() as u32;
    let root = fleet_keys(fleet);
    let mut keys = SurveyKeys::default();
    keys.add_root(&root);
    let mut survey = survey().with_keys(keys);
    let (sender, to) = sender(&survey);
    let ring = |root: &FleetKeys| root.ring(&Identity::s_unit("agv", 7).unwrap()).unwrap();
    let (ours, theirs) = (ring(&root), ring(&fleet_keys(fleet)));
    let mut sealed = [0; SEARCH_BYTES];
    for (ring, fleet) in [(&ours, fleet), (&theirs, fleet), (&theirs, fleet.wrapping_add(1))] {
        let mut signers = SurveyKeys::default();
        signers.add_ring(ring);
        let signer = signers.signers(ring.fleet()).next().unwrap();
        let length = search("agv", 3).encode(Fleet(fleet), &signer, &mut sealed).unwrap().len();
        sender.send_to(&sealed[..length], to).unwrap();
    }
    sender.send_to(&bytes(fleet, &search("agv", 3)), to).unwrap();
    listen_until(&mut survey, |survey| survey.heard().len() == 4);
    let standings: Vec<_> = survey.heard().iter().map(|heard| heard.standing).collect();
    let proven = Standing::Proven { generation: 1, root: 1 };
    assert_eq!(standings, [proven, Standing::OtherKeys, Standing::Unchecked, Standing::Plain]);
    assert!(survey.heard().iter().all(|heard| heard.identity.is_some()), "names travel in clear");
}
