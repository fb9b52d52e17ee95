//! Two managers with gateways share the records of their vehicles: `cargo xtask test vda5050`.

mod fake;
mod plant;

use std::collections::{BTreeMap, BTreeSet};
use std::sync::atomic::{AtomicBool, AtomicUsize, Ordering};
use std::thread::sleep;
use std::time::{Duration, Instant};

use cara_std::control::Client;
use cara_std::control::protocol::{Answer, Question};
use cara_vda5050::message::Order;
use plant::{Messages, Plant, Process, check_messages, until};
use rumqttc::QoS;
use rustix::process::Signal;
use serde_json::Value;

/// What is killed, and when.
#[derive(Clone, Copy, Debug, PartialEq)]
enum Kill {
    Nothing,
    /// Before the vehicle is asked to go: a source that is started again hands it over.
    SourceBefore,
    /// Once the vehicle has agreed.
    Source,
    /// Once the vehicle has agreed.
    Target,
    /// Once it speaks for the vehicle.
    TargetLater,
}

const UNITS: [&str; 2] = ["vda5050/1", "yard/2"];

struct Yard {
    plant: Plant,
    gateways: [Option<Process>; 2],
}

impl Yard {
    fn start(vehicles: u32) -> Self {
        let finish = "{ do = \"finish-base\", seconds = 60.0, metres = 50.0 }";
        let mut plant = Plant::of(vehicles, finish, "2.1.0", |_| Default::default());
        // The first one goes on with its records, which both share from now on.
        plant.kill_gateway();
        let text = std::fs::read_to_string(plant.file()).unwrap();
        let folder = "state_folder = \"state\"";
        let (name, metrics) = ("name = \"vda5050\"\nid = 1\n", format!("metrics = \"127.0.0.1:{}\"", plant.metrics));
        assert!([folder, name, &metrics].iter().all(|part| text.contains(part)));
        let shared = |own: &str| format!("state_folder = \"{own}\"\nshared_records = \"state/vda5050\"");
        std::fs::write(plant.file(), text.replace(folder, &shared("state"))).unwrap();
        let text = text.replace(folder, &shared("state-2")).replace(name, "name = \"yard\"\nid = 2\n");
        std::fs::write(plant.folder.path().join("yard.toml"), text.replace(&metrics, "")).unwrap();
        let mut yard = Self { plant, gateways: [None, None] };
        (0..2).for_each(|which| yard.restart(which));
        yard
    }

    fn restart(&mut self, which: usize) {
        let file = ["vda5050.toml", "yard.toml"][which];
        self.gateways[which] = Some(self.plant.gateway_of(&self.plant.folder.path().join(file)));
    }

    fn kill(&mut self, which: usize) {
        self.gateways[which].take().unwrap().kill();
    }

    fn ask(&self, which: usize, question: &Question) -> Option<Vec<Answer>> {
        let folder = self.plant.folder.path().join("cara");
        let mut client = Client::find_in(&folder, Some(UNITS[which])).ok()?;
        client.ask(question).ok()?.collect::<Result<_, _>>().ok()
    }

    /// Numbers of the vehicles that are linked to it.
    fn linked(&self, which: usize) -> BTreeSet<u32> {
        let nodes = self.ask(which, &Question::Nodes { offering: None }).unwrap_or_default();
        let linked = nodes.iter().filter_map(|answer| match answer {
            Answer::Node(node) if node.connected => node.name.strip_prefix("agv-")?.parse().ok(),
            _ => None,
        });
        linked.collect()
    }

    fn has(&self, which: usize) -> bool {
        self.linked(which).contains(&1)
    }

    /// Whether the vehicle has agreed to go.
    fn sends(&self, from: usize, number: u32) -> bool {
        let (node, to) = (format!("agv-{number}"), UNITS[1 - from].to_owned());
        let answers = self.ask(from, &Question::HandOver { node, to, timeout_ms: 2_000 }).unwrap_or_default();
        answers.iter().any(|answer| matches!(answer, Answer::Called { error: None, .. }))
    }

    fn hand_over(&self, from: usize) {
        until("it leaves", || self.sends(from, 1));
    }
}

