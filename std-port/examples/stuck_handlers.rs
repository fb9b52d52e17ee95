//! How late a safe hook runs, and how long an emergency takes, while 64 handlers of a vehicle never return: one of them
//! holds the application's state, and one is that of another emergency service.
//!
//! `cargo run --release --package cara-std --example stuck_handlers [ROUNDS]` prints median, 99th percentile and worst of
//! 1,000 rounds, and the same less what a thread of the same priority was late that only sleeps meanwhile.

use std::error::Error;
use std::sync::mpsc::{Sender, channel};
use std::sync::{Arc, Mutex};
use std::thread::sleep;
use std::time::{Duration, Instant};

use cara_std::{
    CommunicationSystem, Constraints, Interfaces, Parameters, ParametersView, Priority, Renew, RequestOptions, Served,
    ServiceError, ServiceOptions, Unit,
};

const LEASE: Duration = Duration::from_millis(40);
const STUCK: usize = 64;

fn main() -> Result<(), Box<dyn Error>> {
    let rounds = std::env::args().nth(1).map_or(Ok(1_000), |rounds| rounds.parse::<usize>())?;
    let fleet = std::process::id();
    let manager = CommunicationSystem::builder("manager", 1)?.fleet(fleet).interfaces(Interfaces::Loopback);
    let manager = manager.insecure().build()?;
    let vehicle = Unit::builder("agv", 7, "manager", 1)?.fleet(fleet).interfaces(Interfaces::Loopback);
    let vehicle = vehicle.insecure().state(()).build()?;
    vehicle.set_constraints(Constraints { calls_per_peer: 128, ..vehicle.constraints() })?;
    let (hook, hooks) = channel();
    offer(&vehicle, hook)?;
    manager.start()?;
    vehicle.start()?;
    while manager.nodes_offering("go").is_empty() {
        sleep(Duration::from_millis(10));
    }
    let peer = manager.s_unit("agv")?;
    peer.request("stuck_state", &Parameters::new())?;
    peer.request("stuck_emergency", &Parameters::new())?;
    let patient = RequestOptions { timeout: Some(Duration::from_secs(3_600).into()), ..RequestOptions::default() };
    for _ in 0..STUCK - 2 {
        peer.call("stuck", &mut Parameters::new()).with(patient).send()?;
    }
    peer.flush()?;
    sleep(Duration::from_millis(500));
    let canary = Canary::start();
    let (mut emergencies, mut safe) = (Samples::default(), Samples::default());
    for _ in 0..rounds {
        canary.reset();
        let asked = Instant::now();
        peer.block_request("stop", &mut Parameters::new())?;
        emergencies.note(asked.elapsed(), canary.late());
    }
    let once = RequestOptions { renew: Renew::Never, ..RequestOptions::default() };
    for _ in 0..rounds {
        canary.reset();
        let asked = Instant::now();
        peer.call("go", &mut Parameters::new()).with(once).wait()?;
        let ran: Instant = hooks.recv_timeout(Duration::from_secs(10))?;
        safe.note(ran.saturating_duration_since(asked + LEASE), canary.late());
        // The unit reports the end a moment after the hook: before that it takes no new order.
        sleep(Duration::from_millis(5));
    }
    emergencies.show("an emergency is answered after");
    safe.show("a safe hook runs after the end of its lease by");
    // The handlers never return.
    std::process::exit(0);
}

fn offer(vehicle: &Unit<()>, hook: Sender<Instant>) -> Result<(), Box<dyn Error>> {
    let stuck = |_: &Served, _: &mut ParametersView| -> Result<(), ServiceError> {
        loop {
            std::thread::park();
        }
    };
    let stuck_state = |(): &mut (), _: &Served, _: &mut ParametersView| -> Result<(), ServiceError> {
        loop {
            std::thread::park();
        }
    };
    let quick = |_: &Served, _: &mut ParametersView| -> Result<(), ServiceError> { Ok(()) };
    let hook = Mutex::new(hook);
    let safe = move || {
        let _ = hook.lock().map(|hook| hook.send(Instant::now()));
    };
    let list = vehicle.my_function_list();
    let emergency = || ServiceOptions::new().priority(Priority::Emergency);
    list.add_service(&"stuck()".parse()?, ServiceOptions::new(), stuck)?;
    list.add_service(&"stuck_state()".parse()?, ServiceOptions::new(), stuck_state)?;
    list.add_service(&"stuck_emergency()".parse()?, emergency(), stuck)?;
    list.add_service(&"stop()".parse()?, emergency(), quick)?;
    // No thread of the pool is left for it otherwise.
    list.add_service(&"go()".parse()?, emergency().lease(LEASE, safe), quick)?;
    vehicle.publish_my_function_list()?;
    Ok(())
}

/// A thread that sleeps for a millisecond at a time, and how late it woke at worst.
struct Canary(Arc<Mutex<Duration>>);

impl Canary {
    fn start() -> Self {
        let late = Arc::new(Mutex::new(Duration::ZERO));
        let own = late.clone();
        std::thread::spawn(move || {
            loop {
                let began = Instant::now();
                sleep(Duration::from_millis(1));
                let over = began.elapsed().saturating_sub(Duration::from_millis(1));
                if let Ok(mut late) = own.lock() {
                    *late = over.max(*late);
                }
            }
        });
        Self(late)
    }

    fn reset(&self) {
        if let Ok(mut late) = self.0.lock() {
            *late = Duration::ZERO;
        }
    }

    fn late(&self) -> Duration {
        self.0.lock().map_or(Duration::ZERO, |late| *late)
    }
}

#[derive(Default)]
struct Samples {
    plain: Vec<Duration>,
    less_canary: Vec<Duration>,
}

impl Samples {
    fn note(&mut self, took: Duration, canary: Duration) {
        self.plain.push(took);
        self.less_canary.push(took.saturating_sub(canary));
    }

    fn show(mut self, what: &str) {
        println!(
            "{what} {}; less what the canary was late: {}",
            spread(&mut self.plain),
            spread(&mut self.less_canary)
        );
    }
}

fn spread(samples: &mut [Duration]) -> String {
    samples.sort_unstable();
    let at = |part: usize| samples.get((samples.len() * part / 1_000).min(samples.len().saturating_sub(1)));
    let [median, most, worst] = [500, 990, 1_000].map(|part| at(part).copied().unwrap_or_default());
    format!("median {median:.1?}, p99 {most:.1?}, worst {worst:.1?}")
}
