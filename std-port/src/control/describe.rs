//! Units, nodes, refusals and events in the control socket's form.

use std::collections::BTreeMap;

use crate::Finding;
use cara_core::config::{Constraints, Scheduling, VERSIONS};
use cara_core::distribution::identity::{Epoch, Identity};
use cara_core::services::lease::{ActuatorState, LastOrder, Latch, LeaseEnd};
use cara_core::time::Duration;

use super::failure::name_of;
use super::protocol::{
    Answer, ClockInfo, ConstraintsInfo, FunctionInfo, InhibitedInfo, InterfaceInfo, KeysInfo, LimitsInfo, NodeInfo,
    OrderInfo, RefusedInfo, SchedulingInfo, UnitInfo, unix_ms,
};
use crate::keys::LiveRing;
use crate::{CommunicationSystem, Interface, Limits, Peer, Refusal, TheirFunction, UnitEvent};

pub(super) fn unit<T: Send + 'static>(system: &CommunicationSystem<T>) -> UnitInfo {
    let identity = system.identity();
    UnitInfo {
        name: identity.name().to_owned(),
        id: identity.id(),
        role: identity.role().as_str().to_owned(),
        fleet: system.fleet().0,
        mode: Some(system.keys().mode().as_str().to_owned()),
        keys: system.keys().ring().map(keys),
        version: VERSIONS.last,
        release: Some(env!("CARGO_PKG_VERSION").to_owned()),
        discovery_port: system.discovery_port(),
        tcp_port: system.tcp_port(),
        epoch: epoch(system.epoch()),
        uptime_ms: system.uptime().as_millis(),
        interfaces: system.interfaces().iter().map(interface).collect(),
        constraints: constraints(&system.constraints()),
        connected: system.number_of_s_units() + system.number_of_m_units(),
        leading: system.has_authority().then(|| system.is_leading()),
    }
}

fn keys(live: &LiveRing) -> KeysInfo {
    KeysInfo {
        file: live.path().map(|path| path.display().to_string()),
        generations: live.ring().generations().collect(),
    }
}

fn interface(interface: &Interface) -> InterfaceInfo {
    InterfaceInfo {
        name: interface.name.clone(),
        address: interface.address.to_string(),
        broadcast: interface.broadcast.map(|address| address.to_string()),
        up: interface.up,
        refused: interface.refused.map(|kind| kind.to_string()),
    }
}

pub(super) fn node<T: Send + 'static>(peer: &Peer<T>, expected: bool) -> NodeInfo {
    let (limits, left, searched) = (peer.limits(), peer.left(), peer.searched());
    let under = under(peer);
    NodeInfo {
        name: peer.name().to_owned(),
        id: peer.id(),
        role: peer.identity().role().as_str().to_owned(),
        connected: peer.is_connected(),
        expected,
        address: peer.address().map(|address| address.to_string()),
        version: peer.version(),
        epoch: peer.epoch().map(epoch),
        connected_ms: peer.connected_for().map(Duration::as_millis),
        left_ms: left.map(|(ago, _)| ago.as_millis()),
        left_reason: under.as_ref().map(|_| name_of(&Refusal::Fenced)).or(left.map(|(_, reason)| name_of(&reason))),
        left_text: under.or(left.map(|(_, reason)| reason.to_string())),
        searched_ms: searched.map(|(ago, _)| ago.as_millis()),
        searched_from: searched.map(|(_, from)| from.to_string()),
        limits: limits.map(self::limits),
        link: peer.link_info(),
        clock: peer.clock_offset().map(ClockInfo::of),
        functions: peer.their_function_list().len(),
    }
}

/// That a node obeys another manager of this unit's name.
pub(super) fn under<T: Send + 'static>(peer: &Peer<T>) -> Option<String> {
    peer.under().map(|(claim, address)| format!("under another manager: claim {claim}, address {address}"))
}

fn limits(limits: Limits) -> LimitsInfo {
    LimitsInfo {
        message_size: limits.message_size,
        chunk_size: limits.chunk_size,
        calls: limits.calls,
        minimum_interval_us: u64::from(limits.minimum_interval),
    }
}

pub(super) fn refused(finding: &Finding, age: Duration) -> RefusedInfo {
    RefusedInfo {
        address: finding.address.to_string(),
        node: finding.identity.as_ref().map(Identity::to_string),
        reason: name_of(&finding.refusal),
        text: finding.refusal.to_string(),
        ago_ms: age.as_millis(),
    }
}

pub(super) fn function(function: &TheirFunction) -> FunctionInfo {
    let signature = function.definition.signature();
    let mut units = BTreeMap::new();
    for (variable, unit) in signature.units() {
        units.entry(variable.to_owned()).or_insert_with(|| unit.to_owned());
    }
    FunctionInfo {
        name: signature.name().to_owned(),
        signature: signature.to_string(),
        attributes: function.attributes,
        help: signature.help().to_owned(),
        units,
    }
}

