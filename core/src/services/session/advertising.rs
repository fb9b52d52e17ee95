//! Sends a peer what has changed in this unit's list, the state of its actuators and its limits.

use super::LEAST_MESSAGE_BYTES;
use super::granting::Granting;
use super::permitting::may_see;
use super::wire::Wire;
use crate::ability::HELP;
use crate::config::SIGNATURE_BYTES;
use crate::distribution::function::Attributes;
use crate::distribution::function_list::Slot;
use crate::distribution::hello::Limits;
use crate::distribution::identity::Identity;
use crate::distribution::message::{CONTROL_BYTES, Control, LONGEST_HEADER_BYTES, PUBLISH_BYTES};
use crate::services::lease::ActuatorState;
use crate::services::{Context, Port};

/// Sends changes of this unit's list as far as there is capacity, and acknowledges the peer's list.
pub(super) fn send_list<P: Port>(wire: &mut Wire<P>, cx: &mut Context<'_, P>) {
    if let Some(serial) = wire.publishing.acknowledgement_due {
        let skipped = u16::try_from(wire.theirs.skipped()).unwrap_or(u16::MAX);
        if wire.send_control(cx, &Control::ListAck { serial, skipped }) {
            wire.publishing.acknowledgement_due = None;
        }
    }
    if wire.publishing.dirty {
        wire.publishing.dirty = !send_news(wire, cx);
    }
    if wire.publishing.actuators_due && !wire.publishing.dirty {
        wire.publishing.actuators_due = !send_actuators(wire, cx);
    }
    // The end goes last: its acknowledgement tells that the peer has processed everything before it.
    if wire.publishing.end_due && !wire.publishing.dirty && !wire.publishing.actuators_due {
        let serial = wire.publishing.serial;
        wire.publishing.end_due = !wire.send_control(cx, &Control::ListEnd { serial });
    }
}

/// Sends the state of each actuator if any has changed; `false` if capacity ran out.
fn send_actuators<P: Port>(wire: &mut Wire<P>, cx: &mut Context<'_, P>) -> bool {
    let functions = cx.functions;
    let moves = |slot| functions.function(slot).filter(|function| function.attributes.lease.is_some());
    let leases = wire.publishing.all_slots().filter_map(|slot| moves(slot)?.handler.lease());
    let changes = leases.fold(0, |sum: u32, lease| sum.rotate_left(7).wrapping_add(lease.changes()));
    if changes == wire.publishing.actuators_reported {
        return true;
    }
    let peer = wire.identity().map_or(0, Identity::id);
    for slot in wire.publishing.all_slots() {
        let advertised = wire.publishing.table.get(usize::from(slot.0)).and_then(|publication| publication.advertised);
        let Some(function) = moves(slot).filter(|function| advertised == Some(function.generation)) else {
            continue;
        };
        let ActuatorState { latch, last } = function.handler.state();
        // Nonce and claim of another unit's order are none of this peer's business.
        let last = last.map(|last| if last.holder == peer { last } else { last.of_another() });
        if !wire.send_control(cx, &Control::Actuator { slot: slot.0, latch, last }) {
            return false;
        }
    }
    wire.publishing.actuators_reported = changes;
    true
}

/// Sends this unit's limits if they have changed.
pub(super) fn send_limits<P: Port>(wire: &mut Wire<P>, cx: &mut Context<'_, P>) {
    if wire.publishing.limits_due {
        let Limits { message_size, minimum_interval, calls, .. } = Limits::from(&wire.constraints);
        wire.publishing.limits_due = !wire.send_control(cx, &Control::Limits { message_size, minimum_interval, calls });
    }
}

/// Sends each function whose published generation has changed; `false` if capacity ran out.
fn send_news<P: Port>(wire: &mut Wire<P>, cx: &mut Context<'_, P>) -> bool {
    for index in 0..wire.publishing.table.len() {
        let Some(&publication) = wire.publishing.table.get(index) else { break };
        let slot = Slot(index as u16);
        let wanted = publication.wanted.filter(|_| may_see(wire, cx, slot));
        if wanted == publication.advertised {
            continue;
        }
        let function = wanted.and_then(|generation| cx.functions.lookup(slot, generation).ok());
        let sent = match function {
            None => wire.send_control(cx, &Control::Withdraw { slot: slot.0 }),
            Some(function) => {
                let actuator = Granting::actuator_of(wire, cx, function.handler);
                let whole = function.signature.as_bytes();
                let least = if HELP { function.signature.without_help().as_bytes() } else { whole };
                let control = Control::Publish {
                    slot: slot.0,
                    generation: function.generation.0,
                    attributes: &Attributes { actuator, ..*function.attributes }.encode(),
                    // A signature longer than the peer's buffer would end the link. Without it, the function counts as skipped.
                    signature: [whole, least].into_iter().find(|one| may_hold(wire, one.len())).unwrap_or_default(),
                };
                wire.send_control(cx, &control)
            }
        };
        if !sent {
            return false;
        }
        if function.is_some_and(|function| function.attributes.lease.is_some()) {
            (wire.publishing.actuators_due, wire.publishing.actuators_reported) = (true, 0);
        }
        // Record it only once it is queued: after a full queue the loop restarts at the first function that was not sent.
        if let Some(publication) = wire.publishing.table.get_mut(index) {
            publication.advertised = wanted;
        }
    }
    true
}

/// Whether the peer accepts a message with a signature of this length.
fn may_hold<P: Port>(wire: &Wire<P>, length: usize) -> bool {
    let theirs = wire.hello().map_or(0, |hello| hello.limits.message_size);
    let limit = (theirs as usize).saturating_add(LONGEST_HEADER_BYTES).max(LEAST_MESSAGE_BYTES);
    CONTROL_BYTES + PUBLISH_BYTES + SIGNATURE_BYTES <= LEAST_MESSAGE_BYTES
        || length.saturating_add(CONTROL_BYTES + PUBLISH_BYTES) <= limit
}
