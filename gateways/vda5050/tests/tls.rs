//! TLS to mosquitto: both versions, a client certificate for each vehicle with an access list, expiry, and files that change.

mod fake;
mod plant;

use std::path::Path;
use std::process::{Command, Stdio};
use std::sync::{Arc, Mutex};
use std::thread::sleep;
use std::time::{Duration, Instant};

use cara_vda5050::config::Broker;
use plant::{Plant, certificates, free_port, until};
use rumqttc::{Client, Event, MqttOptions, Packet, QoS, TlsConfiguration, Transport};

/// What mosquitto and the gateway are told of a listener with certificates.
fn secured(folder: &Path, port: u16, days: u32) -> (String, String) {
    secured_for(folder, port, days, &["0001", "0002"])
}

fn secured_for(folder: &Path, port: u16, days: u32, vehicles: &[&str]) -> (String, String) {
    certificates(folder, &[&["broker", "master"], vehicles].concat(), days);
    let file = |name: &str| folder.join(name).display().to_string();
    let acl = Path::new(env!("CARGO_MANIFEST_DIR")).join("example-acl");
    let broker = format!(
        "listener {port} 127.0.0.1\ncafile {}\ncertfile {}\nkeyfile {}\nrequire_certificate true\n\
         use_identity_as_username true\nacl_file {}\n",
        file("ca.pem"),
        file("broker.pem"),
        file("broker.key"),
        acl.display()
    );
    let gateway = "ca_file = \"ca.pem\"\ncertificate_file = \"{serial}.pem\"\nkey_file = \"{serial}.key\"".to_owned();
    (broker, gateway)
}

#[test]
fn both_versions_of_tls_are_spoken() {
    for (version, other) in [("TLSv1.2", "-tls1_3"), ("TLSv1.3", "-tls1_2")] {
        let tls = free_port();
        let plant = Plant::with("{ do = \"stop\" }", "2.1.0", |folder| {
            let text = "openssl_conf = a\n[a]\nssl_conf = b\n[b]\nsystem_default = c\n[c]\n";
            let only = format!("{text}MinProtocol = {version}\nMaxProtocol = {version}\n");
            std::fs::write(folder.join("openssl.cnf"), only).unwrap();
            secured(folder, tls, 400)
        });
        plant.order("o1", 0, 0, "a! b!");
        plant.wait_for_end("o1", "b");
        let mut with_other = Command::new("openssl");
        with_other.args(["s_client", other, "-connect", &format!("127.0.0.1:{tls}")]).stdin(Stdio::null());
        with_other.stdout(Stdio::null()).stderr(Stdio::null());
        assert!(!with_other.status().unwrap().success(), "mosquitto speaks no other version than {version}");
    }
}

/// A client by its certificate, and what it hears of all that it asks for.
fn client(folder: &Path, name: &str, port: u16) -> (Client, Arc<Mutex<Vec<String>>>) {
    let file = |end: &str| folder.join(format!("{name}.{end}")).display().to_string();
    let text = format!(
        "host = \"127.0.0.1\"\nca_file = \"{}\"\ncertificate_file = \"{}\"\nkey_file = \"{}\"",
        folder.join("ca.pem").display(),
        file("pem"),
        file("key")
    );
    let broker: Broker = toml::from_str(&text).unwrap();
    let tls = cara_vda5050::tls::client(&broker, &Arc::default()).unwrap().unwrap();
    let mut options = MqttOptions::new(format!("test-{name}"), "127.0.0.1", port);
    options.set_transport(Transport::tls_with_config(TlsConfiguration::Rustls(Arc::new(tls))));
    let (client, mut connection) = Client::new(options, 100);
    let heard = Arc::<Mutex<Vec<String>>>::default();
    let (subscriber, topics) = (client.clone(), heard.clone());
    std::thread::spawn(move || {
        for event in connection.iter() {
            match event {
                Ok(Event::Incoming(Packet::ConnAck(_))) => subscriber.subscribe("uagv/#", QoS::AtMostOnce).unwrap(),
                Ok(Event::Incoming(Packet::SubAck(_))) => topics.lock().unwrap().push("subscribed".into()),
                Ok(Event::Incoming(Packet::Publish(message))) => topics.lock().unwrap().push(message.topic),
                Ok(_) => {}
                Err(_) => return,
            }
        }
    });
    until("subscribed", || !heard.lock().unwrap().is_empty());
    (client, heard)
}

