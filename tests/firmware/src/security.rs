//! A board that attackers lure to themselves: it is told that its manager is where they listen, and dials them. What is
//! tried is in `cara-security`; what the board makes of it is in its log.

use std::net::{TcpListener, TcpStream};
use std::path::{Path, PathBuf};
use std::sync::mpsc::{Receiver, Sender, channel};
use std::sync::{Mutex, MutexGuard, PoisonError};
use std::time::Duration;

use anyhow::{Context, Result, ensure};
use cara_security::ground::{Keys as Tried, depot};
use cara_security::links::{self, Extent};
use cara_security::linux::accept;
use cara_security::speaker::{Claim, PATIENCE};
use cara_security::tally::{Counters, Report};
use cara_security::target::{Seen, Target, Visit};
use cara_std::keys::{FleetKeys, KeyRing};
use cara_std::{Fleet, Identity};
use clap::Args;

use crate::board::{Bench, Board, Cable, FLEET, Who};
use crate::keys::Keys;

/// Where attackers listen, each for one cable.
const PLACES: [&str; 2] = ["10.77.0.1:7701", "10.77.0.1:7702"];
/// Attempts of each attack: a board takes half a second to start and dial.
const ATTEMPTS: usize = 24;
/// Between the end of a link and the last that the board logs of it.
const SETTLING: Duration = Duration::from_millis(150);

/// What the board logs of a peer without a proof, and of a link that has ended.
const REFUSED: &str = "could not join";
const LEFT: &str = "has left";

/// Attacks the board.
#[derive(Args)]
pub(crate) struct Security {
    /// Also writes the figures here.
    #[arg(long, value_name = "FILE")]
    json: Option<PathBuf>,
}

/// A cable and the attacker behind it.
struct Slot {
    cable: Cable,
    listener: TcpListener,
    place: &'static str,
}

/// A slot on which power is put, and its board.
type Powered = Result<(Slot, Board)>;

/// Boards, a new one for each visit. The bench belongs to another thread, which makes them.
struct Boards {
    slots: Mutex<Vec<Slot>>,
    wanted: Mutex<Sender<(Slot, Sender<Powered>)>>,
    tried: Tried,
    /// How often boards that are gone have logged either.
    logged: Mutex<Counters>,
}

/// Attacks boards and prints what came of it.
pub(crate) fn run(bench: &Bench, options: &Security) -> Result<()> {
    let (wanted, asked) = channel();
    let slots = PLACES.iter().map(|place| slot(bench, place)).collect::<Result<Vec<_>>>()?;
    let boards = Boards {
        slots: Mutex::new(slots),
        wanted: Mutex::new(wanted),
        tried: tried(&bench.keys)?,
        logged: Mutex::default(),
    };
    let report = std::thread::scope(|scope| {
        let attackers = scope.spawn(move || {
            let mut report = Report::default();
            links::run(&mut report, &boards, Extent::Full).map(|()| report)
        });
        power(bench, &asked);
        attackers.join().unwrap_or_else(|_| Err(anyhow::anyhow!("an attacker panicked")))
    })?;
    println!("{report}");
    write(&report, options.json.as_deref())?;
    let faults = report.faults();
    ensure!(faults.is_empty(), "{}", faults.join("; "));
    Ok(())
}

fn write(report: &Report, json: Option<&Path>) -> Result<()> {
    json.map_or(Ok(()), |path| report.write(path))
}

fn slot(bench: &Bench, place: &'static str) -> Result<Slot> {
    Ok(Slot { cable: bench.cable()?, listener: TcpListener::bind(place)?, place })
}

/// Powers boards on request.
fn power(bench: &Bench, asked: &Receiver<(Slot, Sender<Powered>)>) {
    for (slot, answer) in asked {
        let who = Who { manager_address: Some(slot.place), ..Who::agv(17) };
        let board = bench.board(&slot.cable, &who);
        // The receiver may have given up.
        let _ = answer.send(board.map(|board| (slot, board)));
    }
}

