//! A manager and a vehicle as processes on hosts of their own, with a path between them that loses the one or the other: TCP
//! sessions that are forgotten, UDP that is dropped, long packets, a NAT, a relay, a second address. No address here has a
//! broadcast address from the system, and no host a default route. Each test is a fleet of its own.

use std::fs;
use std::io::{Read, Write};
use std::net::{TcpListener, TcpStream};
use std::path::PathBuf;
use std::process::{Child, Command, Stdio};
use std::time::{Duration, Instant};

use cara_processes::network::{self, Namespace, filter, ip, paths};
use cara_processes::random_fleet;
use cara_processes::ticker::Ticker;
use serde_json::Value;

/// Longest wait for anything that is to happen.
const PATIENCE: Duration = Duration::from_secs(120);
const MANAGER: &str = "10.91.3.1";
const VEHICLE: &str = "10.91.3.2";
const PORT: u16 = 7000;

/// Runs a test on the manager's host, with a cable to the vehicle's: `v0` here and `v1` there.
fn inside(name: &str, test: impl FnOnce(Fleet)) {
    if !network::test(name, &["nft"], false) {
        return;
    }
    let there = Host::new();
    ip("link set lo up");
    ip("link add v0 type veth peer name v1");
    ip(&format!("link set v1 netns {}", there.holder.id()));
    // Frames of the size that a cable carries.
    for (host, device, address) in [(None, "v0", MANAGER), (Some(&there), "v1", VEHICLE)] {
        for words in ["link set DEV gso_max_segs 1", "address add ADDRESS/24 dev DEV", "link set DEV up"] {
            let words = format!("ip {}", words.replace("DEV", device).replace("ADDRESS", address));
            host.map_or_else(|| network::run(&words), |host| host.network.run(&words)).unwrap();
        }
    }
    test(Fleet::new(there));
}

/// Another host: what holds its network.
struct Host {
    holder: Child,
    network: Namespace,
}

impl Host {
    fn new() -> Self {
        let mut command = Command::new("unshare");
        command.args(["--net", "sh", "-c", "ip link set lo up && echo && read end"]).env("PATH", paths());
        let mut holder = command.stdin(Stdio::piped()).stdout(Stdio::piped()).spawn().unwrap();
        holder.stdout.as_mut().unwrap().read_exact(&mut [0]).unwrap();
        let network = Namespace::of(holder.id()).unwrap();
        Self { holder, network }
    }
}

impl Drop for Host {
    fn drop(&mut self) {
        let _ = self.holder.kill();
        let _ = self.holder.wait();
    }
}

/// A process that ends with its owner.
struct Running(Child);

impl Drop for Running {
    fn drop(&mut self) {
        let _ = self.0.kill();
        let _ = self.0.wait();
    }
}

struct Fleet {
    there: Host,
    folder: tempfile::TempDir,
    fleet: String,
    units: Vec<Running>,
}

impl Fleet {
    fn new(there: Host) -> Self {
        use std::os::unix::fs::PermissionsExt;
        let private = fs::Permissions::from_mode(0o700);
        let folder = tempfile::Builder::new().permissions(private).tempdir().unwrap();
        let fleet = Self { there, folder, fleet: random_fleet().to_string(), units: Vec::new() };
        let keys =
            fleet.command(&["keys", "new-fleet", "--fleet", &fleet.fleet, "depot/1@m_unit", "agv-17/17"]).output();
        assert!(keys.unwrap().status.success());
        fleet
    }

    fn command(&self, arguments: &[&str]) -> Command {
        let mut command = Command::new(env!("CARGO_BIN_EXE_cara"));
        command.args(arguments).env("CARA_CONTROL_DIR", self.folder.path()).env("CARA_KEYS", self.folder.path());
        command.env("XDG_STATE_HOME", self.folder.path()).env_remove("CARA_INTERFACES").env("NO_COLOR", "1");
        command
    }

    fn log(&self, name: &str) -> PathBuf {
        self.folder.path().join(format!("{name}.log"))
    }

    fn spawn(&mut self, name: &str, mut command: Command) {
        let log = fs::File::create(self.log(name)).unwrap();
        command.stdout(log.try_clone().unwrap()).stderr(log);
        self.units.push(Running(command.spawn().unwrap()));
    }