#[test]
fn a_vehicles_client_has_its_own_topics_only() {
    let tls = free_port();
    let plant = Plant::with("{ do = \"stop\" }", "2.1.0", |folder| secured(folder, tls, 400));
    let (other, of_other) = client(plant.folder.path(), "0002", tls);
    let (master, of_master) = client(plant.folder.path(), "master", tls);
    // Each message says where it was sent; what is allowed comes last, so that the rest would have come before.
    let publish = |client: &Client, topic: &str| {
        client.publish(topic, QoS::AtLeastOnce, false, format!("{{\"to\": \"{topic}\"}}")).unwrap();
    };
    for topic in ["order", "instantActions", "connection", "state", "visualization", "factsheet", "cara-probe"] {
        publish(&other, &format!("uagv/v2/KIT/0001/{topic}"));
    }
    for topic in ["order", "instantActions"] {
        publish(&other, &format!("uagv/v2/KIT/0002/{topic}"));
    }
    publish(&other, "uagv/v2/KIT/0002/state");
    for topic in ["connection", "state", "visualization", "factsheet"] {
        publish(&master, &format!("uagv/v2/KIT/0001/{topic}"));
    }
    publish(&master, "uagv/v2/KIT/0002/order");
    let came = |plant: &Plant| {
        let heard = plant.heard.lock().unwrap();
        let said = heard.values().flatten().filter_map(|(message, _)| message["to"].as_str().map(str::to_owned));
        let mut said: Vec<String> = said.collect();
        said.sort();
        said
    };
    let allowed = ["uagv/v2/KIT/0002/order", "uagv/v2/KIT/0002/state"];
    plant.wait_for("what is allowed has come", |plant| came(plant).len() >= allowed.len());
    assert_eq!(came(&plant), allowed);
    // The master's orders and the vehicle's states get through, and no other vehicle reads them.
    let order = serde_json::to_vec(&fake::order("o1", 0, 0, "a! b!")).unwrap();
    master.publish("uagv/v2/KIT/0001/order", QoS::AtMostOnce, false, order).unwrap();
    plant.wait_for_end("o1", "b");
    until("the master hears a state", || of_master.lock().unwrap().iter().any(|topic| topic.ends_with("0001/state")));
    let foreign: Vec<String> =
        of_other.lock().unwrap().iter().filter(|topic| topic.contains("0001")).cloned().collect();
    assert!(foreign.is_empty(), "{foreign:?}");
}

#[test]
fn certificates_that_expire_are_an_alarm_until_they_are_replaced() {
    let tls = free_port();
    let mut plant = Plant::with("{ do = \"stop\" }", "2.1.0", |folder| secured(folder, tls, 6));
    let alarms = |plant: &Plant| {
        let errors = plant.state()["errors"].as_array().cloned().unwrap_or_default();
        let whose = errors.iter().filter(|error| {
            let is_near = error["errorDescription"].as_str().is_some_and(|text| text.ends_with("within 7 days"));
            error["errorType"] == "certificateExpires" && error["errorLevel"] == "WARNING" && is_near
        });
        whose.map(|error| error["errorReferences"][0]["referenceValue"].clone()).collect::<Vec<_>>()
    };
    plant.wait_for("both expire", |plant| alarms(plant) == ["client", "broker"]);
    let scraped = plant.scrape();
    for line in [
        "cara_vda5050_broker{vehicle=\"0001\"} 1",
        "cara_vda5050_linked{vehicle=\"0001\"} 1",
        "cara_vda5050_out_of_service{vehicle=\"0001\"} 0",
        "cara_vda5050_errors{vehicle=\"0001\"} 2",
        "cara_vda5050_certificate_expires{vehicle=\"0001\",certificate=\"client\"}",
        "cara_vda5050_certificate_expires{vehicle=\"0001\",certificate=\"broker\"}",
        "cara_unit_",
    ] {
        assert!(scraped.contains(line), "{line}: {scraped}");
    }
    assert!(scraped.ends_with("# EOF\n") && scraped.matches("# EOF").count() == 1);
    // An authority that nobody knew before.
    plant.broker.take().unwrap().kill();
    secured(plant.folder.path(), tls, 400);
    plant.restart_broker();
    plant.wait_for("the alarm is over", |plant| plant.connection() == "ONLINE" && alarms(plant).is_empty());
    assert!(plant.scrape().contains("cara_vda5050_broker_losses_total{vehicle=\"0001\"} 1"));
    plant.order("o1", 0, 0, "a! b!");
    plant.wait_for_end("o1", "b");
}

/// Certificates are read each minute: a disk that hangs then holds up no vehicle.
#[test]
fn a_certificate_that_cannot_be_read_holds_up_no_stop() {
    let tls = free_port();
    let plant = Plant::with("{ do = \"stop\" }", "2.1.0", |folder| secured(folder, tls, 400));
    plant.order("o1", 0, 0, "a! b!");
    plant.wait_for_end("o1", "b");
    // A pipe that nobody writes hangs who opens it.
    let file = plant.folder.path().join("0001.pem");
    std::fs::remove_file(&file).unwrap();
    assert!(Command::new("mkfifo").arg(&file).status().unwrap().success());
    // Who opens it for writing waits for a reader, which finds nothing to read then.
    let (opened, is_opened) = std::sync::mpsc::channel();
    std::thread::spawn(move || opened.send(std::fs::File::options().write(true).open(file).unwrap()));
    let _written_by = is_opened.recv_timeout(Duration::from_secs(120)).expect("the file is read each minute");
    plant.order("o2", 0, 0, "b! k!");
    plant.wait_for("it drives", |plant| plant.state()["driving"] == true);
    plant.instant("startPause", "p1");
    plant.wait_for("it stands", |plant| plant.action("p1") == "FINISHED" && plant.state()["driving"] == false);
}

