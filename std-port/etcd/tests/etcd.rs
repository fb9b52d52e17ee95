//! Managers that lead by an etcd of the test (Debian's `etcd-server`), which is killed, stopped and cut off: `cargo xtask test etcd`.

use std::hash::{BuildHasher, Hasher, RandomState};
use std::io::{Read, Write};
use std::net::{TcpListener, TcpStream};
use std::path::PathBuf;
use std::process::{Child, Command, Stdio};
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, AtomicU16, AtomicU64, Ordering};
use std::sync::mpsc::Receiver;
use std::thread;
use std::time::{Duration, Instant};

use cara_etcd::Etcd;
use cara_std::{
    Builder, Claim, CommunicationSystem, Definition, Error, Interfaces, MUnit, Parameters, ParametersView, Peer, Renew,
    Served, ServiceError, ServiceOptions, StartError, Unit, UnitEvent,
};
use rustix::process::{Pid, Signal, kill_process};
use tempfile::TempDir;

#[path = "../../tests/keyed/mod.rs"]
mod keyed;

/// Longest wait for anything that is to happen.
const PATIENCE: Duration = Duration::from_secs(30);
/// The shortest lease that an etcd with its default elections grants.
const LEASE: Duration = Duration::from_secs(2);

/// A member of a cluster, in a process of its own.
struct Server {
    child: Child,
    folder: TempDir,
    port: u16,
    cluster: String,
    number: usize,
}

impl Server {
    /// A cluster of one.
    fn start() -> Self {
        Self::cluster(1).remove(0)
    }

    fn cluster(members: usize) -> Vec<Self> {
        let peers: Vec<u16> = (0..members).map(|_| free_port()).collect();
        let member = |(number, port): (usize, &u16)| format!("m{number}=http://127.0.0.1:{port}");
        let cluster = peers.iter().enumerate().map(member).collect::<Vec<_>>().join(",");
        let start = |number| {
            let (folder, port) = (tempfile::tempdir().unwrap(), free_port());
            let child = run(&folder, port, &cluster, number);
            Self { child, folder, port, cluster: cluster.clone(), number }
        };
        let servers: Vec<_> = (0..members).map(start).collect();
        servers.iter().for_each(Self::wait);
        servers
    }

    /// Waits until it answers.
    fn wait(&self) {
        until("etcd is healthy", || {
            let answer = ureq::get(format!("{}/health", self.endpoint())).call();
            answer.and_then(|mut answer| answer.body_mut().read_to_string()).is_ok_and(|text| text.contains("true"))
        });
    }

    fn endpoint(&self) -> String {
        format!("http://127.0.0.1:{}", self.port)
    }

    fn signal(&self, signal: Signal) {
        kill_process(Pid::from_child(&self.child), signal).unwrap();
    }

    fn kill(&mut self) {
        self.child.kill().unwrap();
        self.child.wait().unwrap();
    }

    /// The same member again, with what it has stored.
    fn restart(&mut self) {
        self.child = run(&self.folder, self.port, &self.cluster, self.number);
        self.wait();
    }

    fn post(&self, path: &str, body: &str) {
        ureq::post(format!("{}/v3/{path}", self.endpoint())).send(body).unwrap();
    }
}

fn run(folder: &TempDir, port: u16, cluster: &str, number: usize) -> Child {
    let (clients, name) = (format!("http://127.0.0.1:{port}"), format!("m{number}"));
    let peers = cluster.split(',').nth(number).and_then(|member| member.split_once('=')).unwrap().1;
    let mut etcd = Command::new("etcd");
    etcd.args(["--name", &name, "--initial-cluster", cluster, "--initial-advertise-peer-urls", peers]);
    etcd.args(["--listen-peer-urls", peers, "--listen-client-urls", &clients, "--advertise-client-urls", &clients]);
    etcd.arg("--data-dir").arg(folder.path()).stdout(Stdio::null()).stderr(Stdio::null());
    etcd.spawn().expect("etcd is installed (apt-get install etcd-server)")
}

impl Drop for Server {
    fn drop(&mut self) {
        let _ = self.child.kill();
        let _ = self.child.wait();
    }
}

