//! Events of the node as lines of its log. Lines about refused connections are rate-limited.

use std::collections::HashMap;
use std::net::SocketAddr;
use std::sync::mpsc::{Receiver, RecvTimeoutError};
use std::time::{Duration, Instant};

use cara_std::{Claim, CloseReason, Identity, UnitEvent};

/// Links that did not come about for one reason are one line in this time: a port scan has hundreds a second.
const PERIOD: Duration = Duration::from_secs(1);

/// Tells what happens to the node, in a thread that ends with the unit; `fenced` once another manager has taken over. `address`
/// tells where a connected peer is.
pub(super) fn log(
    events: Receiver<UnitEvent>,
    address: impl Fn(&Identity) -> Option<SocketAddr> + Send + 'static,
    fenced: impl Fn(Claim) + Send + 'static,
) -> anyhow::Result<()> {
    std::thread::Builder::new().name("cara-log".into()).spawn(move || log_all(&events, &address, &fenced))?;
    Ok(())
}

fn log_all(events: &Receiver<UnitEvent>, address: &dyn Fn(&Identity) -> Option<SocketAddr>, fenced: &dyn Fn(Claim)) {
    let mut sparing = Sparing::default();
    // As many as there are peers.
    let mut addresses = HashMap::new();
    loop {
        let event = match sparing.0.is_empty() {
            true => events.recv().map_err(|_| RecvTimeoutError::Disconnected),
            false => events.recv_timeout(PERIOD),
        };
        match event {
            Ok(UnitEvent::NotJoined { reason, .. }) if !sparing.admits(reason, Instant::now()) => {}
            Ok(UnitEvent::Fenced { claim }) => fenced(claim),
            Ok(UnitEvent::Joined { peer }) => {
                let address = address(&peer);
                tracing::info!(node = %peer, address = address.map(tracing::field::display), "joined");
                addresses.insert(peer, address);
            }
            Ok(UnitEvent::Left { peer, reason }) => {
                let address = addresses.remove(&peer).flatten();
                tracing::warn!(node = %peer, address = address.map(tracing::field::display), "left: {reason}");
            }
            Ok(event) => log_event(event),
            Err(RecvTimeoutError::Timeout) => {}
            Err(RecvTimeoutError::Disconnected) => return sparing.0.into_iter().for_each(left_out),
        }
        sparing.due(Instant::now()).into_iter().for_each(left_out);
    }
}

fn left_out((reason, Told { left_out, .. }): (CloseReason, Told)) {
    if left_out > 0 {
        tracing::warn!(more = left_out, "not joined, likewise: {reason}");
    }
}

/// Which reasons were logged a short while ago.
#[derive(Default)]
struct Sparing(HashMap<CloseReason, Told>);

/// When a reason was logged last, and how often it was not since.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
struct Told {
    at: Instant,
    left_out: u64,
}

impl Sparing {
    /// Whether a reason may have a line of its own.
    fn admits(&mut self, reason: CloseReason, now: Instant) -> bool {
        if let Some(told) = self.0.get_mut(&reason) {
            told.left_out += 1;
            return false;
        }
        self.0.insert(reason, Told { at: now, left_out: 0 });
        true
    }

    /// Those whose time is over; what was left out of them is to be told now.
    fn due(&mut self, now: Instant) -> Vec<(CloseReason, Told)> {
        let over = |told: &Told| now.saturating_duration_since(told.at) >= PERIOD;
        let due: Vec<_> = self.0.iter().filter(|(_, told)| over(told)).map(|(reason, told)| (*reason, *told)).collect();
        for (reason, told) in &due {
            // The line that tells the number is one too.
            match told.left_out {
                0 => self.0.remove(reason),
                _ => self.0.insert(*reason, Told { at: now, left_out: 0 }),
            };
        }
        due
    }
}

fn log_event(event: UnitEvent) {
    match event {
        UnitEvent::NotJoined { address, peer, reason } => {
            let node = peer.map(|peer| peer.to_string());
            tracing::warn!(%address, node, "not joined: {reason}");
        }
        UnitEvent::FunctionsSkipped { peer, skipped } => {
            tracing::warn!(node = %peer, skipped, "it has no room for some of this node's functions");
        }
        UnitEvent::LeaseExpired { peer, function } => tracing::warn!(node = %peer, function, "lease expired"),
        event => tracing::debug!(?event, "event"),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_reason_is_a_line_in_a_period_and_what_is_left_out_is_counted() {
        let mut sparing = Sparing::default();
        let start = Instant::now();
        let admitted = |sparing: &mut Sparing| (0..380).filter(|_| sparing.admits(CloseReason::Reset, start)).count();
        assert_eq!(admitted(&mut sparing), 1);
        assert!(sparing.admits(CloseReason::Protocol, start), "another reason has a line of its own");
        assert_eq!(sparing.due(start), []);
        let mut due = sparing.due(start + PERIOD);
        due.sort_by_key(|(_, told)| told.left_out);
        assert_eq!(
            due.iter().map(|(reason, told)| (*reason, told.left_out)).collect::<Vec<_>>(),
            [(CloseReason::Protocol, 0), (CloseReason::Reset, 379)]
        );
        assert_eq!(admitted(&mut sparing), 0, "the number was a line");
        assert_eq!(sparing.due(start + PERIOD * 2).len(), 1);
        sparing.due(start + PERIOD * 3);
        assert!(sparing.0.is_empty() && sparing.admits(CloseReason::Reset, start + PERIOD * 3));
    }
}
