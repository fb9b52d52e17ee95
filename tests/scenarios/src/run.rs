//! Running scenarios: once on a port, or for a seed with the failure caught.

use std::cell::RefCell;
use std::collections::BTreeMap;
use std::panic::{AssertUnwindSafe, catch_unwind};
use std::sync::Once;

use cara_core::config::Mode;
use cara_core::time::Duration;

use crate::{FaultProfile, Port, Scenario, World, ports};

/// What a run injected, reached and measured.
#[derive(Clone, Debug, Default)]
pub struct Report {
    /// Faults by name.
    pub faults: BTreeMap<&'static str, u64>,
    /// Counters of all units, and states that the scenario noted, by name.
    pub states: BTreeMap<String, u64>,
    /// Spans by name.
    pub measured: BTreeMap<&'static str, Vec<Duration>>,
    /// Of all that could be seen of the runs: their bytes, events and times. Zero on ports where two runs differ.
    pub trace: u64,
}

impl Report {
    /// Adds another run's.
    pub fn merge(&mut self, other: Self) {
        for (name, count) in other.faults {
            *self.faults.entry(name).or_default() += count;
        }
        for (name, count) in other.states {
            *self.states.entry(name).or_default() += count;
        }
        for (name, spans) in other.measured {
            self.measured.entry(name).or_default().extend(spans);
        }
        // Whatever order the runs end in.
        self.trace = self.trace.wrapping_add(other.trace);
    }

    /// Whether a fault or state of this name was counted.
    pub fn has(&self, name: &str) -> bool {
        self.faults.contains_key(name) || self.states.contains_key(name)
    }
}

/// What a handler says that panics because its scenario wants that.
pub(crate) const ON_PURPOSE: &str = "on purpose";

/// Why a run failed.
pub type Failure = String;

/// Runs a scenario once; a broken assertion comes back as text.
pub fn once(scenario: &Scenario, port: Port, seed: u64, profile: FaultProfile) -> Result<Report, Failure> {
    catch_quietly(|| {
        let mut world = match port {
            Port::Simulator => ports::simulator(seed, profile, Mode::Plain),
            Port::Secured => ports::simulator(seed, profile, Mode::Secured),
            Port::Linux => ports::linux(scenario.needs),
            Port::Embassy => ports::embassy(seed, profile, scenario.needs),
            Port::Line => ports::line(seed, profile),
        };
        (scenario.run)(&mut *world);
        world.report()
    })
}

thread_local! {
    static CAUGHT: RefCell<Option<String>> = const { RefCell::new(None) };
    static CATCHING: RefCell<bool> = const { RefCell::new(false) };
}

/// Runs `act` with panics of this thread kept as text instead of printed.
fn catch_quietly<T>(act: impl FnOnce() -> T) -> Result<T, Failure> {
    static HOOK: Once = Once::new();
    HOOK.call_once(|| {
        let usual = std::panic::take_hook();
        std::panic::set_hook(Box::new(move |info| {
            if info.payload_as_str() == Some(ON_PURPOSE) {
                return;
            }
            if CATCHING.with_borrow(|catching| *catching) {
                CAUGHT.set(Some(info.to_string()));
            } else {
                usual(info);
            }
        }));
    });
    CATCHING.set(true);
    CAUGHT.take();
    let result = catch_unwind(AssertUnwindSafe(act));
    CATCHING.set(false);
    result.map_err(|_| CAUGHT.take().unwrap_or_else(|| "panicked".to_owned()))
}

impl dyn World + '_ {
    /// Whether it runs on virtual time.
    pub fn is_virtual(&self) -> bool {
        self.slack().is_some()
    }

    /// By how much what is due may be late because of the port itself; unknown on real time.
    pub fn slack(&self) -> Option<Duration> {
        match self.port() {
            Port::Simulator | Port::Secured => Some(Duration::ZERO),
            Port::Embassy => Some(Duration::from_millis(1)),
            // A few frames.
            Port::Line => Some(Duration::from_millis(10)),
            Port::Linux => None,
        }
    }
}
