//! The headless run: it starts all processes, breaks things, checks what really happened, and reports.

mod board;
mod child;
mod report;
pub mod soak;
mod stage;
pub mod truth;

use std::collections::{HashMap, HashSet};
use std::path::PathBuf;
use std::process::ExitCode;
use std::time::{Duration, Instant};

use anyhow::{Result, ensure};

use crate::faults::{Fault, PART, schedule};
use crate::files::{MapFiles, read};
use crate::map::Map;
use crate::network::{MOST_VEHICLES, vehicle_name};
use crate::orders::{self, Order};
use board::{Board, BoardOptions};
use report::Tally;
use soak::Samples;
use stage::{Heard, Stage};
use truth::Truth;

/// Of a run without minutes.
const SHORT: Duration = Duration::from_secs(45);
const SHORT_VEHICLES: u32 = 14;
/// Vehicles up to which the small floor is used, unless a map is named.
const SMALL: u32 = 40;
/// A stopped vehicle goes on after this.
const STOPPED: Duration = Duration::from_secs(2);
/// A vehicle is off for so long.
const OFF: Duration = Duration::from_secs(3);
/// A vehicle that was switched off so shortly before, or just on again, need not acknowledge a stop of all.
const HARDLY_ON: Duration = Duration::from_secs(5);
/// The manager hangs for so long: leases end, and links do not.
const FROZEN: Duration = Duration::from_millis(1_200);
/// The manager is away for so long.
const AWAY: Duration = Duration::from_millis(1_500);
/// Links are cut for so long, and have so long to come back before anything else is broken.
const CUT: Duration = Duration::from_secs(12);
const BACK: Duration = Duration::from_secs(12);
/// It is told so again until it does.
const REPORTED_AGAIN: Duration = Duration::from_secs(3);
/// A fault that cannot happen now is tried again.
const AGAIN: Duration = Duration::from_millis(300);
/// Drawn orders come within this part of a run, so that the last ones are done at about its end. In a soak they come as long as
/// faults do, which need vehicles that move.
const RELEASED: f64 = 0.75;
/// How often the orders are counted.
const PROGRESS: Duration = Duration::from_secs(10);
/// How long the vehicles may take to join, at first.
const JOINING: Duration = Duration::from_secs(60);
/// How long the last orders may take when nothing is broken any more.
const FINISHING: Duration = Duration::from_secs(240);

/// Options of a run.
#[derive(clap::Args, Clone, Debug)]
pub struct Options {
    /// How many vehicles; 14 unless given.
    #[arg(long, default_value_t = SHORT_VEHICLES, value_parser = clap::value_parser!(u32).range(1..=i64::from(MOST_VEHICLES)))]
    vehicles: u32,
    /// New orders come for so many minutes, and things are broken; without it, those of the file are done in about 70 s.
    #[arg(long, value_parser = clap::value_parser!(u32).range(1..=1_440))]
    minutes: Option<u32>,
    /// Starts, charges, drawn orders and faults are the same for a seed; what time does is not.
    #[arg(long, default_value_t = 1)]
    seed: u64,
    /// Two managers stand by for each other: where one is killed the other commands.
    #[arg(long)]
    standby: bool,
    /// For `cargo xtask soak`: also writes what each process holds here, cuts links, and runs `cara web`.
    #[arg(long, value_name = "FILE", requires = "minutes")]
    soak: Option<PathBuf>,
    /// Breaks nothing.
    #[arg(long, conflicts_with = "soak")]
    no_faults: bool,
    /// The floor, in the `.map` format of the MovingAI benchmarks; with `--stations`.
    #[arg(long, value_name = "FILE", requires = "stations")]
    map: Option<PathBuf>,
    /// Charging stations, a cell a line.
    #[arg(long, value_name = "FILE", requires = "map")]
    stations: Option<PathBuf>,
    /// Orders, one a line: `3,4 20,7`.
    #[arg(long, value_name = "FILE")]
    orders: Option<PathBuf>,
    #[command(flatten)]
    board: BoardOptions,
}

