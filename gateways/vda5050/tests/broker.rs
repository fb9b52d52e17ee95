//! The gateway as a process, between mosquitto (Debian) and vehicles as processes: `cargo xtask test vda5050`.
//!
//! Where a bound is told, it is the vehicle's own log that is judged.

mod fake;
mod plant;

use std::io::{Read, Write};
use std::net::{Shutdown, TcpListener, TcpStream};
use std::path::Path;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::thread::sleep;
use std::time::{Duration, Instant};

use cara_processes::network;
use cara_vda5050::config::Config;
use cara_vda5050::message::{ActionParameter, Connection, ConnectionState, Header, Order, write};
use cara_vda5050::vehicle::LEASE_MS;
use cara_vda5050::version::Version;
use fake::{instant, order};
use plant::{Messages, Plant, check_messages, master_named, until, vehicle};
use rumqttc::QoS;
use rustix::process::Signal;
use serde_json::Value;

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

/// 3.0, a preview: the same, with its names, its lists and what it offers and the gateway refuses.
#[test]
fn a_master_of_3_drives_a_vehicle() {
    let mut plant = Plant::with("{ do = \"stop\" }", "3.0.0", |_| Default::default());
    let (factsheet, is_retained) = plant.last("factsheet");
    assert_eq!(factsheet["typeSpecification"]["mobileRobotKinematics"], "DIFFERENTIAL");
    assert_eq!(factsheet["typeSpecification"]["supportedZones"], serde_json::json!([]));
    assert!(!is_retained, "the master heard it as it was sent");
    let sent = plant.order("o1", 0, 0, "a!:beep=HARD b! c");
    plant.wait_for("the horizon is left", |plant| {
        plant.state()["lastNodeId"] == "b" && plant.state()["driving"] == false
    });
    assert_eq!((plant.action("o1-a0n-beep"), plant.state()["newBaseRequest"] == true), ("FINISHED".into(), true));
    plant.publish("order", false, &sent);
    let mut other = sent.clone();
    other.nodes[2].node_id = "d".into();
    other.edges[1].end_node_id = "d".into();
    plant.publish("order", false, &other);
    plant.wait_for("it is other", |plant| plant.has_error("SAME_ORDER_UPDATE_ID"));
    plant.order("o1", 1, 2, "b! c!:pick=HARD d!");
    plant.wait_for("it picks", |plant| plant.action("o1-c4n-pick") == "RUNNING");
    plant.instant("startPause", "p1");
    plant.wait_for("it is paused", |plant| plant.action("p1") == "FINISHED" && plant.state()["paused"] == true);
    plant.wait_for("it has picked", |plant| plant.action("o1-c4n-pick") == "FINISHED");
    plant.instant("stopPause", "p2");
    plant.wait_for_end("o1", "d");
    let header = &sent.header;
    let zones = serde_json::json!({"zoneSetId": "s1", "mapId": "hall", "zones": []});
    plant.publish("zoneSet", false, &with_header(header, "zoneSet", zones));
    plant.wait_for("there are no zones", |plant| plant.has_error("UNSUPPORTED_PARAMETER"));
    plant.order("o2", 0, 0, "d! a!");
    plant.wait_for("it drives", |plant| {
        plant.state()["driving"] == true && plant.state()["errors"] == Value::Array([].into())
    });
    let granted = serde_json::json!([{"requestId": "r1", "grantType": "GRANTED"}]);
    plant.publish("responses", false, &with_header(header, "responses", granted));
    plant.wait_for("nothing was requested", |plant| plant.has_error("UNSUPPORTED_PARAMETER"));
    plant.instant("cancelOrder", "c2");
    plant.wait_for("it is cancelled", |plant| plant.action("c2") == "FINISHED" && plant.state()["driving"] == false);
    plant.publish("order", false, &order("o3", 0, 0, "a! b!"));
    plant.wait_for("an order of 2.1 is refused", |plant| plant.has_error("VALIDATION_FAILURE"));
    assert_eq!([plant.count("act "), plant.count("drive ")], [2, 4], "{:?}", plant.vehicle.lines());
    check_messages(&plant);
    let mut check = std::process::Command::new(env!("CARGO_BIN_EXE_cara-vda5050"));
    let check = check.arg("--check").arg(plant.file()).env("CARA_KEYS", plant.folder.path().join("keys")).output();
    assert_eq!(String::from_utf8_lossy(&check.unwrap().stdout), "1 vehicles, VDA 5050 3.0.0\n");
    // The last will, and what a master that comes later hears.
    plant.kill_gateway();
    plant.wait_for("the last will", |plant| plant.connection() == "CONNECTION_BROKEN");
    let later = Messages::default();
    let _client = master_named("later", plant.port, later.clone());
    until("the factsheet is retained", || later.lock().unwrap().get("factsheet").is_some_and(|heard| heard[0].1));
}