/// 20 vehicles, or as many as `CARA_TEST_VEHICLES` says: how much the gateway takes, and what a restart of the broker does.
#[test]
#[ignore = "measures"]
fn many_vehicles_over_tls() {
    let count = std::env::var("CARA_TEST_VEHICLES").ok().and_then(|text| text.parse().ok()).unwrap_or(20);
    let serials: Vec<String> = (1..=count).map(|number| format!("{number:04}")).collect();
    let tls = free_port();
    let mut plant = Plant::of(count, "{ do = \"finish-base\", seconds = 60.0, metres = 500.0 }", "2.1.0", |folder| {
        secured_for(folder, tls, 400, &serials.iter().map(String::as_str).collect::<Vec<_>>())
    });
    let topic = |serial: &str, topic: &str| match serial {
        "0001" => topic.to_owned(),
        _ => format!("{serial}/{topic}"),
    };
    let all = |plant: &Plant, what: &str, is_so: &dyn Fn(&serde_json::Value) -> bool| {
        serials.iter().filter(|serial| !is_so(&plant.last(&topic(serial, what)).0)).count()
    };
    let online = |message: &serde_json::Value| message["connectionState"] == "ONLINE";
    let drives = |state: &serde_json::Value| state["driving"] == true;
    let began = Instant::now();
    within(&format!("{count} are ONLINE"), || all(&plant, "connection", &online) == 0);
    println!("{count} vehicles ONLINE after {:?}", began.elapsed());
    let idle = plant.used(Duration::from_secs(5));
    let way: String = ('a'..='z').map(|node| format!("{node}! ")).collect();
    for serial in &serials {
        let mut order = fake::order("o1", 0, 0, &way);
        order.header.serial_number = serial.clone();
        // Slow, so that it lasts.
        order.edges.iter_mut().for_each(|edge| edge.max_speed = Some(0.5));
        let message = serde_json::to_vec(&order).unwrap();
        plant.client.publish(format!("uagv/v2/KIT/{serial}/order"), QoS::AtLeastOnce, false, message).unwrap();
    }
    within("all drive", || all(&plant, "state", &drives) == 0);
    let driving = plant.used(Duration::from_secs(10));
    println!("CPUs idle {idle:.3}, driving {driving:.3}; resident {} KB", plant.resident());
    plant.broker.take().unwrap().kill();
    plant.heard.lock().unwrap().clear();
    std::thread::sleep(Duration::from_secs(1));
    let began = Instant::now();
    plant.restart_broker();
    within("all are ONLINE again", || all(&plant, "connection", &online) == 0);
    println!("all ONLINE {:?} after the broker's restart", began.elapsed());
    within("all drive", || all(&plant, "state", &drives) == 0);
    println!("all have said that they drive after {:?}; resident {} KB", began.elapsed(), plant.resident());
    // On a machine that has too much to do, one or the other lease ends; each vehicle drives again.
    let lines = plant.others.iter().chain([&plant.vehicle]).flat_map(|of| of.lines());
    println!("{} stops under way", lines.filter(|line| line.contains("stood ")).count());
}

fn within(what: &str, mut is_so: impl FnMut() -> bool) {
    let end = Instant::now() + Duration::from_secs(180);
    while !is_so() {
        assert!(Instant::now() < end, "{what}");
        std::thread::sleep(Duration::from_millis(50));
    }
}

/// mosquitto takes a subscription for which its access list has no line, and sends nothing: with `probe_stops` that is noticed.
#[test]
fn a_broker_that_sends_no_stop_is_noticed_where_probes_go_the_same_way() {
    for (rights, is_there) in [("readwrite", true), ("read", false), ("write", false)] {
        let tls = free_port();
        let plant = Plant::with("{ do = \"stop\" }", "2.1.0", |folder| {
            let (broker, gateway) = secured(folder, tls, 400);
            let example = Path::new(env!("CARGO_MANIFEST_DIR")).join("example-acl");
            let text = std::fs::read_to_string(&example).unwrap();
            let own = "pattern read uagv/v2/KIT/%u/instantActions";
            assert!(text.contains(own));
            std::fs::write(folder.join("acl"), text.replace(own, &own.replace("read", rights))).unwrap();
            let broker = broker.replace(&example.display().to_string(), &folder.join("acl").display().to_string());
            (broker, format!("{gateway}\nprobe_stops = true"))
        });
        // A vehicle that no stop reaches does not begin to drive, or stands within the time of a probe.
        if !is_there {
            plant.wait_for("the broker counts as away", |plant| plant.metric("broker_losses_total") > 0);
        }
        for _ in 0..4 {
            sleep(Duration::from_millis(700));
            assert_eq!(plant.metric("broker") == 1, is_there, "{rights}");
        }
        plant.order("o1", 0, 0, "a! b!");
        match is_there {
            true => plant.wait_for_end("o1", "b"),
            false => plant.wait_for("it is refused", |plant| plant.has_error("validationError")),
        }
        assert_eq!(plant.count("drive "), usize::from(is_there), "{rights}");
    }
}
