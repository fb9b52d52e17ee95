//! Actions at once (6.8, 6.9): those of the gateway itself, and when those of the vehicle are given up.

use super::{INSTANT_ACTIONS, Machine, is_controlled};
use crate::actions::{Entry, Place};
use crate::errors::{Kind, Refusal};
use crate::message::{Action, ActionScope, ActionStatus, BlockingType, Error, InstantActions};
use crate::order::{ID_BYTES, PARAMETER_BYTES, parameters, performable};
use crate::state::{Failure, copy_of};
use crate::version::Version;

/// Whether it makes the vehicle stand. No id, no parameter and no number of actions refuses it.
pub(crate) fn is_stop(action: &Action) -> bool {
    matches!(action.action_type.as_str(), "startPause" | "cancelOrder")
}

impl Machine {
    /// A message on topic `instantActions`. A copy of one changes nothing.
    pub fn instant_actions(&mut self, message: InstantActions) {
        let stamp = format!("{} {}", message.header.header_id, message.header.timestamp);
        let known: Vec<Error> =
            self.record.errors.iter().filter(|of| Kind::is_of_instant_action(of)).cloned().collect();
        let mut is_one_taken = false;
        for action in message.actions {
            match self.is_due(&action, &stamp) {
                Ok(true) => {}
                Ok(false) => continue,
                Err(refusal) => {
                    self.refuse(&refusal.about("topic", "instantActions").about("actionType", &action.action_type));
                    if is_stop(&action) {
                        // It is done all the same, and cannot be listed.
                        self.record.spend(copy_of(&action.action_id, &stamp));
                        self.begin(&mut Entry::new(action, Place::Instant));
                    }
                    continue;
                }
            }
            self.has_changed = true;
            self.is_report_due = true;
            let mut entry = Entry { message: stamp.clone(), ..Entry::new(action, Place::Instant) };
            self.begin(&mut entry);
            is_one_taken |= entry.status != ActionStatus::Failed;
            self.record.actions.push(entry);
        }
        if is_one_taken {
            self.record.errors.retain(|error| !known.contains(error));
        }
        self.forget_instant_actions(INSTANT_ACTIONS);
        self.settle();
    }

    /// Whether an action at once is new; fails for one that cannot be listed under its id. What the gateway itself does has the same
    /// effect each time, and some masters send it under the same id again, so that it counts by its message; what the vehicle does
    /// counts by its id.
    fn is_due(&mut self, action: &Action, stamp: &str) -> Result<bool, Refusal> {
        let id = &action.action_id;
        if self.record.spent.contains(&copy_of(id, stamp)) {
            return Ok(false);
        }
        if id.len() > ID_BYTES || parameters(action).len() > PARAMETER_BYTES {
            return Err(Refusal::new(Kind::Validation, "the action's id or its parameters are too long"));
        }
        let is_own = self.policy.version.rules().own_actions.contains(&action.action_type.as_str());
        let known = self.record.actions.iter().position(|entry| entry.action.action_id == *id);
        if let Some(known) = known {
            let entry = &self.record.actions[known];
            let is_same = !entry.is_of_order() && entry.action.action_type == action.action_type;
            // A stop counts again before the last one has ended: it may have been taken back meanwhile.
            if is_same && (entry.message == stamp || is_own && !entry.status.has_ended() && !is_stop(action)) {
                return Ok(false);
            }
            if is_same && is_own {
                let before = self.record.actions.remove(known);
                self.record.spend(copy_of(id, &before.message));
                return Ok(true);
            }
        }
        let is_new = known.is_none() && (is_own || !self.record.spent.contains(id));
        if !is_new {
            return Err(Refusal::new(Kind::Validation, "an action of this id was sent before").about("actionId", id));
        }
        self.forget_instant_actions(INSTANT_ACTIONS - 1);
        // What stops finds a place where nothing else does.
        let most = self.policy.can.max_actions + INSTANT_ACTIONS * (1 + usize::from(is_stop(action)));
        if self.record.actions.len() >= most {
            return Err(Refusal::new(Kind::Space, "too many actions").about("actionId", id));
        }
        Ok(true)
    }

    fn begin(&mut self, entry: &mut Entry) {
        let finished = (ActionStatus::Finished, None);
        let running = (ActionStatus::Running, None);
        let rules = self.policy.version.rules();
        let (status, result) = match entry.action.action_type.as_str() {
            "startPause" => {
                self.record.is_paused = true;
                running
            }
            "stopPause" => {
                self.record.is_paused = false;
                self.record.errors.retain(|error| !Kind::BrokerLost.is_of(error));
                finished
            }
            "cancelOrder" => return self.cancel(entry),
            "stateRequest" => finished,
            "factsheetRequest" => {
                self.is_factsheet_due = true;
                finished
            }
            "initPosition" if self.is_executing() => self.cannot(&entry.action, "an order is being executed"),
            "initPosition" if self.is_linked() => running,
            "initPosition" => self.cannot(&entry.action, "the vehicle is not connected"),
            "clearInstantActions" if rules.lists_instant_actions => {
                self.forget_instant_actions(0);
                finished
            }
            _ => match self.performs(&entry.action) {
                Ok(()) => {
                    entry.is_triggered = true;
                    (ActionStatus::Waiting, None)
                }
                Err(refusal) => {
                    self.refuse(&refusal.about("topic", "instantActions"));
                    (ActionStatus::Failed, None)
                }
            },
        };
        (entry.status, entry.result) = (status, result);
    }

