//! Whatever happens, one thing after another: nothing runs twice, nothing moves unwanted, and all come back.

use cara_core::services::heart::Renew;
use cara_core::services::session::RequestOptions;
use cara_core::time::Duration;
use cara_sim::Path;

use crate::scenario::scenarios;
use crate::{Fault, Service, Spec, Unit, World, boxed, millis, number, secs};

scenarios![
    whatever_happens_the_fleet_comes_back: "4, 13, 68", Rough,
        [Crash, Partition, Freeze, FreezeLink, Reset, Path, AddressChange, Suspend, ThirdUnit],
        ["power-cut", "process-killed", "restart", "partition", "freeze", "reset", "address-change", "suspend",
         "bandwidth", "LeasesExpired", "RequestsExpired", "ran"];
];

const AGVS: usize = 3;
const STEPS: u64 = 20;
const LEASE: Duration = Duration::from_millis(500);

struct Fleet {
    manager: Unit,
    agvs: Vec<Unit>,
    note: Service,
    drives: Vec<Service>,
    /// The number of the next request: each has its own.
    next: i64,
}

fn fleet(world: &mut dyn World) -> Fleet {
    let note = Service::numbered("note");
    let manager = world.add(Spec::manager("manager", 1));
    let drives: Vec<Service> = (0..AGVS).map(|_| Service::new("drive(n: int[1])").lease(LEASE)).collect();
    let spec = |index: usize| Spec::agv(&format!("agv-{index}"), 10 + index as u32).service(&note);
    let agvs = drives.iter().enumerate().map(|(index, drive)| world.add(spec(index).service(drive))).collect();
    world.wait("all have joined", || manager.nodes_offering("drive").len() == AGVS, secs(40));
    Fleet { manager, agvs, note, drives, next: 0 }
}

fn whatever_happens_the_fleet_comes_back(world: &mut dyn World) {
    let mut fleet = fleet(world);
    for _ in 0..STEPS {
        fleet.ask(world);
        fleet.harm(world);
        let span = millis(world.random(800));
        world.run_for(span);
    }
    fleet.repair(world);
    let Fleet { manager, agvs, note, drives, next } = &fleet;
    world.wait("all are back", || manager.nodes_offering("drive").len() == AGVS, secs(90));
    for (index, agv) in agvs.iter().enumerate() {
        let name = format!("agv-{index}");
        // A link that broke may still stand on one side: then this call ends it, and the next finds the new one.
        let mut asked = world.ask(manager, &name, "note", &mut number("n", next + index as i64));
        if asked.is_err() {
            world.wait("it is back", || manager.knows(&name, "note") && agv.is_connected("manager"), secs(60));
            asked = world.ask(manager, &name, "note", &mut number("n", next + (AGVS + index) as i64));
        }
        assert_eq!(asked, Ok(()), "{}", world.story());
    }
    let mut values = note.log().values();
    values.sort_unstable();
    assert!(values.windows(2).all(|pair| pair[0] < pair[1]), "something ran twice: {values:?}");
    world.reached("ran");
    world.fault(Fault::PowerCut(manager));
    world.run_for(LEASE + millis(1));
    for (agv, drive) in agvs.iter().zip(drives) {
        assert!(!agv.lease_is_live("drive"), "it moves without a manager");
        assert!(drive.log().stops().len() <= drive.log().runs(), "a stop without a start");
    }
}

impl Fleet {
    /// A numbered request to each AGV, asynchronous or not, and the wish that one drives.
    fn ask(&mut self, world: &mut dyn World) {
        let options = RequestOptions { timeout: Some(secs(1)), ..RequestOptions::renewing(Renew::Process) };
        for index in 0..AGVS {
            let (name, parameters) = (format!("agv-{index}"), number("n", self.next));
            self.next += 1;
            match world.random(3) {
                0 => drop(self.manager.begin(&name, "note", &boxed(&parameters), options)),
                1 => drop(self.manager.request_with(&name, "note", &parameters, options)),
                _ => drop(self.manager.request_with(&name, "drive", &parameters, options)),
            }
        }
    }

    fn harm(&self, world: &mut dyn World) {
        let agv = self.agvs[world.random(AGVS as u64) as usize].clone();
        let other = if world.random(4) == 0 { self.manager.clone() } else { agv.clone() };
        let span = millis(world.random(3_000));
        match world.random(12) {
            0 => world.fault(Fault::PowerCut(&other)),
            1 => world.fault(Fault::Kill(&other)),
            2 | 3 => self.restart(world),
            4 => world.fault(Fault::Cut(&self.manager, &agv)),
            5 => world.fault(Fault::CutOneWay(&agv, &self.manager)),
            6 => world.fault(Fault::Heal),
            7 => world.fault(Fault::FreezeStreams(&self.manager, &agv, span)),
            8 => world.fault(Fault::FreezeLink(&agv, &self.manager, span)),
            9 => world.fault(Fault::Reset(&other)),
            10 => world.fault(Fault::Suspend(&other, span)),
            _ => {
                let path = Path::WIFI.loss_percent(world.random(20) as f64).bits_per_second(200_000);
                world.fault(Fault::Path(&self.manager, &agv, path));
                world.fault(Fault::ChangeAddress(&self.agvs[0]));
            }
        }
    }

    /// Without effect on those that run.
    fn restart(&self, world: &mut dyn World) {
        world.fault(Fault::Restart(&self.manager));
        self.agvs.iter().for_each(|agv| world.fault(Fault::Restart(agv)));
    }

    fn repair(&self, world: &mut dyn World) {
        world.fault(Fault::Heal);
        self.restart(world);
        for agv in &self.agvs {
            world.fault(Fault::Path(&self.manager, agv, Path::LAN));
        }
        world.run_for(secs(4));
    }
}
