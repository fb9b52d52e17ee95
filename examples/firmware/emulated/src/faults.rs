//! For test images only: a service that makes the board fail, and a record of how long the motors went on behind that.
//!
//! All times are read from the board's own clock, so that it does not matter how busy the emulator's host is. A fault is
//! counted from the last sign before it that the manager wants the vehicle to drive: the call that announced the fault,
//! or a renewal of the lease that came behind it. The fault itself is later than either, so the motors stand no later
//! behind it than is measured.
//!
//! Log lines are read by `tests/firmware`.

use core::cell::Cell;
use core::mem::{MaybeUninit, size_of};
use core::sync::atomic::{AtomicBool, Ordering};

use cara_apps::agv::GO_TO_LEASE;
use cara_board::Reason;
use cara_core::error::{Error, ServiceError};
use cara_core::services::lease::Lease;
use cara_core::time::{Duration as CoreDuration, Instant};
use cara_embassy::{Handler, Hook, ServiceOptions, now};
use cara_vehicle::{Agv, DRIVING, Vehicle};
use critical_section::Mutex;
use embassy_sync::blocking_mutex::raw::CriticalSectionRawMutex;
use embassy_sync::signal::Signal;

use crate::TICK;
use crate::creep::{self, CREEPING};

/// Makes the board fail: 0 notes that something outside is about to fail, 1 hangs in the handler, 2 starves all tasks,
/// 3 panics, 4 calls itself until the stack is full, 5 has a frame larger than the stack, 6 presses the bumper in an
/// interrupt, 7 frees it; with the feature `logs` 8 logs a hundred lines a second.
const FAULT: &str = "fault(kind: int)";
/// Longest turn of the executor while nothing is broken: until it ends, a frame that has arrived may wait.
const POLL: CoreDuration = CoreDuration::from_millis(20);
/// A millisecond, to which a lease is exact.
const STEP: CoreDuration = CoreDuration::from_millis(1);

/// Words of a lease in memory.
const LEASE_WORDS: usize = size_of::<Lease>() / size_of::<u32>();

static PRESSING: AtomicBool = AtomicBool::new(false);
static STARVING: Signal<CriticalSectionRawMutex, ()> = Signal::new();
static RECORD: Mutex<Cell<Record>> = Mutex::new(Cell::new(Record::NEW));

#[derive(Clone, Copy)]
struct Record {
    /// When the fault was announced.
    marked: Instant,
    /// When the first datagram behind that which ends a motion was taken from the network's controller.
    heard: Option<Instant>,
    /// The last tick before which a renewal of the lease was seen.
    renewed: Instant,
    /// How far the lease is known to reach.
    reaches: Instant,
    /// The last tick.
    ticked: Instant,
    /// The processor sleeps, or has just been woken by an interrupt.
    sleeps: bool,
    /// How late the emulator was to wake the processor for the last tick, because its host was busy: no chip is.
    late: CoreDuration,
    /// Longest completed turn of the executor during a live lease.
    turn: CoreDuration,
    /// Losses of the manager for which the hook has run.
    losses: u32,
    /// Calls that tasks have taken.
    orders: u32,
    /// The lease's words before the stack overflows.
    lease: [u32; LEASE_WORDS],
}

impl Record {
    const NEW: Self = Self {
        marked: Instant::START,
        heard: None,
        renewed: Instant::START,
        reaches: Instant::START,
        ticked: Instant::START,
        sleeps: false,
        late: CoreDuration::ZERO,
        turn: CoreDuration::ZERO,
        losses: 0,
        orders: 0,
        lease: [0; LEASE_WORDS],
    };

    fn change<R>(act: impl FnOnce(&mut Self) -> R) -> R {
        critical_section::with(|section| {
            let place = RECORD.borrow(section);
            let mut record = place.get();
            let result = act(&mut record);
            place.set(record);
            result
        })
    }
}

/// Offers the service, and counts losses of the manager.
pub fn offer(vehicle: Vehicle) -> Result<(), Error> {
    let fault = Handler::method(&|_: &mut Agv, _, parameters| {
        let kind = parameters.variable::<i64>("kind").map_err(|_| ServiceError::BadResults)?;
        Record::change(|record| (record.marked, record.heard) = (now(), None));
        fail(kind);
        Ok(())
    });
    vehicle.my_function_list().add_service(FAULT, ServiceOptions::new(), fault)?;
    let lost: &'static Hook<Agv> = &|agv| {
        cara_vehicle::stand_still(agv);
        let losses = Record::change(|record| {
            record.losses += 1;
            record.losses
        });
        defmt::info!("hook for the lost manager: {=u32}", losses);
    };
    creep::offer(vehicle)?;
    vehicle.publish_my_function_list()?;
    vehicle.on_manager_lost(lost);
    let [lease, poll, tick] = [GO_TO_LEASE.as_micros(), POLL.as_micros(), TICK.as_micros()];
    defmt::info!("bound: lease={=u64} poll={=u64} tick={=u64}", lease, poll, tick);
    Ok(())
}

fn fail(kind: i64) {
    match kind {
        1 => hang(),
        2 => STARVING.signal(()),
        3 => panic!("asked for"),
        4 | 5 => overflow(kind),
        6 => PRESSING.store(true, Ordering::Release),
        7 => cara_vehicle::bumper(false),
        #[cfg(feature = "logs")]
        8 => crate::logs::chatter::BEGINS.signal(()),
        _ => {}
    }
}

fn hang() -> ! {
    loop {
        cortex_m::asm::nop();
    }
}