/// An order is under way: paused at standstill, handed over, and gone on with.
#[test]
fn a_vehicle_that_is_handed_over_takes_its_order_along() {
    let mut yard = Yard::start(1);
    let kills = [Kill::Nothing, Kill::SourceBefore, Kill::Source, Kill::Target, Kill::TargetLater];
    for (round, kill) in kills.into_iter().enumerate() {
        println!("{kill:?}");
        let (from, to) = (round % 2, 1 - round % 2);
        until("it is at the source", || yard.has(from));
        yard.plant.wait_for("ONLINE", |plant| plant.connection() == "ONLINE");
        let ways = ["a!:beep=HARD b! c! d! e!:beep=HARD f", "e!:beep=HARD d! c! b! a!:beep=HARD f"];
        let (id, way) = (format!("o{round}"), ways[from]);
        yard.plant.order(&id, 0, 0, way);
        let is_driving = |plant: &Plant| plant.state()["orderId"] == *id && plant.state()["driving"] == true;
        yard.plant.wait_for("it drives", is_driving);
        let (pause, drives) = (format!("pause-{round}"), yard.plant.count("drive "));
        yard.plant.instant("startPause", &pause);
        yard.plant.wait_for("it stands", |plant| plant.action(&pause) == "FINISHED" && !is_driving(plant));
        if kill == Kill::SourceBefore {
            yard.kill(from);
            yard.restart(from);
        }
        yard.hand_over(from);
        match kill {
            Kill::Source => yard.kill(from),
            Kill::Target => {
                yard.kill(to);
                yard.restart(to);
            }
            _ => {}
        }
        until("it is at the target", || yard.has(to));
        if kill == Kill::TargetLater {
            yard.plant.wait_for("the target speaks", |plant| plant.connection() == "ONLINE");
            yard.kill(to);
            yard.restart(to);
        }
        if kill == Kill::Source {
            yard.restart(from);
        }
        // Paused, as it was: nobody else has let it go on.
        yard.plant.wait_for("the target speaks", |plant| plant.connection() == "ONLINE");
        assert_eq!(yard.plant.count("drive "), drives, "{:?}", yard.plant.vehicle.lines());
        // What comes while no gateway speaks for it is lost: a master says it again.
        let mut tries = 0;
        until("it goes on", || {
            yard.plant.instant("stopPause", &format!("go-on-{round}-{tries}"));
            tries += 1;
            sleep(Duration::from_millis(500));
            yard.plant.state()["paused"] == false
        });
        let last = ["e", "a"][from];
        yard.plant.wait_for("it is at its last released node", |plant| {
            let state = plant.state();
            state["orderId"] == *id && state["lastNodeId"] == last && state["driving"] == false
        });
        let actions = ["a0n", "e8n", "e0n", "a8n"].map(|place| format!("{id}-{place}-beep"));
        for action in &actions[2 * from..][..2] {
            yard.plant.wait_for("it has beeped", |plant| plant.action(action) == "FINISHED");
            let lines = yard.plant.vehicle.lines();
            let begun = lines.iter().filter(|line| line.starts_with("act ") && line.ends_with(action.as_str()));
            assert_eq!(begun.count(), 1, "{action}: {lines:?}");
        }
        assert!(!yard.has(from), "both have it");
        yard.plant.instant("cancelOrder", &format!("cancel-{round}"));
        yard.plant
            .wait_for("its horizon is gone", |plant| plant.state()["nodeStates"].as_array().is_some_and(Vec::is_empty));
    }
    check_messages(&yard.plant);
}

/// Steps of a hand-over, at which a gateway is killed.
const STEPS: [Step; 5] = [Step::Driving, Step::Paused, Step::Leaving, Step::Arrived, Step::GoesOn];

#[derive(Clone, Copy, Debug, PartialEq)]
enum Step {
    /// Before the vehicles are paused.
    Driving,
    /// Before they are handed over.
    Paused,
    /// Half of them have left.
    Leaving,
    /// All are at the target, and paused.
    Arrived,
    /// They drive there.
    GoesOn,
}

/// Orders lead there and back, with actions for which the vehicle stands about half of the time.
const WAYS: [&str; 2] = [
    "a! b!:beep=HARD,pick=HARD c!:beep=HARD d!:beep=HARD,pick=HARD e!:beep=HARD f!:beep=HARD,pick=HARD",
    "f! e!:beep=HARD,pick=HARD d!:beep=HARD c!:beep=HARD,pick=HARD b!:beep=HARD a!:beep=HARD,pick=HARD",
];

/// What a master says again, it says after so long.
const SAID_AGAIN: Duration = Duration::from_secs(1);

