//! What services of a simulated unit move, and the hearts of loops that want it moved.

use std::cell::Cell;
use std::fmt;
use std::rc::Rc;

use cara_core::services::heart::{self, Beats, Renew};
use cara_core::services::lease::{Latch, Lease};
use cara_core::time::{Duration, Instant};

use super::handle::UnitHandle;

/// What several services move: an order of one of them takes the place of any other's, and a stop ends it. It belongs to one
/// life of its unit.
///
/// ```
/// use cara_core::time::Duration;
/// use cara_sim::{Actuator, Service, World};
///
/// let world = World::new(1);
/// world.s_unit("agv", 7).joins("depot", 1).program(|unit| {
///     let drive = Actuator::new(|_| println!("the drive stands"));
///     let moves = || Service::new(|_, _| Ok(())).moves(&drive, Duration::from_millis(400));
///     let functions = unit.my_function_list();
///     functions.add_service("go_to(position: int[2])", moves()).unwrap();
///     functions.add_service("dock(station: int)", moves()).unwrap();
///     functions.add_service("halt()", Service::new(|_, _| Ok(())).stops(&drive)).unwrap();
///     functions.add_service("go_on()", Service::new(|_, _| Ok(())).resets(&drive)).unwrap();
///     unit.publish_my_function_list().unwrap();
/// });
/// ```
#[derive(Clone)]
pub struct Actuator(Rc<Moved>);

struct Moved {
    word: Lease,
    safe: Box<dyn Fn(&UnitHandle)>,
    /// It was stopped, and the unit has not looked yet which of its links had the order.
    stopped: Cell<bool>,
    /// When it was stopped last, on the unit's clock.
    stopped_at: Cell<Option<Instant>>,
}

impl Actuator {
    /// `safe` runs once for each order that ends without being replaced or finished, before anything else the unit does.
    pub fn new(safe: impl Fn(&UnitHandle) + 'static) -> Self {
        Self(Rc::new(Moved {
            word: Lease::new(),
            safe: Box::new(safe),
            stopped: Cell::default(),
            stopped_at: Cell::default(),
        }))
    }

    /// Whether it may move now, on behalf of whichever order has it.
    pub fn is_live(&self, unit: &UnitHandle) -> bool {
        self.word().is_live(unit.clock())
    }

    /// The vehicle's own stop, as of a bumper: the order ends, and none begins until it is reset. Callers are told `reason`.
    pub fn inhibit(&self, unit: &UnitHandle, reason: u16) {
        self.stop(unit.clock(), Latch { by: 0, reason });
        unit.each_link(|_, _, _| ());
    }

    /// Lets it move again.
    pub fn reset(&self, unit: &UnitHandle) {
        let now = unit.clock();
        self.word().reset(now, now);
    }

    /// What inhibits it.
    pub fn latch(&self) -> Option<Latch> {
        self.word().latch()
    }

    /// When it was stopped last, in virtual time. The handler of the call that stops it may have waited since.
    pub fn stopped_at(&self, unit: &UnitHandle) -> Option<Instant> {
        self.0.stopped_at.get().map(|at| unit.now() - unit.clock().since(at))
    }

    pub(super) fn word(&self) -> &Lease {
        &self.0.word
    }

    pub(super) fn make_safe(&self, unit: &UnitHandle) {
        (self.0.safe)(unit);
    }

    pub(super) fn stop(&self, now: Instant, latch: Latch) {
        self.word().inhibit(now, latch);
        self.0.stopped.set(true);
        self.0.stopped_at.set(Some(now));
    }

    /// Whether it was stopped since this was asked last.
    pub(super) fn take_stopped(&self) -> bool {
        self.0.stopped.take()
    }
}

impl fmt::Debug for Actuator {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.debug_struct("Actuator").field("latch", &self.latch()).finish_non_exhaustive()
    }
}

/// Shows that one loop of a unit runs: what names it goes on while the loop beats it. Dropped, it releases what names it.
#[derive(Debug)]
pub struct Heart {
    word: &'static heart::Heart,
    unit: UnitHandle,
}

impl UnitHandle {
    /// A heart that beats at least once in `period`, which is half of the leases of what names it, or less.
    pub fn heart(&self, period: Duration) -> Heart {
        // A session may look at it at any time: some bytes that stay until the end of the test.
        Heart { word: Box::leak(Box::new(heart::Heart::new(period))), unit: self.clone() }
    }
}

impl Heart {
    /// The loop has come round.
    pub fn beat(&mut self) {
        self.word.beat(self.unit.clock());
    }

    /// For the calls of this loop.
    pub fn renew(&self) -> Renew {
        Renew::Heart(self.beats())
    }

    fn beats(&self) -> Beats {
        self.word.beats()
    }
}

impl Drop for Heart {
    fn drop(&mut self) {
        let beats = self.beats();
        self.word.stop();
        if self.unit.exists() {
            self.unit.each_link(|links, network, index| {
                links.with(network, index, |session, cx| session.release_beats(cx, beats));
            });
        }
    }
}