    /// Starts both; the vehicle is told this address of its manager, or looks for it.
    fn start(&mut self, address: Option<&str>) {
        let port = PORT.to_string();
        let fleet = self.fleet.clone();
        let manager = self.command(&["node", "--name", "depot", "--id", "1", "--fleet", &fleet, "--tcp-port", &port]);
        self.spawn("depot", manager);
        let file = self.folder.path().join("agv.toml");
        let address = address.map_or(String::new(), |address| format!("address = \"{address}\"\n"));
        let text = format!(
            "name = \"agv-17\"\nid = 17\nrole = \"s_unit\"\nfleet = {fleet}\n[manager]\nname = \"depot\"\nid = 1\n{address}\
             [[functions]]\nsignature = \"echo(text: string[20000]) -> (text: string[20000])\"\nanswer = \"echo\"\n\
             [[functions]]\nsignature = \"note(text: string[20])\"\nanswer = \"log\"\n"
        );
        fs::write(&file, text).unwrap();
        let vehicle = self.command(&["node", file.to_str().unwrap()]);
        // It inherits the network of the thread that starts it.
        let log = fs::File::create(self.log("agv")).unwrap();
        let started = self.there.network.within(|| {
            let mut vehicle = vehicle;
            vehicle.env("CARA_CONTROL_DIR", self.folder.path().join("agv"));
            Ok(Running(vehicle.stdout(log.try_clone()?).stderr(log).spawn()?))
        });
        self.units.push(started.unwrap());
        self.until("it has joined", |fleet| fleet.node()["functions"] == 2);
    }

    fn logs(&self) -> String {
        ["depot", "agv"].map(|name| fs::read_to_string(self.log(name)).unwrap_or_default()).join("\n--\n")
    }

    #[track_caller]
    fn until(&self, what: &str, mut condition: impl FnMut(&Self) -> bool) {
        let end = Instant::now() + PATIENCE;
        while !condition(self) {
            assert!(Instant::now() < end, "not in time: {what}\n{}\n{}", self.node(), self.logs());
            std::thread::sleep(Duration::from_millis(200));
        }
    }

    fn json(&self, arguments: &[&str]) -> Value {
        let output = self.command(arguments).output().unwrap();
        serde_json::from_slice(&output.stdout).unwrap_or_default()
    }

    /// The vehicle as `cara scan --json` shows it.
    fn node(&self) -> Value {
        self.json(&["scan", "--json"])["nodes"][0].clone()
    }

    fn datagrams(&self) -> Option<String> {
        self.node()["link"]["datagrams"].as_str().map(str::to_owned)
    }

    fn call(&self, length: usize) -> bool {
        let call = format!("echo(text: \"{}\")", "x".repeat(length));
        self.command(&["call", "agv-17", &call]).output().unwrap().status.success()
    }

    /// How many of five best-effort calls are accepted and arrive.
    fn best_effort(&self) -> usize {
        for n in 0..5 {
            let call = format!("note(text: \"best {n}\")");
            let called = self.command(&["call", "agv-17", &call, "--best-effort", "--async"]).output().unwrap();
            assert!(called.status.success(), "{called:?}");
        }
        let arrived = || fs::read_to_string(self.log("agv")).unwrap().matches("best ").count();
        let end = Instant::now() + PATIENCE;
        while arrived() < 5 && Instant::now() < end {
            std::thread::sleep(Duration::from_millis(50));
        }
        arrived()
    }

    /// The ids of what the doctor finds about the vehicle, and the first text.
    fn doctor(&self) -> (Vec<String>, String) {
        let reported = self.json(&["doctor", "agv-17", "--fleet", &self.fleet, "--listen", "2s", "--json"]);
        let findings = reported["findings"].as_array().unwrap_or_else(|| panic!("{reported}"));
        let text = |finding: &Value, part: &str| finding[part].as_str().unwrap_or_default().to_owned();
        (findings.iter().map(|finding| text(finding, "id")).collect(), text(&findings[0], "found"))
    }
}

