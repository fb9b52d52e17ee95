//! What the gateway makes of brokers and readers of its log that do not do their part.

mod fake;
mod plant;

use std::io::{Read, Write};
use std::net::{TcpListener, TcpStream};
use std::os::unix::net::UnixDatagram;
use std::process::{Command, Stdio};
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::{Duration, Instant, SystemTime};

use cara_vda5050::mqtt::{Heard, Link, Place};
use fake::{instant, order};
use plant::{PATIENCE, Plant, Process};
use rumqttc::QoS;

/// Takes a connection and its subscriptions, with these answers.
fn broker(listener: &TcpListener, answers: &[u8]) -> TcpStream {
    let (mut stream, id) = subscribed(listener);
    stream.write_all(&[0x90, 2 + answers.len() as u8, id[0], id[1]]).unwrap();
    stream.write_all(answers).unwrap();
    stream
}

/// Takes a connection: that, and the packet id of its subscriptions.
fn subscribed(listener: &TcpListener) -> (TcpStream, [u8; 2]) {
    let (mut stream, _) = listener.accept().unwrap();
    let packet = |stream: &mut TcpStream| {
        // No packet of this test has 128 bytes or more but the first, whose length takes two.
        let mut head = [0; 2];
        stream.read_exact(&mut head).unwrap();
        let mut length = usize::from(head[1] & 0x7f);
        if head[1] >= 0x80 {
            let mut more = [0];
            stream.read_exact(&mut more).unwrap();
            length += usize::from(more[0]) << 7;
        }
        let mut body = vec![0; length];
        stream.read_exact(&mut body).unwrap();
        (head[0] >> 4, body)
    };
    assert_eq!(packet(&mut stream).0, 1, "CONNECT");
    stream.write_all(&[0x20, 2, 0, 0]).unwrap();
    let (kind, body) = packet(&mut stream);
    assert_eq!(kind, 8, "SUBSCRIBE");
    (stream, [body[0], body[1]])
}

fn link(listener: &TcpListener, will: Box<dyn Fn() -> Vec<u8> + Send>) -> Link {
    let port = listener.local_addr().unwrap().port();
    Link::start(Place {
        broker: toml::from_str(&format!("host = \"127.0.0.1\"\nport = {port}")).unwrap(),
        client_id: "KIT-0001".into(),
        prefix: "uagv/v2/KIT/0001".into(),
        topics: vec!["order", "instantActions", "connection"],
        will,
        recording: Default::default(),
        expiry: Arc::default(),
    })
    .unwrap()
}

fn why_lost(link: &Link) -> String {
    match link.heard.recv_timeout(PATIENCE).unwrap() {
        Heard::Lost(why) => why,
        _ => panic!("something else"),
    }
}

/// A vehicle that no stop would reach is not ONLINE.
#[test]
fn a_subscription_that_is_refused_is_a_broker_that_is_away() {
    let listener = TcpListener::bind("127.0.0.1:0").unwrap();
    let link = link(&listener, Box::new(Vec::new));
    // The second one is refused, or not answered at all.
    for answers in [&[0, 0x80, 0][..], &[0]] {
        let _refusing = broker(&listener, answers);
        assert_eq!(why_lost(&link), "the broker refuses to send instantActions of uagv/v2/KIT/0001");
    }
    // Without this one a late last will stays.
    let _takes_orders = broker(&listener, &[0, 0, 0x80]);
    assert!(matches!(link.heard.recv_timeout(PATIENCE).unwrap(), Heard::Connected(_)));
}

#[test]
fn a_broker_that_answers_no_subscription_is_one_that_is_away() {
    let listener = TcpListener::bind("127.0.0.1:0").unwrap();
    let link = link(&listener, Box::new(Vec::new));
    let begun = Instant::now();
    let _silent = subscribed(&listener);
    assert_eq!(why_lost(&link), "the broker does not answer the subscriptions");
    assert!(begun.elapsed() >= Duration::from_secs(4), "{:?}", begun.elapsed());
    // It is tried again.
    let _answers = broker(&listener, &[0, 0, 0]);
    assert!(matches!(link.heard.recv_timeout(PATIENCE).unwrap(), Heard::Connected(_)));
}

