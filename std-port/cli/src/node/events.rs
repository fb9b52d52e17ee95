//! Events of the node as lines of its log. Lines that others can cause are rate-limited.

use std::collections::HashMap;
use std::fmt;
use std::net::SocketAddr;
use std::sync::mpsc::{Receiver, RecvTimeoutError};
use std::time::{Duration, Instant};

use cara_std::{Claim, CloseReason, Identity, UnitEvent};

use super::black_box::BlackBox;

/// The target of its lines.
pub(super) const TARGET: &str = module_path!();
/// How often what is left out is looked for.
const LOOK: Duration = Duration::from_secs(1);

/// Tells what happens to the node, in a thread that ends with the unit; `fenced` once another manager has taken over. `address`
/// tells where a connected peer is.
pub(super) fn log(
    events: Receiver<UnitEvent>,
    address: impl Fn(&Identity) -> Option<SocketAddr> + Send + 'static,
    black_box: BlackBox,
    fenced: impl Fn(Claim) + Send + 'static,
) -> anyhow::Result<()> {
    std::thread::Builder::new()
        .name("cara-log".into())
        .spawn(move || log_all(&events, &address, &black_box, &fenced))?;
    Ok(())
}

fn log_all(
    events: &Receiver<UnitEvent>,
    address: &dyn Fn(&Identity) -> Option<SocketAddr>,
    black_box: &BlackBox,
    fenced: &dyn Fn(Claim),
) {
    let mut sparing = Sparing::default();
    // As many as there are peers.
    let mut addresses = HashMap::new();
    loop {
        let event = match sparing.0.is_empty() {
            true => events.recv().map_err(|_| RecvTimeoutError::Disconnected),
            false => events.recv_timeout(LOOK),
        };
        if let Ok(event) = &event {
            black_box.event(event);
        }
        match event {
            Ok(UnitEvent::Fenced { claim }) => fenced(claim),
            Ok(event) => {
                let address = match &event {
                    UnitEvent::Joined { peer } => *addresses.entry(peer.clone()).insert_entry(address(peer)).get(),
                    UnitEvent::Left { peer, .. } => addresses.remove(peer).flatten(),
                    _ => None,
                };
                if Line::of(&event).is_none_or(|line| sparing.admits(line, Instant::now())) {
                    log_event(event, address);
                }
            }
            Err(RecvTimeoutError::Timeout) => {}
            Err(RecvTimeoutError::Disconnected) => return sparing.0.into_iter().for_each(left_out),
        }
        sparing.due(Instant::now()).into_iter().for_each(left_out);
    }
}

/// Lines of one kind that others can cause as often as they like: by a node that joins in a loop, or a port scan.
#[derive(Clone, Debug, PartialEq, Eq, Hash)]
enum Line {
    NotJoined(CloseReason),
    Joined(Identity),
    Left(Identity),
    Skipped(Identity),
    Expired(Identity),
}

impl Line {
    fn of(event: &UnitEvent) -> Option<Self> {
        Some(match event {
            UnitEvent::NotJoined { reason, .. } => Self::NotJoined(*reason),
            UnitEvent::Joined { peer } => Self::Joined(peer.clone()),
            UnitEvent::Left { peer, .. } => Self::Left(peer.clone()),
            UnitEvent::FunctionsSkipped { peer, .. } => Self::Skipped(peer.clone()),
            UnitEvent::LeaseExpired { peer, .. } => Self::Expired(peer.clone()),
            _ => return None,
        })
    }

    /// So many lines in so much time: a port scan has hundreds a second of a few reasons, and a node that works leaves seldom.
    const fn limit(&self) -> (u64, Duration) {
        match self {
            Self::NotJoined(_) => (1, Duration::from_secs(1)),
            _ => (4, Duration::from_secs(10)),
        }
    }
}

impl fmt::Display for Line {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::NotJoined(reason) => write!(f, "not joined, likewise: {reason}"),
            Self::Joined(node) => write!(f, "{node} has joined, again and again"),
            Self::Left(node) => write!(f, "{node} has left, again and again"),
            Self::Skipped(node) => write!(f, "{node} has no room for some of this node's functions, likewise"),
            Self::Expired(node) => write!(f, "leases of {node} have expired, likewise"),
        }
    }
}

fn left_out((line, Report { left_out, .. }): (Line, Report)) {
    if left_out > 0 {
        tracing::warn!(more = left_out, "{line}");
    }
}

/// Which lines were logged a short while ago.
#[derive(Default)]
struct Sparing(HashMap<Line, Report>);

/// How often a line was logged since `at`, and how often it was not.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
struct Report {
    at: Instant,
    lines: u64,
    left_out: u64,
}