/// The vehicle's port of the connection that is open now.
fn vehicles_port(fleet: &Fleet) -> u16 {
    let address = fleet.node()["address"].as_str().unwrap_or_default().to_owned();
    address.rsplit_once(':').expect("it is connected").1.parse().unwrap()
}

/// As behind a firewall that has forgotten the session: its packets are dropped, and UDP and new connections pass.
#[test]
fn a_forgotten_tcp_session_is_found_and_opened_anew() {
    inside("a_forgotten_tcp_session_is_found_and_opened_anew", |mut fleet| {
        fleet.start(None);
        fleet.until("datagrams pass", |fleet| fleet.datagrams().as_deref() == Some("pass"));
        let port = vehicles_port(&fleet);
        let start = Instant::now();
        filter("inet box", "input", &format!("tcp sport {port} drop")).unwrap();
        filter("inet box", "output", &format!("tcp dport {port} drop")).unwrap();
        fleet.until("it is connected by another connection", |fleet| {
            let node = fleet.node();
            node["connected"] == true && !node["address"].as_str().unwrap_or_default().ends_with(&format!(":{port}"))
        });
        assert!(start.elapsed() >= Duration::from_secs(7), "{:?}", start.elapsed());
        fleet.until("a call is answered", |fleet| fleet.call(10));
        assert!(fleet.logs().contains("the stream is dead"), "{}", fleet.logs());
        let (ids, text) = fleet.doctor();
        assert_eq!(
            (&ids[..], text.contains("opened again")),
            (&["stream-dead".to_owned(), "connected".to_owned()][..], true),
            "{text}"
        );
    });
}

#[test]
fn where_no_datagrams_pass_the_connection_carries_all() {
    inside("where_no_datagrams_pass_the_connection_carries_all", |mut fleet| {
        fleet.start(None);
        // Discovery has done its work.
        filter("inet box", "input", "meta l4proto udp drop").unwrap();
        filter("inet box", "output", "meta l4proto udp drop").unwrap();
        fleet.until("it is found", |fleet| fleet.datagrams().as_deref() == Some("none"));
        assert_eq!(fleet.best_effort(), 5);
        assert!(fleet.call(10) && fleet.node()["connected"] == true, "{}", fleet.logs());
        let (ids, text) = fleet.doctor();
        assert!(
            ids == ["datagrams-blocked"] && text.contains("no datagrams pass between depot/1 and agv-17/17"),
            "{ids:?} {text}"
        );
        // A silent peer is lost as soon as where datagrams pass.
        let (cut, ticker) = (Instant::now(), Ticker::start());
        ip("link set v0 down");
        let (mut asked, mut node) = (Duration::ZERO, Value::Null);
        fleet.until("it has left", |fleet| {
            // Before it asks: the command may be late where this process is not.
            (asked, node) = (cut.elapsed(), fleet.node());
            node["connected"] == false && node["left_ms"].is_u64()
        });
        assert_eq!(node["left_reason"], "Silent");
        let after = asked.saturating_sub(Duration::from_millis(node["left_ms"].as_u64().unwrap()));
        assert!(after < Duration::from_secs(7) + ticker.together(), "{after:?}");
    });
}

#[test]
fn the_direction_in_which_datagrams_do_not_pass_is_told() {
    inside("the_direction_in_which_datagrams_do_not_pass_is_told", |mut fleet| {
        fleet.start(None);
        for (hook, direction) in [("input", "to_node"), ("output", "to_unit")] {
            filter("inet box", hook, "meta l4proto udp drop").unwrap();
            fleet.until(direction, |fleet| fleet.datagrams().as_deref() == Some(direction));
            assert!(fleet.call(10), "{}", fleet.logs());
            network::run("nft flush ruleset").unwrap();
            fleet.until("they pass again", |fleet| fleet.datagrams().as_deref() == Some("pass"));
        }
        assert_eq!(fleet.best_effort(), 5);
    });
}