/// A master that gives each vehicle one order after another, and an order again that a vehicle does not show.
struct Master {
    heard: Messages,
    client: rumqttc::Client,
    /// No new orders.
    is_over: AtomicBool,
}

impl Master {
    /// What is seen in the last message of a topic.
    fn sees<T>(&self, number: u32, topic: &str, look: impl FnOnce(&Value) -> T) -> T {
        let heard = self.heard.lock().unwrap();
        let last = heard.get(&key(number, topic)).and_then(|messages| messages.last());
        look(last.map_or(&Value::Null, |(message, _)| message))
    }

    fn send(&self, number: u32, topic: &str, message: &impl serde::Serialize) {
        let message = serde_json::to_vec(message).unwrap();
        self.client.publish(format!("uagv/v2/KIT/{number:04}/{topic}"), QoS::AtMostOnce, false, message).unwrap();
    }

    /// Until it is over and the last orders have ended: how many each vehicle was given.
    fn drive(&self, vehicles: u32) -> BTreeMap<u32, usize> {
        let mut given: BTreeMap<u32, (usize, Instant)> =
            (1..=vehicles).map(|number| (number, (0, Instant::now()))).collect();
        let (mut busy, mut given_last) = (true, Instant::now());
        while busy {
            busy = false;
            if !self.is_over.load(Ordering::SeqCst) {
                given_last = Instant::now();
            }
            let patience = plant::PATIENCE + Duration::from_secs(vehicles.into());
            assert!(given_last.elapsed() < patience, "the last orders do not end");
            for (number, (count, said)) in &mut given {
                let look = |state: &Value| (has_ended(state, *count), state["orderId"] != order_id(*count));
                let (has_ended, is_unknown) = self.sees(*number, "state", look);
                let has_ended = has_ended || *count == 0;
                let is_due = match has_ended {
                    true if self.is_over.load(Ordering::SeqCst) => continue,
                    true => true,
                    false => is_unknown && said.elapsed() > SAID_AGAIN,
                };
                busy = true;
                if is_due {
                    (*count, *said) = (*count + usize::from(has_ended), Instant::now());
                    self.send(*number, "order", &order(*number, *count));
                }
            }
            sleep(Duration::from_millis(50));
        }
        given.into_iter().map(|(number, (count, _))| (number, count)).collect()
    }

    /// Has these vehicles do something, and says it again to those that do not: what comes while no gateway speaks for one is lost.
    fn instant(&self, numbers: &[u32], kind: &str, is_so: impl Fn(&Value) -> bool) {
        static SAID: AtomicUsize = AtomicUsize::new(0);
        let mut due = Instant::now();
        patiently(kind, numbers.len(), || {
            let left: Vec<_> = numbers.iter().filter(|number| !self.sees(**number, "state", &is_so)).collect();
            if !left.is_empty() && Instant::now() >= due {
                due = Instant::now() + SAID_AGAIN;
                let mut message = fake::instant(kind, &format!("{kind}-{}", SAID.fetch_add(1, Ordering::SeqCst)));
                for number in &left {
                    message.header.serial_number = format!("{number:04}");
                    self.send(**number, "instantActions", &message);
                }
            }
            left.is_empty()
        });
    }
}

/// Waits the longer the more there are.
fn patiently(what: &str, vehicles: usize, mut is_so: impl FnMut() -> bool) {
    let end = Instant::now() + plant::PATIENCE + Duration::from_secs(vehicles as u64);
    while !is_so() {
        assert!(Instant::now() < end, "it takes too long: {what}");
        sleep(Duration::from_millis(20));
    }
}

/// Under which a topic of a vehicle was heard.
fn key(number: u32, topic: &str) -> String {
    if number == 1 { topic.to_owned() } else { format!("{number:04}/{topic}") }
}

fn order_id(count: usize) -> String {
    format!("o{count}")
}

fn order(number: u32, count: usize) -> Order {
    let mut order = fake::order(&order_id(count), 0, 0, WAYS[(count + 1) % 2]);
    order.header.serial_number = format!("{number:04}");
    order
}

fn is_online(connection: &Value) -> bool {
    connection["connectionState"] == "ONLINE"
}

fn has_ended(state: &Value, count: usize) -> bool {
    let all = |list: &str, is_so: fn(&Value) -> bool| state[list].as_array().is_some_and(|list| list.iter().all(is_so));
    let has_ended = |action: &Value| action["actionStatus"] == "FINISHED" || action["actionStatus"] == "FAILED";
    state["orderId"] == order_id(count)
        && state["driving"] == false
        && all("nodeStates", |_| false)
        && all("actionStates", has_ended)
}