/// What is to happen at a time.
#[derive(Clone, Debug)]
enum Due {
    Break(Fault),
    /// A vehicle that was stopped goes on, or all that were.
    GoOn(Option<String>),
    SwitchOn(String),
    ThawManager,
    StartManager,
    /// Links are whole again.
    Heal,
    /// Those that were cut have had time to come back.
    Back,
}

/// Runs; success only if all was as it has to be.
pub fn run(options: &Options) -> Result<ExitCode> {
    let files = files(options);
    let map = files.map()?;
    let starts = map.starts(options.vehicles as usize, options.seed);
    ensure!(
        starts.is_some(),
        "{} is too small for {} vehicles: they need half as many free cells beside their own",
        files.map.display(),
        options.vehicles
    );
    let place = starts.and_then(|starts| starts.last().copied());
    let board = place.and_then(|at| Board::of(&options.board, options.vehicles, at));
    let board_name = board.as_ref().map(|board| vehicle_name(board.number));
    let span = options.minutes.map_or(SHORT, |minutes| Duration::from_secs(60 * u64::from(minutes)));
    let orders = take_orders(options, &files, &map, span)?;
    let mut run = Run {
        stage: Stage::new(files, &orders, options.vehicles, board, options.standby, options.seed)?,
        truth: Truth::new(&map, &orders),
        tally: Tally { orders: orders.len(), ..Tally::default() },
        due: Vec::new(),
        rng: fastrand::Rng::with_seed(options.seed),
        commanding: false,
        old_manager: None,
        killed: None,
        stopping_all: false,
        off: HashMap::new(),
        hardly_on: 0,
        is_alone: false,
        frozen: false,
        looked: Instant::now(),
        progress: Instant::now(),
        stopped: HashSet::new(),
        samples: options.soak.as_deref().map(|file| soak::may_cut().and_then(|()| Samples::open(file))).transpose()?,
        cut: false,
    };
    run.stage.show(&format!("{} vehicles, {} orders, seed {}", options.vehicles, orders.len(), options.seed));
    let finished = run.play(span, options);
    if let Err(error) = finished {
        run.tally.wrong.push(format!("{error:#}"));
        run.ask_why()?;
    }
    run.end();
    let Run { tally, mut truth, .. } = run;
    truth.finish();
    let passed = report::print(&tally, &truth, board_name.as_deref(), !options.no_faults, options.standby);
    Ok(if passed { ExitCode::SUCCESS } else { ExitCode::FAILURE })
}

fn files(options: &Options) -> MapFiles {
    let floor = if options.vehicles <= SMALL { "small" } else { "hall" };
    let own = |ending: &str| PathBuf::from(env!("CARGO_MANIFEST_DIR")).join(format!("maps/{floor}.{ending}"));
    MapFiles {
        map: options.map.clone().unwrap_or_else(|| own("map")),
        stations: options.stations.clone().unwrap_or_else(|| own("stations")),
    }
}

/// Of a file, or drawn for a run of some minutes: so many that the vehicles are busy half of the time, and half as many in a soak, in
/// which they are off, stopped or waiting for others besides.
fn take_orders(options: &Options, files: &MapFiles, map: &Map, span: Duration) -> Result<Vec<Order>> {
    let own = files.map.with_extension("orders");
    let file = match (&options.orders, options.minutes) {
        (Some(file), _) => Some(file),
        (None, None) if own.exists() => Some(&own),
        (None, _) => None,
    };
    if let Some(file) = file {
        return Ok(orders::parse(&file.to_string_lossy(), &read(file)?, map)?);
    }
    // Two legs, each of a third of the sides on average, a second a cell.
    let seconds_each = 2.0 * f64::from(map.width() + map.height()) / 3.0;
    let (share, part) = if options.soak.is_some() { (0.28, PART.end) } else { (0.5, RELEASED) };
    let count = span.as_secs_f64() / seconds_each * f64::from(options.vehicles) * share;
    let released = span.mul_f64(part);
    Ok(orders::draw(map, (count as usize).max(1), released, &mut fastrand::Rng::with_seed(options.seed)))
}