/// A port below those that the system gives to connections, and not the same twice.
fn free_port() -> u16 {
    static NEXT: AtomicU16 = AtomicU16::new(0);
    loop {
        let port = 20_000 + (std::process::id() as u16 % 1_000) * 10 + NEXT.fetch_add(1, Ordering::SeqCst) % 2_000;
        if TcpListener::bind(("127.0.0.1", port)).is_ok() {
            return port;
        }
    }
}

/// Passes connections on to a port until it is cut: from then on it takes them, and forwards nothing.
struct Relay {
    port: u16,
    is_cut: Arc<AtomicBool>,
}

impl Relay {
    fn to(port: u16) -> Self {
        let listener = TcpListener::bind("127.0.0.1:0").unwrap();
        let relay = Self { port: listener.local_addr().unwrap().port(), is_cut: Arc::default() };
        let is_cut = relay.is_cut.clone();
        thread::spawn(move || {
            for client in listener.incoming().map_while(Result::ok) {
                let Ok(server) = TcpStream::connect(("127.0.0.1", port)) else { continue };
                let (back, forth) = (server.try_clone().unwrap(), client.try_clone().unwrap());
                for (from, to) in [(client, server), (back, forth)] {
                    let is_cut = is_cut.clone();
                    thread::spawn(move || forward(from, to, &is_cut));
                }
            }
        });
        relay
    }

    fn endpoint(&self) -> String {
        format!("http://127.0.0.1:{}", self.port)
    }

    fn cut(&self, is_cut: bool) {
        self.is_cut.store(is_cut, Ordering::SeqCst);
    }
}

fn forward(mut from: TcpStream, mut to: TcpStream, is_cut: &AtomicBool) {
    let mut bytes = [0; 4096];
    while let Ok(count @ 1..) = from.read(&mut bytes) {
        while is_cut.load(Ordering::SeqCst) {
            thread::sleep(Duration::from_millis(5));
        }
        if to.write_all(&bytes[..count]).is_err() {
            return;
        }
    }
}

fn until(what: &str, mut condition: impl FnMut() -> bool) {
    let end = Instant::now() + PATIENCE;
    while !condition() {
        assert!(Instant::now() < end, "not in time: {what}");
        thread::sleep(Duration::from_millis(5));
    }
}

/// A fleet of its own, and its folders.
struct Fleet {
    number: u32,
    folder: TempDir,
}

impl Fleet {
    fn new() -> Self {
        Self { number: RandomState::new().build_hasher().finish() as u32, folder: tempfile::tempdir().unwrap() }
    }

    fn state(&self, name: &str) -> PathBuf {
        self.folder.path().join(name)
    }

    /// A manager with a folder of state of this name, which does not ask whether another one is there.
    fn manager(&self, name: &str, etcd: Etcd) -> Builder<(), MUnit> {
        let manager = keyed::pair(self.number).0.interfaces(Interfaces::Loopback).beside_another();
        manager.state_folder(self.state(name)).authority(etcd.lease(LEASE))
    }

    /// Its vehicle, with an order from the manager that goes on for as long as that holds it.
    fn driven(&self, manager: &CommunicationSystem) -> Driven {
        let agv = keyed::pair(self.number).1.interfaces(Interfaces::Loopback).state_folder(self.state("agv"));
        let agv = agv.build().unwrap();
        let drive = agv.my_function_list().actuator(|| ()).unwrap();
        let options = ServiceOptions::new().moves(&drive, Duration::from_secs(1));
        let go = |_: &Served, _: &mut ParametersView| -> Result<(), ServiceError> { Ok(()) };
        agv.my_function_list().add_service(&Definition::parse("go()").unwrap(), options, go).unwrap();
        // Another call that moves it would end the order.
        agv.my_function_list().add_service(&Definition::parse("pass()").unwrap(), ServiceOptions::new(), go).unwrap();
        agv.publish_my_function_list().unwrap();
        agv.start().unwrap();
        until("the vehicle offers to go", || !manager.nodes_offering("go").is_empty());
        let peer = manager.nodes_offering("go").remove(0);
        let mut none = Parameters::new();
        let order = peer.call("go", &mut none).only_while_leading().renewing(Renew::Process).hold().wait().unwrap();
        let lease = drive.watch();
        let goes_on = Box::new(move || {
            let _held = &order;
            lease.is_live()
        });
        Driven { agv, peer, goes_on }
    }
}

/// A vehicle with an order that goes on.
struct Driven {
    agv: Unit,
    peer: Peer<()>,
    goes_on: Box<dyn Fn() -> bool>,
}