/// As the unit `own` knows it.
pub(super) fn order<T: Send + 'static>(own: u32, peer: &Peer<T>, function: &str) -> OrderInfo {
    let ActuatorState { latch, last } = peer.actuator_state(function).unwrap_or_default();
    let left = peer.lease_left(function);
    // What is renewed here runs, also where the node has not told it yet.
    let (order, holder) = match last {
        _ if left.is_some() => ("runs", Some(own)),
        None => ("none", None),
        Some(LastOrder { end, holder, .. }) => (end.map_or("runs", LeaseEnd::word), Some(holder)),
    };
    OrderInfo {
        node: peer.name().to_owned(),
        id: peer.id(),
        function: function.to_owned(),
        order: order.to_owned(),
        holder,
        trace: last.filter(|last| last.call != 0).map(|last| format!("{:016x}", last.trace())),
        claim: last.filter(|last| last.call != 0).map(|last| (last.claim.term, last.claim.claimant)),
        left_ms: left.map(|left| left.as_millis()),
        inhibited: latch.map(|Latch { by, reason }| InhibitedInfo { by, reason }),
        age_ms: peer.link_info().map(|link| link.stream_ms),
    }
}

pub(super) const fn constraints(constraints: &Constraints) -> ConstraintsInfo {
    ConstraintsInfo {
        request_timeout_us: constraints.request_timeout.as_micros(),
        minimum_interval_us: constraints.minimum_interval.as_micros(),
        maximum_nodes: constraints.maximum_nodes,
        message_size: constraints.message_size,
        chunk_size: constraints.chunk_size,
        keep_alive_us: constraints.keep_alive.as_micros(),
        calls_per_peer: constraints.calls_per_peer,
        scheduling: match constraints.scheduling {
            Scheduling::EarliestDeadline => SchedulingInfo::Deadline,
            Scheduling::Fifo => SchedulingInfo::Fifo,
            Scheduling::Admission => SchedulingInfo::Admission,
        },
    }
}

/// An event in words, as [`Question::Watch`](super::protocol::Question::Watch) has it; `at` is the time since the unit was made.
pub fn event(event: &UnitEvent, at: Duration) -> Answer {
    let (name, node, text) = match event {
        UnitEvent::Joined { peer } => ("joined", Some(peer), "is connected".to_owned()),
        UnitEvent::Left { peer, reason } => ("left", Some(peer), reason.to_string()),
        UnitEvent::NotJoined { address, peer, reason } => ("not_joined", peer.as_ref(), format!("{address}: {reason}")),
        UnitEvent::Fenced { claim } => ("fenced", None, format!("another manager commands with the claim {claim}")),
        UnitEvent::Raised { claim } => ("raised", None, format!("this manager has raised its claim to {claim}")),
        UnitEvent::StandsBy { by: None } => ("stands_by", None, "this m_unit stands by".to_owned()),
        UnitEvent::StandsBy { by: Some(claim) } => {
            ("stands_by", None, format!("this m_unit stands by: another one commands with the claim {claim}"))
        }
        UnitEvent::TookCommand { claim } => {
            ("took_command", None, format!("this standby commands, with the claim {claim}"))
        }
        UnitEvent::Leading { claim } => ("leading", None, format!("this manager leads, with the claim {claim}")),
        UnitEvent::NotLeading => ("not_leading", None, "this manager does not lead: links and orders go on".to_owned()),
        UnitEvent::ClaimNotKept { peer, claim } => (
            "claim_not_stored",
            Some(peer),
            format!("the claim {claim} is obeyed until the next start: it could not be stored"),
        ),
        UnitEvent::HandOver { peer, .. } => ("handed_over", Some(peer), "goes over to another manager".to_owned()),
        UnitEvent::ListChanged { peer } => ("list_changed", Some(peer), "published or withdrew functions".to_owned()),
        UnitEvent::NetworkChanged { up } => {
            ("interfaces_changed", None, format!("interfaces that are up: {}", up.join(" ")))
        }
        UnitEvent::FunctionsSkipped { peer, skipped } => {
            ("functions_skipped", Some(peer), format!("keeps no room for {skipped} functions of this unit"))
        }
        UnitEvent::RequestFailed { peer, call, error } => {
            ("request_failed", Some(peer), format!("call {}: {error}", call.0))
        }
        UnitEvent::LeaseExpired { peer, function } => {
            ("lease_expired", Some(peer), format!("'{function}' of this unit stopped: its caller no longer wants it"))
        }
        UnitEvent::LeaseEnded { peer, function, why, .. } => {
            let text = match why {
                LeaseEnd::Finished => format!("'{function}' is finished there"),
                LeaseEnd::Expired => format!("'{function}' stopped there: it was not renewed in time"),
                LeaseEnd::Replaced => format!("'{function}' goes on there for a newer call"),
                _ => format!("'{function}' ended there: {}", why.word()),
            };
            ("lease_ended", Some(peer), text)
        }
        UnitEvent::Inhibited { peer, function, latch } => {
            let text = match latch {
                Some(Latch { by: 0, reason }) => {
                    format!("'{function}' was stopped by the node itself, reason {reason}")
                }
                Some(Latch { by, .. }) => format!("'{function}' was stopped there by unit {by}"),
                None => format!("'{function}' was reset there"),
            };
            ("inhibited", Some(peer), text)
        }
        other => ("other", None, format!("{other:?}")),
    };
    let (event, node) = (name.to_owned(), node.map(Identity::to_string));
    Answer::Event { at_ms: at.as_millis(), unix_ms: unix_ms(), event, node, text }
}

fn epoch(epoch: Epoch) -> String {
    format!("{:016x}", epoch.0)
}