struct Run<'m> {
    stage: Stage,
    truth: Truth<'m>,
    tally: Tally,
    /// What is to happen, since the start.
    due: Vec<(Duration, Due)>,
    rng: fastrand::Rng,
    /// The manager knows where all vehicles are.
    commanding: bool,
    /// The manager that another one takes over from.
    old_manager: Option<usize>,
    /// When the manager was killed, until a vehicle drives for its standby.
    killed: Option<Instant>,
    /// All are told to stop, and the manager has not said how many have.
    stopping_all: bool,
    /// When vehicles were last switched off.
    off: HashMap<String, Instant>,
    /// Of the vehicles that have not acknowledged the stop of all, those that were hardly on.
    hardly_on: usize,
    /// Nobody stands by, since one was killed and is not started again yet.
    is_alone: bool,
    /// It hangs.
    frozen: bool,
    looked: Instant,
    progress: Instant,
    /// Vehicles that were stopped, until they are let go on.
    stopped: HashSet<String>,
    samples: Option<Samples>,
    /// Links are cut, or just come back.
    cut: bool,
}

impl Run<'_> {
    /// Everything up to the last order.
    fn play(&mut self, span: Duration, options: &Options) -> Result<()> {
        self.stage.start_all()?;
        let began = Instant::now();
        while !self.commanding {
            ensure!(began.elapsed() < JOINING, "the vehicles have not joined within {JOINING:?}");
            self.hear()?;
        }
        self.stage.show(&format!("all vehicles have joined after {:.1} s", began.elapsed().as_secs_f64()));
        // On one host the first has the control socket, for the page.
        if options.standby {
            self.stage.start_standby()?;
        }
        if self.samples.is_some() {
            self.stage.start_page()?;
        }
        let start = Instant::now();
        if !options.no_faults {
            self.due = schedule(options.seed, span, options.soak.is_some())
                .into_iter()
                .map(|(at, fault)| (at, Due::Break(fault)))
                .collect();
        }
        while self.truth.done.len() < self.tally.orders || !self.due.is_empty() || !self.commanding {
            self.hear()?;
            self.act(start.elapsed())?;
            self.tally.took = start.elapsed();
            if self.progress.elapsed() >= PROGRESS {
                self.progress = Instant::now();
                self.stage.show(&format!("{} of {} orders are done", self.truth.done.len(), self.tally.orders));
            }
            let is_stuck = options.standby && self.killed.is_some_and(|killed| killed.elapsed() > FINISHING);
            ensure!(!is_stuck, "no vehicle drives for the standby {FINISHING:?} after its manager was killed");
            let late = span + FINISHING;
            let undone = self.tally.orders.saturating_sub(self.truth.done.len());
            ensure!(start.elapsed() < late, "{undone} orders are not done, {} things are due", self.due.len());
        }
        Ok(())
    }

    /// What processes say, for a moment.
    fn hear(&mut self) -> Result<()> {
        if self.looked.elapsed() >= Duration::from_secs(1) {
            self.looked = Instant::now();
            self.look();
            // Behind the last fault vehicles finish, and hold more than before: none of them is off any more.
            if let Some(samples) = &mut self.samples
                && !self.due.is_empty()
                && samples.is_due()
            {
                samples.write(&self.stage.held())?;
            }
        }
        for heard in self.stage.hear(Duration::from_millis(50)) {
            match heard {
                Heard::Vehicle(line) => {
                    let known = self.truth.wrong.len();
                    self.truth.hear(&line);
                    self.truth.wrong[known..].iter().for_each(|wrong| self.stage.show(&format!("WRONG: {wrong}")));
                }
                Heard::Manager(number, line) => self.manager_says(number, &line)?,
                Heard::Ended(name) => self.tally.wrong.push(format!("the process of {name} has ended")),
            }
        }
        Ok(())
    }

    fn look(&mut self) {
        let (cpu, resident_kib) = self.stage.usage();
        self.tally.cpu = cpu;
        self.tally.resident_kib = self.tally.resident_kib.max(resident_kib);
    }

    fn manager_says(&mut self, number: usize, line: &str) -> Result<()> {
        match line.split(' ').collect::<Vec<_>>()[..] {
            ["call", word, micros] => {
                self.tally.calls.push((word.to_owned(), Duration::from_micros(micros.parse()?)));
                if word == "advance" && self.commanding && self.stage.has_standby() {
                    self.tally.standby.extend(self.killed.take().map(|killed| killed.elapsed()));
                }
            }
            ["up", ..] if self.stage.has_standby() && self.stage.commands(number) => {
                self.commanding = false;
                self.stage.show("the standby commands");
            }
            ["failed", ..] => self.tally.failed_calls += 1,
            ["commands"] if self.stage.is_manager(number) => {
                self.commanding = true;
                self.stage.show("the manager knows where all vehicles are, and commands them");
            }
            // Also a stop that came late, behind the word to go on.
            ["stopped", name] => {
                if self.stopped.insert(name.to_owned()) {
                    self.due.push((self.tally.took + STOPPED, Due::GoOn(Some(name.to_owned()))));
                }
            }
            ["goes-on", name] => drop(self.stopped.remove(name)),
            ["mended", name] => {
                self.tally.mended += 1;
                self.stage.show(&format!("{name} has been mended"));
            }
            ["not-stopped", name, ..] => {
                let is_hardly_on = self.off.get(name).is_some_and(|off| off.elapsed() < HARDLY_ON);
                self.hardly_on += usize::from(is_hardly_on);
                self.stage.show(&format!("{line}{}", if is_hardly_on { ": it was switched off" } else { "" }));
            }
            ["stopped-all", stopped, asked, micros] => {
                let took = Duration::from_micros(micros.parse()?);
                let asked = asked.parse::<usize>()?.saturating_sub(std::mem::take(&mut self.hardly_on));
                self.stopping_all = false;
                self.stage.show(&format!("stop-all: {stopped} of {asked} have stopped"));
                self.tally.stopped_all.push((stopped.parse()?, asked, took));
            }
            ["fenced:", ..] if self.old_manager == Some(number) => {
                self.old_manager = None;
                self.tally.take_overs += 1;
                self.stage.show("the other manager has taken over; the first one has stepped down");
            }
            ["is", ..] => println!("          {line}"),
            ["up", ..] | ["stands-by"] | ["commands"] | ["done", _] | ["mechanic", ..] => {}
            _ => self.tally.wrong.push(format!("the manager says `{line}`")),
        }
        Ok(())
    }

    /// Does what is due.
    fn act(&mut self, now: Duration) -> Result<()> {
        let (due, later): (Vec<_>, Vec<_>) = std::mem::take(&mut self.due).into_iter().partition(|(at, _)| *at <= now);
        self.due = later;
        for (_, what) in due {
            if let Some((after, next)) = self.do_one(what)? {
                self.due.push((now + after, next));
            }
        }
        Ok(())
    }

    /// Does one thing; what follows from it, after what time.
    fn do_one(&mut self, due: Due) -> Result<Option<(Duration, Due)>> {
        // A manager that is away or new is left to come up first.
        let is_whole = self.commanding && self.old_manager.is_none() && !self.is_alone;
        // What else breaks meanwhile would keep vehicles from acknowledging a stop of all.
        let is_calm = is_whole && !self.frozen && !self.cut && !self.stopping_all;
        Ok(match due {
            Due::Break(fault) if !is_calm => Some((AGAIN, Due::Break(fault))),
            Due::Break(fault) => self.break_one(fault)?,
            Due::GoOn(whom) => {
                // Told again until the manager says so: the one that was told may be killed before it has done it.
                let is_one_stopped = whom.as_ref().is_none_or(|name| self.stopped.contains(name));
                if self.commanding && is_one_stopped {
                    self.stage
                        .notify_manager(&whom.as_ref().map_or("go-on".to_owned(), |name| format!("go-on {name}")));
                }
                (is_one_stopped && !self.stopped.is_empty()).then_some((REPORTED_AGAIN, Due::GoOn(whom)))
            }
            Due::SwitchOn(name) => {
                self.stage.notify_vehicle("on", &name)?;
                None
            }
            Due::ThawManager => {
                self.stage.thaw_managers()?;
                self.frozen = false;
                self.tally.freezes += 1;
                None
            }
            Due::Heal => {
                soak::heal()?;
                Some((BACK, Due::Back))
            }
            Due::Back => {
                self.cut = false;
                self.tally.cuts += 1;
                None
            }
            // Only once its standby does what it did.
            Due::StartManager if self.stage.has_standby() && !self.commanding => Some((AGAIN, due)),
            Due::StartManager => {
                if self.stage.has_standby() {
                    self.stage.start_standby()?;
                } else {
                    self.stage.start_manager(false)?;
                }
                self.is_alone = false;
                self.tally.kills += 1;
                None
            }
        })
    }

    fn break_one(&mut self, fault: Fault) -> Result<Option<(Duration, Due)>> {
        Ok(match fault {
            Fault::Stop | Fault::Off | Fault::Fail => {
                // What switches vehicles off, and breaks their wheels, cannot reach into the board.
                let within_reach = |name: &String| matches!(fault, Fault::Stop) || !self.stage.is_board(name);
                let moving = self.truth.moving().into_iter().filter(within_reach).collect::<Vec<_>>();
                let Some(name) = self.rng.choice(moving) else {
                    let moves_again = self.truth.done.len() < self.tally.orders;
                    return Ok(moves_again.then_some((AGAIN, Due::Break(fault))));
                };
                match fault {
                    Fault::Stop => {
                        self.stage.notify_manager(&format!("stop {name}"));
                        self.stopped.insert(name.clone());
                        Some((STOPPED, Due::GoOn(Some(name))))
                    }
                    Fault::Off => {
                        self.stage.show(&format!("{name} is switched off"));
                        self.stage.notify_vehicle("off", &name)?;
                        self.off.insert(name.clone(), Instant::now());
                        Some((OFF, Due::SwitchOn(name)))
                    }
                    _ => {
                        self.stage.show(&format!("{name} has a fault"));
                        self.stage.notify_vehicle("fail", &name)?;
                        None
                    }
                }
            }
            Fault::StopAll => {
                self.stage.notify_manager("stop-all");
                self.stopping_all = true;
                self.stopped.extend((1..=self.stage.vehicles()).map(vehicle_name));
                Some((STOPPED, Due::GoOn(None)))
            }
            Fault::FreezeManager => {
                self.stage.show("the manager hangs");
                self.stage.freeze_manager()?;
                self.frozen = true;
                Some((FROZEN, Due::ThawManager))
            }
            Fault::Cut => {
                let rule = soak::cut(&mut self.rng)?;
                self.stage.show(&format!("links are cut: {}", rule.replace('\n', "; ")));
                self.cut = true;
                Some((CUT, Due::Heal))
            }
            Fault::TakeOver if !self.stage.has_standby() => {
                self.stage.show("another manager takes over");
                self.old_manager = Some(self.stage.start_manager(true)?);
                self.commanding = false;
                None
            }
            // A standby takes nothing over from a live manager.
            Fault::KillManager | Fault::TakeOver => {
                self.stage.show("the manager is killed");
                self.stage.kill_manager()?;
                self.commanding = false;
                self.killed = Some(Instant::now());
                self.is_alone = true;
                Some((AWAY, Due::StartManager))
            }
        })
    }

    /// What the manager knows, where the orders are not done.
    fn ask_why(&mut self) -> Result<()> {
        self.stage.notify_manager("tell");
        let until = Instant::now() + Duration::from_secs(1);
        while Instant::now() < until {
            self.hear()?;
        }
        Ok(())
    }

    /// Ends all processes, and hears what they say last.
    fn end(&mut self) {
        self.look();
        let statuses = self.stage.end();
        self.tally.wrong.extend(statuses);
        while let Some(heard) = self.stage.next_heard() {
            if let Heard::Vehicle(line) = heard {
                self.truth.hear(&line);
            }
        }
        [self.tally.messages, self.tally.datagrams] = self.stage.sent();
    }
}
