//! Hearts of control loops.

use std::fmt;
use std::sync::{Arc, Mutex};

use cara_core::services::heart::{self, Beats, Renew};
use cara_core::time::Duration;

use crate::clock::Clock;
use crate::engine::{Answered, Engine};
use crate::locks::lock;

/// Words of hearts that are not in use. A session may look at one at any time, so they are never freed.
static FREE: Mutex<Vec<&'static heart::Heart>> = Mutex::new(Vec::new());

/// Shows that one loop of the program runs: [`Handle::heart`](crate::Handle::heart). Orders that name it are renewed only
/// while the loop beats it, and end at once when it is dropped.
///
/// It belongs to one loop and can't be cloned: a beat of another loop would hide that this one hangs.
///
/// ```no_run
/// use cara_std::{Duration, Parameters};
/// # let depot = cara_std::CommunicationSystem::new("depot", 1)?;
/// # fn is_still_wanted() -> bool { true }
///
/// let mut heart = depot.heart(Duration::from_millis(100));
/// let mut position = Parameters::new();
/// position.add_int("position", 2)?;
/// depot.s_unit("agv")?.call("go_to", &mut position).renewing(heart.renew()).wait()?;
/// while is_still_wanted() {
///     heart.beat();
///     std::thread::sleep(std::time::Duration::from_millis(50));
/// }
/// # Ok::<(), Box<dyn std::error::Error>>(())
/// ```
pub struct Heart {
    word: &'static heart::Heart,
    beats: Beats,
    clock: Clock,
    /// Releases what names it.
    release: Box<dyn Fn(Beats) + Send>,
}

impl Heart {
    pub(crate) fn new<T: Send + 'static>(engine: &Arc<Engine<T>>, period: Duration) -> Self {
        let word = lock(&FREE).pop().unwrap_or_else(|| Box::leak(Box::new(heart::Heart::new(period))));
        word.set_period(period);
        let unit = Arc::downgrade(engine);
        let release = move |beats| {
            if let Some(engine) = unit.upgrade() {
                engine.on_each_link(|session, cx| session.unrecorded("a heart has stopped").release_beats(cx, beats));
            }
        };
        Self { word, beats: word.beats(), clock: engine.driver.clock(), release: Box::new(release) }
    }

    /// The loop has come round.
    pub fn beat(&mut self) {
        self.word.beat(self.clock.now());
    }

    /// For the calls of this loop: their leases are renewed as of its last beat.
    pub const fn renew(&self) -> Renew {
        Renew::Heart(self.beats)
    }
}

impl fmt::Debug for Heart {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.debug_struct("Heart").finish_non_exhaustive()
    }
}

impl Drop for Heart {
    fn drop(&mut self) {
        self.word.stop();
        (self.release)(self.beats);
        lock(&FREE).push(self.word);
    }
}

/// Dropping this guard stops what the call has started: [`Call::hold`](crate::Call::hold).
#[must_use = "dropped, it is released at once"]
pub struct Hold<T: Send + 'static = ()> {
    pub(crate) engine: Arc<Engine<T>>,
    pub(crate) call: Answered,
}

impl<T: Send + 'static> Hold<T> {
    /// Whether the call's order is still held. Not once its link has ended, or the node has ended it, which
    /// [`UnitEvent::LeaseEnded`](crate::UnitEvent::LeaseEnded) reports too.
    pub fn is_held(&self) -> bool {
        let link = self.call.link.lock();
        link.session.is_live() && link.session.holds(self.call.id)
    }
}

impl<T: Send + 'static> Drop for Hold<T> {
    fn drop(&mut self) {
        self.engine.give_up_call(&self.call.link, self.call.id);
    }
}

impl<T: Send + 'static> fmt::Debug for Hold<T> {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.debug_struct("Hold").field("is_held", &self.is_held()).finish()
    }
}
