//! The manager: takes orders, gives them to vehicles, and lets each vehicle into one cell at a time.
//!
//! A vehicle is only where a manager has let it in, and that stands in the [book](crate::book) before the vehicle is told. A
//! manager that starts, be it again or in place of another one, commands none before it knows the cells of all: from the
//! vehicle's own word, or, of one that is not there, from the book.
//!
//! Its loop beats a heart, on which all motions depend: when the loop hangs, all vehicles stop.
//!
//! With `--standby` it waits until no other manager commands, and waits again when one with a higher claim is there.
//!
//! | line of its input | does |
//! |---|---|
//! | `stop-all`, `go-on` | stops all vehicles; lets those drive again that were stopped |
//! | `stop agv-7`, `go-on agv-7` | the same of one |
//! | `notify` | prints what it knows of each vehicle |

mod care;
mod driver;
mod jobs;
mod known;
mod traffic;

use std::io::BufRead;
use std::path::PathBuf;
use std::process::ExitCode;
use std::sync::mpsc::{Receiver, RecvTimeoutError, Sender, channel};
use std::sync::{Arc, Mutex, PoisonError};
use std::time::{Duration, Instant};

use anyhow::{Context, Result};
use cara_std::{CallError, CommunicationSystem, Error, Heart, Identity, LinkCounter, StartError, UnitEvent};

use crate::book::{Book, BookError};
use crate::files::{MapFiles, read};
use crate::map::Map;
use crate::network::{MANAGER, MOST_VEHICLES, Network, vehicle_id, vehicle_name};
use crate::orders::{self, Order};
use cara_apps::warehouse::{FAULT, Floor, FloorServer, refusal};
use driver::{Answer, Command, Outcome};
use jobs::Jobs;
use known::{Job, Known, State};
use traffic::{Traffic, goal};

/// The loop comes round so often.
const TURN: Duration = Duration::from_millis(40);
/// The loop's heart: half of the vehicles' lease.
const HEART: Duration = Duration::from_millis(200);
/// Vehicles that are not there are taken to be where the book says, so long after the start.
const GATHERING: Duration = Duration::from_secs(3);
/// Options of the manager.
#[derive(clap::Args, Clone, Debug)]
pub struct Options {
    #[command(flatten)]
    network: Network,
    #[command(flatten)]
    files: MapFiles,
    /// The orders, one a line.
    #[arg(long, value_name = "FILE")]
    orders: PathBuf,
    /// The managers' book.
    #[arg(long, value_name = "FILE")]
    book: PathBuf,
    /// Where it keeps its term.
    #[arg(long, value_name = "FOLDER")]
    state: PathBuf,
    /// How many vehicles there are.
    #[arg(long, value_parser = clap::value_parser!(u32).range(1..=i64::from(MOST_VEHICLES)))]
    vehicles: u32,
    /// The orders' times began so many seconds ago.
    #[arg(long, default_value_t = 0.0)]
    began: f64,
    /// Take over from the manager that runs.
    #[arg(long)]
    take_over: bool,
    /// Wait until no manager commands; two of these are one manager that outlives a host.
    #[arg(long, conflicts_with = "take_over")]
    standby: bool,
}

/// What the manager's services get.
#[derive(Clone, Debug, Default)]
pub(crate) struct Desk {
    mended: Arc<Mutex<Vec<String>>>,
}

impl Floor for Desk {
    fn mended(&mut self, vehicle: &str) {
        self.mended.lock().unwrap_or_else(PoisonError::into_inner).push(vehicle.to_owned());
    }
}

/// What outlives a term of a standby.
struct Post {
    system: CommunicationSystem<Desk>,
    desk: Desk,
    map: Map,
    orders: Vec<Order>,
    began: Instant,
    commands: Receiver<String>,
    events: Receiver<UnitEvent>,
}