/// Nobody else would connect this vehicle again.
#[test]
fn a_connection_that_panics_is_tried_again() {
    let listener = TcpListener::bind("127.0.0.1:0").unwrap();
    let panics = AtomicBool::new(true);
    let link =
        link(&listener, Box::new(move || if panics.swap(false, Ordering::SeqCst) { panic!() } else { Vec::new() }));
    assert_eq!(why_lost(&link), "the connection has panicked");
    let _answers = broker(&listener, &[0, 0, 0]);
    assert!(matches!(link.heard.recv_timeout(PATIENCE).unwrap(), Heard::Connected(_)));
}

/// It says that one came: the master sees it in the state.
#[test]
fn a_message_that_cannot_be_held_ends_the_connection_and_is_told_of() {
    let listener = TcpListener::bind("127.0.0.1:0").unwrap();
    let link = link(&listener, Box::new(Vec::new));
    let mut broker = broker(&listener, &[0, 0, 0]);
    assert!(matches!(link.heard.recv_timeout(PATIENCE).unwrap(), Heard::Connected(_)));
    // The head of a message of 16 MiB and one byte: nothing of it is read.
    broker.write_all(&[0x30, 0x81, 0x80, 0x80, 0x08]).unwrap();
    assert!(matches!(link.heard.recv_timeout(PATIENCE).unwrap(), Heard::TooLong(None, 16_777_217)));
    assert_eq!(why_lost(&link), "a message of 16777217 bytes came: one with more than 16777216 ends the connection");
}

/// The vehicle does what is set for a broker that is away, and the connection comes back.
#[test]
fn behind_a_message_that_cannot_be_held_the_connection_comes_back() {
    let mut plant = Plant::start("{ do = \"finish-base\", seconds = 60.0, metres = 50.0 }");
    for (policy, way) in [("finish-base", "a! k!"), ("stop", "k! a!")] {
        if policy == "stop" {
            plant.change("do = \"finish-base\", seconds = 60.0, metres = 50.0", "do = \"stop\"");
        }
        let (id, end) = (policy, &way[3..4]);
        plant.order(id, 0, 0, way);
        plant.wait_for("it drives", |plant| plant.state()["orderId"] == id && plant.state()["driving"] == true);
        let losses = plant.metric("broker_losses_total");
        plant.publish_long("order", 17 << 20);
        plant.wait_for("the connection ends", |plant| plant.metric("broker_losses_total") > losses);
        plant.wait_for("it is there again, and says why", |plant| {
            plant.metric("broker") == 1 && plant.metric("refused_total") > 0 && plant.has_error("validationError")
        });
        if policy == "stop" {
            plant.wait_for("it stands", |plant| plant.state()["paused"] == true && plant.has_error("brokerLost"));
            plant.go_on();
        } else {
            assert_eq!(plant.count("stood"), 0);
        }
        plant.wait_for_end(id, end);
    }
}

/// The master's clock is an hour behind: what it sends is old, and what stops the vehicle counts.
#[test]
fn no_time_stamp_refuses_a_stop() {
    let mut plant = Plant::start("{ do = \"stop\" }");
    plant.change("oldest = 0.0", "oldest = 60.0");
    let stamp = |at: SystemTime| humantime::format_rfc3339_millis(at).to_string();
    let now = || stamp(SystemTime::now());
    let behind = || stamp(SystemTime::now() - Duration::from_secs(3_600));
    let send = |plant: &Plant, kind: &str, id: &str, timestamp: String| {
        let mut message = instant(kind, id);
        message.header.timestamp = timestamp;
        plant.publish("instantActions", false, &message);
    };
    let mut sent = order("o1", 0, 0, "a! k!");
    sent.header.timestamp = behind();
    plant.publish("order", false, &sent);
    plant.wait_for("it is too old", |plant| plant.has_error("validationError"));
    sent.header.timestamp = now();
    plant.publish("order", false, &sent);
    plant.wait_for("it drives", |plant| plant.state()["driving"] == true && !plant.has_error("validationError"));
    for (index, timestamp) in [behind(), "yesterday".into()].into_iter().enumerate() {
        let id = format!("p{index}");
        send(&plant, "startPause", &id, timestamp.clone());
        plant.wait_for("it stands", |plant| plant.action(&id) == "FINISHED" && plant.state()["driving"] == false);
        // What makes it go on is refused.
        send(&plant, "stopPause", "old", timestamp);
        plant.wait_for("that is too old", |plant| plant.has_error("validationError"));
        assert!(plant.state()["paused"] == true && plant.action("old").is_empty());
        send(&plant, "stopPause", &format!("on{index}"), now());
        plant.wait_for("it goes on", |plant| plant.state()["driving"] == true);
    }
    send(&plant, "cancelOrder", "c1", behind());
    plant.wait_for("it is cancelled", |plant| plant.action("c1") == "FINISHED" && plant.state()["driving"] == false);
}

