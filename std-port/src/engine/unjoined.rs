//! A vehicle without its manager says why in the log: once, and again when the reason is another one.

use std::net::SocketAddr;
use std::sync::Mutex;

use cara_core::counters::Counters;
use cara_core::distribution::connection_handler::NodeCounter;
use cara_core::distribution::identity::{Identity, Role};
use cara_core::error::{CloseReason, Refusal};
use cara_core::time::{Duration, Instant};

use super::hub::SharedHub;
use super::link::LinkCell;
use crate::event::UnitEvent;
use crate::locks::lock;

/// A start, and a manager's restart, take less: by then four searches at least have gone out, since the pauses before them are
/// twice 0.25, 0.5, 1 and 2 s at most, and a dial that nothing answers has been given up, after 2 s.
const PATIENCE: Duration = Duration::from_secs(10);
/// How often the reason is checked from then on.
const LOOK: Duration = Duration::from_secs(3);
/// What happened longer ago is no reason: two dials are at most 16 s apart, and each takes 2 s.
const FRESH: Duration = Duration::from_secs(30);
/// What comes from units that this one does not take, and what is said of it.
const STRANGE: [(NodeCounter, &str); 5] = [
    (NodeCounter::DatagramFleet, "units of another fleet"),
    (NodeCounter::DatagramVersion, "units of another version"),
    (NodeCounter::DatagramMagic, "units of the other mode, or none of CARA's"),
    (NodeCounter::DatagramForged, "units with other keys of the fleet"),
    (NodeCounter::DatagramNotForUs, "a manager without the key of this pair"),
];

#[derive(Debug, Default)]
pub(super) struct Unjoined(Mutex<State>);

#[derive(Debug, Default)]
struct State {
    /// Since when the manager is missing.
    since: Option<Instant>,
    /// What had been counted by then.
    before: Option<[u64; STRANGE.len()]>,
    /// How the last dial ended below.
    dial: Option<std::io::Error>,
    /// The last link that did not join.
    failed: Option<(Instant, String)>,
    /// Another manager that is heard.
    other: Option<Identity>,
    /// What was warned of last; in it `None` that nothing was heard.
    warned: Option<Option<String>>,
}

impl Unjoined {
    /// A connection could not be opened, or ends without having joined.
    pub(super) fn dial_ended(&self, error: Option<std::io::Error>) {
        lock(&self.0).dial = error;
    }

    /// Keeps why a link did not join, and ends the wait with one that did. Whether the manager was lost: then it is time to look.
    pub(super) fn note(&self, now: Instant, event: &UnitEvent) -> bool {
        match event {
            UnitEvent::Joined { peer } if peer.role() == Role::MUnit => {
                let before = std::mem::take(&mut *lock(&self.0));
                if before.warned.is_some() {
                    tracing::info!(manager = %peer, "has joined its manager");
                }
            }
            UnitEvent::Left { peer, .. } if peer.role() == Role::MUnit => {
                lock(&self.0).since = Some(now);
                return true;
            }
            UnitEvent::NotJoined { address, reason, .. } => {
                let mut state = lock(&self.0);
                state.failed = Some((now, failed(*address, *reason, state.dial.take())));
            }
            _ => {}
        }
        false
    }

