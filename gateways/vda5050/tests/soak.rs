//! The gateway for hours, with a broker that ends, vehicles that hang and a master that repeats itself: `cargo xtask soak --gateway`,
//! which judges what the gateway held meanwhile. A plain test breaks each once.

mod fake;
mod plant;

use std::cell::Cell;
use std::path::PathBuf;
use std::sync::atomic::{AtomicBool, Ordering};
use std::thread::sleep;
use std::time::{Duration, Instant};

use cara_vda5050::message::{Order, write};
use cara_warehouse::run::soak::{Samples, line};
use fake::order;
use plant::Plant;
use rumqttc::QoS;
use rustix::process::Signal;
use serde_json::Value;

const VEHICLES: u32 = 20;
/// How long something is broken: links are lost meanwhile.
const BROKEN: Duration = Duration::from_secs(5);
/// How long all vehicles may take for their orders, on a busy machine.
const ROUND: Duration = Duration::from_secs(120);

#[derive(Clone, Copy, Debug)]
enum Fault {
    None,
    BrokerKilled,
    BrokerHangs,
    GatewayHangs,
    VehicleHangs,
    Paused,
    Nonsense,
}

const FAULTS: [Fault; 7] = [
    Fault::None,
    Fault::BrokerKilled,
    Fault::GatewayHangs,
    Fault::VehicleHangs,
    Fault::Paused,
    Fault::Nonsense,
    Fault::BrokerHangs,
];

#[test]
fn the_gateway_goes_on_and_holds_what_it_held() {
    let file = std::env::var_os("CARA_SOAK_FILE").map(PathBuf::from);
    let minutes = std::env::var("CARA_SOAK_MINUTES").map_or(0, |minutes| minutes.parse::<u64>().unwrap());
    let end = Instant::now() + Duration::from_secs(60 * minutes);
    let policy = "{ do = \"finish-base\", seconds = 60.0, metres = 50.0 }";
    let mut plant = Plant::of(VEHICLES, policy, "2.1.0", |_| Default::default());
    let (gateway, is_over) = (plant.gateway.as_ref().unwrap().child.id(), AtomicBool::new(false));
    let mut samples = file.as_deref().map(|file| Samples::open(file).unwrap());
    std::thread::scope(|scope| {
        let _ends = Ends(&is_over);
        scope.spawn(|| {
            while !is_over.load(Ordering::Relaxed) {
                sleep(Duration::from_millis(100));
                if let Some(samples) = &mut samples
                    && samples.is_due()
                {
                    samples.write(&[line("gateway", 0, gateway, [0; 2]).unwrap()]).unwrap();
                }
            }
        });
        let mut rounds = 0;
        while rounds < FAULTS.len() || Instant::now() < end {
            drive(&mut plant, rounds);
            rounds += 1;
        }
        println!("{rounds} rounds, in each an order for each of {VEHICLES} vehicles");
    });
}

/// Ends the sampling, also where an assertion fails.
struct Ends<'a>(&'a AtomicBool);

impl Drop for Ends<'_> {
    fn drop(&mut self) {
        self.0.store(true, Ordering::Relaxed);
    }
}

/// Each vehicle drives three edges and acts once, and something breaks on its way.
fn drive(plant: &mut Plant, round: usize) {
    let (id, fault) = (format!("o{round}"), FAULTS[round % FAULTS.len()]);
    let (way, last) = [("a! b!:beep=HARD c! d!", "d"), ("d! c!:beep=HARD b! a!", "a")][round % 2];
    let orders: Vec<Order> = (1..=VEHICLES).map(|number| order_of(number, &id, way)).collect();
    let all = |plant: &Plant, is_so: &dyn Fn(&Value) -> bool| {
        (1..=VEHICLES).all(|number| is_so(&last_of(plant, number, "state")))
    };
    plant.wait_within(ROUND, "all are online", |plant| {
        (1..=VEHICLES).all(|number| last_of(plant, number, "connection")["connectionState"] == "ONLINE")
    });
    orders.iter().for_each(|order| publish(plant, order, "order", &write(plant.version(), order)));
    let sent = Cell::new(Instant::now());
    plant.wait_within(ROUND, "each has its order", |plant| {
        // The broker keeps nothing of QoS 0 for a vehicle that has just noticed that it was away: a master asks again.
        if sent.get().elapsed() > BROKEN {
            sent.set(Instant::now());
            let lacks = |order: &&Order| last_of(plant, number_of(order), "state")["orderId"] != *id;
            orders
                .iter()
                .filter(lacks)
                .for_each(|order| publish(plant, order, "order", &write(plant.version(), order)));
        }
        all(plant, &|state| state["orderId"] == *id)
    });
    let mended = |signalled: &plant::Process| {
        signalled.signal(Signal::STOP);
        sleep(BROKEN);
        signalled.signal(Signal::CONT);
    };
    match fault {
        Fault::None => {}
        Fault::BrokerKilled => {
            plant.broker.take().unwrap().kill();
            sleep(BROKEN);
            plant.restart_broker();
        }
        Fault::BrokerHangs => mended(plant.broker.as_ref().unwrap()),
        Fault::GatewayHangs => mended(plant.gateway.as_ref().unwrap()),
        Fault::VehicleHangs => mended(&plant.others[round % plant.others.len()]),
        Fault::Paused => {
            plant.instant("startPause", &format!("pause-{round}"));
            plant.wait_for("it is paused", |plant| plant.state()["paused"] == true);
            plant.go_on();
        }
        Fault::Nonsense => {
            for order in &orders {
                publish(plant, order, "order", b"{\"orderId\": 7");
                publish(plant, order, "instantActions", &[b'['; 5_000]);
                publish(plant, order, "order", &write(plant.version(), order));
            }
        }
    }
    plant.wait_within(ROUND, &format!("all have ended behind {fault:?}"), |plant| {
        let has_ended = |state: &Value| {
            state["orderId"] == *id
                && state["lastNodeId"] == last
                && state["driving"] == false
                && state["nodeStates"].as_array().is_some_and(Vec::is_empty)
        };
        all(plant, &has_ended)
    });
    // What a master has heard is not what is measured.
    for messages in plant.heard.lock().unwrap().values_mut() {
        messages.drain(..messages.len().saturating_sub(1));
    }
    for vehicle in plant.others.iter().chain([&plant.vehicle]) {
        vehicle.lines.lock().unwrap().clear();
    }
}

fn order_of(number: u32, id: &str, way: &str) -> Order {
    let mut order = order(id, 0, 0, way);
    order.header.serial_number = format!("{number:04}");
    order
}

fn number_of(order: &Order) -> u32 {
    order.header.serial_number.parse().unwrap()
}

fn publish(plant: &Plant, order: &Order, topic: &str, message: &[u8]) {
    let topic = format!("uagv/v2/KIT/{}/{topic}", order.header.serial_number);
    plant.client.publish(topic, QoS::AtMostOnce, false, message).unwrap();
}

/// The last message of a vehicle.
fn last_of(plant: &Plant, number: u32, topic: &str) -> Value {
    let topic = if number == 1 { topic.to_owned() } else { format!("{number:04}/{topic}") };
    plant.last(&topic).0
}
