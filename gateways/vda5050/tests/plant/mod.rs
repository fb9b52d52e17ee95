//! A plant of processes: mosquitto, a master, the gateway and a vehicle.
#![allow(dead_code, unreachable_pub)]

use std::cell::Cell;
use std::collections::BTreeMap;
use std::ffi::OsString;
use std::io::{BufRead, BufReader, Read, Write};
use std::net::{TcpListener, TcpStream};
use std::path::{Path, PathBuf};
use std::process::{Child, Command, Stdio};
use std::sync::atomic::{AtomicU16, AtomicU32, Ordering};
use std::sync::{Arc, Mutex};
use std::thread::sleep;
use std::time::{Duration, Instant};

use cara_std::keys::{FleetKeys, Store};
use cara_std::{Fleet, Identity};
use cara_vda5050::message::{InstantActions, Order, write};
use cara_vda5050::version::Version;
use rumqttc::{Client, Event, MqttOptions, Packet, QoS};
use rustix::process::{Pid, Signal, kill_process};
use serde_json::Value;
use tempfile::TempDir;

use crate::fake::{instant, order};

/// Longest wait for anything that is to happen.
pub const PATIENCE: Duration = Duration::from_secs(30);

pub fn until(what: &str, mut is_so: impl FnMut() -> bool) {
    let end = Instant::now() + PATIENCE;
    while !is_so() {
        assert!(Instant::now() < end, "not within {PATIENCE:?}: {what}");
        sleep(Duration::from_millis(10));
    }
}

/// A port below those that the system gives to connections, and not the same twice.
pub fn free_port() -> u16 {
    static NEXT: AtomicU16 = AtomicU16::new(0);
    loop {
        let port = 20_000 + (std::process::id() as u16 % 1_000) * 10 + NEXT.fetch_add(1, Ordering::SeqCst) % 2_000;
        if TcpListener::bind(("127.0.0.1", port)).is_ok() {
            return port;
        }
    }
}

/// A child process that ends with its owner, and the lines of its output with the moments when they came.
pub struct Process {
    pub child: Child,
    pub lines: Arc<Mutex<Vec<(Instant, String)>>>,
}

