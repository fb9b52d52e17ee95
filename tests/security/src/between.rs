//! An attacker in the middle: every frame between a genuine manager and a genuine vehicle passes through it.

use std::io::{self, Read, Write};
use std::net::{Ipv4Addr, Shutdown, TcpListener, TcpStream};
use std::sync::{Mutex, PoisonError};
use std::time::{Duration, Instant};

use anyhow::{Context, Result, ensure};
use cara_core::host::frame;
use cara_std::Unit;

use crate::event_log::EventLog;
use crate::ground::agv;
use crate::links::Extent;
use crate::linux::{Linux, LinuxManager, LinuxVehicles, accept, wait_for};
use crate::speaker::{HANDSHAKE, fresh_mark};
use crate::tally::Report;
use crate::target::{Seen, Target};
use crate::trial::row;

/// A link that is still up after this time has not detected the attack. Longer than any wait for a proof.
const NOTICED: Duration = Duration::from_secs(5);
/// Requests in each direction.
const REQUESTS: usize = 12;

/// A frame on its way.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
struct Place {
    to_manager: bool,
    /// Its number in its direction.
    number: usize,
}

/// How a frame is tampered with.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Tampering {
    Change,
    Truncate,
    Drop,
    Duplicate,
    Swap,
    Insert,
    Reflect,
}

const TAMPERINGS: [Tampering; 7] = [
    Tampering::Change,
    Tampering::Truncate,
    Tampering::Drop,
    Tampering::Duplicate,
    Tampering::Swap,
    Tampering::Insert,
    Tampering::Reflect,
];

/// A manager, and vehicles that reach it through the attacker.
pub struct Middle<'l> {
    linux: &'l Linux,
    manager: &'l LinuxManager<'l>,
    vehicles: &'l LinuxVehicles<'l>,
}

/// A vehicle and the way to its manager.
struct Way<'m> {
    unit: Unit,
    log: EventLog,
    listener: TcpListener,
    middle: &'m Middle<'m>,
    id: u32,
    before: Seen,
}

impl Drop for Way<'_> {
    fn drop(&mut self) {
        self.middle.vehicles.retire(&self.unit);
    }
}

impl<'l> Middle<'l> {
    /// Between these.
    pub fn new(linux: &'l Linux, manager: &'l LinuxManager<'l>, vehicles: &'l LinuxVehicles<'l>) -> Self {
        Self { linux, manager, vehicles }
    }

    /// Every attack from the middle.
    pub fn run(&self, report: &mut Report, extent: Extent) -> Result<()> {
        self.flip_every_bit(report, extent)?;
        self.meddle(report, extent)
    }

