//! The gateway as a process, between mosquitto (Debian) and vehicles as processes: `cargo xtask test vda5050`.
//!
//! Where a bound is told, it is the vehicle's own log that is judged.

mod fake;

use std::collections::BTreeMap;
use std::io::{BufRead, BufReader};
use std::net::TcpListener;
use std::path::{Path, PathBuf};
use std::process::{Child, Command, Stdio};
use std::sync::atomic::{AtomicU16, AtomicU32, Ordering};
use std::sync::{Arc, Mutex};
use std::thread::sleep;
use std::time::{Duration, Instant};

use cara_std::keys::{FleetKeys, Store};
use cara_std::{Fleet, Identity};
use cara_vda5050::config::Config;
use cara_vda5050::message::{ActionParameter, Connection, ConnectionState, InstantActions, Order};
use cara_vda5050::vehicle::LEASE_MS;
use fake::{instant, order};
use rumqttc::{Client, Event, MqttOptions, Packet, QoS};
use rustix::process::{Pid, Signal, kill_process};
use serde_json::Value;
use tempfile::TempDir;

/// Longest wait for anything that is to happen.
const PATIENCE: Duration = Duration::from_secs(30);

fn until(what: &str, mut is_so: impl FnMut() -> bool) {
    let end = Instant::now() + PATIENCE;
    while !is_so() {
        assert!(Instant::now() < end, "not within {PATIENCE:?}: {what}");
        sleep(Duration::from_millis(10));
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

/// A child process that ends with its owner, and the lines of its output with the moments when they came.
struct Process {
    child: Child,
    lines: Arc<Mutex<Vec<(Instant, String)>>>,
}

impl Process {
    fn start(command: &mut Command) -> Self {
        let mut child = command.stdout(Stdio::piped()).spawn().unwrap_or_else(|error| panic!("{command:?}: {error}"));
        let lines: Arc<Mutex<Vec<_>>> = Arc::default();
        let (output, heard) = (child.stdout.take().unwrap(), lines.clone());
        std::thread::spawn(move || {
            for line in BufReader::new(output).lines().map_while(Result::ok) {
                heard.lock().unwrap().push((Instant::now(), line));
            }
        });
        Self { child, lines }
    }

    fn signal(&self, signal: Signal) {
        kill_process(Pid::from_child(&self.child), signal).unwrap();
    }

    fn kill(&mut self) {
        self.child.kill().unwrap();
        self.child.wait().unwrap();
    }

    fn lines(&self) -> Vec<String> {
        self.lines.lock().unwrap().iter().map(|(_, line)| line.clone()).collect()
    }

    fn wait_for(&self, start: &str) {
        until(start, || self.lines().iter().any(|line| line.starts_with(start)));
    }

    /// When a line came.
    fn at(&self, start: &str) -> Option<Instant> {
        self.lines.lock().unwrap().iter().find(|(_, line)| line.starts_with(start)).map(|(at, _)| *at)
    }
}

impl Drop for Process {
    fn drop(&mut self) {
        let _ = self.child.kill();
        let _ = self.child.wait();
    }
}

/// What a master has heard, by topic.
type Messages = Arc<Mutex<BTreeMap<String, Vec<(Value, bool)>>>>;

/// A plant: a broker, a master, a gateway and a vehicle.
struct Plant {
    folder: TempDir,
    fleet: u32,
    port: u16,
    broker: Option<Process>,
    gateway: Option<Process>,
    vehicle: Process,
    client: Client,
    heard: Messages,
    more_of_broker: String,
    protocol: &'static str,
}

impl Plant {
    fn start(on_broker_loss: &str) -> Self {
        Self::with(on_broker_loss, "2.1.0", |_| (String::new(), String::new()))
    }

    /// `secured` makes files in a folder, and says what broker and gateway are told of them.
    fn with(on_broker_loss: &str, version: &'static str, secured: impl Fn(&Path) -> (String, String)) -> Self {
        static FLEETS: AtomicU32 = AtomicU32::new(0);
        let fleet = 5_050_000 + std::process::id() % 10_000 * 20 + FLEETS.fetch_add(1, Ordering::SeqCst);
        let (folder, port, heard) = (tempfile::tempdir().unwrap(), free_port(), Messages::default());
        keys(folder.path(), fleet);
        let (more_of_broker, more_of_gateway) = secured(folder.path());
        let example = Path::new(env!("CARGO_MANIFEST_DIR"));
        std::fs::copy(example.join("example-factsheet.json"), folder.path().join("example-factsheet.json")).unwrap();
        let text = std::fs::read_to_string(example.join("example.toml")).unwrap();
        let finish = "{ do = \"finish-base\", seconds = 60.0, metres = 50.0 }";
        assert!(text.contains(finish));
        let text =
            text.replace("port = 1883", &format!("port = {}\n{more_of_gateway}", tls_port(port, &more_of_broker)));
        let text = text.replace("fleet = 42", &format!("fleet = {fleet}")).replace(finish, on_broker_loss);
        std::fs::write(folder.path().join("vda5050.toml"), text.replace("\"2.1.0\"", &format!("\"{version}\"")))
            .unwrap();
        let vehicle = vehicle(folder.path(), fleet);
        let broker = Some(broker(folder.path(), port, &more_of_broker));
        let client = master(port, heard.clone());
        let gateway = None;
        let mut plant =
            Self { folder, fleet, port, broker, gateway, vehicle, client, heard, more_of_broker, protocol: version };
        plant.start_gateway();
        plant.wait_for("ONLINE", |plant| plant.connection() == "ONLINE");
        plant.wait_for("a state", |plant| plant.state() != Value::Null);
        plant
    }

    fn file(&self) -> PathBuf {
        self.folder.path().join("vda5050.toml")
    }

    fn start_gateway(&mut self) {
        let mut command = Command::new(env!("CARGO_BIN_EXE_cara-vda5050"));
        command.arg(self.file()).env("CARA_KEYS", self.folder.path().join("keys"));
        command.env("XDG_RUNTIME_DIR", self.folder.path());
        let gateway = Process::start(&mut command);
        gateway.wait_for("up with");
        self.gateway = Some(gateway);
    }

    fn kill_gateway(&mut self) -> Instant {
        self.gateway.take().unwrap().kill();
        Instant::now()
    }

    fn restart_broker(&mut self) {
        self.broker = Some(broker(self.folder.path(), self.port, &self.more_of_broker));
    }

    fn wait_for(&self, what: &str, is_so: impl Fn(&Self) -> bool) {
        let end = Instant::now() + PATIENCE;
        while !is_so(self) {
            let late = Instant::now() >= end;
            assert!(!late, "not within {PATIENCE:?}: {what}\n{}\n{:?}", self.state(), self.vehicle.lines());
            sleep(Duration::from_millis(10));
        }
    }

    fn last(&self, topic: &str) -> (Value, bool) {
        let heard = self.heard.lock().unwrap();
        heard.get(topic).and_then(|messages| messages.last()).cloned().unwrap_or_default()
    }

    fn state(&self) -> Value {
        self.last("state").0
    }

    fn connection(&self) -> String {
        self.last("connection").0["connectionState"].as_str().unwrap_or_default().to_owned()
    }

    fn publish(&self, topic: &str, retain: bool, message: &impl serde::Serialize) {
        let message = serde_json::to_vec(message).unwrap();
        self.client.publish(format!("uagv/v2/KIT/0001/{topic}"), QoS::AtMostOnce, retain, message).unwrap();
    }

    fn order(&self, id: &str, update: u32, first: u32, way: &str) -> Order {
        let mut order = order(id, update, first, way);
        order.header.version = self.protocol.into();
        self.publish("order", false, &order);
        order
    }

    fn instant(&self, kind: &str, id: &str) -> InstantActions {
        let message = instant(kind, id);
        self.publish("instantActions", false, &message);
        message
    }

    /// The order's end has come, at a node.
    fn wait_for_end(&self, id: &str, node: &str) {
        self.wait_for(&format!("order {id} has ended at {node}"), |plant| {
            let state = plant.state();
            let left = state["nodeStates"].as_array().map_or(1, Vec::len);
            state["orderId"] == id && state["lastNodeId"] == node && left == 0 && state["driving"] == false
        });
    }

    fn action(&self, id: &str) -> String {
        let state = self.state();
        let states = state["actionStates"].as_array().cloned().unwrap_or_default();
        let found = states.iter().find(|action| action["actionId"] == id);
        found.map_or_else(String::new, |action| action["actionStatus"].as_str().unwrap_or_default().to_owned())
    }

    fn has_error(&self, kind: &str) -> bool {
        self.state()["errors"].as_array().is_some_and(|errors| errors.iter().any(|error| error["errorType"] == kind))
    }

    /// Lines of the vehicle: how often one began so.
    fn count(&self, start: &str) -> usize {
        self.vehicle.lines().iter().filter(|line| line.starts_with(start)).count()
    }
}

/// The master speaks without TLS, to the port of its own.
fn tls_port(port: u16, more_of_broker: &str) -> u16 {
    more_of_broker
        .lines()
        .find_map(|line| line.strip_prefix("listener "))
        .map_or(port, |rest| rest.split_whitespace().next().unwrap().parse().unwrap())
}

fn keys(folder: &Path, fleet: u32) {
    let manager = Identity::m_unit("vda5050", 1).unwrap();
    let mut keys = FleetKeys::draw(Fleet(fleet)).unwrap();
    keys.add(&manager, &[]).unwrap();
    keys.add_all(&[Identity::s_unit("agv-1", 101).unwrap()], &[manager]).unwrap();
    std::fs::create_dir(folder.join("keys")).unwrap();
    Store::create(&folder.join("keys"), keys).unwrap();
}

fn vehicle(folder: &Path, fleet: u32) -> Process {
    // Examples are beside the programs.
    let file = Path::new(env!("CARGO_BIN_EXE_cara-vda5050")).with_file_name("examples").join("vehicle");
    let mut command = Command::new(file);
    command.args(["agv-1", "101", "--speed", "2", "--fleet", &fleet.to_string()]);
    Process::start(command.env("CARA_KEYS", folder.join("keys")).env("XDG_STATE_HOME", folder.join("vehicle")))
}

fn broker(folder: &Path, port: u16, more: &str) -> Process {
    let file = folder.join("mosquitto.conf");
    let text = format!("user root\nlistener {port} 127.0.0.1\nallow_anonymous true\n{more}");
    std::fs::write(&file, text).unwrap();
    let broker = Process::start(Command::new("mosquitto").arg("-c").arg(&file).stderr(Stdio::null()));
    until("mosquitto listens", || std::net::TcpStream::connect(("127.0.0.1", port)).is_ok());
    broker
}

/// A client that hears all topics, and connects again.
fn master(port: u16, heard: Messages) -> Client {
    let mut options = MqttOptions::new("master", "127.0.0.1", port);
    options.set_keep_alive(Duration::from_secs(5)).set_max_packet_size(1 << 20, 1 << 20);
    let (client, mut connection) = Client::new(options, 100);
    let subscriber = client.clone();
    std::thread::spawn(move || {
        for event in connection.iter() {
            match event {
                Ok(Event::Incoming(Packet::ConnAck(_))) => {
                    let _ = subscriber.try_subscribe("uagv/#", QoS::AtLeastOnce);
                }
                Ok(Event::Incoming(Packet::Publish(message))) => {
                    let topic = message.topic.rsplit('/').next().unwrap_or_default().to_owned();
                    let value = serde_json::from_slice(&message.payload).unwrap_or_default();
                    heard.lock().unwrap().entry(topic).or_default().push((value, message.retain));
                }
                Ok(_) => {}
                Err(_) => sleep(Duration::from_millis(100)),
            }
        }
    });
    client
}

/// Each message that was sent is valid, and its header ids rise by topic.
fn check_messages(plant: &Plant) {
    for (topic, messages) in plant.heard.lock().unwrap().iter() {
        if matches!(topic.as_str(), "order" | "instantActions" | "cara-probe") {
            continue;
        }
        let file = format!("schemas/2.1.0/{topic}.schema");
        let schema = std::fs::read(Path::new(env!("CARGO_MANIFEST_DIR")).join(file)).unwrap();
        let validator = jsonschema::validator_for(&serde_json::from_slice(&schema).unwrap()).unwrap();
        let mut last = -1;
        for (message, is_retained) in messages {
            let errors: Vec<String> = validator.iter_errors(message).map(|error| error.to_string()).collect();
            assert!(errors.is_empty(), "{topic}: {errors:?}\n{message}");
            let header_id = message["headerId"].as_i64().unwrap();
            // A retained one comes again with each connection, and a last will has the id of its making.
            let is_will = message["connectionState"] == "CONNECTIONBROKEN";
            assert!(header_id > last || *is_retained || is_will, "{topic}: {header_id} behind {last}");
            last = last.max(header_id);
        }
    }
}

#[test]
fn a_master_drives_a_vehicle() {
    for version in ["2.1.0", "2.0.0"] {
        let plant = Plant::with("{ do = \"stop\" }", version, |_| Default::default());
        assert_eq!(plant.last("factsheet").0["typeSpecification"]["seriesName"], "example");
        let sent = plant.order("o1", 0, 0, "a!:beep=HARD b! c");
        plant.wait_for("the horizon is left", |plant| {
            plant.state()["lastNodeId"] == "b" && plant.state()["driving"] == false
        });
        assert_eq!((plant.action("o1-a0n-beep"), plant.state()["newBaseRequest"] == true), ("FINISHED".into(), true));
        plant.publish("order", false, &sent);
        plant.order("o1", 1, 2, "b! c!:pick=HARD d!");
        plant.wait_for("it picks", |plant| plant.action("o1-c4n-pick") == "RUNNING");
        let pause = plant.instant("startPause", "p1");
        plant.wait_for("it is paused", |plant| plant.action("p1") == "FINISHED" && plant.state()["paused"] == true);
        plant.wait_for("it has picked", |plant| plant.action("o1-c4n-pick") == "FINISHED");
        assert_eq!(plant.state()["nodeStates"].as_array().unwrap().len(), 1);
        plant.instant("stopPause", "p2");
        plant.publish("instantActions", false, &pause);
        plant.wait_for_end("o1", "d");
        plant.instant("cancelOrder", "c1");
        plant.wait_for("there is nothing to cancel", |plant| {
            plant.action("c1") == "FAILED" && plant.has_error("noOrderToCancel")
        });
        plant.order("o2", 0, 0, "d! a!");
        plant.wait_for("it drives", |plant| plant.state()["driving"] == true);
        plant.instant("cancelOrder", "c2");
        plant
            .wait_for("it is cancelled", |plant| plant.action("c2") == "FINISHED" && plant.state()["driving"] == false);
        assert_eq!(plant.state()["nodeStates"].as_array().unwrap().len(), 0);
        assert_eq!([plant.count("act "), plant.count("drive ")], [2, 4], "{:?}", plant.vehicle.lines());
        check_messages(&plant);
    }
}

/// Nodes are passed without standing at them, and what the vehicle carries is in its state.
#[test]
fn a_vehicle_drives_through_and_carries_something() {
    let plant = Plant::start("{ do = \"stop\" }");
    plant.wait_for("it carries nothing", |plant| plant.state()["loads"] == serde_json::json!([]));
    assert_eq!(plant.state()["batteryState"]["batteryVoltage"], 48.0);
    let mut way = order("o1", 0, 0, "a! b! c! d! e! f! g! h! i! j! k! l!:pick=HARD");
    let parameter = ActionParameter { key: "loadId".into(), value: "pallet-7".into() };
    way.nodes[11].actions[0].action_parameters = Some(vec![parameter]);
    plant.publish("order", false, &way);
    plant.vehicle.wait_for("passed b");
    plant.wait_for("b is reported while it drives", |plant| {
        plant.state()["lastNodeId"] == "b" && plant.state()["driving"] == true
    });
    plant.instant("startPause", "p1");
    plant.vehicle.wait_for("stood");
    plant.instant("stopPause", "p2");
    plant.wait_for_end("o1", "l");
    plant.wait_for("it has picked", |plant| plant.action("o1-l22n-pick") == "FINISHED");
    assert_eq!(plant.state()["loads"][0]["loadId"], "pallet-7");
    assert_eq!([plant.count("passed"), plant.count("arrived"), plant.count("stood")], [10, 1, 1]);
    check_messages(&plant);
}

/// Runs a master control by others, which says by its exit code whether all went as it was to.
fn by_others(version: &'static str, program: &Path, script: &str, drives: usize, actions: usize) {
    let plant = Plant::with("{ do = \"stop\" }", version, |_| Default::default());
    let mut command = Command::new(program);
    command.arg(script).arg(plant.port.to_string()).current_dir(masters());
    let mut master = Process::start(&mut command);
    let mut ended = None;
    until("the master ends", || {
        ended = master.child.try_wait().unwrap();
        ended.is_some()
    });
    assert!(ended.unwrap().success(), "{:?}\n{:?}", master.lines(), plant.vehicle.lines());
    assert_eq!([plant.count("drive "), plant.count("act ")], [drives, actions], "{:?}", plant.vehicle.lines());
    check_messages(&plant);
}

/// A folder with the scripts, into which what they need is installed.
fn masters() -> PathBuf {
    let folder = Path::new(env!("CARGO_TARGET_TMPDIR")).join("masters");
    std::fs::create_dir_all(&folder).unwrap();
    for file in ["package.json", "master.js", "master.py"] {
        let from = Path::new(env!("CARGO_MANIFEST_DIR")).join("tests/masters").join(file);
        std::fs::copy(from, folder.join(file)).unwrap();
    }
    folder
}

fn ran(command: &mut Command) {
    assert!(command.stdout(Stdio::null()).status().unwrap().success(), "{command:?}");
}

#[test]
#[ignore = "fetches vda-5050-lib by npm"]
fn a_master_by_others_drives_a_vehicle_of_2_0() {
    ran(Command::new("npm").args(["install", "--silent"]).current_dir(masters()));
    by_others("2.0.0", Path::new("node"), "master.js", 5, 1);
}

#[test]
#[ignore = "fetches vda5050-sdk by pip"]
fn a_master_by_others_drives_a_vehicle_of_2_1() {
    let python = masters().join("python");
    ran(Command::new("python3").args(["-m", "venv"]).arg(&python));
    ran(Command::new(python.join("bin/pip")).args(["install", "--quiet", "vda5050-sdk==0.2.0", "aiomqtt==2.5.1"]));
    by_others("2.1.0", &python.join("bin/python"), "master.py", 4, 0);
}

#[test]
fn messages_that_are_not_for_this_vehicle_now_move_nothing() {
    let plant = Plant::start("{ do = \"stop\" }");
    let mut foreign = order("o1", 0, 0, "a! b!");
    foreign.header.serial_number = "0002".into();
    let mut version = order("o1", 0, 0, "a! b!");
    version.header.version = "3.0.0".into();
    for (what, order) in [("foreign", foreign), ("of another version", version)] {
        plant.publish("order", false, &order);
        plant.wait_for(what, |plant| plant.has_error("validationError"));
    }
    plant.client.publish("uagv/v2/KIT/0001/order", QoS::AtMostOnce, false, "{").unwrap();
    // A retained order is there when the gateway connects.
    plant.publish("order", true, &order("o1", 0, 0, "a! b!"));
    plant.wait_for_end("o1", "b");
    let mut plant = plant;
    plant.publish("order", true, &order("o2", 0, 0, "b! a!"));
    plant.wait_for_end("o2", "a");
    let drives = plant.count("drive ");
    plant.publish("order", true, &order("o3", 0, 0, "a! b!"));
    plant.wait_for_end("o3", "b");
    plant.kill_gateway();
    plant.heard.lock().unwrap().clear();
    plant.start_gateway();
    plant.wait_for("the retained order is refused", |plant| plant.has_error("validationError"));
    assert_eq!(plant.count("drive "), drives + 1);
}

/// A loop that hangs does not renew anything, though its process and its links live.
#[test]
fn a_gateway_that_hangs_stops_the_vehicle() {
    let plant = Plant::start("{ do = \"finish-base\", seconds = 60.0, metres = 50.0 }");
    plant.order("o1", 0, 0, "a! k!");
    plant.vehicle.wait_for("drive 1 k");
    sleep(Duration::from_millis(300));
    let gateway = plant.gateway.as_ref().unwrap();
    gateway.signal(Signal::STOP);
    let hung = Instant::now();
    plant.vehicle.wait_for("stood");
    let took = plant.vehicle.at("stood").unwrap().duration_since(hung);
    println!("gateway stopped: stood after {took:?}");
    assert!(took < Duration::from_millis(LEASE_MS + 150), "{took:?}");
    gateway.signal(Signal::CONT);
    plant.wait_for_end("o1", "k");
}

/// No stop waits for a disk.
#[test]
fn a_record_that_cannot_be_written_stops_the_vehicle() {
    let plant = Plant::start("{ do = \"stop\" }");
    plant.order("o1", 0, 0, "a! k!");
    plant.vehicle.wait_for("drive 1 k");
    sleep(Duration::from_millis(300));
    let folder = plant.folder.path().join("state/vda5050");
    std::fs::remove_dir_all(&folder).unwrap();
    plant.instant("startPause", "p1");
    let sent = Instant::now();
    plant.vehicle.wait_for("stood");
    let took = plant.vehicle.at("stood").unwrap().duration_since(sent);
    println!("record not written: stood after {took:?}");
    assert!(took < Duration::from_millis(LEASE_MS + LEASE_MS / 2 + 150), "{took:?}");
    std::fs::create_dir(&folder).unwrap();
    plant.wait_for("it is paused", |plant| plant.action("p1") == "FINISHED");
    plant.instant("stopPause", "p2");
    plant.wait_for_end("o1", "k");
}

/// One record that cannot be read is that vehicle's trouble alone, and mended without a restart.
#[test]
fn a_damaged_record_puts_its_vehicle_out_of_service() {
    let mut plant = Plant::start("{ do = \"stop\" }");
    plant.kill_gateway();
    let record = plant.folder.path().join("state/vda5050/0001.json");
    std::fs::write(&record, "{\"order_id\": \"o").unwrap();
    plant.start_gateway();
    plant.wait_for("it is out of service", |plant| {
        plant.has_error("outOfService") && plant.state()["operatingMode"] == "SERVICE"
    });
    plant.order("o1", 0, 0, "a! b!");
    plant.wait_for("the order is refused", |plant| plant.has_error("orderError"));
    assert_eq!(std::fs::read_to_string(&record).unwrap(), "{\"order_id\": \"o");
    std::fs::rename(&record, record.with_extension("damaged")).unwrap();
    plant.wait_for("it is mended", |plant| plant.state()["operatingMode"] == "AUTOMATIC");
    plant.order("o2", 0, 0, "a! b!");
    plant.wait_for_end("o2", "b");
}

/// A message of half a megabyte, whatever is in it, is not kept and not reported.
#[test]
fn large_messages_do_no_harm() {
    let plant = Plant::start("{ do = \"stop\" }");
    for index in 0..4 {
        let id = format!("{index}{}", "o".repeat(300_000));
        plant.order(&id, 0, 0, "a! b!");
        plant.publish("instantActions", false, &instant("stateRequest", &id));
    }
    plant.wait_for("they are refused", |plant| plant.has_error("validationError"));
    plant.order("o1", 0, 0, "a! b!");
    plant.wait_for_end("o1", "b");
    let longest = |(state, _): &(Value, bool)| state.to_string().len();
    let longest = plant.heard.lock().unwrap()["state"].iter().map(longest).max();
    assert!(longest < Some(10_000), "{longest:?}");
}

/// The gateway is killed while the vehicle drives and handles something.
#[test]
fn a_gateway_that_is_killed_stops_the_vehicle_and_goes_on_afterwards() {
    let mut plant = Plant::start("{ do = \"stop\" }");
    plant.order("o1", 0, 0, "a! e! i!:beep");
    plant.vehicle.wait_for("drive 1 e");
    sleep(Duration::from_millis(300));
    let killed = plant.kill_gateway();
    plant.vehicle.wait_for("stood");
    let took = plant.vehicle.at("stood").unwrap().duration_since(killed);
    println!("gateway killed: stood after {took:?}");
    // The lease, and a turn of the motors' loop; the heart's period is not in it, as the renewals end with the process.
    assert!(took < Duration::from_millis(LEASE_MS + 150), "{took:?}");
    plant.wait_for("the last will", |plant| plant.connection() == "CONNECTIONBROKEN");
    plant.start_gateway();
    plant.wait_for("ONLINE", |plant| plant.connection() == "ONLINE");
    plant.wait_for_end("o1", "i");
    assert_eq!([plant.count("drive "), plant.count("act ")], [2, 1], "{:?}", plant.vehicle.lines());
    // Started again and again, ONLINE is what stays.
    for _ in 0..5 {
        plant.kill_gateway();
        plant.start_gateway();
    }
    sleep(Duration::from_secs(1));
    plant.wait_for("ONLINE", |plant| plant.connection() == "ONLINE");
    check_messages(&plant);
    // Ended in order, it says so.
    plant.gateway.as_ref().unwrap().signal(Signal::TERM);
    plant.wait_for("OFFLINE", |plant| plant.connection() == "OFFLINE");
}

#[test]
fn a_last_will_that_comes_late_is_contradicted() {
    let plant = Plant::start("{ do = \"stop\" }");
    // The gateway has heard itself.
    sleep(Duration::from_secs(1));
    let broken = Connection { connection_state: ConnectionState::Broken, ..Connection::default() };
    plant.publish("connection", true, &broken);
    let has_come =
        |plant: &Plant| plant.heard.lock().unwrap()["connection"].iter().any(|(said, _)| said["manufacturer"] == "");
    plant.wait_for("the will", has_come);
    plant.wait_for("ONLINE", |plant| plant.connection() == "ONLINE");
}

#[test]
fn a_vehicle_that_is_lost_is_a_broken_connection() {
    let mut plant = Plant::start("{ do = \"stop\" }");
    plant.order("o1", 0, 0, "a! e!");
    plant.vehicle.wait_for("drive 1 e");
    plant.vehicle.kill();
    plant.wait_for("broken", |plant| plant.connection() == "CONNECTIONBROKEN");
    let states = plant.heard.lock().unwrap()["state"].len();
    sleep(Duration::from_millis(500));
    assert_eq!(plant.heard.lock().unwrap()["state"].len(), states, "nothing is said of a vehicle that is away");
    plant.vehicle = vehicle(plant.folder.path(), plant.fleet);
    plant.wait_for_end("o1", "e");
    assert_eq!(plant.connection(), "ONLINE");
}

/// By the standard, the vehicle drives on to the end of its base.
#[test]
fn without_a_broker_the_base_is_finished() {
    let mut plant = Plant::start("{ do = \"finish-base\", seconds = 60.0, metres = 50.0 }");
    plant.order("o1", 0, 0, "a! c! e! g");
    plant.vehicle.wait_for("drive 1 c");
    plant.broker.take().unwrap().kill();
    plant.vehicle.wait_for("arrived e");
    plant.restart_broker();
    plant.wait_for("its state", |plant| plant.state()["lastNodeId"] == "e" && plant.connection() == "ONLINE");
    assert_eq!((plant.count("stood"), plant.state()["paused"] == true), (0, false));
    plant.order("o1", 1, 4, "e! g!");
    plant.wait_for_end("o1", "g");
}

/// Killed, stopped, and limits of finish-base: the vehicle stands, and waits for stopPause.
#[test]
fn without_a_broker_the_vehicle_stops_within_its_bound() {
    for (policy, kills, bound) in [
        ("{ do = \"stop\" }", true, 500),
        // The probe's time-out, and the rest of a turn.
        ("{ do = \"stop\" }", false, 2_500),
        ("{ do = \"finish-base\", seconds = 1.0, metres = 50.0 }", true, 1_500),
        ("{ do = \"finish-base\", seconds = 60.0, metres = 2.0 }", true, 1_500),
    ] {
        let mut plant = Plant::start(policy);
        plant.order("o1", 0, 0, "a! k!");
        plant.vehicle.wait_for("drive 1 k");
        let lost = Instant::now();
        if kills {
            plant.broker.take().unwrap().kill();
        } else {
            plant.broker.as_ref().unwrap().signal(Signal::STOP);
        }
        plant.vehicle.wait_for("stood");
        let took = plant.vehicle.at("stood").unwrap().duration_since(lost);
        println!("{policy}, {}: stood after {took:?}", if kills { "killed" } else { "stopped" });
        assert!(took < Duration::from_millis(bound), "{policy}: {took:?}");
        if kills {
            plant.restart_broker();
        } else {
            plant.broker.as_ref().unwrap().signal(Signal::CONT);
        }
        plant.wait_for("it is paused", |plant| plant.state()["paused"] == true && plant.has_error("brokerLost"));
        plant.instant("stopPause", "p1");
        plant.wait_for_end("o1", "k");
    }
}

/// With certificates on both ends.
#[test]
fn the_connection_can_be_secured() {
    let tls = free_port();
    let plant = Plant::with("{ do = \"stop\" }", "2.1.0", |folder| {
        certificates(folder);
        let file = |name: &str| folder.join(name).display().to_string();
        let broker = format!(
            "listener {tls} 127.0.0.1\ncafile {}\ncertfile {}\nkeyfile {}\nrequire_certificate true\n",
            file("ca.pem"),
            file("broker.pem"),
            file("broker.key")
        );
        let gateway = "ca_file = \"ca.pem\"\ncertificate_file = \"gateway.pem\"\nkey_file = \"gateway.key\"".to_owned();
        (broker, gateway)
    });
    plant.order("o1", 0, 0, "a! b!");
    plant.wait_for_end("o1", "b");
}

fn certificates(folder: &Path) {
    let openssl = |arguments: &str| {
        let arguments = arguments.split_whitespace();
        let mut command = Command::new("openssl");
        let ran = command.args(arguments).current_dir(folder).stderr(Stdio::null()).stdout(Stdio::null()).status();
        assert!(ran.unwrap().success(), "{command:?}");
    };
    let curve = "-newkey ec -pkeyopt ec_paramgen_curve:P-256 -nodes";
    openssl(&format!("req -x509 {curve} -keyout ca.key -out ca.pem -subj /CN=ca -days 1"));
    std::fs::write(folder.join("names"), "subjectAltName = IP:127.0.0.1\n").unwrap();
    for name in ["broker", "gateway"] {
        openssl(&format!("req -new {curve} -keyout {name}.key -out {name}.csr -subj /CN={name}"));
        let signed = "-CA ca.pem -CAkey ca.key -CAcreateserial -days 1 -extfile names";
        openssl(&format!("x509 -req -in {name}.csr -out {name}.pem {signed}"));
    }
}

#[test]
fn the_example_is_checked_and_mistakes_are_named() {
    let folder = tempfile::tempdir().unwrap();
    let file = folder.path().join("vda5050.toml");
    let text = std::fs::read_to_string(Path::new(env!("CARGO_MANIFEST_DIR")).join("example.toml")).unwrap();
    std::fs::write(&file, &text).unwrap();
    Config::read(&file).unwrap();
    for (from, to, named) in [
        ("version = \"2.1.0\"", "version = \"3.0.0\"", "is not 2.0.x or 2.1.x"),
        ("manufacturer = \"KIT\"", "manufacturer = \"KIT/1\"", "level of a topic"),
        ("serial_number = \"0001\"", "serial_number = \"../1\"", "serial number"),
        (
            "[[vehicle]]",
            "[[vehicle]]\nname = \"agv-1\"\nid = 101\nserial_number = \"2\"\n[[vehicle]]",
            "agv-1/101 is there twice",
        ),
        ("state_every = 10.0", "state_every = 40.0", "from 1 to 30 s"),
        ("state_every = 10.0", "state_evry = 10.0", "unknown field"),
        ("# ca_file", "certificate_file = \"x\" #", "go together"),
        ("probe_timeout = 2000", "probe_timeout = 100", "longer than probe"),
        ("seconds = 60.0", "seconds = -1.0", "not negative"),
    ] {
        assert!(text.contains(from), "{from}");
        std::fs::write(&file, text.replace(from, to)).unwrap();
        let error = format!("{:#}", Config::read(&file).unwrap_err());
        assert!(error.contains(named), "{to}: {error}");
    }
}
