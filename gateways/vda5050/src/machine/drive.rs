//! The stretch that the vehicle is told to drive: how far, when it is told more, and what becomes of one that it refuses.

use super::Machine;
use crate::actions::{Place, block_driving};
use crate::errors::{Kind, Refusal};
use crate::message::{Edge, Node};
use crate::state::{Command, Failure, Status};
use crate::stretch::{LEGS, fits};

/// With so many edges left, or fewer, the vehicle is told of those that follow.
const TOLD_AGAIN: usize = LEGS / 2;

impl Machine {
    /// How many of the nodes that it was told of the vehicle has passed, the one at which it stands included.
    pub(super) fn passed(&self, status: &Status) -> usize {
        let Some(first) = self.record.drive else { return 0 };
        let Some(ahead) = status.drive.checked_sub(first) else { return 0 };
        let told = self.record.told.max(1);
        let ahead = usize::try_from(ahead).unwrap_or(usize::MAX);
        // What nobody told it, it has not driven.
        if ahead >= told { 0 } else { ahead + usize::from(status.has_arrived) }
    }

    /// How many of the nodes that are left the vehicle has agreed to drive to.
    fn agreed(&self) -> usize {
        let ahead = self.record.drive.map(|first| self.record.taken.saturating_add(1).saturating_sub(first));
        ahead.and_then(|ahead| usize::try_from(ahead).ok()).unwrap_or_default()
    }

    /// Whether the vehicle has enough to drive, or has refused more: it is told that again when it stands at the end of what it has, as
    /// one without `vda_can_drive` stops for each stretch that it refuses.
    pub(super) fn is_drive_enough(&self) -> bool {
        self.is_drive_sent && (self.agreed() > TOLD_AGAIN || self.refused > self.record.taken)
    }

    /// The released edges that the vehicle drives without standing. It stands where an action forbids driving, and at both ends of an
    /// edge with actions, which begin and end there; nor does a stretch leave its map.
    fn stretch(&self) -> Vec<(Edge, Node)> {
        let mut legs: Vec<(Edge, Node)> = Vec::new();
        for (edge, node) in self.record.edges.iter().zip(&self.record.nodes).take(LEGS) {
            if !edge.released || !node.released {
                break;
            }
            let map = |node: &Node| node.node_position.as_ref().map(|at| at.map_id.clone());
            let stands = |(before, at): &(Edge, Node)| {
                let blocks = at.actions.iter().any(|action| action.blocking_type.blocks_driving());
                blocks || !before.actions.is_empty() || !edge.actions.is_empty() || map(at) != map(node)
            };
            if legs.last().is_some_and(stands) || !fits(&legs, edge, node) {
                break;
            }
            legs.push((edge.clone(), node.clone()));
        }
        legs
    }

    /// Tells the vehicle of a stretch, or of a longer one while it drives.
    pub(super) fn next_drive(&mut self, boot: u64) -> Option<Command> {
        let mut legs = self.stretch();
        let (edge, _) = legs.first()?;
        let (agreed, goes_on) = (self.agreed(), self.is_drive_sent);
        if goes_on && legs.len() <= agreed {
            return None;
        }
        if self.record.drive.is_none() {
            let entered = Place::Edge(edge.sequence_id);
            for entry in self.record.actions.iter_mut().filter(|entry| entry.place == entered && !entry.is_triggered) {
                entry.is_triggered = true;
                self.has_changed = true;
            }
            // What stands on the edge begins before the vehicle moves there.
            if let Some(command) = self.next_action(boot) {
                return Some(command);
            }
            if block_driving(&self.record.actions) {
                return None;
            }
            self.record.drive = Some(self.record.number + 1);
        }
        let number = self.record.drive?;
        if !goes_on && agreed > 0 {
            // It stands on its way. What it has agreed to comes first: it may refuse the rest.
            legs.truncate(agreed);
        }
        if legs.len() > self.record.told {
            self.record.told = legs.len();
            self.record.number = self.record.number.max(number + legs.len() as u64 - 1);
            self.has_changed = true;
        }
        self.is_drive_sent = true;
        Some(Command::Drive { number, legs, goes_on })
    }

    /// What the vehicle has answered to a stretch that ends with this number.
    pub(super) fn drive_answered(&mut self, last: u64, goes_on: bool, answer: Result<(), Failure>) {
        self.is_status_old = true;
        let is_refused = matches!(answer, Err(Failure::Refused(_)));
        match answer {
            Ok(()) => {
                // On disk with what changes next: without it the vehicle is told less at first.
                self.record.taken = last;
                if self.refused <= last {
                    self.drive_refused = None;
                }
                return;
            }
            Err(Failure::Refused(why)) => (self.refused, self.drive_refused) = (last, Some(why)),
            Err(Failure::Lost(why)) => self.drive_refused = Some(why),
            // That one is reported as long as it is stopped.
            Err(Failure::Stopped(_)) => self.drive_refused = None,
        }
        // What it agreed to before goes on, or the next status says that its order has ended.
        if is_refused && goes_on && self.is_drive_sent {
            return;
        }
        self.is_drive_sent = false;
        // It may drive all the same, or on by what it was told before.
        self.is_halt_due = true;
    }

    /// What is reported while the vehicle does not take what it is told; under a pause it is not told.
    pub(super) fn drive_error(&self) -> Option<Refusal> {
        let why = self.drive_refused.as_ref().filter(|_| self.record.is_order_open() && self.may_drive())?;
        let agreed = self.agreed();
        let is_on_its_way = agreed > 0 && self.refused > self.record.taken;
        let kind = if is_on_its_way { Kind::NoWay } else { Kind::DriveRefused };
        let refusal = Refusal::new(kind, why).about("topic", "order").about("orderId", &self.record.order_id);
        let refusal = refusal.about("orderUpdateId", self.record.order_update_id);
        let legs = self.stretch();
        let refused = legs.iter().skip(if is_on_its_way { agreed } else { 0 });
        Some(refused.fold(refusal, |refusal, (edge, node)| {
            refusal.about("edgeId", &edge.edge_id).about("nodeId", &node.node_id)
        }))
    }
}