impl Driven {
    fn check(&self, is_leading: bool) {
        assert!((self.goes_on)() && self.peer.is_connected(), "the order and the link go on");
        let mut none = Parameters::new();
        let exclusive = self.peer.call("pass", &mut none).only_while_leading().wait().map(drop).map_err(Error::from);
        if is_leading {
            assert_eq!(exclusive, Ok(()));
        } else {
            assert_eq!(exclusive, Err(Error::NoAuthority));
        }
    }
}

fn leading(events: &Receiver<UnitEvent>) -> Claim {
    loop {
        if let UnitEvent::Leading { claim } = events.recv_timeout(PATIENCE).expect("not in time: it leads") {
            return claim;
        }
    }
}

fn not_leading(events: &Receiver<UnitEvent>) {
    while events.recv_timeout(PATIENCE).expect("not in time: it does not lead") != UnitEvent::NotLeading {}
}

/// Looks all the time that no two of these managers lead at once.
struct Watch {
    ends: Arc<AtomicBool>,
    looks: Arc<AtomicU64>,
    looker: Option<thread::JoinHandle<()>>,
}

impl Watch {
    fn of(managers: &[&CommunicationSystem]) -> Self {
        let managers: Vec<_> = managers.iter().map(|manager| (*manager).clone()).collect();
        let (ends, looks) = (Arc::<AtomicBool>::default(), Arc::<AtomicU64>::default());
        let (ended, looked) = (ends.clone(), looks.clone());
        let looker = thread::spawn(move || {
            while !ended.load(Ordering::SeqCst) {
                let leading = managers.iter().filter(|manager| manager.is_leading()).count();
                assert!(leading <= 1, "{leading} managers lead");
                looked.fetch_add(1, Ordering::SeqCst);
                thread::sleep(Duration::from_micros(200));
            }
        });
        Self { ends, looks, looker: Some(looker) }
    }

    fn end(mut self) {
        self.ends.store(true, Ordering::SeqCst);
        self.looker.take().unwrap().join().unwrap();
        assert!(self.looks.load(Ordering::SeqCst) > 10);
    }
}

#[test]
fn the_first_manager_leads_and_the_second_is_refused_until_the_first_has_stopped() {
    let (server, fleet) = (Server::start(), Fleet::new());
    let one = fleet.manager("one", Etcd::new([server.endpoint()])).build().unwrap();
    let two = fleet.manager("two", Etcd::new([server.endpoint()])).build().unwrap();
    let events = one.events();
    one.start().unwrap();
    assert_eq!(leading(&events), one.claim());
    let refused = two.start();
    assert!(matches!(&refused, Err(StartError::NoAuthority { .. })), "{refused:?}");
    // Another prefix is another key, and another identity as well.
    let apart = fleet.manager("apart", Etcd::new([server.endpoint()]).prefix("elsewhere/"));
    apart.build().unwrap().start().unwrap();
    let watch = Watch::of(&[&one, &two]);
    let (stopped, claim) = (Instant::now(), one.claim());
    one.stop();
    until("the second one starts", || two.start().is_ok());
    assert!(stopped.elapsed() < LEASE / 2, "the key was given back");
    assert!(two.claim() > claim && two.claim().term > claim.term);
    watch.end();
}

#[test]
fn orders_go_on_while_etcd_is_killed_stopped_or_cut_off_and_the_manager_leads_again_behind_it() {
    let (mut server, fleet) = (Server::start(), Fleet::new());
    let relay = Relay::to(server.port);
    let depot = fleet.manager("depot", Etcd::new([relay.endpoint()])).build().unwrap();
    let events = depot.events();
    depot.start().unwrap();
    let mut claim = leading(&events);
    let driven = fleet.driven(&depot);
    for loss in ["killed", "stopped", "cut off"] {
        let lost = Instant::now();
        match loss {
            "killed" => server.kill(),
            "stopped" => server.signal(Signal::STOP),
            _ => relay.cut(true),
        }
        not_leading(&events);
        println!("{loss}: did not lead any more after {:?}", lost.elapsed());
        driven.check(false);
        // The lease has ended at etcd as well, where that counts.
        thread::sleep(LEASE);
        driven.check(false);
        assert_eq!(depot.claim(), claim, "no other claim without the key");
        let back = Instant::now();
        match loss {
            "killed" => server.restart(),
            "stopped" => server.signal(Signal::CONT),
            _ => relay.cut(false),
        }
        let after = leading(&events);
        println!("{loss}: leads again after {:?}, with {claim} before and {after} now", back.elapsed());
        assert!(after >= claim);
        claim = after;
        driven.check(true);
        until("the vehicle obeys that claim", || driven.agv.claim() == claim);
    }
}