/// One that is retained would come again with each connection.
#[test]
fn a_message_that_is_too_long_is_refused_and_nothing_else() {
    let mut plant = Plant::start("{ do = \"stop\" }");
    let long = vec![b' '; 600 * 1024];
    plant.client.publish("uagv/v2/KIT/0001/order", QoS::AtMostOnce, true, long).unwrap();
    plant.wait_for("it is refused", |plant| plant.has_error("validationError"));
    plant.order("o1", 0, 0, "a! b!");
    plant.wait_for_end("o1", "b");
    plant.kill_gateway();
    plant.wait_for("the last will", |plant| plant.connection() == "CONNECTIONBROKEN");
    plant.start_gateway();
    plant.wait_for("it is refused again", |plant| plant.has_error("validationError"));
    plant.order("o2", 0, 0, "b! a!");
    plant.wait_for_end("o2", "a");
}

#[test]
fn a_service_manager_hears_that_it_is_up_and_lives() {
    let mut plant = Plant::start("{ do = \"stop\" }");
    let path = plant.folder.path().join("notify");
    let socket = UnixDatagram::bind(&path).unwrap();
    socket.set_read_timeout(Some(PATIENCE)).unwrap();
    restart(&mut plant, |command| {
        command.env("NOTIFY_SOCKET", &path).env("WATCHDOG_USEC", "400000");
    });
    let heard = || {
        let mut text = [0; 64];
        let length = socket.recv(&mut text).unwrap();
        String::from_utf8_lossy(&text[..length]).trim().to_owned()
    };
    assert_eq!(heard(), "READY=1");
    (0..20).for_each(|_| assert_eq!(heard(), "WATCHDOG=1"));
}

/// Starts the gateway with this for its log.
fn logs_to(plant: &mut Plant, stderr: Stdio) {
    restart(plant, |command| {
        command.stderr(stderr);
    });
}

fn restart(plant: &mut Plant, change: impl FnOnce(&mut Command)) {
    plant.kill_gateway();
    let mut command = Command::new(env!("CARGO_BIN_EXE_cara-vda5050"));
    command.arg(plant.file()).env("CARA_KEYS", plant.folder.path().join("keys"));
    command.env("XDG_RUNTIME_DIR", plant.folder.path());
    change(&mut command);
    plant.heard.lock().unwrap().clear();
    plant.gateway = Some(Process::start(&mut command));
    plant.wait_for("ONLINE", |plant| plant.connection() == "ONLINE");
}

/// The loss of a broker, about which there is a line, and a stop behind that.
fn lose_the_broker(plant: &mut Plant) {
    plant.broker.take().unwrap().kill();
    std::thread::sleep(Duration::from_millis(500));
    plant.heard.lock().unwrap().clear();
    plant.restart_broker();
    plant.wait_for("ONLINE again", |plant| plant.connection() == "ONLINE");
    plant.order("o1", 0, 0, "a! k!");
    plant.wait_for("it drives", |plant| plant.state()["driving"] == true);
    plant.instant("startPause", "p1");
    plant.wait_for("it stands", |plant| plant.action("p1") == "FINISHED" && plant.state()["driving"] == false);
}

#[test]
fn a_log_that_nobody_reads_ends_no_vehicle() {
    let mut plant = Plant::start("{ do = \"stop\" }");
    let (reader, writer) = std::io::pipe().unwrap();
    logs_to(&mut plant, writer.into());
    drop(reader);
    lose_the_broker(&mut plant);
    // The lines are counted.
    plant.wait_for("lost lines", |plant| plant.metric("log_lost_total") > 0);
}

#[test]
fn a_log_that_is_held_up_holds_up_no_vehicle() {
    let mut plant = Plant::start("{ do = \"stop\" }");
    let (_reader, writer) = std::io::pipe().unwrap();
    let mut filling = writer.try_clone().unwrap();
    // Until it is full, and then for ever.
    std::thread::spawn(move || while filling.write_all(b" ").is_ok() {});
    logs_to(&mut plant, writer.into());
    lose_the_broker(&mut plant);
}
