//! A process with many vehicles: the loop of their motors, and a switch for each. It ends when its standard input does.
//!
//! | line of its input | does |
//! |---|---|
//! | `off agv-7`, `on agv-7` | switches the vehicle's unit off, which loses all it knows, and on again |
//! | `fail agv-7` | the vehicle has a fault |
//!
//! Its output is the log of what really happens, which knows no manager: `SECONDS agv-7 enter 3,4`, `leave`, `stop`, `deliver`,
//! `off`, `on`, and each second `sent MESSAGES DATAGRAMS`.

use std::collections::HashSet;
use std::io::{BufRead, ErrorKind, Write};
use std::sync::mpsc::{Receiver, Sender, TryRecvError, channel};
use std::time::{Duration, Instant};

use anyhow::{Context, Result, ensure};
use cara_apps::warehouse::{self, TICK};
use cara_std::{LeaseWatch, Stage, Threads};

use crate::map::{Cell, Map};
use crate::network::{MOST_VEHICLES, Network, vehicle_id, vehicle_name};
use crate::vehicle::{self, Running, Shared};

/// Charges at the start are within so many percent.
const CHARGES: std::ops::Range<f64> = 38.0..100.0;

/// Which vehicles a process has.
#[derive(clap::Args, Clone, Debug)]
pub struct Options {
    #[command(flatten)]
    network: Network,
    #[command(flatten)]
    files: crate::files::MapFiles,
    /// The first of them, from 1.
    #[arg(long, value_parser = clap::value_parser!(u32).range(1..=i64::from(MOST_VEHICLES)))]
    first: u32,
    /// How many.
    #[arg(long, value_parser = clap::value_parser!(u32).range(1..=i64::from(MOST_VEHICLES)))]
    count: u32,
    /// How many there are in all processes.
    #[arg(long, value_parser = clap::value_parser!(u32).range(1..=i64::from(MOST_VEHICLES)))]
    vehicles: u32,
    /// Where they stand at first.
    #[arg(long)]
    seed: u64,
}

struct Slot {
    id: u32,
    vehicle: Shared,
    switch: Switch,
    /// It is to be on.
    wanted: bool,
}

/// Of a vehicle's unit.
enum Switch {
    On(Box<Running>),
    Off(Duration),
    /// It takes a while to come on, or to go off.
    Changing(Duration, Receiver<Option<Box<Running>>>),
}

struct Host {
    slots: Vec<Slot>,
    network: Network,
    threads: Threads,
    stations: HashSet<Cell>,
    /// Of units that were switched off.
    sent_before: [u64; 2],
}

/// Runs until standard input ends.
pub fn run(options: &Options) -> Result<()> {
    let map = options.files.map()?;
    let mut host = Host::new(options, &map)?;
    let (sender, commands) = channel();
    std::thread::spawn(move || hear(&sender));
    let (mut last, mut reported) = (Instant::now(), Instant::now());
    loop {
        match commands.try_recv() {
            Ok(line) => host.command(&line)?,
            Err(TryRecvError::Disconnected) => return Ok(()),
            Err(TryRecvError::Empty) => {
                let late = Instant::now().saturating_duration_since(last);
                std::thread::sleep(TICK.saturating_sub(late));
            }
        }
        let now = Instant::now();
        if now.saturating_duration_since(last) < TICK {
            continue;
        }
        host.turn(now, now.saturating_duration_since(last))?;
        last = now;
        let is_reported = now.saturating_duration_since(reported) >= Duration::from_secs(1);
        host.write(is_reported)?;
        if is_reported {
            reported = now;
        }
    }
}

/// Lines of standard input, until it ends.
fn hear(commands: &Sender<String>) {
    for line in std::io::stdin().lock().lines().map_while(Result::ok) {
        if commands.send(line).is_err() {
            return;
        }
    }
}

impl Host {
    fn new(options: &Options, map: &Map) -> Result<Self> {
        let Options { network, first, count, vehicles, seed, .. } = options;
        let starts = map.starts(*vehicles as usize, *seed);
        let starts = starts.with_context(|| format!("the floor is too small for {vehicles} vehicles"))?;
        ensure!(first + count - 1 <= *vehicles, "vehicles are numbered from 1 to {vehicles}");
        let threads = Threads::new()?;
        let mut rng = fastrand::Rng::with_seed(seed.wrapping_add(u64::from(*first)));
        let mut slots = Vec::new();
        for number in *first..first + count {
            let charge = CHARGES.start + rng.f64() * (CHARGES.end - CHARGES.start);
            let vehicle = Shared::new(vehicle_name(number), starts[number as usize - 1], charge);
            let running = Running::start(&vehicle, vehicle_id(number), network, &threads)?;
            let switch = Switch::On(Box::new(running));
            slots.push(Slot { id: vehicle_id(number), vehicle, switch, wanted: true });
        }
        let stations = map.stations().iter().copied().collect();
        Ok(Self { slots, network: *network, threads, stations, sent_before: [0; 2] })
    }