#[test]
fn of_two_managers_at_both_sides_of_a_partition_only_one_leads_at_a_time() {
    let (server, fleet) = (Server::start(), Fleet::new());
    let relay = Relay::to(server.port);
    let one = fleet.manager("one", Etcd::new([relay.endpoint()])).build().unwrap();
    let two = fleet.manager("two", Etcd::new([server.endpoint()])).build().unwrap();
    let watch = Watch::of(&[&one, &two]);
    let (events, its_events) = (one.events(), two.events());
    one.start().unwrap();
    leading(&events);
    relay.cut(true);
    let cut = Instant::now();
    until("the second one has the key", || two.start().is_ok());
    println!("the second one starts {:?} after the cut", cut.elapsed());
    not_leading(&events);
    assert!(leading(&its_events) > one.claim());
    watch.end();
}

/// A standby takes the key only to command.
#[test]
fn a_standby_leaves_the_key_to_a_manager_that_is_cut_off_from_etcd_and_leads_when_that_has_ended() {
    let (server, fleet) = (Server::start(), Fleet::new());
    let relay = Relay::to(server.port);
    let depot = fleet.manager("depot", Etcd::new([relay.endpoint()])).standby().build().unwrap();
    let events = depot.events();
    depot.start().unwrap();
    leading(&events);
    let driven = fleet.driven(&depot);
    let standby = fleet.manager("standby", Etcd::new([server.endpoint()])).standby().build().unwrap();
    let its_events = standby.events();
    standby.start().unwrap();
    let watch = Watch::of(&[&depot, &standby]);
    relay.cut(true);
    not_leading(&events);
    thread::sleep(LEASE * 2);
    driven.check(false);
    assert!(standby.is_standby() && !standby.is_leading());
    relay.cut(false);
    let claim = leading(&events);
    driven.check(true);
    drop(driven.goes_on);
    let stopped = Instant::now();
    depot.stop();
    let after = leading(&its_events);
    println!("the standby leads {:?} after the end of the manager", stopped.elapsed());
    assert!(after > claim && !standby.is_standby());
    until("the vehicle obeys it", || driven.agv.claim() == after);
    watch.end();
}

#[test]
fn a_manager_leads_on_when_the_leader_of_a_cluster_is_killed() {
    let (mut servers, fleet) = (Server::cluster(3), Fleet::new());
    let endpoints: Vec<_> = servers.iter().map(Server::endpoint).collect();
    let etcd = Etcd::new(endpoints);
    let depot = fleet.manager("depot", etcd).build().unwrap();
    let events = depot.events();
    depot.start().unwrap();
    let claim = leading(&events);
    let driven = fleet.driven(&depot);
    // The first endpoint is the one that it asks.
    servers[0].kill();
    thread::sleep(LEASE * 3);
    until("it leads, again or still", || depot.is_leading());
    driven.check(true);
    println!("with {claim} before and {} now", depot.claim());
    servers[1].kill();
    // Without an event: it may have lost the key for a moment before.
    until("it does not lead without a majority", || !depot.is_leading());
    driven.check(false);
}

#[test]
fn a_user_of_etcd_needs_its_password() {
    let (server, fleet) = (Server::start(), Fleet::new());
    server.post("auth/user/add", r#"{"name":"root","password":"secret"}"#);
    server.post("auth/role/add", r#"{"name":"root"}"#);
    server.post("auth/user/grant", r#"{"user":"root","role":"root"}"#);
    server.post("auth/enable", "{}");
    let etcd = || Etcd::new([server.endpoint()]);
    for refused in [etcd(), etcd().user("root", "wrong")] {
        let refused = fleet.manager("depot", refused).build().unwrap().start();
        assert!(matches!(&refused, Err(StartError::NoAuthority { why, .. }) if why.contains("etcd")), "{refused:?}");
    }
    let depot = fleet.manager("depot", etcd().user("root", "secret")).build().unwrap();
    depot.start().unwrap();
    until("it leads", || depot.is_leading());
}