impl Yard {
    /// Hands them over as an operator does, who asks again for those that have not arrived.
    fn move_all(&self, from: usize, numbers: &[u32]) {
        patiently("all have arrived", numbers.len(), || {
            let (here, there) = (self.linked(from), self.linked(1 - from));
            let left = numbers.iter().filter(|number| here.contains(number) && !there.contains(number));
            left.for_each(|number| {
                self.sends(from, *number);
            });
            numbers.iter().all(|number| there.contains(number))
        });
    }

    /// Kills a gateway, and starts it again.
    fn strike(&mut self, which: usize) {
        self.kill(which);
        self.restart(which);
    }

    /// Kills a gateway when one of its vehicles has just begun an action.
    fn strike_while_one_acts(&mut self, which: usize) {
        let linked = self.linked(which);
        let acts = |number: &u32| self.lines(*number).last().is_some_and(|line| line.starts_with("act "));
        until("one acts", || linked.iter().any(acts));
        self.strike(which);
    }

    /// Kills a gateway when half of them have left.
    fn strike_while_they_leave(&mut self, from: usize, numbers: &[u32], which: usize) {
        let gone = AtomicUsize::new(0);
        std::thread::scope(|scope| {
            scope.spawn(|| {
                for number in numbers {
                    self.sends(from, *number);
                    gone.fetch_add(1, Ordering::SeqCst);
                }
            });
            until("half have left", || gone.load(Ordering::SeqCst) >= numbers.len() / 2);
            self.gateways[which].as_ref().unwrap().signal(Signal::KILL);
        });
        self.strike(which);
    }

    /// Moves vehicles that drive, and kills a gateway at a step. How long they stood.
    fn moves(&mut self, master: &Master, from: usize, numbers: &[u32], (step, which): (Step, usize)) -> Duration {
        let is_paused = |state: &Value| state["paused"] == true && state["driving"] == false;
        if step == Step::Driving {
            self.strike_while_one_acts(which);
        }
        let began = Instant::now();
        master.instant(numbers, "startPause", is_paused);
        if step == Step::Paused {
            self.strike(which);
        }
        if step == Step::Leaving {
            self.strike_while_they_leave(from, numbers, which);
        }
        self.move_all(from, numbers);
        if step == Step::Arrived {
            self.strike(which);
        }
        master.instant(numbers, "stopPause", |state| state["paused"] == false);
        let stood = began.elapsed();
        if step == Step::GoesOn {
            self.strike_while_one_acts(which);
        }
        patiently("all are ONLINE at the target", numbers.len(), || {
            let (here, there) = (self.linked(from), self.linked(1 - from));
            numbers.iter().all(|number| {
                let has_said = master.sees(*number, "connection", is_online);
                has_said && there.contains(number) && !here.contains(number)
            })
        });
        stood
    }

    /// The vehicle's own log.
    fn lines(&self, number: u32) -> Vec<String> {
        let prefix = format!("agv-{number} ");
        match (number, &self.plant.others[..]) {
            (1, _) => self.plant.vehicle.lines(),
            (_, [all]) => all.lines().iter().filter_map(|line| line.strip_prefix(&prefix)).map(str::to_owned).collect(),
            (_, others) => others[number as usize - 2].lines(),
        }
    }

    /// What a vehicle did: names of nodes as it drove to them, and ids of actions as they began.
    fn done(&self, number: u32) -> [Vec<String>; 2] {
        let lines = self.lines(number);
        ["drive ", "act "].map(|verb| {
            let lines = lines.iter().filter_map(|line| line.strip_prefix(verb));
            lines.filter_map(|line| line.split_once(' ')).map(|(_, what)| what.to_owned()).collect()
        })
    }
}

/// A master has heard of each order, one after the other, and no node or action came back.
fn check_states(heard: &Messages, number: u32, orders: usize) {
    let heard = heard.lock().unwrap();
    let mut last = (0, usize::MAX);
    let mut seen = BTreeSet::new();
    for (state, _) in &heard[&key(number, "state")] {
        let id = state["orderId"].as_str().unwrap();
        let count = id.strip_prefix('o').map_or(0, |count| count.parse::<usize>().unwrap());
        let left = state["nodeStates"].as_array().unwrap().len();
        assert!(count > last.0 || (count == last.0 && left <= last.1), "agv-{number}: {left} of {id} after {last:?}");
        last = (count, left);
        seen.insert(count);
    }
    let missing: Vec<usize> = (1..=orders).filter(|count| !seen.contains(count)).collect();
    assert!(missing.is_empty() && last == (orders, 0), "agv-{number}: {missing:?}, {last:?} of {orders}");
}