fn with_header(header: &Header, name: &str, value: Value) -> Value {
    let mut message = serde_json::to_value(header).unwrap();
    message[name] = value;
    message
}

/// Nodes are passed without standing at them, and what the vehicle carries is in its state.
#[test]
fn a_vehicle_drives_through_and_carries_something() {
    let plant = Plant::start("{ do = \"stop\" }");
    plant.wait_for("it carries nothing", |plant| plant.state()["loads"] == serde_json::json!([]));
    assert_eq!(plant.state()["batteryState"]["batteryVoltage"], 48.0);
    let mut way = order("o1", 0, 0, "a! b! c! d! e! f! g! h! i! j! k! l!:pick=HARD");
    // The longest names and parameters that are taken get there.
    let parameter = |key: &str, value: &str| ActionParameter { key: key.into(), value: value.into() };
    let parameters = vec![parameter("loadId", "pallet-7"), parameter("note", &"n".repeat(735))];
    way.nodes[11].actions[0].action_parameters = Some(parameters);
    way.edges.iter_mut().for_each(|edge| edge.edge_id = "e".repeat(64));
    for node in 1..11 {
        way.nodes[node].node_id = format!("{}{}", way.nodes[node].node_id, "n".repeat(63));
        way.edges[node - 1].end_node_id = way.nodes[node].node_id.clone();
        way.edges[node].start_node_id = way.nodes[node].node_id.clone();
    }
    plant.publish("order", false, &way);
    plant.vehicle.wait_for("passed b");
    plant.wait_for("b is reported while it drives", |plant| {
        plant.state()["lastNodeSequenceId"] == 2 && plant.state()["driving"] == true
    });
    plant.instant("startPause", "p1");
    plant.vehicle.wait_for("stood");
    plant.instant("stopPause", "p2");
    plant.wait_for_end("o1", "l");
    plant.wait_for("it has picked", |plant| plant.action("o1-l22n-pick") == "FINISHED");
    assert_eq!(plant.state()["loads"][0]["loadId"], "pallet-7");
    assert_eq!([plant.count("passed"), plant.count("arrived")], [10, 1]);
    check_messages(&plant);
}

/// One of the warehouse, which refuses a cell that is not beside the one before: what it drives goes on, to its end.
#[test]
fn a_vehicle_that_refuses_an_update_drives_to_the_end_of_its_base() {
    let plant = Plant::on_floor(1, &["3,4".into()], "{ do = \"stop\" }", "2.1.0", |_| Default::default());
    let place = |mut order: Order| {
        for node in &mut order.nodes {
            let x = node.node_id.bytes().next().map_or(0, |name| 3 + name - b'a');
            let at = node.node_position.as_mut().unwrap();
            (at.x, at.y) = (if node.node_id == "d" { 20.0 } else { f64::from(x) }, 4.0);
        }
        plant.publish("order", false, &order);
    };
    place(order("o1", 0, 0, "a! b! c!"));
    plant.wait_for("it drives", |plant| plant.state()["driving"] == true);
    place(order("o1", 1, 4, "c! d!"));
    plant.wait_for("the master hears of it", |plant| plant.has_error("orderError"));
    plant.wait_for("it stands at c", |plant| plant.state()["lastNodeId"] == "c" && plant.has_error("driveRefused"));
    assert_eq!([plant.count("stood"), plant.count("arrived c")], [0, 1], "{:?}", plant.vehicle.lines());
    plant.instant("cancelOrder", "c1");
    plant.wait_for("it is cancelled", |plant| plant.action("c1") == "FINISHED");
    place(order("o2", 0, 0, "c! b!"));
    plant.wait_for_end("o2", "b");
    check_messages(&plant);
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
    plant.order_is_never_empty("o1", "k");
}