/// The keys that attackers try: the board's own, from its manager's file, and others.
fn tried(keys: &Keys) -> Result<Tried> {
    let ring = KeyRing::load(&keys.manager_file().context("boards without keys cannot be attacked")?)?;
    let earlier = KeyRing::load(&keys.others()?.manager_file().context("these have keys as well")?)?;
    let [own, other] = [17, 18].map(|id| Identity::s_unit(&format!("agv-{id}"), id));
    let (own, other) = (own?, other?);
    let of = |ring: &KeyRing, who| ring.pair(who).cloned().context("it is one of the boards");
    let elsewhere = |fleet| -> Result<_> {
        let mut fleet = FleetKeys::draw(Fleet(fleet))?;
        fleet.add(&depot(), &[])?;
        fleet.add(&own, &[])?;
        of(&fleet.ring(&depot())?, &own)
    };
    Ok(Tried {
        genuine: of(&ring, &own)?,
        of_another_unit: of(&ring, &other)?,
        revoked: of(&earlier, &own)?,
        wrong: elsewhere(FLEET)?,
        of_another_fleet: elsewhere(FLEET + 1)?,
    })
}

fn lock<T>(mutex: &Mutex<T>) -> MutexGuard<'_, T> {
    mutex.lock().unwrap_or_else(PoisonError::into_inner)
}

impl Boards {
    /// A powered board that has not dialled yet.
    fn board(&self) -> Result<(Slot, Board)> {
        let slot = lock(&self.slots).pop().context("each attacker has a slot")?;
        slot.listener.set_nonblocking(true)?;
        // What the board before has dialled.
        while slot.listener.accept().is_ok() {}
        let (answer, powered) = channel();
        lock(&self.wanted).send((slot, answer)).map_err(|_| anyhow::anyhow!("the bench is gone"))?;
        powered.recv().context("the bench is gone")?
    }
}

/// The first connection on which a board says something: it gives up those that it has dialled when it is told its address.
fn greeted(listener: &TcpListener) -> Result<TcpStream> {
    loop {
        let stream = accept(listener).context("a board dials its manager")?;
        stream.set_read_timeout(Some(PATIENCE))?;
        if matches!(stream.peek(&mut [0]), Ok(1)) {
            return Ok(stream);
        }
    }
}

/// A board that is powered off when it is dropped.
struct Guest<'b> {
    boards: &'b Boards,
    of: Option<(Slot, Board)>,
}

impl Guest<'_> {
    fn lines(&self) -> Vec<String> {
        self.of.as_ref().map(|(_, board)| board.lines(0)).unwrap_or_default()
    }
}

impl Drop for Guest<'_> {
    fn drop(&mut self) {
        let mut logged = lock(&self.boards.logged);
        for line in self.lines().iter().filter(|line| line.contains(REFUSED) || line.contains(LEFT)) {
            let name = if line.contains(REFUSED) { REFUSED } else { LEFT };
            *logged.entry(name.to_owned()).or_default() += 1;
        }
        drop(logged);
        if let Some((slot, board)) = self.of.take() {
            drop(board);
            lock(&self.boards.slots).push(slot);
        }
    }
}

impl Target for Boards {
    fn name(&self) -> &str {
        "board in QEMU"
    }

    fn workers(&self) -> usize {
        PLACES.len()
    }

    fn share(&self, attempts: usize) -> usize {
        attempts.min(ATTEMPTS)
    }

    fn reports_calls(&self) -> bool {
        false
    }

    fn visit(&self) -> Result<Visit<'_>> {
        let guest = Guest { boards: self, of: Some(self.board()?) };
        let (slot, _) = guest.of.as_ref().context("it has just been given")?;
        let stream = greeted(&slot.listener)?;
        let seen = move || {
            std::thread::sleep(SETTLING);
            let joins = guest.lines().iter().filter(|line| line.contains("has joined")).count();
            Ok(Seen { joins, marks: Vec::new() })
        };
        Ok(Visit {
            stream,
            dials: false,
            claim: Claim { fleet: Fleet(FLEET), identity: depot(), wanted: None },
            keys: self.tried.clone(),
            seen: Box::new(seen),
        })
    }

    fn counters(&self) -> Result<Counters> {
        Ok(lock(&self.logged).clone())
    }
}