/// A manager that commands, for one term.
struct Manager<'p> {
    post: &'p Post,
    vehicles: Vec<Known>,
    traffic: Traffic,
    jobs: Jobs,
    book: Book,
    outcomes: Receiver<Outcome>,
    heart: Heart,
    /// It commands since then, or will when it knows where all vehicles are.
    since: Instant,
    /// All are stopped: none is sent anywhere.
    halted: bool,
    commanding: bool,
    last_reset: Instant,
}

/// Why a term is over.
enum Over {
    /// Standard input has ended.
    Asked,
    /// This standby stands by again.
    StandsBy,
}

/// Runs until standard input ends; or, with an exit code of its own, until another manager has taken over.
pub fn run(options: &Options) -> Result<ExitCode> {
    let post = Post::open(options)?;
    while post.awaits_command() {
        let ended = Manager::start(&post, options).and_then(Manager::command_all);
        match ended {
            Ok(Over::Asked) => break,
            Ok(Over::StandsBy) => println!("stands-by"),
            Err(error) if !matches!(error.downcast_ref(), Some(BookError::Fenced(_))) => return Err(error),
            // The book knew first. The unit hears the other manager soon, or raises its claim above one that is gone.
            Err(_) if options.standby && post.rests() => {}
            Err(_) if options.standby => break,
            Err(error) => {
                println!("fenced: {error}");
                return Ok(ExitCode::from(StartError::FENCED_EXIT));
            }
        }
    }
    Ok(ExitCode::SUCCESS)
}

impl Post {
    fn open(options: &Options) -> Result<Self> {
        let map = options.files.map()?;
        let orders = orders::parse(&options.orders.to_string_lossy(), &read(&options.orders)?, &map)?;
        let began =
            Instant::now().checked_sub(Duration::try_from_secs_f64(options.began)?).unwrap_or_else(Instant::now);
        let desk = Desk::default();
        let builder = options.network.place(CommunicationSystem::builder(MANAGER.0, MANAGER.1)?);
        let builder = builder.state_folder(&options.state).take_over(options.take_over);
        let builder = if options.standby { builder.standby() } else { builder };
        let system = builder.state(desk.clone()).build()?;
        system.my_function_list().serve(FloorServer)?;
        system.publish_my_function_list()?;
        let events = system.events();
        system.start()?;
        let (lines, commands) = channel();
        std::thread::spawn(move || hear(&lines));
        Ok(Self { system, desk, map, orders, began, commands, events })
    }

    /// Waits until this manager commands, which only a standby does not at once; `false` where standard input has ended.
    fn awaits_command(&self) -> bool {
        while self.system.is_standby() {
            if !self.rests() {
                return false;
            }
            self.events.try_iter().for_each(drop);
        }
        true
    }

    /// For a turn; `false` where standard input has ended. What is said to one that rests is for the one that commands.
    fn rests(&self) -> bool {
        !matches!(self.commands.recv_timeout(TURN), Err(RecvTimeoutError::Disconnected))
    }
}

impl<'p> Manager<'p> {
    fn start(post: &'p Post, options: &Options) -> Result<Self> {
        let system = &post.system;
        let term = system.claim().term;
        let (book, mut written) = Book::open(&options.book, term)?;
        let heart = system.heart(HEART);
        let (sender, outcomes) = channel();
        let mut vehicles = Vec::new();
        for number in 1..=options.vehicles {
            let name = vehicle_name(number);
            let identity = Identity::s_unit(&name, vehicle_id(number))?;
            let peer = system.node(&identity).with_context(|| format!("there are no keys for {name}"))?;
            let cells = written.cells.remove(&name);
            let commands = driver::start(vehicles.len(), peer.clone(), heart.renew(), sender.clone());
            vehicles.push(Known::new(name, peer, cells, commands));
        }
        println!("up with term {term}");
        let (traffic, jobs) = (Traffic::new(post.map.clone()), Jobs::new(post.orders.clone(), written));
        let (halted, commanding, since) = (false, false, Instant::now());
        let last_reset = since;
        Ok(Self { post, vehicles, traffic, jobs, book, outcomes, heart, since, halted, commanding, last_reset })
    }