    fn command(&mut self, line: &str) -> Result<()> {
        let (verb, name) = line.split_once(' ').unwrap_or((line, ""));
        let found = self.slots.iter_mut().find(|slot| slot.vehicle.lock().name == name);
        let slot = found.with_context(|| format!("no vehicle of this process is called `{name}`"))?;
        match (verb, &slot.switch) {
            ("off", _) => slot.wanted = false,
            ("on", _) => slot.wanted = true,
            ("fail", Switch::On(running)) => running.fail(&mut slot.vehicle.lock()),
            _ => {}
        }
        Ok(())
    }

    /// Switches a vehicle's unit on or off, as is wanted, once the last change is over.
    fn switch(&mut self, number: usize, now: Duration) {
        let slot = &mut self.slots[number];
        slot.switch = match (std::mem::replace(&mut slot.switch, Switch::Off(now)), slot.wanted) {
            (Switch::Changing(since, changed), _) => match changed.try_recv() {
                Ok(running) => running.map_or(Switch::Off(since), Switch::On),
                Err(_) => Switch::Changing(since, changed),
            },
            (Switch::On(running), false) => {
                let [messages, datagrams] = running.sent();
                self.sent_before = [self.sent_before[0] + messages, self.sent_before[1] + datagrams];
                slot.vehicle.lock().note(format_args!("off"));
                changing(now, move || {
                    running.stop();
                    None
                })
            }
            (Switch::Off(since), true) => {
                let (vehicle, id) = (slot.vehicle.clone(), slot.id);
                let (network, threads) = (self.network, self.threads.clone());
                changing(since, move || match Running::start(&vehicle, id, &network, &threads) {
                    Ok(running) => {
                        vehicle.lock().note(format_args!("on"));
                        Some(Box::new(running))
                    }
                    // It is tried again.
                    Err(error) => {
                        eprintln!("vehicle {id} does not start: {error:#}");
                        None
                    }
                })
            }
            (switch, _) => switch,
        };
    }

    /// A turn of all motors.
    fn turn(&mut self, now: Instant, elapsed: Duration) -> Result<()> {
        for number in 0..self.slots.len() {
            let clock = vehicle::now();
            self.switch(number, clock);
            let slot = &mut self.slots[number];
            let finished = turn_one(slot, clock, elapsed, &self.stations);
            if let Switch::On(running) = &mut slot.switch {
                finished.into_iter().for_each(|order| running.arrived(&order));
                running.publish(&slot.vehicle, now)?;
            }
        }
        Ok(())
    }

    /// Writes the log.
    fn write(&self, with_sent: bool) -> Result<()> {
        let mut text = String::new();
        for slot in &self.slots {
            for line in std::mem::take(&mut slot.vehicle.lock().log) {
                text.push_str(&line);
                text.push('\n');
            }
        }
        if with_sent {
            let mut sent = self.sent_before;
            for slot in &self.slots {
                if let Switch::On(running) = &slot.switch {
                    let [messages, datagrams] = running.sent();
                    sent = [sent[0] + messages, sent[1] + datagrams];
                }
            }
            text.push_str(&format!("sent {} {}\n", sent[0], sent[1]));
        }
        let mut out = std::io::stdout().lock();
        match out.write_all(text.as_bytes()).and_then(|()| out.flush()) {
            // Its reader has ended, and with it the standard input, which is looked at next.
            Err(error) if error.kind() == ErrorKind::BrokenPipe => Ok(()),
            written => Ok(written?),
        }
    }
}

/// What is changed in a thread of its own, since it takes a while.
fn changing(since: Duration, change: impl FnOnce() -> Option<Box<Running>> + Send + 'static) -> Switch {
    let (sender, changed) = channel();
    std::thread::spawn(move || drop(sender.send(change())));
    Switch::Changing(since, changed)
}

/// A turn of one motor; the order that is done.
fn turn_one(slot: &mut Slot, now: Duration, elapsed: Duration, stations: &HashSet<Cell>) -> Option<LeaseWatch> {
    // Before the look at the order: a service that stops it notes that under this lock, when the order has ended.
    let mut vehicle = slot.vehicle.lock();
    let (stage, off) = match &slot.switch {
        Switch::On(running) => ((running.watch.stage(), running.watch.left().map(Into::into)), None),
        Switch::Off(since) | Switch::Changing(since, _) => ((Stage::Dead, None), Some(*since)),
    };
    let before = vehicle.agv.body.at();
    let warehouse::Vehicle { body, motor, .. } = &mut vehicle.agv;
    let turned = motor.turn(now, elapsed, stage, off, stations.contains(&before), body);
    if turned.arrived {
        vehicle.note(format_args!("leave {before}"));
    }
    if let Some(stop) = turned.stopped {
        vehicle.note(format_args!("{stop}"));
    }
    if turned.arrived { vehicle.agv.order.take() } else { None }
}