    /// 3.0 wants an error as well (6.2.1).
    fn cannot(&mut self, action: &Action, why: &str) -> (ActionStatus, Option<String>) {
        if self.policy.version == Version::V3 {
            let refusal = Refusal::new(Kind::InstantAction, why).about("topic", "instantActions");
            self.refuse(&refusal.about("actionId", &action.action_id));
        }
        (ActionStatus::Failed, Some(why.to_owned()))
    }

    /// Whether the vehicle does this at once: it does nothing late.
    fn performs(&self, action: &Action) -> Result<(), Refusal> {
        let refused = |text: &str| Err(Refusal::new(Kind::InstantAction, text).about("actionId", &action.action_id));
        let is_none = action.blocking_type == BlockingType::None && action.retriable != Some(true);
        match &self.status {
            None => refused("the vehicle is not connected"),
            Some(status) if !is_controlled(status.mode) => refused("the vehicle is not in an automatic mode"),
            Some(_) if self.policy.version.rules().instant_is_none && !is_none => {
                refused("an action at once blocks nothing, and is not tried again")
            }
            Some(_) => performable(action, ActionScope::Instant, &self.policy.can).map(drop),
        }
    }

    /// `cancelOrder` (6.6.3): what waits fails, what runs is ended where that can be; then the vehicle stands, and the order is over.
    fn cancel(&mut self, entry: &mut Entry) {
        let named = entry.action.action_parameters.iter().flatten().find(|parameter| parameter.key == "orderId");
        let is_other = self.policy.version.rules().cancels_by_name
            && named.is_some_and(|named| named.value.as_str() != Some(&self.record.order_id));
        if !self.record.is_order_open() || is_other {
            entry.status = ActionStatus::Failed;
            let text = if is_other { "another order is here" } else { "there is no order" };
            let refusal = Refusal::new(Kind::NoOrderToCancel, text);
            return self.refuse(&refusal.about("actionId", &entry.action.action_id).about("topic", "instantActions"));
        }
        entry.status = ActionStatus::Running;
        self.give_up_order("the order was cancelled");
    }

    pub(super) fn give_up_order(&mut self, why: &str) {
        self.record.is_cancelled = true;
        self.give_up_actions(why, Entry::is_of_order);
        self.has_changed = true;
    }

    /// What waits fails, what runs is ended where that can be.
    pub(super) fn give_up_actions(&mut self, why: &str, which: impl Fn(&Entry) -> bool) {
        for entry in self.record.actions.iter_mut().filter(|entry| which(entry)) {
            let kind = self.policy.can.actions.get(&entry.action.action_type);
            if entry.status.has_ended() {
            } else if entry.number == 0 {
                entry.end(ActionStatus::Failed, Some(why.into()));
                self.has_changed = true;
            } else if entry.ends_as.is_none() && kind.is_none_or(|kind| kind.can_be_cancelled) {
                entry.ends_as = Some(ActionStatus::Failed);
                self.has_changed = true;
            }
        }
    }

    /// Those that have ended, but for so many.
    fn forget_instant_actions(&mut self, left: usize) {
        let is_old = |entry: &Entry| !entry.is_of_order() && entry.status.has_ended();
        let mut too_many = self.record.actions.iter().filter(|entry| is_old(entry)).count().saturating_sub(left);
        let (gone, kept) = std::mem::take(&mut self.record.actions).into_iter().partition(|entry| {
            let goes = too_many > 0 && is_old(entry);
            too_many -= usize::from(goes);
            goes
        });
        self.record.actions = kept;
        let gone: Vec<Entry> = gone;
        gone.into_iter().for_each(|entry| self.record.spend_action(entry));
    }

    /// Actions at once that had not begun when the link was lost, or the program ended: they were wanted then, not now.
    pub(super) fn fail_what_is_late(&mut self) {
        for index in 0..self.record.actions.len() {
            let entry = &self.record.actions[index];
            let is_position = entry.action.action_type == "initPosition" && !entry.is_of_order();
            if !entry.status.has_ended() && entry.number == 0 && (is_position || entry.is_of_vehicle_at_once()) {
                self.end(index, ActionStatus::Failed, "the vehicle was lost before it began", false);
            }
        }
    }

    pub(super) fn positioned(&mut self, action: &Action, answer: Result<(), Failure>) {
        self.is_position_sent = false;
        let Some(index) = self.record.actions.iter().position(|entry| entry.action.action_id == action.action_id)
        else {
            return;
        };
        match answer {
            Ok(()) => {
                let named = action.action_parameters.iter().flatten().find(|parameter| parameter.key == "lastNodeId");
                if let Some(node) = named.and_then(|parameter| parameter.value.as_str()) {
                    (self.record.last_node_id, self.record.last_node_sequence_id) = (node.to_owned(), 0);
                    // The order that has ended elsewhere does not go on from here, with sequence ids that it had before.
                    self.record.is_placed = true;
                }
                self.end(index, ActionStatus::Finished, "", true);
            }
            Err(Failure::Refused(why)) => self.end(index, ActionStatus::Failed, &why, false),
            Err(_) => {}
        }
    }
}
