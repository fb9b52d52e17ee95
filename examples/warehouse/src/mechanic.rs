//! The mechanic: an m_unit that is called to vehicles with a fault. He walks there, mends one after the other, and tells the
//! manager. One that he cannot tell, since the manager is away, he tells when it is back.

use std::collections::VecDeque;
use std::io::Read;
use std::sync::{Arc, Mutex, PoisonError};
use std::time::{Duration, Instant};

use anyhow::Result;
use cara_std::CommunicationSystem;

use crate::network::{MANAGER, MECHANIC, Network};
use cara_apps::warehouse::{FloorClient, Workshop, WorkshopServer};

/// How long he takes for a vehicle.
const MENDING: Duration = Duration::from_secs(4);
/// How often he looks at his list.
const LOOK: Duration = Duration::from_millis(200);

/// Options of the mechanic.
#[derive(clap::Args, Clone, Debug)]
pub struct Options {
    #[command(flatten)]
    network: Network,
}

/// Vehicles that wait for him, with when each is mended.
#[derive(Clone, Default)]
struct Jobs(Arc<Mutex<VecDeque<(String, Instant)>>>);

impl Jobs {
    fn with<R>(&self, act: impl FnOnce(&mut VecDeque<(String, Instant)>) -> R) -> R {
        act(&mut self.0.lock().unwrap_or_else(PoisonError::into_inner))
    }
}

impl Workshop for Jobs {
    fn call_mechanic(&mut self, vehicle: &str, _: u16) -> i64 {
        let now = Instant::now();
        let due = self.with(|jobs| match jobs.iter().find(|(known, _)| known == vehicle) {
            Some((_, due)) => *due,
            None => {
                let begins = jobs.back().map_or(now, |(_, due)| now.max(*due));
                jobs.push_back((vehicle.to_owned(), begins + MENDING));
                begins + MENDING
            }
        });
        println!("called {vehicle}");
        due.saturating_duration_since(now).as_secs() as i64 + 1
    }
}

/// Runs until standard input ends.
pub fn run(options: &Options) -> Result<()> {
    let jobs = Jobs::default();
    let builder = options.network.place(CommunicationSystem::builder(MECHANIC.0, MECHANIC.1)?);
    let unit = builder.state(jobs.clone()).build()?;
    unit.my_function_list().serve(WorkshopServer)?;
    unit.publish_my_function_list()?;
    unit.start()?;
    std::thread::spawn(|| {
        // Whatever comes is not meant for him; only the end counts.
        let _ = std::io::stdin().lock().read_to_end(&mut Vec::new());
        std::process::exit(0);
    });
    loop {
        std::thread::sleep(LOOK);
        let now = Instant::now();
        let Some((vehicle, _)) = jobs.with(|jobs| jobs.front().filter(|(_, due)| *due <= now).cloned()) else {
            continue;
        };
        let reported = unit.m_unit(MANAGER.0).map(|manager| FloorClient::at(&manager).mended(&vehicle).wait());
        if matches!(reported, Ok(Ok(()))) {
            jobs.with(VecDeque::pop_front);
            println!("mended {vehicle}");
        }
    }
}
