//! What happens without being asked for, as lines.

use std::sync::mpsc::Receiver;

use cara_std::{LeaseEnd, StartError, UnitEvent};

use crate::say;

/// Prints each event, in a thread of its own.
pub fn show_events(events: Receiver<UnitEvent>) {
    std::thread::spawn(move || events.iter().for_each(|event| show(&event)));
}

fn show(event: &UnitEvent) {
    match event {
        UnitEvent::Joined { peer } => say!("joined {peer}"),
        UnitEvent::Fenced { claim } => {
            // The unit has stopped. A supervisor is not to start it again.
            say!("another manager of this name and id commands with the claim {claim}");
            std::process::exit(i32::from(StartError::FENCED_EXIT));
        }
        UnitEvent::Left { peer, reason } => say!("left {peer}: {reason}"),
        UnitEvent::ListChanged { peer } => say!("new function list of {peer}"),
        UnitEvent::RequestFailed { peer, error, .. } => say!("request to {peer} failed: {error}"),
        UnitEvent::LeaseExpired { peer, function } => say!("lease of {function} expired, held by {peer}"),
        UnitEvent::LeaseEnded { peer, function, why, .. } => match why {
            LeaseEnd::Finished => say!("{function} at {peer} is finished"),
            LeaseEnd::Expired => say!("lease of {function} at {peer} expired"),
            LeaseEnd::Replaced => say!("{function} at {peer} goes on for a newer call"),
            _ => say!("lease of {function} at {peer} {}", why.word()),
        },
        UnitEvent::NotJoined { address, reason, .. } => say!("{address} did not join: {reason}"),
        UnitEvent::NetworkChanged { up } => say!("interfaces that are up: {}", up.join(" ")),
        UnitEvent::FunctionsSkipped { peer, skipped } => say!("{peer} has no room for {skipped} functions"),
        _ => say!("{event:?}"),
    }
}