impl Sparing {
    /// Whether a line may be logged.
    fn admits(&mut self, line: Line, now: Instant) -> bool {
        let (limit, _) = line.limit();
        let reported = self.0.entry(line).or_insert(Report { at: now, lines: 0, left_out: 0 });
        let admits = reported.lines < limit;
        *if admits { &mut reported.lines } else { &mut reported.left_out } += 1;
        admits
    }

    /// Those whose time is over; what was left out of them is to be told now.
    fn due(&mut self, now: Instant) -> Vec<(Line, Report)> {
        let over = |line: &Line, reported: &Report| now.saturating_duration_since(reported.at) >= line.limit().1;
        let due = self
            .0
            .iter()
            .filter(|(line, reported)| over(line, reported))
            .map(|(line, reported)| (line.clone(), *reported));
        let due: Vec<_> = due.collect();
        for (line, reported) in &due {
            // The line that tells the number is one too.
            match reported.left_out {
                0 => self.0.remove(line),
                _ => self.0.insert(line.clone(), Report { at: now, lines: 1, left_out: 0 }),
            };
        }
        due
    }
}

/// `address` is that of a node that joins or leaves.
fn log_event(event: UnitEvent, address: Option<SocketAddr>) {
    let address = address.map(tracing::field::display);
    match event {
        UnitEvent::Joined { peer } => tracing::info!(node = %peer, address, "joined"),
        UnitEvent::Left { peer, reason } => tracing::warn!(node = %peer, address, "left: {reason}"),
        UnitEvent::NotJoined { address, peer, reason } => {
            let node = peer.map(|peer| peer.to_string());
            tracing::warn!(%address, node, "not joined: {reason}");
        }
        UnitEvent::FunctionsSkipped { peer, skipped } => {
            tracing::warn!(node = %peer, skipped, "it has no room for some of this node's functions");
        }
        UnitEvent::LeaseExpired { peer, function } => tracing::warn!(node = %peer, function, "lease expired"),
        UnitEvent::StandsBy { by: None } => tracing::info!("stands by"),
        UnitEvent::StandsBy { by: Some(by) } => tracing::warn!(%by, "stands by"),
        event => tracing::debug!(?event, "event"),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const SECOND: Duration = Duration::from_secs(1);

    #[test]
    fn a_reason_is_a_line_in_a_period_and_what_is_left_out_is_counted() {
        let mut sparing = Sparing::default();
        let start = Instant::now();
        let [reset, protocol] = [CloseReason::Reset, CloseReason::Protocol].map(Line::NotJoined);
        let admitted = |sparing: &mut Sparing| (0..380).filter(|_| sparing.admits(reset.clone(), start)).count();
        assert_eq!(admitted(&mut sparing), 1);
        assert!(sparing.admits(protocol.clone(), start), "another reason has a line of its own");
        assert_eq!(sparing.due(start), []);
        let mut due = sparing.due(start + SECOND);
        due.sort_by_key(|(_, reported)| reported.left_out);
        let due = due.into_iter().map(|(line, reported)| (line, reported.left_out)).collect::<Vec<_>>();
        assert_eq!(due, [(protocol, 0), (reset.clone(), 379)]);
        assert_eq!(admitted(&mut sparing), 0, "the number was a line");
        assert_eq!(sparing.due(start + SECOND * 2).len(), 1);
        sparing.due(start + SECOND * 3);
        assert!(sparing.0.is_empty() && sparing.admits(reset, start + SECOND * 3));
    }

    #[test]
    fn a_node_that_joins_in_a_loop_does_not_fill_the_log() {
        let [looping, other] = ["looping", "other"].map(|name| Identity::s_unit(name, 7).unwrap());
        let (mut sparing, start, mut lines, mut counted) = (Sparing::default(), Instant::now(), 0, 0);
        let joined = |peer: &Identity| Line::of(&UnitEvent::Joined { peer: peer.clone() }).unwrap();
        let left = |peer: &Identity| UnitEvent::Left { peer: peer.clone(), reason: CloseReason::Stopped };
        // 200 times a second, for a minute.
        for millis in (0..60_000).step_by(5) {
            let now = start + Duration::from_millis(millis);
            lines += usize::from(sparing.admits(joined(&looping), now));
            lines += usize::from(sparing.admits(Line::of(&left(&looping)).unwrap(), now));
            let due = sparing.due(now);
            lines += due.len();
            counted += due.iter().map(|(_, reported)| reported.left_out).sum::<u64>();
        }
        assert!(lines <= 2 * 4 * 6, "{lines} lines in a minute");
        assert_eq!(
            counted + sparing.0.values().map(|reported| reported.left_out).sum::<u64>(),
            24_000 - 2 * (4 + 5 * 3)
        );
        let admitted = (0..9).filter(|_| sparing.admits(joined(&other), start)).count();
        assert_eq!(admitted, 4, "another node has lines of its own");
    }
}