impl Process {
    pub fn start(command: &mut Command) -> Self {
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

    pub fn signal(&self, signal: Signal) {
        kill_process(Pid::from_child(&self.child), signal).unwrap();
    }

    pub fn kill(&mut self) {
        self.child.kill().unwrap();
        self.child.wait().unwrap();
    }

    pub fn lines(&self) -> Vec<String> {
        self.lines.lock().unwrap().iter().map(|(_, line)| line.clone()).collect()
    }

    pub fn wait_for(&self, start: &str) {
        until(start, || self.lines().iter().any(|line| line.starts_with(start)));
    }

    /// When a line came.
    pub fn at(&self, start: &str) -> Option<Instant> {
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
pub type Messages = Arc<Mutex<BTreeMap<String, Vec<(Value, bool)>>>>;

/// A plant: a broker, a master, a gateway and a vehicle.
pub struct Plant {
    pub folder: TempDir,
    pub fleet: u32,
    pub port: u16,
    pub broker: Option<Process>,
    pub gateway: Option<Process>,
    pub vehicle: Process,
    pub others: Vec<Process>,
    pub client: Client,
    pub heard: Messages,
    pub more_of_broker: String,
    pub protocol: &'static str,
    /// Where metrics are.
    pub metrics: u16,
}

impl Plant {
    pub fn start(on_broker_loss: &str) -> Self {
        Self::with(on_broker_loss, "2.1.0", |_| (String::new(), String::new()))
    }

    /// `secured` makes files in a folder, and says what broker and gateway are told of them.
    pub fn with(on_broker_loss: &str, version: &'static str, secured: impl Fn(&Path) -> (String, String)) -> Self {
        Self::of(1, on_broker_loss, version, secured)
    }

    /// With so many vehicles, whose serial numbers are 0001 and so on.
    pub fn of(
        vehicles: u32,
        on_broker_loss: &str,
        version: &'static str,
        secured: impl Fn(&Path) -> (String, String),
    ) -> Self {
        Self::on_floor(vehicles, &[], on_broker_loss, version, secured)
    }

    /// With vehicles of the warehouse that stand in these cells, if there are any.
    pub fn on_floor(
        vehicles: u32,
        cells: &[String],
        on_broker_loss: &str,
        version: &'static str,
        secured: impl Fn(&Path) -> (String, String),
    ) -> Self {
        static FLEETS: AtomicU32 = AtomicU32::new(0);
        let fleet = 5_050_000 + std::process::id() % 10_000 * 20 + FLEETS.fetch_add(1, Ordering::SeqCst);
        let (folder, port, heard) = (tempfile::tempdir().unwrap(), free_port(), Messages::default());
        keys(folder.path(), fleet, vehicles);
        let (more_of_broker, more_of_gateway) = secured(folder.path());
        let example = Path::new(env!("CARGO_MANIFEST_DIR"));
        std::fs::copy(example.join("example-factsheet.json"), folder.path().join("example-factsheet.json")).unwrap();
        let text = std::fs::read_to_string(example.join("example.toml")).unwrap();
        let finish = "{ do = \"finish-base\", seconds = 60.0, metres = 50.0 }";
        assert!(text.contains(finish));
        let text =
            text.replace("port = 1883", &format!("port = {}\n{more_of_gateway}", tls_port(port, &more_of_broker)));
        let text = text.replace("fleet = 42", &format!("fleet = {fleet}")).replace(finish, on_broker_loss);
        let (metrics, off) = (free_port(), "# metrics = \"127.0.0.1:9465\"");
        assert!(text.contains(off));
        let text = text.replace(off, &format!("metrics = \"127.0.0.1:{metrics}\""));
        let more = (2..=vehicles).map(|number| {
            let id = 100 + number;
            format!("\n[[vehicle]]\nname = \"agv-{number}\"\nid = {id}\nserial_number = \"{number:04}\"\n")
        });
        let text = text + &more.collect::<String>();
        std::fs::write(folder.path().join("vda5050.toml"), text.replace("\"2.1.0\"", &format!("\"{version}\"")))
            .unwrap();
        // Each a process, or one for many.
        let others = match vehicles {
            0..=20 => (2..=vehicles).map(|number| vehicles_from(folder.path(), fleet, number, 1, cells)).collect(),
            _ => vec![vehicles_from(folder.path(), fleet, 2, vehicles - 1, &[])],
        };
        let vehicle = vehicles_from(folder.path(), fleet, 1, 1, cells);
        let broker = Some(broker(folder.path(), port, &more_of_broker));
        let client = master(port, heard.clone());
        let gateway = None;
        let mut plant = Self {
            folder,
            fleet,
            port,
            broker,
            gateway,
            vehicle,
            client,
            heard,
            more_of_broker,
            protocol: version,
            metrics,
            others,
        };
        plant.start_gateway();
        let patience = PATIENCE + Duration::from_secs(vehicles.into());
        plant.wait_within(patience, "ONLINE", |plant| plant.connection() == "ONLINE");
        plant.wait_for("a state", |plant| plant.state() != Value::Null);
        plant
    }

    pub fn file(&self) -> PathBuf {
        self.folder.path().join("vda5050.toml")
    }

    /// What Prometheus gets.
    pub fn scrape(&self) -> String {
        let mut stream = TcpStream::connect(("127.0.0.1", self.metrics)).unwrap();
        stream.write_all(b"GET /metrics HTTP/1.1\r\nhost: x\r\n\r\n").unwrap();
        let mut text = String::new();
        stream.read_to_string(&mut text).unwrap();
        text
    }

    /// One of the gateway's own, of the first vehicle or of all.
    pub fn metric(&self, name: &str) -> u64 {
        let text = self.scrape();
        let values = text.lines().filter_map(|line| line.strip_prefix("cara_vda5050_")?.strip_prefix(name));
        let value =
            values.map(|rest| rest.trim_start_matches("{vehicle=\"0001\"}")).find_map(|rest| rest.strip_prefix(' '));
        value.unwrap_or_else(|| panic!("{name}: {text}")).parse().unwrap()
    }

    /// CPUs that the gateway takes in a while.
    pub fn used(&self, time: Duration) -> f64 {
        let ticks = || {
            let id = self.gateway.as_ref().unwrap().child.id();
            let text = std::fs::read_to_string(format!("/proc/{id}/stat")).unwrap();
            let fields: Vec<&str> = text.rsplit(')').next().unwrap().split_whitespace().collect();
            fields[11].parse::<u64>().unwrap() + fields[12].parse::<u64>().unwrap()
        };
        let (before, began) = (ticks(), Instant::now());
        sleep(time);
        (ticks() - before) as f64 / 100.0 / began.elapsed().as_secs_f64()
    }

    /// KB of memory that it has.
    pub fn resident(&self) -> u64 {
        let id = self.gateway.as_ref().unwrap().child.id();
        let text = std::fs::read_to_string(format!("/proc/{id}/status")).unwrap();
        let line = text.lines().find_map(|line| line.strip_prefix("VmRSS:")).unwrap();
        line.trim().split(' ').next().unwrap().parse().unwrap()
    }

    pub fn start_gateway(&mut self) {
        self.gateway = Some(self.gateway_of(&self.file()));
    }

    /// Starts it again with something else in its configuration.
    pub fn change(&mut self, from: &str, to: &str) {
        self.kill_gateway();
        let text = std::fs::read_to_string(self.file()).unwrap();
        assert!(text.contains(from), "{from}");
        std::fs::write(self.file(), text.replace(from, to)).unwrap();
        self.heard.lock().unwrap().clear();
        self.start_gateway();
        self.wait_for("ONLINE", |plant| plant.connection() == "ONLINE" && plant.state() != Value::Null);
    }

    /// One with this configuration.
    pub fn gateway_of(&self, file: &Path) -> Process {
        let mut command = Command::new(gateway_program());
        command.arg(file).env("CARA_KEYS", self.folder.path().join("keys"));
        command.env("XDG_RUNTIME_DIR", self.folder.path());
        let gateway = Process::start(&mut command);
        gateway.wait_for("up with");
        gateway
    }

    pub fn kill_gateway(&mut self) -> Instant {
        self.gateway.take().unwrap().kill();
        Instant::now()
    }

    pub fn restart_broker(&mut self) {
        self.broker = Some(broker(self.folder.path(), self.port, &self.more_of_broker));
    }

    pub fn wait_for(&self, what: &str, is_so: impl Fn(&Self) -> bool) {
        self.wait_within(PATIENCE, what, is_so);
    }

    pub fn wait_within(&self, patience: Duration, what: &str, is_so: impl Fn(&Self) -> bool) {
        let end = Instant::now() + patience;
        while !is_so(self) {
            let late = Instant::now() >= end;
            assert!(!late, "not within {patience:?}: {what}\n{}\n{:?}", self.state(), self.vehicle.lines());
            sleep(Duration::from_millis(10));
        }
    }

    pub fn last(&self, topic: &str) -> (Value, bool) {
        let heard = self.heard.lock().unwrap();
        heard.get(topic).and_then(|messages| messages.last()).cloned().unwrap_or_default()
    }

    pub fn state(&self) -> Value {
        self.last("state").0
    }

    pub fn connection(&self) -> String {
        self.last("connection").0["connectionState"].as_str().unwrap_or_default().to_owned()
    }

    pub fn version(&self) -> Version {
        Version::of(self.protocol).unwrap()
    }

    pub fn publish(&self, topic: &str, retain: bool, message: &impl serde::Serialize) {
        let (root, message) = (self.version().rules().root, write(self.version(), message));
        self.client.publish(format!("uagv/{root}/KIT/0001/{topic}"), QoS::AtMostOnce, retain, message).unwrap();
    }

    /// A message of so many bytes, which the master's own client would not take.
    pub fn publish_long(&self, topic: &str, bytes: usize) {
        let mut options = MqttOptions::new("long", "127.0.0.1", self.port);
        options.set_max_packet_size(1 << 20, bytes + 1_024);
        let (client, mut connection) = Client::new(options, 10);
        client.publish(format!("uagv/v2/KIT/0001/{topic}"), QoS::AtLeastOnce, false, vec![b' '; bytes]).unwrap();
        let is_sent = |event| matches!(event, Ok(Event::Incoming(Packet::PubAck(_))));
        assert!(connection.iter().any(is_sent));
    }

    pub fn order(&self, id: &str, update: u32, first: u32, way: &str) -> Order {
        let mut order = order(id, update, first, way);
        order.header.version = self.protocol.into();
        self.publish("order", false, &order);
        order
    }

    pub fn instant(&self, kind: &str, id: &str) -> InstantActions {
        let mut message = instant(kind, id);
        if self.version() == Version::V3 {
            message.header.version = self.protocol.into();
        }
        self.publish("instantActions", false, &message);
        message
    }

    /// Ends a pause. What arrives before the gateway hears the broker again is refused as late: a master says it again.
    pub fn go_on(&self) {
        let said = Cell::new(0);
        let begun = Instant::now();
        self.wait_for("it goes on", |plant| {
            if begun.elapsed() >= Duration::from_secs(1) * said.get() {
                said.set(said.get() + 1);
                plant.instant("stopPause", &format!("go-on-{}", said.get()));
            }
            plant.state()["paused"] == false
        });
    }

    /// The order's end has come, at a node.
    pub fn wait_for_end(&self, id: &str, node: &str) {
        self.wait_for(&format!("order {id} has ended at {node}"), |plant| {
            let state = plant.state();
            let left = state["nodeStates"].as_array().map_or(1, Vec::len);
            state["orderId"] == id && state["lastNodeId"] == node && left == 0 && state["driving"] == false
        });
    }

    /// Until the order has ended at its last node, each state had some of its nodes: a master frees those that are gone.
    pub fn order_is_never_empty(&self, id: &str, last: &str) {
        let heard = self.heard.lock().unwrap();
        let states = heard["state"].iter().filter(|(state, _)| state["orderId"] == id);
        for (state, _) in states {
            let left = state["nodeStates"].as_array().map_or(0, Vec::len);
            assert!(left > 0 || state["lastNodeId"] == last, "{state}");
        }
    }

    pub fn action(&self, id: &str) -> String {
        let state = self.state();
        let lists = [&state["actionStates"], &state["instantActionStates"]];
        let states: Vec<&Value> = lists.into_iter().filter_map(Value::as_array).flatten().collect();
        let found = states.iter().find(|action| action["actionId"] == id);
        found.map_or_else(String::new, |action| action["actionStatus"].as_str().unwrap_or_default().to_owned())
    }

    pub fn has_error(&self, kind: &str) -> bool {
        self.state()["errors"].as_array().is_some_and(|errors| errors.iter().any(|error| error["errorType"] == kind))
    }

    /// Lines of the vehicle: how often one began so.
    pub fn count(&self, start: &str) -> usize {
        self.vehicle.lines().iter().filter(|line| line.starts_with(start)).count()
    }
}

/// The master speaks without TLS, to the port of its own.
pub fn tls_port(port: u16, more_of_broker: &str) -> u16 {
    more_of_broker
        .lines()
        .find_map(|line| line.strip_prefix("listener "))
        .map_or(port, |rest| rest.split_whitespace().next().unwrap().parse().unwrap())
}

pub fn keys(folder: &Path, fleet: u32, vehicles: u32) {
    let managers = [("vda5050", 1), ("yard", 2)].map(|(name, id)| Identity::m_unit(name, id).unwrap());
    let mut keys = FleetKeys::draw(Fleet(fleet)).unwrap();
    managers.iter().for_each(|manager| keys.add(manager, &[]).unwrap());
    let vehicle = |number| Identity::s_unit(&format!("agv-{number}"), 100 + number).unwrap();
    keys.add_all(&(1..=vehicles).map(vehicle).collect::<Vec<_>>(), &managers).unwrap();
    std::fs::create_dir(folder.join("keys")).unwrap();
    Store::create(&folder.join("keys"), keys).unwrap();
}

/// In turn that of this version and that of another one, which `CARA_TEST_OTHER_GATEWAY` names, if it does.
fn gateway_program() -> OsString {
    static STARTED: AtomicU32 = AtomicU32::new(0);
    let is_other = STARTED.fetch_add(1, Ordering::SeqCst).is_multiple_of(2);
    let other = std::env::var_os("CARA_TEST_OTHER_GATEWAY").filter(|_| is_other);
    other.unwrap_or(env!("CARGO_BIN_EXE_cara-vda5050").into())
}

pub fn vehicle(folder: &Path, fleet: u32, number: u32) -> Process {
    vehicles_from(folder, fleet, number, 1, &[])
}

fn vehicles_from(folder: &Path, fleet: u32, number: u32, count: u32, cells: &[String]) -> Process {
    // Examples are beside the programs.
    let file = Path::new(env!("CARGO_BIN_EXE_cara-vda5050")).with_file_name("examples").join("vehicle");
    let mut command = Command::new(std::env::var_os("CARA_TEST_OTHER_VEHICLE").unwrap_or(file.into()));
    let (name, id) = (format!("agv-{number}"), (100 + number).to_string());
    command.args([&name, &id]).args(["--vehicles", &count.to_string(), "--speed", "2", "--fleet", &fleet.to_string()]);
    if let Some(cell) = cells.get(number as usize - 1) {
        command.args(["--cell", cell]);
    }
    Process::start(
        command
            .env("CARA_KEYS", folder.join("keys"))
            .env("XDG_STATE_HOME", folder.join(&name))
            .env("CARA_STATE", folder.join(name)),
    )
}

pub fn broker(folder: &Path, port: u16, more: &str) -> Process {
    let file = folder.join("mosquitto.conf");
    let text =
        format!("per_listener_settings true\nuser root\nlistener {port} 127.0.0.1\nallow_anonymous true\n{more}");
    std::fs::write(&file, text).unwrap();
    let mut command = Command::new("mosquitto");
    command.arg("-c").arg(&file).stderr(Stdio::null()).env("OPENSSL_CONF", folder.join("openssl.cnf"));
    let broker = Process::start(&mut command);
    until("mosquitto listens", || TcpStream::connect(("127.0.0.1", port)).is_ok());
    broker
}

/// A client that hears all topics, and connects again.
pub fn master(port: u16, heard: Messages) -> Client {
    master_named("master", port, heard)
}

pub fn master_named(name: &str, port: u16, heard: Messages) -> Client {
    let mut options = MqttOptions::new(name, "127.0.0.1", port);
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
                    let topic = message.topic.rsplit('/').next().unwrap_or_default();
                    // Those of the first vehicle by their topic alone.
                    let serial = message.topic.rsplit('/').nth(1).unwrap_or_default();
                    let topic = if serial == "0001" { topic.to_owned() } else { format!("{serial}/{topic}") };
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
pub fn check_messages(plant: &Plant) {
    for (topic, messages) in plant.heard.lock().unwrap().iter() {
        let topic = topic.rsplit('/').next().unwrap();
        if matches!(topic, "order" | "instantActions" | "zoneSet" | "responses" | "cara-probe") {
            continue;
        }
        let schemas = if plant.version() == Version::V3 { "main-0b2ae43" } else { "2.1.0" };
        let file = format!("schemas/{schemas}/{topic}.schema");
        let schema = std::fs::read(Path::new(env!("CARGO_MANIFEST_DIR")).join(file)).unwrap();
        let validator = jsonschema::validator_for(&serde_json::from_slice(&schema).unwrap()).unwrap();
        let mut last = -1;
        for (message, is_retained) in messages {
            let errors: Vec<String> = validator.iter_errors(message).map(|error| error.to_string()).collect();
            assert!(errors.is_empty(), "{topic}: {errors:?}\n{message}");
            let header_id = message["headerId"].as_i64().unwrap();
            // A retained one comes again with each connection, and a last will has the id of its making.
            let is_will = message["connectionState"].as_str().is_some_and(|state| state.ends_with("BROKEN"));
            assert!(header_id > last || *is_retained || is_will, "{topic}: {header_id} behind {last}");
            last = last.max(header_id);
        }
    }
}

/// A new authority, and certificates of it.
pub fn certificates(folder: &Path, names: &[&str], days: u32) {
    let openssl = |arguments: &str| {
        let arguments = arguments.split_whitespace();
        let mut command = Command::new("openssl");
        let ran = command.args(arguments).current_dir(folder).stderr(Stdio::null()).stdout(Stdio::null()).status();
        assert!(ran.unwrap().success(), "{command:?}");
    };
    let curve = "-newkey ec -pkeyopt ec_paramgen_curve:P-256 -nodes";
    openssl(&format!("req -x509 {curve} -keyout ca.key -out ca.pem -subj /CN=ca -days 500"));
    std::fs::write(folder.join("names"), "subjectAltName = IP:127.0.0.1\n").unwrap();
    for name in names {
        openssl(&format!("req -new {curve} -keyout {name}.key -out {name}.csr -subj /CN={name}"));
        let signed = format!("-CA ca.pem -CAkey ca.key -CAcreateserial -days {days} -extfile names");
        openssl(&format!("x509 -req -in {name}.csr -out {name}.pem {signed}"));
    }
}
