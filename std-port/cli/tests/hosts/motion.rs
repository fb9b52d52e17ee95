//! Whether the vehicle stands in time.

use std::time::{Duration, Instant};

/// The lease of the order.
pub(crate) const LEASE: Duration = Duration::from_secs(1);
/// The vehicle may stand so much later, as processes share few processors here.
const MARGIN: Duration = Duration::from_millis(500);

/// Why the vehicle has to stand.
#[derive(Clone, Copy, Debug)]
pub(crate) enum Why {
    /// Its manager is silent.
    Silence,
    /// It stood still itself, for longer than the lease.
    Thawed,
}

/// What the vehicle does, and has to do.
#[derive(Default)]
pub(crate) struct Motion {
    pub(crate) drives: bool,
    /// Since when it has to stand, and until when it may move on.
    due: [Option<(Instant, Instant)>; 2],
    /// How long it took until it stood.
    pub(crate) longest: Option<Duration>,
    /// How often it moved on.
    pub(crate) overdue: usize,
}

impl Motion {
    /// From here on the vehicle has to stand, if it moves.
    pub(crate) fn must_stand(&mut self, why: Why, now: Instant) {
        let within = if matches!(why, Why::Silence) { LEASE } else { Duration::ZERO };
        if self.drives {
            self.due[why as usize].get_or_insert((now, now + within + MARGIN));
        }
    }

    /// Its manager speaks again, or the vehicle itself stands still.
    pub(crate) fn may_move(&mut self) {
        self.due[Why::Silence as usize] = None;
    }

    pub(crate) fn began(&mut self) {
        self.drives = true;
        self.due = [None; 2];
    }

    pub(crate) fn stood(&mut self, at: Instant) {
        self.look(at);
        let longest = self.due.iter().flatten().map(|(since, _)| at.saturating_duration_since(*since)).max();
        self.longest = self.longest.max(longest);
        self.ended();
    }

    /// Its process has ended, and with it all of this.
    pub(crate) fn ended(&mut self) {
        self.drives = false;
        self.due = [None; 2];
    }

    /// Nothing that it did until now is unknown.
    pub(crate) fn look(&mut self, now: Instant) {
        for due in &mut self.due {
            self.overdue += usize::from(due.take_if(|(_, until)| now > *until).is_some());
        }
    }
}