    /// Warns if it is time; returns when to look again.
    pub(super) fn warn(&self, now: Instant, hub: &SharedHub, discovery_port: u16) -> Instant {
        let (identity, is_alone, counted, heard, other) = {
            let node = &hub.lock().hub.node;
            if node.identity().role() != Role::SUnit {
                return Instant::FAR_FUTURE;
            }
            let fresh = || node.findings().filter(|finding| finding.at + FRESH > now);
            let full = fresh().find(|finding| finding.refusal == Refusal::Full);
            let other = fresh().find(|finding| finding.refusal == Refusal::WrongManager);
            let heard = full.map(|finding| refused(finding.address, finding.refusal));
            let other = other.and_then(|finding| finding.identity.clone());
            (node.identity().clone(), node.connected() == 0, counts(&node.counters), heard, other)
        };
        let mut state = lock(&self.0);
        if !is_alone {
            // The event of a loss comes before the hub knows of it.
            state.since = state.since.filter(|since| now < *since + LOOK);
            return state.since.map_or(Instant::FAR_FUTURE, |_| now + LOOK);
        }
        let (since, before) = (*state.since.get_or_insert(now), *state.before.get_or_insert(counted));
        if now < since + PATIENCE {
            return since + PATIENCE;
        }
        let failed = state.failed.as_ref().filter(|(at, _)| *at + FRESH > now).map(|(_, text)| text.clone());
        // The first of several others stays: they are heard by turns, and the reason is the same.
        state.other = state.other.take().or(other);
        // Other units that are heard are no reason of their own: a doctor that listens here would count as one.
        let reason = failed.or(heard);
        if state.warned.as_ref() != Some(&reason) {
            let silence = || silence(discovery_port, before, counted, state.other.as_ref());
            let text = reason.clone().unwrap_or_else(silence);
            tracing::warn!(unit = %identity, reason = %text, "has no manager");
            state.warned = Some(reason);
        }
        now + LOOK
    }
}

/// How the dial of a link ended below, where that is known.
pub(super) fn dial_error(link: &LinkCell, reason: CloseReason) -> Option<std::io::Error> {
    match reason {
        CloseReason::DialFailed => link.stream.dial_error(),
        // What is not connected by then has not been answered.
        CloseReason::HelloTimeout if link.stream.peer_address().is_none() => Some(std::io::ErrorKind::TimedOut.into()),
        _ => None,
    }
}

fn failed(address: SocketAddr, reason: CloseReason, dial: Option<std::io::Error>) -> String {
    match dial {
        Some(error) => format!("the connection to its manager at {address} could not be opened: {error}"),
        None => match reason {
            CloseReason::Refused(refusal) => refused(address, refusal),
            reason => format!("{address}: {reason}"),
        },
    }
}

/// The same, whether a search was answered so or a link.
fn refused(address: SocketAddr, refusal: Refusal) -> String {
    format!("{}: {refusal}", address.ip())
}

fn counts(counters: &Counters<NodeCounter, { NodeCounter::COUNT }>) -> [u64; STRANGE.len()] {
    STRANGE.map(|(counter, _)| counters.value(counter))
}

fn silence(port: u16, before: [u64; STRANGE.len()], counted: [u64; STRANGE.len()], other: Option<&Identity>) -> String {
    let rose = STRANGE.iter().zip(before).zip(counted).filter(|((_, before), counted)| counted > before);
    let strange = rose.map(|(((_, what), _), _)| (*what).to_owned());
    let heard: Vec<String> = other.map(|other| format!("the manager {other}")).into_iter().chain(strange).collect();
    let but = if heard.is_empty() { String::new() } else { format!(", but of {}", heard.join(", ")) };
    format!(
        "nothing was heard of its manager{but}: does it run, with this name, id and fleet, and does UDP port {port} pass?"
    )
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_reason_is_the_same_text_until_it_is_another_one() {
        let none = [0; STRANGE.len()];
        let alone = silence(21_971, none, none, None);
        assert_eq!(alone, silence(21_971, [4; STRANGE.len()], [4; STRANGE.len()], None));
        let other = Identity::m_unit("bos", 1).unwrap();
        let text = silence(21_971, none, [9, 0, 0, 0, 0], Some(&other));
        assert!(text.contains(", but of the manager bos/1, units of another fleet: does"), "{text}");
        let at = |port| SocketAddr::from(([10, 0, 0, 1], port));
        let full = CloseReason::Refused(Refusal::Full);
        assert_eq!(failed(at(7_000), full, None), refused(at(21_971), Refusal::Full));
        let timed_out = failed(at(7_000), CloseReason::HelloTimeout, Some(std::io::ErrorKind::TimedOut.into()));
        assert_eq!(timed_out, "the connection to its manager at 10.0.0.1:7000 could not be opened: timed out");
    }
}
