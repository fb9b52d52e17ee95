//! What an operator sees of attacks, and how long a revoked vehicle stays.

use std::io::Write;
use std::net::TcpStream;
use std::sync::{Arc, Mutex};
use std::time::{Duration, Instant};

use cara_core::config::{Mode, Priority};
use cara_security::ground::{agv, depot};
use cara_security::linux::{Linux, Weakness, wait_for};
use cara_security::speaker::{HANDSHAKE, Speaker};
use cara_security::target::Target;
use cara_std::access::AccessTable;
use cara_std::control::Control;
use cara_std::keys::{FleetKeys, Store, location};
use cara_std::{CommunicationSystem, Fleet, Interfaces, Unit};

/// Log lines written since the subscriber was installed.
#[derive(Clone, Default)]
struct Lines(Arc<Mutex<Vec<u8>>>);

impl Write for Lines {
    fn write(&mut self, bytes: &[u8]) -> std::io::Result<usize> {
        self.0.lock().unwrap().write(bytes)
    }

    fn flush(&mut self) -> std::io::Result<()> {
        Ok(())
    }
}

impl Lines {
    fn with(&self, text: &str) -> usize {
        String::from_utf8_lossy(&self.0.lock().unwrap()).lines().filter(|line| line.contains(text)).count()
    }
}

/// Two peers make forbidden calls, some hundred times: each refusal is counted, and the unit logs at most one line a
/// second, with their number.
#[test]
fn every_refusal_is_counted_and_one_line_a_second_is_logged() {
    let lines = Lines::default();
    let writer = lines.clone();
    tracing_subscriber::fmt().with_ansi(false).with_writer(move || writer.clone()).init();
    let linux = Linux::new(8, Weakness::None).unwrap();
    let manager = linux.manager().unwrap();
    manager.system.set_access(Some(AccessTable::default()));
    let mut speakers: Vec<_> = [1, 2]
        .map(|id| {
            let stream = TcpStream::connect(manager.address()).unwrap();
            let key = linux.ground.keys(id).genuine;
            let mut speaker = Speaker::new(stream, true, Mode::Secured, linux.claim_of(id), key).unwrap();
            speaker.converse(HANDSHAKE + 2).unwrap();
            speaker.hear_answer(speaker.last_id()).unwrap();
            speaker
        })
        .into();
    let (started, mut asked) = (Instant::now(), 0);
    while started.elapsed() < Duration::from_millis(2_500) {
        for speaker in &mut speakers {
            let request = speaker.request(0, Priority::Normal, true);
            speaker.say_bytes(&request).unwrap();
            assert!(!speaker.hear_answer(speaker.last_id()).unwrap());
            asked += 1;
        }
        std::thread::sleep(Duration::from_millis(5));
    }
    let seconds = started.elapsed().as_secs() as usize + 1;
    assert!(manager.counters().unwrap()["RequestsForbidden"] >= asked);
    let written = lines.with("may not call mark");
    // One more before the loop, from their first call after joining.
    assert!((1..=seconds + 1).contains(&written), "{written} lines for {asked} refusals in {seconds} s");
    assert!(asked > 5 * seconds as u64);
}

/// From the new key file that `cara keys revoke` writes to the end of the link.
#[test]
fn a_live_link_ends_soon_after_its_key_is_revoked() {
    let fleet = Fleet(cara_processes::random_fleet());
    let folder = tempfile::tempdir().unwrap();
    let mut keys = FleetKeys::draw(fleet).unwrap();
    [depot(), agv(1), agv(2)].iter().for_each(|node| keys.add(node, &[]).unwrap());
    let mut store = Store::create(folder.path(), keys).unwrap();
    store.save().unwrap();
    let file = |node| folder.path().join(location::file_name(&node, fleet));
    let builder = CommunicationSystem::builder("depot", 1).unwrap().fleet(fleet.0).control(Control::Off);
    let manager = builder.interfaces(Interfaces::Loopback).key_file(file(depot())).build().unwrap();
    manager.start().unwrap();
    let units = [1, 2].map(|id| {
        let builder = Unit::builder("agv", id, "depot", 1).unwrap().fleet(fleet.0);
        let unit = builder.interfaces(Interfaces::Loopback).key_file(file(agv(id))).build().unwrap();
        unit.start().unwrap();
        unit
    });
    assert!(wait_for(|| manager.number_of_s_units() == 2));
    let revoked = Instant::now();
    store.keys_mut().revoke(&[agv(1)]).unwrap();
    store.save().unwrap();
    assert!(wait_for(|| manager.number_of_s_units() == 1), "it is still there");
    println!("a live link ended {:.1} s after its key was revoked", revoked.elapsed().as_secs_f64());
    // The vehicle detects the end of its link a little later.
    assert!(wait_for(|| !units[0].is_connected() && units[1].is_connected()));
    // It does not come back.
    std::thread::sleep(Duration::from_secs(2));
    assert!(!units[0].is_connected() && manager.number_of_s_units() == 1);
}