    fn way(&self) -> Result<Way<'_>> {
        let id = self.vehicles.next_vehicle();
        let listener = TcpListener::bind((Ipv4Addr::LOCALHOST, 0))?;
        let before = self.manager.log.seen(&agv(id));
        let (unit, log) = self.linux.vehicle(id, Some(listener.local_addr()?))?;
        Ok(Way { unit, log, listener, middle: self, id, before })
    }

    /// Lengths of the frames of an undisturbed handshake.
    fn lengths(&self) -> Result<Vec<(Place, usize)>> {
        let way = self.way()?;
        let lengths = Mutex::new(Vec::new());
        way.carry(
            |place, bytes| {
                if place.number < HANDSHAKE {
                    lengths.lock().unwrap_or_else(PoisonError::into_inner).push((place, bytes.len()));
                }
                vec![bytes]
            },
            |_| wait_for(|| way.has_joined() && lengths.lock().is_ok_and(|lengths| lengths.len() == 2 * HANDSHAKE)),
        )?;
        Ok(lengths.into_inner().unwrap_or_else(PoisonError::into_inner))
    }

    fn flip_every_bit(&self, report: &mut Report, extent: Extent) -> Result<()> {
        let lengths = self.lengths()?;
        for to_manager in [true, false] {
            let places = lengths.iter().filter(|(place, _)| place.to_manager == to_manager);
            let bits = places.flat_map(|(place, length)| (0..length * 8).map(|bit| (*place, bit))).collect();
            let bits = extent.some(bits, 19);
            let (target, whose): (&dyn Target, _) =
                if to_manager { (self.manager, "vehicle's") } else { (self.vehicles, "manager's") };
            let name = format!("each bit of the {whose} handshake flipped");
            row(report, target, &name, &bits, false, |(place, bit)| self.flip(*place, *bit))?;
        }
        Ok(())
    }

    /// Flips one bit of one frame: whether the link came up all the same. The next handshake, undisturbed, must
    /// succeed.
    fn flip(&self, at: Place, bit: usize) -> Result<bool> {
        let way = self.way()?;
        let changed = |place, mut bytes: Vec<u8>| {
            if place == at {
                let bit = bit % (bytes.len() * 8);
                if let Some(byte) = bytes.get_mut(bit / 8) {
                    *byte ^= 1 << (bit % 8);
                }
            }
            vec![bytes]
        };
        let ended = way.carry(changed, |_| false)?;
        // The last frame is the manager's: it has the vehicle's proof then, and takes it.
        let last = !at.to_manager && at.number == HANDSHAKE - 1;
        let fooled = !ended || way.log.all().joins > 0 || (!last && way.manager_joins() > 0);
        if fooled {
            let (vehicle, manager) = (way.log.all().joins, way.manager_joins());
            eprintln!("bit {bit} of {at:?}: ended {ended}, joins at the vehicle {vehicle}, at the manager {manager}");
        }
        if bit.is_multiple_of(8) {
            let next = way.carry(|_, bytes| vec![bytes], |_| wait_for(|| way.has_joined()));
            next.with_context(|| {
                let (events, counters) = (way.manager_joins(), way.unit.counters());
                let reported: Vec<_> = counters.into_iter().filter(|(_, count)| *count > 0).collect();
                format!("behind bit {bit} of {at:?}, after which the manager had {events} joins: {reported:?}")
            })?;
            ensure!(way.has_joined(), "bit {bit} of {at:?}: nor did the next link come up");
        }
        Ok(fooled)
    }

    /// Tampers with each sealed frame.
    pub fn meddle(&self, report: &mut Report, extent: Extent) -> Result<()> {
        for to_manager in [true, false] {
            let numbers = HANDSHAKE..HANDSHAKE + 8;
            let places = numbers.map(|number| Place { to_manager, number });
            let cases = places.flat_map(|place| TAMPERINGS.map(|tampering| (place, tampering))).collect();
            let cases = extent.some(cases, 3);
            let target: &dyn Target = if to_manager { self.manager } else { self.vehicles };
            let name = "in the middle: change, cut, drop, double, swap, insert, reflect";
            row(report, target, name, &cases, false, |(place, tampering)| self.meddle_once(*place, *tampering))?;
        }
        Ok(())
    }

    /// Tampers with one sealed frame: whether a call ran that was not requested, a call ran twice, or the link stayed
    /// up.
    fn meddle_once(&self, at: Place, tampering: Tampering) -> Result<bool> {
        let way = self.way()?;
        let mut held = None;
        let mut came = false;
        let meddle = |place: Place, bytes: Vec<u8>| {
            let next = Place { number: at.number + 1, ..at };
            match tampering {
                _ if place == at => {
                    came = true;
                    done(tampering, bytes, &mut held)
                }
                Tampering::Swap if place == next => [Some(bytes), held.take()].into_iter().flatten().collect(),
                // The next frame in the other direction is preceded by the one that came from there.
                Tampering::Reflect if place.to_manager != at.to_manager && held.is_some() => {
                    [held.take(), Some(bytes)].into_iter().flatten().collect()
                }
                _ => vec![bytes],
            }
        };
        let asked = Mutex::new(Vec::new());
        let ended = way.carry(meddle, |over| {
            let marks = way.ask(over);
            asked.lock().unwrap_or_else(PoisonError::into_inner).extend(marks);
            false
        })?;
        let asked = asked.into_inner().unwrap_or_else(PoisonError::into_inner);
        ensure!(came, "nothing came at {at:?}");
        let more = |marks: Vec<i64>| {
            let mut once = marks.clone();
            once.sort_unstable();
            once.dedup();
            once.len() < marks.len() || once.iter().any(|mark| !asked.contains(mark))
        };
        Ok(!ended || more(way.log.all().marks) || more(way.manager_marks()))
    }
}

/// The frames that are sent in place of one.
fn done(tampering: Tampering, mut bytes: Vec<u8>, held: &mut Option<Vec<u8>>) -> Vec<Vec<u8>> {
    match tampering {
        Tampering::Change => {
            let at = fastrand::usize(2..bytes.len());
            if let Some(byte) = bytes.get_mut(at) {
                *byte ^= 1 << fastrand::u8(0..8);
            }
            vec![bytes]
        }
        Tampering::Truncate => {
            let body = bytes.get(2..bytes.len() - 1).unwrap_or_default();
            vec![[&(body.len() as u16).to_le_bytes()[..], body].concat()]
        }
        Tampering::Drop => Vec::new(),
        Tampering::Duplicate => vec![bytes.clone(), bytes],
        Tampering::Swap => {
            *held = Some(bytes);
            Vec::new()
        }
        Tampering::Insert => {
            let noise = std::iter::repeat_with(|| fastrand::u8(..)).take(bytes.len() - 2);
            let length = bytes.iter().take(2).copied();
            vec![length.chain(noise).collect(), bytes]
        }
        Tampering::Reflect => {
            *held = Some(bytes.clone());
            vec![bytes]
        }
    }
}

