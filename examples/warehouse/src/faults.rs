//! What is broken in a run, and when: the same for a seed. Which vehicle it meets is drawn when it happens, from those that move.

use std::time::Duration;

/// A fault.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Fault {
    /// One vehicle is stopped, and goes on a while later.
    Stop,
    /// All are.
    StopAll,
    /// A vehicle is switched off, and on a while later.
    Off,
    /// A vehicle has a fault, for which the mechanic comes.
    Fail,
    /// The manager hangs for a while: its connections stay open.
    FreezeManager,
    /// The manager is killed, and started a while later.
    KillManager,
    /// Another manager takes over.
    TakeOver,
    /// Some links are cut, or lose much, for a while.
    Cut,
}

/// Each kind with the least number of them in a run, and the seconds between two in a long one.
const KINDS: [(Fault, u32, f64); 7] = [
    (Fault::Stop, 24, 3.0),
    (Fault::StopAll, 1, 120.0),
    (Fault::Off, 7, 15.0),
    (Fault::Fail, 2, 30.0),
    (Fault::FreezeManager, 1, 180.0),
    (Fault::KillManager, 1, 150.0),
    (Fault::TakeOver, 1, 210.0),
];
/// As above, in a run that cuts links.
const CUTS: (Fault, u32, f64) = (Fault::Cut, 1, 40.0);
/// A soak looks for what grows while a manager lives: they are killed less often, and in its first part only.
const SOAK_KILLS: f64 = 4.0;
const SOAK_KILLS_PART: std::ops::Range<f64> = 0.06..0.2;
/// And where vehicles start again and again: the memory of a process fills up over the first 30 starts of each of its vehicles.
const SOAK_STARTS: f64 = 0.03;
/// The part of a run in which things are broken; the rest is left to finish.
pub(crate) const PART: std::ops::Range<f64> = 0.06..0.86;

/// The faults of a run that takes so long, in the order of their times.
pub fn schedule(seed: u64, span: Duration, is_soak: bool) -> Vec<(Duration, Fault)> {
    let mut rng = fastrand::Rng::with_seed(seed);
    let mut faults = Vec::new();
    for (index, (fault, least, every)) in KINDS.into_iter().chain(is_soak.then_some(CUTS)).enumerate() {
        let every = match fault {
            Fault::KillManager | Fault::TakeOver if is_soak => every * SOAK_KILLS,
            Fault::Off if is_soak => every * SOAK_STARTS,
            _ => every,
        };
        let count = least.max((span.as_secs_f64() / every) as u32);
        let kills = matches!(fault, Fault::KillManager | Fault::TakeOver);
        let parts = if is_soak && kills { SOAK_KILLS_PART } else { PART };
        let width = (parts.end - parts.start) / f64::from(count);
        // Those that happen once are kept apart: each has its own place in the run.
        let place = (index as f64 + 0.5) / KINDS.len() as f64;
        for number in 0..count {
            let within = if count == 1 { place } else { rng.f64() };
            let part = parts.start + width * (f64::from(number) + within);
            faults.push((span.mul_f64(part), fault));
        }
    }
    faults.sort_by_key(|(at, _)| *at);
    faults
}

#[cfg(test)]
mod tests {
    use super::{Fault, KINDS, schedule};
    use std::time::Duration;

    #[test]
    fn a_short_run_has_each_often_enough() {
        let span = Duration::from_secs(45);
        let faults = schedule(1, span, false);
        assert_eq!(faults, schedule(1, span, false));
        for (fault, least, _) in KINDS {
            let count = faults.iter().filter(|(_, other)| *other == fault).count();
            assert_eq!(count, least as usize, "{fault:?}");
        }
        assert!(faults.is_sorted_by_key(|(at, _)| *at) && faults.iter().all(|(at, _)| *at < span.mul_f64(0.87)));
        let at = |wanted| faults.iter().find(|(_, fault)| *fault == wanted).map(|(at, _)| *at).unwrap();
        assert!(at(Fault::TakeOver) - at(Fault::KillManager) > Duration::from_secs(5));
    }

    #[test]
    fn a_soak_cuts_links_kills_seldom_and_starts_often() {
        let count = |is_soak, fault| {
            let faults = schedule(1, Duration::from_secs(7_200), is_soak);
            faults.iter().filter(|(_, other)| *other == fault).count()
        };
        assert_eq!((count(true, Fault::Cut), count(false, Fault::Cut)), (180, 0));
        assert_eq!((count(true, Fault::KillManager), count(false, Fault::KillManager)), (12, 48));
        assert_eq!((count(true, Fault::Off), count(false, Fault::Off)), (16_000, 480));
        let faults = schedule(1, Duration::from_secs(7_200), true);
        let kills = faults.iter().filter(|(_, fault)| matches!(fault, Fault::KillManager | Fault::TakeOver));
        assert!(
            kills.map(|(at, _)| *at).max() < Some(Duration::from_secs(1_500)),
            "managers live for an hour and a half"
        );
    }

    #[test]
    fn a_long_run_has_more() {
        let faults = schedule(1, Duration::from_secs(600), false);
        assert_eq!(faults.iter().filter(|(_, fault)| *fault == Fault::Stop).count(), 200);
        assert_eq!(faults.iter().filter(|(_, fault)| *fault == Fault::KillManager).count(), 4);
    }
}