/// The network between the gateway and the vehicle loses everything; the broker and both processes live.
#[test]
fn a_vehicles_link_that_is_cut_stops_the_vehicle_alone() {
    if !network::test("a_vehicles_link_that_is_cut_stops_the_vehicle_alone", &["nft"], false) {
        return;
    }
    network::ip("link set lo up");
    let plant = Plant::start("{ do = \"stop\" }");
    plant.order("o1", 0, 0, "a! k!");
    plant.vehicle.wait_for("drive 1 k");
    sleep(Duration::from_millis(300));
    let port = plant.port;
    let others = format!("tcp dport {port} accept\ntcp sport {port} accept\ndrop");
    network::filter("inet cut", "input", &others).unwrap();
    let cut = Instant::now();
    plant.vehicle.wait_for("stood");
    let took = plant.vehicle.at("stood").unwrap().duration_since(cut);
    println!("link to the vehicle cut: stood after {took:?}");
    assert!(took < Duration::from_millis(LEASE_MS + 150), "{took:?}");
    plant.wait_for("broken", |plant| plant.connection() == "CONNECTIONBROKEN");
    println!("CONNECTIONBROKEN after {:?}", cut.elapsed());
    network::run("nft flush ruleset").unwrap();
    plant.wait_for_end("o1", "k");
    assert_eq!((plant.connection().as_str(), plant.count("drive ")), ("ONLINE", 1), "{:?}", plant.vehicle.lines());
    plant.order_is_never_empty("o1", "k");
}

/// Killed at any moment and started again, 10 times or as often as `CARA_TEST_FAIL_OVERS` says: what is retained ends with ONLINE, and
/// the vehicle drives each edge once.
#[test]
fn connection_ends_online_after_each_fail_over() {
    let count = std::env::var("CARA_TEST_FAIL_OVERS").ok().and_then(|text| text.parse().ok()).unwrap_or(10);
    let mut plant = Plant::start("{ do = \"stop\" }");
    let seed = fastrand::u64(..);
    let mut rng = fastrand::Rng::with_seed(seed);
    for round in 0..count {
        let (id, to) = (format!("o{round}"), if round % 2 == 0 { "a! b!" } else { "b! a!" });
        plant.order(&id, 0, 0, to);
        sleep(Duration::from_millis(rng.u64(..1_000)));
        plant.kill_gateway();
        plant.start_gateway();
        // Until it is taken, the master sends it again.
        plant.wait_for("its state", |plant| {
            let is_taken = plant.state()["orderId"] == id.as_str();
            if !is_taken && plant.connection() == "ONLINE" {
                plant.order(&id, 0, 0, to);
                sleep(Duration::from_millis(100));
            }
            is_taken
        });
        plant.wait_for_end(&id, &to[3..4]);
        let (said, messages) = (Messages::default(), |said: &Messages| said.lock().unwrap().get("connection").cloned());
        let reader = master_named("reader", plant.port, said.clone());
        until("what is retained", || messages(&said).is_some());
        let first = messages(&said).unwrap()[0].clone();
        assert_eq!(
            (&first.0["connectionState"], first.1),
            (&Value::from("ONLINE"), true),
            "round {round}, seed {seed}"
        );
        reader.disconnect().unwrap();
    }
    // A drive that goes on with its edge has its number, so no number comes for two nodes, nor is a node reached twice.
    assert_eq!(plant.count("arrived "), count, "seed {seed}: {:?}", plant.vehicle.lines());
    println!("{count} fail-overs: ONLINE, and no order driven twice");
}

/// No stop waits for a disk.
#[test]
fn a_record_that_cannot_be_written_stops_the_vehicle() {
    // What stops the vehicle needs no disk; else it stops by its heart and its lease.
    for (kind, bound) in [("startPause", 200), ("stateRequest", LEASE_MS + LEASE_MS / 2 + 150)] {
        let plant = Plant::start("{ do = \"stop\" }");
        plant.order("o1", 0, 0, "a! k!");
        plant.vehicle.wait_for("drive 1 k");
        sleep(Duration::from_millis(300));
        let folder = plant.folder.path().join("state/vda5050");
        std::fs::remove_dir_all(&folder).unwrap();
        plant.instant(kind, "p1");
        let sent = Instant::now();
        plant.vehicle.wait_for("stood");
        let took = plant.vehicle.at("stood").unwrap().duration_since(sent);
        println!("record not written, {kind}: stood after {took:?}");
        assert!(took < Duration::from_millis(bound), "{took:?}");
        std::fs::create_dir(&folder).unwrap();
        plant.wait_for("it is kept", |plant| plant.action("p1") == "FINISHED");
        plant.instant("stopPause", "p2");
        plant.wait_for_end("o1", "k");
    }
}

