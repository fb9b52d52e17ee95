//! A manager on tokio: its vehicles join, it hears events as a stream, calls all vehicles at once, drives each in a task of
//! its own, which follows the positions that the vehicle publishes, and releases them. The runtime has one thread, which
//! nothing here blocks.

use std::time::Duration;

use anyhow::Result;
use cara_examples::{Network, Stop, log_to_stderr, say};
use cara_std::{CommunicationSystem, Error, EventStream, Parameters, Peer, UnitEvent};
use clap::Parser;

/// Each vehicle drives for so many of its positions, so far apart.
const LOOKS: u32 = 10;
const LOOK_EVERY: Duration = Duration::from_millis(100);
/// A vehicle that tells no position for so long stops.
const HEART: Duration = Duration::from_millis(200);
/// Longest wait for a vehicle to tell that it has stopped.
const PATIENCE: Duration = Duration::from_secs(5);

/// A manager that drives its vehicles side by side.
#[derive(Parser)]
struct Options {
    #[arg(long, default_value = "AGV_manager")]
    name: String,
    #[arg(long, default_value_t = 1)]
    id: u32,
    /// The vehicles to wait for.
    #[arg(long = "agv", value_name = "NAME", default_values = ["agv-1", "agv-2"])]
    agvs: Vec<String>,
    #[command(flatten)]
    network: Network,
}

fn main() -> Result<()> {
    let options = Options::parse();
    log_to_stderr();
    let stop = Stop::new(options.network.attended)?;
    let stopper = stop.stopper();
    let runtime = tokio::runtime::Builder::new_current_thread().enable_time().build()?;
    std::thread::spawn(move || stopper.stop(runtime.block_on(manage(options))));
    stop.wait()
}

async fn manage(options: Options) -> Result<()> {
    let manager = options.network.place(CommunicationSystem::builder(&options.name, options.id)?).build()?;
    let events = tokio::spawn(show(manager.events_async()));
    manager.start_async().await?;
    let mut agvs = Vec::new();
    for name in &options.agvs {
        let agv = manager.wait_for_s_unit_async(name).await?;
        for wanted in ["go_to", "pose"] {
            agv.wait_for_function_async(wanted).await?;
        }
        say!("{agv:?} is there, {} us away", agv.ping_async(PATIENCE).await?.as_micros());
        agvs.push(agv);
    }
    // One call to each, all at the same time.
    for (agv, outcome) in manager.call_all("pos_info", &position([0, 0])?).await {
        match outcome.map_err(Error::from).and_then(|at| at.variable::<[i64; 2]>("position")) {
            Ok(at) => say!("{agv:?} is at {at:?}"),
            Err(error) => say!("{agv:?}: {error}"),
        }
    }
    let drives: Vec<_> = agvs.into_iter().map(|agv| tokio::spawn(drive(manager.clone(), agv))).collect();
    for drive in drives {
        drive.await??;
    }
    manager.stop_async().await?;
    // The stream ends with the unit.
    events.await?;
    say!("ended");
    Ok(())
}

/// Sends one vehicle far away and follows it for a while. Were this task dropped, the vehicle would stop.
async fn drive(manager: CommunicationSystem, agv: Peer) -> Result<()> {
    let mut heart = manager.heart(HEART);
    heart.beat();
    let order = agv.call("go_to", &mut position([50, 0])?).renewing(heart.renew()).hold().await?;
    say!("{agv:?} drives");
    let mut pose = agv.stream("pose")?.subscribe_async(LOOK_EVERY);
    for _ in 0..LOOKS {
        let Some(sample) = pose.next().await else { break };
        heart.beat();
        let [x, y]: [f64; 2] = sample?.value("position")?;
        say!("{agv:?} is at {x:.2}, {y:.2}");
    }
    let end = order.hold.release_async(PATIENCE).await?;
    say!("{agv:?} stands, its order is over: {}", end.word());
    Ok(())
}

async fn show(mut events: EventStream) {
    while let Some(event) = events.next().await {
        match event {
            Ok(UnitEvent::Joined { peer }) => say!("joined {peer}"),
            Ok(UnitEvent::Left { peer, reason }) => say!("left {peer}: {reason}"),
            Ok(_) => {}
            Err(lost) => say!("{lost}"),
        }
    }
}

fn position(at: [i64; 2]) -> Result<Parameters> {
    let mut position = Parameters::new();
    position.add_int("position", 2)?;
    position.set_value("position", at)?;
    Ok(position)
}