impl Way<'_> {
    fn manager_joins(&self) -> usize {
        self.middle.manager.log.seen(&agv(self.id)).joins - self.before.joins
    }

    fn manager_marks(&self) -> Vec<i64> {
        let marks = self.middle.manager.log.seen(&agv(self.id)).marks;
        marks.into_iter().skip(self.before.marks.len()).collect()
    }

    fn has_joined(&self) -> bool {
        self.log.all().joins > 0 && self.manager_joins() > 0
    }

    /// Both ends call functions of each other; the numbers of their requests.
    fn ask(&self, over: &dyn Fn() -> bool) -> Vec<i64> {
        let mut marks = Vec::new();
        let know =
            || self.unit.manager().is_some_and(|peer| knows(&peer)) && self.peer().is_some_and(|peer| knows(&peer));
        if !wait_for(|| over() || (self.has_joined() && know())) || over() {
            return marks;
        }
        let (Some(peer), Some(manager)) = (self.peer(), self.unit.manager()) else { return marks };
        for _ in 0..REQUESTS {
            for peer in [&peer, &manager] {
                let mark = fresh_mark();
                marks.push(mark);
                let mut number = cara_std::Parameters::<64>::sized();
                let made = number.add_int("n", 1).and_then(|_| number.set_value("n", mark));
                let _ = made.map(|()| peer.request("mark", &number));
                let _ = peer.flush();
            }
            std::thread::sleep(Duration::from_millis(1));
        }
        marks
    }

    fn peer(&self) -> Option<cara_std::Peer> {
        let found = self.middle.manager.system.s_units().into_iter();
        found.filter(cara_std::Peer::is_connected).find(|peer| peer.identity() == &agv(self.id))
    }

    /// Carries the vehicle's next link to the manager and back, until one end closes it, or `enough` says so. Whether an
    /// end closed it.
    fn carry(
        &self,
        change: impl FnMut(Place, Vec<u8>) -> Vec<Vec<u8>> + Send,
        enough: impl FnOnce(&dyn Fn() -> bool) -> bool,
    ) -> Result<bool> {
        let vehicle = accept(&self.listener).context("a vehicle dials")?;
        let manager = TcpStream::connect(self.middle.manager.address())?;
        let change = Mutex::new(change);
        let change = |place, bytes| (change.lock().unwrap_or_else(PoisonError::into_inner))(place, bytes);
        std::thread::scope(|scope| {
            let pumps = [(true, &vehicle, &manager), (false, &manager, &vehicle)]
                .map(|(to_manager, from, to)| scope.spawn(move || pump(to_manager, from, to, &change)));
            let over = || pumps.iter().any(|pump| pump.is_finished());
            let stop = enough(&over);
            let end = Instant::now() + NOTICED;
            while !stop && Instant::now() < end && !over() {
                std::thread::sleep(Duration::from_millis(1));
            }
            let ended = over();
            for stream in [&vehicle, &manager] {
                let _ = stream.shutdown(Shutdown::Both);
            }
            Ok(ended)
        })
    }
}

fn knows(peer: &cara_std::Peer) -> bool {
    peer.their_function_list().contains("mark")
}

/// Passes frames on, changed or not, until either end is closed.
fn pump(
    to_manager: bool,
    mut from: &TcpStream,
    mut to: &TcpStream,
    change: &(impl Fn(Place, Vec<u8>) -> Vec<Vec<u8>> + Sync),
) -> io::Result<()> {
    let (mut came, mut buffer, mut number) = (Vec::new(), [0; 4096], 0);
    to.set_nodelay(true)?;
    loop {
        while let Some(length) = frame::first_frame_length(&came).filter(|length| *length <= came.len()) {
            let bytes = came.drain(..length).collect();
            for bytes in change(Place { to_manager, number }, bytes) {
                to.write_all(&bytes)?;
            }
            number += 1;
        }
        match from.read(&mut buffer)? {
            0 => return Ok(()),
            count => came.extend(buffer.iter().take(count)),
        }
    }
}