/// 6 vehicles, of which 2 move at a time, or as many as `CARA_TEST_VEHICLES` and `CARA_TEST_HAND_OVERS` say. All have orders all the
/// time, half of them at each gateway, of which one is killed at each step.
#[test]
#[ignore = "takes long"]
fn nothing_is_lost_or_done_twice_whatever_is_killed_at_a_hand_over() {
    let size = |name, default| std::env::var(name).ok().and_then(|text| text.parse().ok()).unwrap_or(default);
    let (vehicles, at_a_time): (u32, usize) = (size("CARA_TEST_VEHICLES", 6), size("CARA_TEST_HAND_OVERS", 2) as usize);
    let mut yard = Yard::start(vehicles);
    let master =
        Master { heard: yard.plant.heard.clone(), client: yard.plant.client.clone(), is_over: AtomicBool::new(false) };
    let all: BTreeSet<u32> = (1..=vehicles).collect();
    patiently("all are there", all.len(), || yard.linked(0) == all);
    let began = Instant::now();
    yard.move_all(0, &all.iter().copied().filter(|number| number % 2 == 0).collect::<Vec<_>>());
    println!("half of {vehicles} vehicles are at the other gateway after {:?}", began.elapsed());
    let began = Instant::now();
    let mut moves: BTreeMap<u32, usize> = all.iter().map(|number| (*number, 0)).collect();
    let given = std::thread::scope(|scope| {
        let driving = scope.spawn(|| master.drive(vehicles));
        // Also where a step fails, so that the thread ends.
        let _over = Over(&master.is_over);
        for (round, step) in STEPS.into_iter().flat_map(|step| [step; 2]).enumerate() {
            // Source and target take turns in being the one that is killed.
            let (from, which) = (round % 2, round / 2 % 2);
            let mut numbers: Vec<u32> = yard.linked(from).into_iter().collect();
            numbers.sort_by_key(|number| moves[number]);
            numbers.truncate(at_a_time);
            assert_eq!(numbers.len(), at_a_time, "linked to {}", UNITS[from]);
            let killed = if which == from { "source" } else { "target" };
            let stood = yard.moves(&master, from, &numbers, (step, which));
            println!("{step:?}, {killed} killed: {numbers:?} stood for {stood:?}");
            numbers.iter().for_each(|number| *moves.get_mut(number).unwrap() += 1);
        }
        master.is_over.store(true, Ordering::SeqCst);
        driving.join().unwrap()
    });
    let took = began.elapsed();
    let (here, there) = (yard.linked(0), yard.linked(1));
    assert!(here.is_disjoint(&there) && &here | &there == all, "{here:?} {there:?}");
    for (number, count) in &given {
        let orders: Vec<Order> = (1..=*count).map(|count| order(*number, count)).collect();
        let nodes: Vec<_> =
            orders.iter().flat_map(|order| order.nodes[1..].iter().map(|node| node.node_id.clone())).collect();
        let actions = orders.iter().flat_map(|order| order.nodes.iter().flat_map(|node| &node.actions));
        let actions: Vec<_> = actions.map(|action| action.action_id.clone()).collect();
        assert_eq!(yard.done(*number), [nodes, actions], "agv-{number}, edges and actions");
        check_states(&master.heard, *number, *count);
        assert!(master.sees(*number, "connection", is_online), "agv-{number}");
    }
    check_messages(&yard.plant);
    let (orders, moves): (usize, usize) = (given.values().sum(), moves.values().sum());
    let ended = |line: &String| line.starts_with("ended ") && line.ends_with(" FAILED");
    let failed: usize = all.iter().map(|number| yard.lines(*number).iter().filter(|line| ended(line)).count()).sum();
    println!("{vehicles} vehicles, {moves} hand-overs, {orders} orders within {took:?}, {failed} actions cut off");
}

/// Sets it when it is dropped.
struct Over<'o>(&'o AtomicBool);

impl Drop for Over<'_> {
    fn drop(&mut self) {
        self.0.store(true, Ordering::SeqCst);
    }
}
