//! Recorded core sessions run again: those in `recorded`, and one of a manager and a vehicle on loopback.

use std::hash::{BuildHasher, Hasher, RandomState};
use std::net::{Ipv4Addr, Shutdown, SocketAddr, TcpListener, TcpStream};
use std::path::{Path, PathBuf};
use std::time::{Duration, Instant};

use cara_scenarios::recorded;
use cara_std::{
    CommunicationSystem, Interfaces, Parameters, ParametersView, Renew, RequestOptions, RerunError, Served,
    ServiceError, ServiceOptions, Unit, rerun,
};

fn until(what: &str, mut condition: impl FnMut() -> bool) {
    let end = Instant::now() + Duration::from_secs(20);
    while !condition() {
        assert!(Instant::now() < end, "not in time: {what}");
        std::thread::sleep(Duration::from_millis(1));
    }
}

fn recordings(folder: &Path) -> Vec<PathBuf> {
    let mut files: Vec<_> = std::fs::read_dir(folder).unwrap().map(|entry| entry.unwrap().path()).collect();
    files.sort();
    files
}

/// Passes one connection on to a manager; what it returns cuts both ways of it.
fn relay(to: SocketAddr) -> (SocketAddr, impl FnOnce()) {
    let listener = TcpListener::bind((Ipv4Addr::LOCALHOST, 0)).unwrap();
    let address = listener.local_addr().unwrap();
    let (sender, ends) = std::sync::mpsc::channel::<TcpStream>();
    std::thread::spawn(move || {
        let near = listener.accept().unwrap().0;
        let far = TcpStream::connect(to).unwrap();
        for (mut from, mut into) in [(near.try_clone(), far.try_clone()), (far.try_clone(), near.try_clone())]
            .map(|(from, into)| (from.unwrap(), into.unwrap()))
        {
            std::thread::spawn(move || std::io::copy(&mut from, &mut into));
        }
        sender.send(near).unwrap();
        sender.send(far).unwrap();
    });
    (address, move || ends.iter().for_each(|end| drop(end.shutdown(Shutdown::Both))))
}

/// A manager calls a vehicle, orders it to move under a lease, and loses the link: the recording of that.
fn record(folder: &Path) -> String {
    let fleet = RandomState::new().build_hasher().finish() as u32;
    let port = TcpListener::bind((Ipv4Addr::LOCALHOST, 0)).unwrap().local_addr().unwrap().port();
    let manager = CommunicationSystem::builder("manager", 1).unwrap().interfaces(Interfaces::Loopback);
    let manager = manager.fleet(fleet).insecure().tcp_port(port).record_core(folder).build().unwrap();
    manager.start().unwrap();
    let (address, cut) = relay((Ipv4Addr::LOCALHOST, port).into());
    let vehicle = Unit::builder("agv", 7, "manager", 1).unwrap().interfaces(Interfaces::Loopback);
    let vehicle = vehicle.fleet(fleet).insecure().manager_address(address).build().unwrap();
    let functions = vehicle.my_function_list();
    let double = |_: &mut (), _: &Served, parameters: &mut ParametersView| -> Result<(), ServiceError> {
        let number: i64 = parameters.variable("number")?;
        Ok(parameters.set_value("number", 2 * number)?)
    };
    let signature = |name: &str| format!("{name}(number: int[1]) -> (number: int[1])").parse().unwrap();
    functions.add_service(&signature("double"), ServiceOptions::new(), double).unwrap();
    let lease = ServiceOptions::new().lease(Duration::from_millis(1_600), || ());
    let lease = functions.add_service(&signature("go_to"), lease, double).unwrap();
    vehicle.publish_my_function_list().unwrap();
    vehicle.start().unwrap();
    until("the vehicle has joined", || manager.number_of_s_units() == 1);
    let peer = manager.s_unit("agv").unwrap();
    until("its functions are known", || peer.their_function_list().len() == 2);
    let mut number = Parameters::new();
    number.add_int("number", 1).unwrap();
    number.set_value("number", 21).unwrap();
    peer.block_request("double", &mut number).unwrap();
    assert_eq!(number.variable("number"), Ok(42));
    let options = RequestOptions::renewing(Renew::Process);
    peer.call("go_to", &mut number).with(options).wait().unwrap();
    let mut before = lease.left();
    until("the order is renewed", || {
        let left = lease.left();
        left > std::mem::replace(&mut before, left)
    });
    cut();
    until("the manager has lost it", || manager.number_of_s_units() == 0);
    until("the order has ended", || !lease.is_live());
    vehicle.stop();
    manager.stop();
    std::fs::read_to_string(folder.join("1.core")).unwrap()
}

#[test]
fn every_recording_runs_again() {
    let files = recordings(&recorded::folder());
    assert!(!files.is_empty());
    for file in files {
        println!("{}", recorded::run(&file).unwrap());
    }
}

/// `CARA_RECORDINGS` names a folder where its recording stays.
#[test]
fn a_session_runs_again_to_the_same_and_a_changed_byte_is_found() {
    let temporary = tempfile::tempdir().unwrap();
    let kept = std::env::var_os("CARA_RECORDINGS").map(PathBuf::from);
    let text = record(kept.as_deref().unwrap_or(temporary.path()));
    let first = rerun(&text).unwrap();
    assert_eq!(first.cut, None);
    for word in ["receive", "make", "request", "poll", "datagram", "disconnected"] {
        assert!(text.contains(&format!(" {word} ")) || text.contains(&format!(" {word}\n")), "no {word}");
    }
    for _ in 0..9 {
        assert_eq!(rerun(&text), Ok(first.clone()));
    }
    // A letter of the vehicle's name, and of a function's, and a byte of a result.
    for (received, changed) in
        [("03616776", "03616777"), ("646f75626c65", "656f75626c65"), ("2a00000000000000\n", "2b00000000000000\n")]
    {
        let expected = text[..text.find(received).unwrap()].lines().count();
        match rerun(&text.replacen(received, changed, 1)) {
            Err(RerunError::Differs { line, .. }) => assert_eq!(line, expected),
            other => panic!("{received}: {other:?}"),
        }
    }
}

#[test]
fn what_is_no_recording_is_refused() {
    assert_eq!(rerun(""), Err(RerunError::Malformed(1)));
    assert_eq!(rerun("CARA core session 1\nsession 1"), Err(RerunError::Malformed(1)));
    assert!(recorded::keep(Path::new("x"), "../y").is_err());
}