/// A write that does not come back: what stops the vehicle is heard meanwhile, else it stops 1 s later by its lease.
#[test]
fn a_disk_that_hangs_holds_up_no_stop() {
    for (kind, bound) in [("startPause", 200), ("stateRequest", 1_000 + LEASE_MS + LEASE_MS / 2 + 150)] {
        let plant = Plant::start("{ do = \"stop\" }");
        plant.order("o1", 0, 0, "a! k!");
        plant.vehicle.wait_for("drive 1 k");
        sleep(Duration::from_millis(300));
        // A pipe that nobody reads hangs who opens it.
        let pipe = plant.folder.path().join("state/vda5050/0001.next");
        assert!(std::process::Command::new("mkfifo").arg(&pipe).status().unwrap().success());
        plant.instant("stateRequest", "p0");
        sleep(Duration::from_millis(100));
        plant.instant(kind, "p1");
        let sent = Instant::now();
        plant.vehicle.wait_for("stood");
        let took = plant.vehicle.at("stood").unwrap().duration_since(sent);
        println!("the disk hangs, {kind}: stood after {took:?}");
        assert!(took < Duration::from_millis(bound), "{took:?}");
        assert_eq!([plant.action("p0"), plant.action("p1")], ["", ""], "said, and not written");
        // A pipe cannot be synchronized: that write fails, and the next one is to a file.
        let end = std::fs::File::open(&pipe).unwrap();
        std::fs::remove_file(&pipe).unwrap();
        plant.wait_for("it is kept", |plant| plant.action("p1") == "FINISHED");
        drop(end);
        plant.instant("stopPause", "p2");
        plant.wait_for_end("o1", "k");
    }
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
    plant.vehicle = vehicle(plant.folder.path(), plant.fleet, 1);
    plant.wait_for_end("o1", "e");
    assert_eq!(plant.connection(), "ONLINE");
}

/// The broker stays away for `CARA_TEST_BROKER_AWAY` seconds more.
fn away() {
    let seconds = std::env::var("CARA_TEST_BROKER_AWAY").ok().and_then(|text| text.parse().ok()).unwrap_or_default();
    sleep(Duration::from_secs(seconds));
}

/// By the standard, the vehicle drives on to the end of its base.
#[test]
fn without_a_broker_the_base_is_finished() {
    let mut plant = Plant::start("{ do = \"finish-base\", seconds = 60.0, metres = 50.0 }");
    plant.order("o1", 0, 0, "a! c! e! g");
    plant.vehicle.wait_for("drive 1 c");
    plant.broker.take().unwrap().kill();
    plant.vehicle.wait_for("arrived e");
    away();
    plant.restart_broker();
    plant.wait_for("its state", |plant| plant.state()["lastNodeId"] == "e" && plant.connection() == "ONLINE");
    assert_eq!((plant.count("stood"), plant.state()["paused"] == true), (0, false));
    plant.order("o1", 1, 4, "e! g!");
    plant.wait_for_end("o1", "g");
}

/// Killed, stopped, and limits of finish-base: the vehicle stands, and waits for stopPause.
#[test]
fn without_a_broker_the_vehicle_stops_within_its_bound() {
    const STOP: &str = "{ do = \"stop\" }";
    for (policy, kills, bound) in [
        (STOP, true, 500),
        // The probe's time-out, and the rest of a turn.
        (STOP, false, 2_500),
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
            if policy == STOP {
                away();
            }
            plant.restart_broker();
        } else {
            plant.broker.as_ref().unwrap().signal(Signal::CONT);
        }
        plant.wait_for("it is paused", |plant| plant.state()["paused"] == true && plant.has_error("brokerLost"));
        plant.go_on();
        plant.wait_for_end("o1", "k");
    }
}

/// A proxy before the broker that holds back all that comes, as a network does that loses everything: nothing is closed.
fn black_hole(broker: u16) -> (u16, Arc<AtomicBool>) {
    let listener = TcpListener::bind("127.0.0.1:0").unwrap();
    let (port, holds) = (listener.local_addr().unwrap().port(), Arc::new(AtomicBool::new(false)));
    let held = holds.clone();
    std::thread::spawn(move || {
        for client in listener.incoming().flatten() {
            let Ok(server) = TcpStream::connect(("127.0.0.1", broker)) else { continue };
            for (from, to) in [(&client, &server), (&server, &client)] {
                let (mut from, mut to, held) = (from.try_clone().unwrap(), to.try_clone().unwrap(), held.clone());
                std::thread::spawn(move || {
                    let mut bytes = [0; 65_536];
                    while let Ok(read @ 1..) = from.read(&mut bytes) {
                        while held.load(Ordering::SeqCst) {
                            sleep(Duration::from_millis(1));
                        }
                        if to.write_all(&bytes[..read]).is_err() {
                            break;
                        }
                    }
                    let _ = to.shutdown(Shutdown::Both);
                });
            }
        }
    });
    (port, holds)
}