/// Long packets vanish without a word, small ones pass.
#[test]
fn a_hole_in_the_mtu_is_got_round_with_short_segments() {
    inside("a_hole_in_the_mtu_is_got_round_with_short_segments", |mut fleet| {
        filter("inet box", "input", "meta l4proto tcp ip length > 900 drop").unwrap();
        filter("inet box", "output", "meta l4proto tcp ip length > 900 drop").unwrap();
        fleet.start(None);
        assert!(fleet.call(10), "short ones pass: {}", fleet.logs());
        fleet.until("a long call is answered", |fleet| fleet.call(5_000));
        let segment = fleet.node()["link"]["segment"].as_u64();
        assert!(segment.is_some_and(|segment| segment <= 536), "{segment:?} {}", fleet.logs());
        let (ids, text) = fleet.doctor();
        assert!(ids[0] == "stream-dead" && text.contains("segments of"), "{ids:?} {text}");
    });
}

/// As with keepalived: the vehicle knows the manager by an address that is not the first one of its host.
#[test]
fn a_second_address_is_as_good_as_the_first() {
    inside("a_second_address_is_as_good_as_the_first", |mut fleet| {
        ip("address add 10.91.3.100/24 dev v0");
        fleet.start(Some("10.91.3.100:7000"));
        fleet.until("datagrams pass", |fleet| fleet.datagrams().as_deref() == Some("pass"));
        assert_eq!(fleet.best_effort(), 5);
        assert!(fleet.call(10));
        assert_eq!(fleet.doctor().0, ["connected"]);
    });
}

/// A NAT that changes every port: what comes from the vehicle passes, and what is sent to the port that it told does not.
#[test]
fn behind_a_nat_that_changes_ports_a_vehicle_is_connected() {
    inside("behind_a_nat_that_changes_ports_a_vehicle_is_connected", |mut fleet| {
        fleet.there.network.run("ip address add 10.92.0.1/32 dev lo").unwrap();
        let nat = "table ip box {\nchain out {\ntype nat hook postrouting priority 100\noifname v1 masquerade fully-random\n}\n}";
        fleet
            .there
            .network
            .within(|| {
                assert!(Command::new("nft").arg(nat).env("PATH", paths()).status()?.success());
                Ok(())
            })
            .unwrap();
        fleet.start(Some("10.91.3.1:7000"));
        fleet
            .until("it is known what passes", |fleet| matches!(fleet.datagrams().as_deref(), Some("to_unit" | "pass")));
        std::thread::sleep(Duration::from_secs(5));
        assert!(fleet.call(10) && fleet.best_effort() == 5, "{}", fleet.logs());
        assert!(matches!(fleet.datagrams().as_deref(), Some("to_unit" | "pass")), "{}", fleet.node());
        assert_eq!(fleet.node()["connected"], true);
    });
}

/// A relay of streams knows nothing of datagrams, and its ends have its address.
#[test]
fn through_a_relay_of_streams_all_goes_in_the_stream() {
    inside("through_a_relay_of_streams_all_goes_in_the_stream", |mut fleet| {
        ip("address add 10.91.3.9/24 dev v0");
        // As if it were another host: no datagram that is sent there comes to the manager's program.
        filter("inet box", "input", "ip daddr 10.91.3.9 meta l4proto udp drop").unwrap();
        let listener = TcpListener::bind(("10.91.3.9", 7001)).unwrap();
        std::thread::spawn(move || {
            for near in listener.incoming().flatten() {
                let Ok(far) = TcpStream::connect((MANAGER, PORT)) else { continue };
                for (mut from, mut to) in [(near.try_clone().unwrap(), far.try_clone().unwrap()), (far, near)] {
                    std::thread::spawn(move || {
                        let mut buffer = [0; 4096];
                        while let Ok(count @ 1..) = from.read(&mut buffer) {
                            if to.write_all(&buffer[..count]).is_err() {
                                break;
                            }
                        }
                        let _ = to.shutdown(std::net::Shutdown::Both);
                    });
                }
            }
        });
        fleet.start(Some("10.91.3.9:7001"));
        // The manager's go to the relay's host as well.
        filter("inet relay", "output", "ip daddr 10.91.3.1 meta l4proto udp drop").unwrap();
        fleet.until("it is known that none pass", |fleet| fleet.datagrams().as_deref() == Some("none"));
        assert!(fleet.call(5_000) && fleet.best_effort() == 5, "{}", fleet.logs());
        assert_eq!(fleet.doctor().0, ["datagrams-blocked"]);
        assert_eq!(fleet.node()["connected"], true);
    });
}