    /// The loop, until standard input ends or this standby stands by again.
    fn command_all(mut self) -> Result<Over> {
        let mut reported = Instant::now();
        loop {
            let turn = Instant::now();
            if let Some(over) = self.turn()? {
                return Ok(over);
            }
            if reported.elapsed() >= Duration::from_secs(1) {
                reported = Instant::now();
                let counters = [LinkCounter::MessagesSent, LinkCounter::DatagramsSent];
                let [messages, datagrams] = counters.map(|counter| self.post.system.counted(counter));
                println!("sent {messages} {datagrams}");
            }
            std::thread::sleep(TURN.saturating_sub(turn.elapsed()));
        }
    }

    /// A turn of the loop; at the end, why it is over.
    fn turn(&mut self) -> Result<Option<Over>> {
        if self.post.system.is_standby() {
            return Ok(Some(Over::StandsBy));
        }
        self.heart.beat();
        loop {
            match self.post.commands.try_recv() {
                Ok(line) => self.command(&line),
                Err(std::sync::mpsc::TryRecvError::Empty) => break,
                Err(std::sync::mpsc::TryRecvError::Disconnected) => return Ok(Some(Over::Asked)),
            }
        }
        self.hear_events()?;
        while let Ok(outcome) = self.outcomes.try_recv() {
            self.take(&outcome)?;
        }
        let now = Instant::now();
        self.vehicles.iter_mut().for_each(|vehicle| vehicle.look(now));
        self.care();
        if !self.halted && self.is_commanding() {
            self.jobs.assign(&mut self.vehicles, &self.traffic.map, self.post.began.elapsed());
            self.work()?;
            self.send_on()?;
        }
        Ok(None)
    }

    /// Whether the cells of all vehicles are known: each has been heard, or, some time after the start, stands in the book.
    fn is_commanding(&mut self) -> bool {
        if !self.commanding {
            let heard = |vehicle: &Known| !matches!(vehicle.state, State::Lost(_) | State::Asked);
            let all_heard = self.vehicles.iter().all(heard);
            let is_late = self.since.elapsed() > GATHERING;
            self.commanding = all_heard || is_late && self.vehicles.iter().all(|vehicle| vehicle.cells.is_some());
            if self.commanding {
                println!("commands");
            }
        }
        self.commanding
    }

    fn hear_events(&mut self) -> Result<()> {
        while let Ok(event) = self.post.events.try_recv() {
            match event {
                UnitEvent::Fenced { claim } => return Err(BookError::Fenced(claim.term).into()),
                UnitEvent::Inhibited { peer, latch, .. } => {
                    let Some(vehicle) = self.vehicles.iter_mut().find(|vehicle| *vehicle.peer.identity() == peer)
                    else {
                        continue;
                    };
                    match latch {
                        Some(latch) => vehicle.stopped(latch.by, latch.reason),
                        None if matches!(vehicle.state, State::Stopped { .. }) => vehicle.lost(),
                        None => {}
                    }
                }
                _ => {}
            }
        }
        Ok(())
    }

    fn command(&mut self, line: &str) {
        match line.split_once(' ').unwrap_or((line, "")) {
            ("stop-all", _) => {
                self.halted = true;
                self.stop_all();
            }
            ("go-on", "") => {
                self.halted = false;
                self.vehicles.iter_mut().for_each(|vehicle| vehicle.reset = Some(false));
            }
            ("tell", _) => self.vehicles.iter().for_each(|vehicle| println!("is {vehicle}")),
            (verb, name) => {
                let Some(vehicle) = self.vehicles.iter_mut().find(|vehicle| vehicle.name == name) else { return };
                match verb {
                    "stop" => care::stop(&vehicle.peer),
                    "go-on" => vehicle.reset = Some(false),
                    _ => {}
                }
            }
        }
    }

