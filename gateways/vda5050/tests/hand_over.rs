//! Two managers with gateways share the records of their vehicles: `cargo xtask test vda5050`.

mod fake;
mod plant;

use std::thread::sleep;
use std::time::Duration;

use cara_std::control::Client;
use cara_std::control::protocol::{Answer, Question};
use plant::{Plant, Process, check_messages, until};

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
    fn start() -> Self {
        let mut plant = Plant::start("{ do = \"finish-base\", seconds = 60.0, metres = 50.0 }");
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

    fn has(&self, which: usize) -> bool {
        let nodes = self.ask(which, &Question::Nodes { offering: None }).unwrap_or_default();
        nodes.iter().any(|answer| matches!(answer, Answer::Node(node) if node.name == "agv-1" && node.connected))
    }

    fn hand_over(&self, from: usize) {
        let question = Question::HandOver { node: "agv-1".into(), to: UNITS[1 - from].to_owned(), timeout_ms: 2_000 };
        until("it leaves", || {
            let answers = self.ask(from, &question).unwrap_or_default();
            answers.iter().any(|answer| matches!(answer, Answer::Called { error: None, .. }))
        });
    }
}

/// An order is under way: paused at standstill, handed over, and gone on with.
#[test]
fn a_vehicle_that_is_handed_over_takes_its_order_along() {
    let mut yard = Yard::start();
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