/// Nothing gets through, and nothing says so.
#[test]
fn a_network_that_loses_everything_stops_the_vehicle() {
    for (policy, bound) in [
        // The probe's time-out, and a limit.
        ("{ do = \"stop\" }", 2_500),
        ("{ do = \"finish-base\", seconds = 1.0, metres = 50.0 }", 3_500),
    ] {
        let mut plant = Plant::start(policy);
        let (port, holds) = black_hole(plant.port);
        plant.change(&format!("port = {}\n", plant.port), &format!("port = {port}\n"));
        plant.order("o1", 0, 0, "a! k!");
        plant.vehicle.wait_for("drive 1 k");
        let lost = Instant::now();
        holds.store(true, Ordering::SeqCst);
        // These arrive when the network is back, and are old then.
        plant.order("o1", 1, 2, "k! l!");
        plant.instant("beep", "late");
        plant.vehicle.wait_for("stood");
        let took = plant.vehicle.at("stood").unwrap().duration_since(lost);
        println!("{policy}, black hole: stood after {took:?}");
        assert!(took < Duration::from_millis(bound), "{policy}: {took:?}");
        holds.store(false, Ordering::SeqCst);
        plant.wait_for("it is paused", |plant| plant.state()["paused"] == true && plant.has_error("brokerLost"));
        plant.wait_for("what is late is refused", |plant| plant.has_error("validationError"));
        plant.go_on();
        plant.wait_for_end("o1", "k");
        assert_eq!([plant.count("drive "), plant.count("act ")], [1, 0], "{:?}", plant.vehicle.lines());
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
        ("version = \"2.1.0\"", "version = \"4.0.0\"", "is not 2.0.x, 2.1.x or 3.0.x"),
        ("scopes = [\"NODE\"]", "scopes = [\"ZONE\"]", "no vehicle has zones"),
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

/// One file serves all versions, with the names of 2.x or of 3.0, and `--check` says what 3.0 needs beside that.
#[test]
fn the_factsheet_of_3_is_checked() {
    let (folder, example) = (tempfile::tempdir().unwrap(), Path::new(env!("CARGO_MANIFEST_DIR")));
    let [config, factsheet] =
        ["example.toml", "example-factsheet.json"].map(|name| std::fs::read_to_string(example.join(name)).unwrap());
    let file = folder.path().join("vda5050.toml");
    let of = |version: &str, factsheet: &str| {
        std::fs::write(&file, config.replace("2.1.0", version)).unwrap();
        std::fs::write(folder.path().join("example-factsheet.json"), factsheet).unwrap();
        Config::read(&file).unwrap().factsheet().map_err(|error| format!("{error:#}"))
    };
    for (version, schemas) in [("2.1.0", "2.1.0"), ("3.0.0", "main-0b2ae43")] {
        let schema = std::fs::read(example.join(format!("schemas/{schemas}/factsheet.schema"))).unwrap();
        let validator = jsonschema::validator_for(&serde_json::from_slice(&schema).unwrap()).unwrap();
        let version_of = Version::of(version).unwrap();
        let mut sent = of(version, &factsheet).unwrap();
        sent.header = fake::header(version);
        let text = write(version_of, &sent);
        validator
            .validate(&serde_json::from_slice(&text).unwrap())
            .unwrap_or_else(|error| panic!("{version}: {error}"));
        let again = of(version, std::str::from_utf8(&text).unwrap()).unwrap();
        assert_eq!((again.agv_geometry, again.physical_parameters), (sent.agv_geometry, sent.physical_parameters));
        assert_eq!(again.type_specification, sent.type_specification);
    }
    let refused = [("\"heightMin\": 0.4,", "", "minimumHeight"), ("VIRTUAL_LINE_GUIDED", "AUTONOMOUS", "planned path")];
    for (from, to, named) in refused {
        assert!(factsheet.contains(from));
        let spoilt = factsheet.replace(from, to);
        assert!(of("2.1.0", &spoilt).is_ok());
        let error = of("3.0.0", &spoilt).unwrap_err();
        assert!(error.contains(named) && error.contains("example-factsheet.json"), "{error}");
    }
}
