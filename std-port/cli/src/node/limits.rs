//! `[constraints]` and `[capacities]`: which values a unit can hold.

use std::ops::{Range, RangeInclusive};

use cara_std::{Capacities, Constraints, Duration, Scheduling};

use super::black_box::Budget;
use super::file::{self, Maybe, Role};
use super::mistake::Mistake;
use super::values::{Size, Time};

/// Longest message that a Linux unit takes.
const LONGEST_MESSAGE: u64 = 256 * 1024;
/// Longest that a Linux unit polls before it sleeps.
const LONGEST_SPIN: Duration = Duration::from_millis(1);
/// Chunks: an emergency fits into the shortest, and none is longer than what the protocol allows.
const CHUNKS: RangeInclusive<u64> = 320..=4096;
/// Entries of a table, so that no mistake asks for more memory than there is.
const ENTRIES: RangeInclusive<u64> = 1..=65_535;
/// Bytes of a table of signatures, likewise.
const SIGNATURE_BYTES: RangeInclusive<u64> = 512..=16 * 1024 * 1024;

/// These constraints with what the file says.
pub(super) fn constraints(
    table: &file::Constraints,
    mut limits: Constraints,
    mistakes: &mut Vec<Mistake>,
) -> Constraints {
    set_time(&mut limits.request_timeout, &table.request_timeout, Duration::from_millis(1), mistakes);
    set_time(&mut limits.minimum_interval, &table.minimum_interval, Duration::ZERO, mistakes);
    set_time(&mut limits.keep_alive, &table.keep_alive, Duration::from_millis(1), mistakes);
    set(&mut limits.maximum_nodes, &table.maximum_nodes, 1..=65_535, mistakes);
    set(&mut limits.message_size, &table.message_size, 16..=LONGEST_MESSAGE, mistakes);
    set(&mut limits.chunk_size, &table.chunk_size, CHUNKS, mistakes);
    set(&mut limits.calls_per_peer, &table.calls_per_peer, 1..=65_535, mistakes);
    if let Some(scheduling) = &table.scheduling {
        limits.scheduling = match scheduling.get_ref() {
            file::Scheduling::Deadline => Scheduling::EarliestDeadline,
            file::Scheduling::Fifo => Scheduling::Fifo,
            file::Scheduling::Admission => Scheduling::Admission,
        };
    }
    limits
}

/// The constraints of a unit on Linux that says nothing about them.
pub(super) fn defaults(role: Role, stands_by: bool) -> Constraints {
    let Constraints { message_size, chunk_size, .. } = Constraints::M_UNIT;
    match role {
        Role::MUnit if stands_by => Constraints::STANDBY,
        Role::MUnit => Constraints::M_UNIT,
        Role::SUnit => Constraints { message_size, chunk_size, ..Constraints::S_UNIT },
    }
}

/// The sizes of the unit's tables with what the file says.
pub(super) fn capacities(table: &file::Capacities, mistakes: &mut Vec<Mistake>) -> Capacities {
    let mut sizes = Capacities::default();
    let entries = [
        (&mut sizes.functions, &table.functions),
        (&mut sizes.published_to_one, &table.published_to_one),
        (&mut sizes.their_functions, &table.their_functions),
        (&mut sizes.calls_in_flight, &table.calls_in_flight),
        (&mut sizes.calls_running, &table.calls_running),
        (&mut sizes.pending_links, &table.pending_links),
        (&mut sizes.message_buffers, &table.message_buffers),
    ];
    entries.into_iter().for_each(|(place, value)| set(place, value, ENTRIES, mistakes));
    set(&mut sizes.signature_bytes, &table.signature_bytes, SIGNATURE_BYTES, mistakes);
    set(&mut sizes.their_signature_bytes, &table.their_signature_bytes, SIGNATURE_BYTES, mistakes);
    sizes
}

/// How long a thread polls before it sleeps, with what the file says.
pub(super) fn spin(value: &Maybe<Time>, mistakes: &mut Vec<Mistake>) -> Duration {
    let Some(value) = value else { return Duration::ZERO };
    let span = value.get_ref().0;
    if span > LONGEST_SPIN {
        mistakes.push(Mistake::new(value.span(), "this time is too long", "write a time of at most 1 ms"));
    }
    span
}

/// What the black box may take with what the file says.
pub(super) fn black_box(table: &file::BlackBox, mistakes: &mut Vec<Mistake>) -> Budget {
    let mut budget = Budget::default();
    set(&mut budget.keep, &table.keep, 0..=1000, mistakes);
    set(&mut budget.size, &table.size, 64 * 1024..=256 << 20, mistakes);
    budget
}