/// Fills the stack beyond its end.
fn overflow(kind: i64) {
    let lease = lease_words();
    Record::change(|record| record.lease = lease);
    if kind == 4 {
        recurse(0);
    } else {
        too_large();
    }
}

/// Small frames: whatever lies below the stack is reached by one of them.
#[inline(never)]
#[allow(unconditional_recursion)]
fn recurse(depth: u32) -> u32 {
    let frame = MaybeUninit::<[u8; 512]>::uninit();
    core::hint::black_box(&frame);
    recurse(core::hint::black_box(depth + 1)) + 1
}

/// One frame that leaves the stack by far, and would lie among the variables if those were below it.
#[inline(never)]
fn too_large() {
    let frame = core::hint::black_box([0xFF_u8; 43 * 1024]);
    core::hint::black_box(&frame);
}

/// The lease as it lies in memory.
#[allow(unsafe_code)]
fn lease_words() -> [u32; LEASE_WORDS] {
    let place = (&raw const DRIVING).cast::<u32>();
    // SAFETY: the words of a variable, which is aligned to them at least and has as many.
    core::array::from_fn(|index| unsafe { place.add(index).read_volatile() })
}

/// The program has ended, and why: has an overflow written over the lease?
pub fn ended(reason: Reason) {
    if reason == Reason::StackOverflow {
        let kept = lease_words() == Record::change(|record| record.lease);
        defmt::info!("the lease's words are {=str}", if kept { "as they were" } else { "overwritten" });
    }
}

/// Once told to, keeps the processor for itself: interrupts run, tasks do not.
#[embassy_executor::task]
pub async fn starve() -> ! {
    STARVING.wait().await;
    Record::change(|record| record.marked = now());
    hang()
}

/// Whether a lease lasts beyond a time.
fn lasts_beyond(at: Instant) -> bool {
    DRIVING.lasts_beyond(at) || CREEPING.lasts_beyond(at)
}

/// Whether one that moves the vehicle does.
fn moves_beyond(at: Instant) -> bool {
    DRIVING.lasts_beyond(at) || (creep::moves() && CREEPING.lasts_beyond(at))
}

/// A task has taken a call that moves, or is to end the motion of another one; its number. A fault counts from here.
pub(crate) fn order_begins() -> u32 {
    let number = Record::change(|record| {
        record.marked = now();
        record.orders += 1;
        record.orders
    });
    defmt::info!("order {=u32} begins", number);
    number
}

/// A turn of the executor begins; when, if the lease is live. Other turns delay nothing: the longest of all are those
/// of a proof, on a link that is not live yet, and the one that reads everything that comes with a new link.
pub(crate) fn turn() -> Option<Instant> {
    let now = now();
    lasts_beyond(now).then_some(now)
}

/// That turn has ended.
pub(crate) fn turned(began: Option<Instant>) {
    if let Some(began) = began {
        let turn = now().since(began);
        Record::change(|record| record.turn = record.turn.max(turn));
    }
}

/// The processor is going to sleep, or has run the interrupts that woke it.
pub(crate) fn sleeps(it_does: bool) {
    Record::change(|record| record.sleeps = it_does);
}

/// The motors' interrupt looks: has the lease of what moves become longer since the last tick?
pub fn tick() {
    Record::change(|record| {
        let now = now();
        if record.reaches <= now || moves_beyond(record.reaches) {
            record.reaches = record.reaches.max(now);
            while moves_beyond(record.reaches) {
                record.reaches = record.reaches + STEP;
                record.renewed = record.ticked;
            }
        }
        let gap = now.since(record.ticked);
        let tick = CoreDuration::from_micros(TICK.as_micros());
        record.late = if record.sleeps {
            CoreDuration::from_micros(gap.as_micros().saturating_sub(tick.as_micros()))
        } else {
            CoreDuration::ZERO
        };
        record.ticked = now;
    });
}

/// A frame was taken from the network's controller. What is in it is sealed, and told by its length: renewals and
/// keep-alives come in datagrams as well, and say nothing of when a stop came.
pub fn received(frame: &[u8]) {
    const IPV4: [u8; 2] = [8, 0];
    const UDP: u8 = 17;
    /// The call of `stop`, and the release of an order.
    const ENDS: [usize; 2] = [125, 97];
    let is_own = frame.first().is_some_and(|first| first & 1 == 0);
    if ENDS.contains(&frame.len()) && is_own && frame.get(12..14) == Some(&IPV4) && frame.get(23) == Some(&UDP) {
        Record::change(|record| record.heard = record.heard.or(Some(now())));
    }
}

/// The motors' interrupt has looked: the latest moment before its next look, as an interrupt of a bumper may have it.
pub fn ticked() {
    // There is no swap on this processor; a press that is asked for in between is seen with the next tick.
    if PRESSING.load(Ordering::Acquire) {
        PRESSING.store(false, Ordering::Release);
        Record::change(|record| record.marked = now());
        cara_vehicle::bumper(true);
    }
}

/// The motors were, and are, on.
pub fn switched(before: bool, on: bool) {
    if before == on {
        return;
    }
    let now = now();
    let Record { marked, heard, renewed, turn, late, .. } = Record::change(|record| *record);
    if on {
        defmt::info!("motors on");
        return;
    }
    let [marked, renewed] = [marked, renewed].map(|sign| now.since(sign).as_micros());
    let heard = heard.map_or(0, |heard| now.since(heard).as_micros());
    let [turn, late] = [turn, late].map(CoreDuration::as_micros);
    defmt::info!(
        "motors off: announced={=u64} renewed={=u64} heard={=u64} late={=u64} turn={=u64}",
        marked,
        renewed,
        heard,
        late,
        turn
    );
}