    /// What a vehicle has answered.
    fn take(&mut self, outcome: &Outcome) -> Result<()> {
        let Outcome { vehicle: number, command, answer, took } = outcome;
        let vehicle = &mut self.vehicles[*number];
        match answer {
            Ok(_) => println!("call {} {}", command.word(), took.as_micros()),
            Err(error) => println!("failed {} {}: {error}", command.word(), vehicle.name),
        }
        match (*command, answer) {
            (Command::Place, _) if !vehicle.was_asked() => {}
            (Command::Place, Ok(Answer::Place(place))) => {
                let delivered = self.jobs.reconcile(vehicle, place);
                let on = vehicle.is_at(*place);
                if let Some(next) = on {
                    vehicle.command(Command::Advance(next));
                }
                if let Some(order) = delivered {
                    self.finish(order)?;
                }
            }
            (Command::Advance(_), Ok(Answer::Moves(moves))) => vehicle.state = State::Moves(*moves, Instant::now()),
            (Command::Load(order), Ok(_)) => {
                vehicle.do_job(Job::Carry(order));
                vehicle.state = State::Ready;
            }
            (Command::Unload(order), Ok(_)) => {
                vehicle.do_job(Job::Idle);
                vehicle.state = State::Ready;
                if self.jobs.done.insert(order) {
                    self.finish(order)?;
                }
            }
            (Command::Reset { mended }, Ok(_)) => {
                (vehicle.reset, vehicle.mechanic) = (None, None);
                println!("{} {}", if mended { "mended" } else { "goes-on" }, vehicle.name);
                vehicle.lost();
            }
            // It was stopped before, and has a fault beside that.
            (Command::Reset { .. }, Err(failed)) if failed.code() == Some(refusal::FAULTY) => {
                vehicle.reset = None;
                vehicle.stopped(0, FAULT);
            }
            (Command::Reset { .. }, Err(_)) => {}
            (_, Err(CallError { error: Error::Inhibited { by, reason }, .. })) => vehicle.stopped(*by, *reason),
            _ => vehicle.lost(),
        }
        Ok(())
    }

    /// An order is done.
    fn finish(&mut self, order: usize) -> Result<()> {
        self.book.write(&format!("done {order}\n"))?;
        println!("done {order}");
        Ok(())
    }

    /// Vehicles that are where their jobs want them take a parcel or put it down.
    fn work(&mut self) -> Result<()> {
        for vehicle in self.vehicles.iter_mut().filter(|vehicle| vehicle.state == State::Ready) {
            let is_there = goal(vehicle.job, &self.jobs.orders).is_some_and(|goal| vehicle.cells == Some([goal, goal]));
            let command = match vehicle.job {
                Job::Fetch(order) if is_there => Command::Load(order),
                Job::Carry(order) if is_there => Command::Unload(order),
                _ => continue,
            };
            if let Command::Load(order) = command {
                self.book.write(&format!("pick {} {order}\n", vehicle.name))?;
                self.jobs.picks(order, &vehicle.name);
            }
            vehicle.state = State::Handles;
            vehicle.command(command);
        }
        Ok(())
    }

    /// Lets vehicles into the next cells of their ways.
    fn send_on(&mut self) -> Result<()> {
        let grants = self.traffic.grants(&self.vehicles, &self.jobs.orders);
        let mut lines = String::new();
        for (number, next) in &grants {
            let vehicle = &mut self.vehicles[*number];
            let Some([at, _]) = vehicle.cells else { continue };
            vehicle.cells = Some([at, *next]);
            vehicle.state = State::Sent;
            lines.push_str(&format!("grant {} {at} {next}\n", vehicle.name));
        }
        if lines.is_empty() {
            return Ok(());
        }
        self.book.write(&lines)?;
        for (number, next) in grants {
            self.vehicles[number].command(Command::Advance(next));
        }
        Ok(())
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