fn set<T: TryFrom<u64>>(place: &mut T, value: &Maybe<Size>, range: RangeInclusive<u64>, mistakes: &mut Vec<Mistake>) {
    let Some(value) = value else { return };
    let number = value.get_ref().0;
    match T::try_from(number).ok().filter(|_| range.contains(&number)) {
        Some(fitting) => *place = fitting,
        None => mistakes.push(outside(value.span(), number, &range)),
    }
}

fn outside(span: Range<usize>, number: u64, range: &RangeInclusive<u64>) -> Mistake {
    let what = format!("{number} is outside what this unit can hold");
    Mistake::new(span, what, format!("write a number from {} to {}", range.start(), range.end()))
}

fn set_time(place: &mut Duration, value: &Maybe<Time>, least: Duration, mistakes: &mut Vec<Mistake>) {
    let Some(value) = value else { return };
    *place = value.get_ref().0;
    if *place < least {
        let help = format!("write a time of at least {} us", least.as_micros());
        mistakes.push(Mistake::new(value.span(), "this time is too short", help));
    }
}

#[cfg(test)]
mod tests {
    use cara_std::{CommunicationSystem, Error, Interfaces, Unit};

    use super::*;

    fn read(text: &str) -> Result<Constraints, Vec<Mistake>> {
        let mut mistakes = Vec::new();
        let limits = constraints(&toml::from_str(text).unwrap(), Constraints::M_UNIT, &mut mistakes);
        if mistakes.is_empty() { Ok(limits) } else { Err(mistakes) }
    }

    /// Whether the file's checks and the library's are the same ones.
    #[test]
    fn the_library_takes_what_a_file_may_say_and_nothing_else() {
        let system = CommunicationSystem::builder("limits", 1).unwrap().interfaces(Interfaces::Loopback).insecure();
        let system = system.fleet(std::process::id()).build().unwrap();
        let base = Constraints::M_UNIT;
        let cases = [
            ("maximum_nodes = 1", Some(Constraints { maximum_nodes: 1, ..base })),
            ("maximum_nodes = 0", None),
            ("message_size = \"256KiB\"", Some(Constraints { message_size: 256 * 1024, ..base })),
            ("message_size = 262_145", None),
            ("message_size = 16", Some(Constraints { message_size: 16, ..base })),
            ("message_size = 15", None),
            ("request_timeout = \"999us\"", None),
            ("chunk_size = 320", Some(Constraints { chunk_size: 320, ..base })),
            ("chunk_size = 4096", Some(Constraints { chunk_size: 4096, ..base })),
            ("chunk_size = 319", None),
            ("chunk_size = \"5KiB\"", None),
            ("keep_alive = \"1ms\"", Some(Constraints { keep_alive: Duration::from_millis(1), ..base })),
            ("keep_alive = \"999us\"", None),
            ("calls_per_peer = 1", Some(Constraints { calls_per_peer: 1, ..base })),
            ("calls_per_peer = 0", None),
            ("scheduling = \"fifo\"", Some(Constraints { scheduling: Scheduling::Fifo, ..base })),
            ("scheduling = \"deadline\"", Some(base)),
            ("scheduling = \"admission\"", Some(Constraints { scheduling: Scheduling::Admission, ..base })),
            ("minimum_interval = 0", Some(base)),
        ];
        for (text, expected) in cases {
            assert_eq!(read(text).ok(), expected, "{text}");
            if let Some(limits) = expected {
                assert_eq!(system.set_constraints(limits), Ok(()), "{text}");
            }
        }
        let refused = [
            Constraints { maximum_nodes: 0, ..base },
            Constraints { message_size: 262_145, ..base },
            Constraints { message_size: 15, ..base },
            Constraints { request_timeout: Duration::from_micros(999), ..base },
            Constraints { chunk_size: 319, ..base },
            Constraints { chunk_size: 5120, ..base },
            Constraints { keep_alive: Duration::from_micros(999), ..base },
            Constraints { calls_per_peer: 0, ..base },
        ];
        for limits in refused {
            assert_eq!(system.set_constraints(limits), Err(Error::BadConstraint), "{limits:?}");
        }
    }

    #[test]
    fn the_defaults_are_those_of_the_library() {
        let system = CommunicationSystem::builder("limits", 1).unwrap().interfaces(Interfaces::Loopback).insecure();
        assert_eq!(system.build().unwrap().constraints(), defaults(Role::MUnit, false));
        let unit = Unit::builder("limits", 1, "manager", 1).unwrap().interfaces(Interfaces::Loopback).insecure();
        assert_eq!(unit.build().unwrap().constraints(), defaults(Role::SUnit, false));
        assert_eq!(capacities(&file::Capacities::default(), &mut Vec::new()), Capacities::default());
    }
}
