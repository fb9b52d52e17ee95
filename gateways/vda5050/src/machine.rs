//! One vehicle's order, and what follows from it, without I/O and without a clock.
//!
//! Messages and statuses change the [`Machine`]; [`Machine::next`] says what the vehicle is to be told. Whoever drives it writes
//! [`Machine::record`] to disk when [`Machine::take_changed`] says so, before it tells the vehicle or the master anything.

pub(crate) mod at_once;
mod drive;

use std::time::Duration;

use crate::actions::{Entry, Place, block_driving, startable};
use crate::errors::{Kind, Refusal};
use crate::message::{Action, ActionStatus, EStop, Header, OperatingMode, Order, Report};
use crate::order::{Held, Verdict, judge};
use crate::state::{Command, Failure, OnBrokerLoss, Policy, Record, Status};
use crate::version::Version;

/// Most errors that are reported at a time; the oldest go.
pub const ERRORS: usize = 16;
/// Most actions at once that are remembered after they have ended; the oldest go.
pub const INSTANT_ACTIONS: usize = 64;
/// How long the vehicle is left alone after it has refused something.
const BACK_OFF: Duration = Duration::from_millis(500);

/// Header ids of a block.
const HEADER_IDS: u32 = 1_000;

/// A topic of the gateway's own messages.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Topic {
    /// `connection`.
    Connection,
    /// `state`.
    State,
    /// `visualization`.
    Visualization,
    /// `factsheet`.
    Factsheet,
}

/// One vehicle under VDA 5050.
#[derive(Debug)]
pub struct Machine {
    record: Record,
    policy: Policy,
    status: Option<Status>,
    has_changed: bool,
    header_ids: [u32; 4],
    is_drive_sent: bool,
    is_halt_due: bool,
    is_position_sent: bool,
    retry_at: Duration,
    /// Since when the broker is away, and what the vehicle had driven then.
    broker_lost: Option<(Duration, Option<f64>)>,
    had_broker: bool,
    /// The vehicle stands because the broker is away.
    is_held: bool,
    is_report_due: bool,
    is_factsheet_due: bool,
    /// What the vehicle had driven when it passed its last node.
    driven_at_node: Option<f64>,
    /// What is reported while it lasts, and concerns no order.
    alarms: Vec<Refusal>,
    /// Why the vehicle does not take the stretch that it was told, which is told again and again.
    drive_refused: Option<String>,
    /// The last number of the stretch that the vehicle has refused last; 0 before that.
    refused: u64,
    /// A command to drive or to stand has changed what the vehicle does since it said how it is.
    is_status_old: bool,
    /// Why nothing is done with this vehicle, if so.
    out_of_service: Option<String>,
}

impl Machine {
    /// Goes on from a record. The broker counts as away from `now` on.
    pub fn new(record: Record, policy: Policy, now: Duration) -> Self {
        Self {
            header_ids: record.header_ids,
            record,
            policy,
            status: None,
            has_changed: false,
            is_drive_sent: false,
            is_halt_due: false,
            is_position_sent: false,
            retry_at: Duration::ZERO,
            broker_lost: Some((now, None)),
            had_broker: false,
            is_held: false,
            is_report_due: true,
            is_factsheet_due: false,
            driven_at_node: None,
            alarms: Vec::new(),
            drive_refused: None,
            refused: 0,
            is_status_old: false,
            out_of_service: None,
        }
    }

    /// One whose record cannot be read: the vehicle is shown in mode SERVICE with a FATAL error, as nobody knows what it has driven.
    pub fn out_of_service(why: &str, policy: Policy, now: Duration) -> Self {
        Self { out_of_service: Some(why.to_owned()), ..Self::new(Record::default(), policy, now) }
    }

    /// What is reported from now on, beside errors of orders.
    pub fn alarm(&mut self, alarms: Vec<Refusal>) {
        self.alarms = alarms;
    }

    /// Whether it was made so.
    pub const fn is_out_of_service(&self) -> bool {
        self.out_of_service.is_some()
    }

    /// What is to be kept.
    pub const fn record(&self) -> &Record {
        &self.record
    }

    /// Whether the record has changed since this was asked.
    pub const fn take_changed(&mut self) -> bool {
        std::mem::replace(&mut self.has_changed, false)
    }

    /// Whether a state was asked for, or is due whatever it says.
    pub const fn take_report_due(&mut self) -> bool {
        std::mem::replace(&mut self.is_report_due, false)
    }

    /// Whether the factsheet was asked for.
    pub const fn take_factsheet_due(&mut self) -> bool {
        std::mem::replace(&mut self.is_factsheet_due, false)
    }

    /// Whether the vehicle is linked.
    pub const fn is_linked(&self) -> bool {
        self.status.is_some()
    }

    /// Whether the vehicle moves or handles something, or is to.
    pub fn is_busy(&self) -> bool {
        self.record.is_order_open() || self.record.actions.iter().any(|entry| !entry.status.has_ended())
    }

    /// The next header id of a topic (6.4). After a start they go on above what is reserved.
    pub const fn header_id(&mut self, topic: Topic) -> u32 {
        let next = &mut self.header_ids[topic as usize];
        let id = *next;
        *next = next.saturating_add(1);
        id
    }

    /// Reserves header ids in blocks, and before they are used up: no message waits for a disk because of its id alone.
    pub fn reserve_header_ids(&mut self) {
        for (next, kept) in self.header_ids.iter().zip(&mut self.record.header_ids) {
            if next.saturating_add(HEADER_IDS / 2) > *kept {
                *kept = next.saturating_add(HEADER_IDS);
                self.has_changed = true;
            }
        }
    }

    /// A message that cannot be read, or is not for now.
    pub fn refuse(&mut self, refusal: &Refusal) {
        let error = refusal.error(self.policy.version);
        self.has_changed = true;
        self.is_report_due = true;
        self.record.errors.retain(|known| *known != error);
        self.record.errors.push(error);
        if self.record.errors.len() > ERRORS {
            self.record.errors.remove(0);
        }
    }

    /// A message on topic `order`.
    pub fn order(&mut self, order: Order) {
        self.is_report_due = true;
        match self.judge(&order) {
            Ok(Verdict::Duplicate) => {}
            Ok(verdict) => self.take(order, verdict),
            Err(refusal) => {
                let refusal = refusal.about("topic", "order").about("headerId", order.header.header_id);
                let refusal = refusal.about("orderId", &order.order_id);
                self.refuse(&refusal.about("orderUpdateId", order.order_update_id));
            }
        }
    }

    fn judge(&self, order: &Order) -> Result<Verdict, Refusal> {
        let record = &self.record;
        let refused = |kind: Kind, text: &str| Err(Refusal::new(kind, text));
        let Some(status) = &self.status else { return refused(Kind::NotAvailable, "the vehicle is not connected") };
        if !is_controlled(status.mode) {
            return refused(Kind::NotAvailable, "the vehicle is not in an automatic mode");
        }
        let base = record.nodes.iter().take_while(|node| node.released).last();
        let last_node = (record.last_node_id.as_str(), record.last_node_sequence_id);
        let held = Held {
            order_id: &record.order_id,
            order_update_id: record.order_update_id,
            zone_set_id: record.zone_set_id.as_deref(),
            is_cancelled: record.is_cancelled,
            is_placed: record.is_placed,
            is_executing: self.is_executing(),
            decision_point: Some(base.map_or(last_node, |node| (&node.node_id, node.sequence_id))),
            last_node,
            is_same_content: record.content.is_none_or(|content| content == content_of(order)),
            position: status.position.as_ref().map(|at| (at.x, at.y, at.map_id.as_str())),
        };
        let verdict = judge(order, &held, &self.policy.can, self.policy.version)?;
        let is_placing = |entry: &Entry| !entry.is_of_order() && entry.action.action_type == "initPosition";
        if verdict == Verdict::Update
            && record.actions.iter().any(|entry| is_placing(entry) && !entry.status.has_ended())
        {
            return refused(Kind::NotAvailable, "initPosition is under way");
        }
        if verdict == Verdict::New && record.spent.contains(&order.order_id) {
            return refused(Kind::Replaced, "the order was replaced by a later one");
        }
        if verdict != Verdict::Duplicate {
            self.has_space(order, verdict)?;
        }
        Ok(verdict)
    }

    /// Actions' ids are used once, and what is held is bounded over all updates. An update sends its first node again.
    fn has_space(&self, order: &Order, verdict: Verdict) -> Result<(), Refusal> {
        let skipped = usize::from(verdict == Verdict::Update);
        let base = self.record.nodes.iter().filter(|node| node.released && verdict == Verdict::Update).count();
        let nodes = base + order.nodes.len() - skipped;
        if nodes > self.policy.can.max_nodes {
            return Err(Refusal::new(Kind::Space, "too many nodes with those that are left").about("nodes", nodes));
        }
        let nodes = order.nodes.iter().skip(skipped).flat_map(|node| &node.actions);
        let sent: Vec<&Action> = nodes.chain(order.edges.iter().flat_map(|edge| &edge.actions)).collect();
        let keeps_instant = self.policy.version.rules().lists_instant_actions;
        let stays = |entry: &&Entry| match verdict {
            Verdict::Update => !self.is_in_horizon(entry.place),
            _ => keeps_instant && !entry.is_of_order(),
        };
        let kept: Vec<&Entry> = self.record.actions.iter().filter(stays).collect();
        if let Some(twice) = sent.iter().find(|sent| kept.iter().any(|kept| kept.action.action_id == sent.action_id)) {
            let text = "an action of this id is here";
            return Err(Refusal::new(Kind::Validation, text).about("actionId", &twice.action_id));
        }
        // Those at once that have ended give way.
        let held = kept.iter().filter(|entry| entry.is_of_order() || !entry.status.has_ended()).count();
        if sent.len() + held > self.policy.can.max_actions {
            return Err(Refusal::new(Kind::Space, "too many actions").about("actions", sent.len() + held));
        }
        Ok(())
    }

    fn is_in_horizon(&self, place: Place) -> bool {
        let nodes = self.record.nodes.iter().filter(|node| !node.released);
        let edges = self.record.edges.iter().filter(|edge| !edge.released);
        match place {
            Place::Node(id) => nodes.map(|node| node.sequence_id).any(|horizon| horizon == id),
            Place::Edge(id) => edges.map(|edge| edge.sequence_id).any(|horizon| horizon == id),
            Place::Instant => false,
        }
    }

    /// Takes an order that was judged: box 9.
    fn take(&mut self, order: Order, verdict: Verdict) {
        let content = Some(content_of(&order));
        let Order { order_id, order_update_id, zone_set_id, mut nodes, edges, .. } = order;
        let keeps_instant = self.policy.version.rules().lists_instant_actions;
        if verdict == Verdict::New {
            (self.drive_refused, self.refused) = (None, 0);
            let number = self.record.number;
            let mut old = std::mem::take(&mut self.record);
            // That of an instant action lasts until the next one.
            old.errors.retain(|error| keeps_instant && Kind::is_of_instant_action(error));
            let Record { errors, last_node_id, last_node_sequence_id, is_paused, header_ids, spent, .. } = old;
            self.record = Record {
                errors,
                spent,
                last_node_id,
                last_node_sequence_id,
                is_paused,
                header_ids,
                number,
                order_id,
                zone_set_id,
                ..Record::default()
            };
            let (instant, _): (Vec<_>, Vec<_>) = old.actions.into_iter().partition(|entry| !entry.is_of_order());
            self.record.spend(old.order_id);
            if keeps_instant {
                self.record.actions = instant;
            } else {
                instant.into_iter().for_each(|entry| self.record.spend_action(entry));
            }
        } else {
            let horizon: Vec<Place> = self.record.actions.iter().map(|entry| entry.place).collect();
            let mut stays = horizon.iter().map(|place| !self.is_in_horizon(*place)).collect::<Vec<_>>().into_iter();
            self.record.actions.retain(|_| stays.next().unwrap_or(true));
            self.record.nodes.retain(|node| node.released);
            self.record.edges.retain(|edge| edge.released);
            // The node at which it is joined is here, and stays as it was sent first.
            nodes.remove(0);
            self.record.errors.retain(|error| !Kind::ends_with_an_order(error));
        }
        (self.record.order_update_id, self.record.content) = (order_update_id, content);
        let mut at_edges = edges.iter().map(|edge| (edge.sequence_id, Place::Edge(edge.sequence_id), &edge.actions));
        let mut actions: Vec<_> =
            nodes.iter().map(|node| (node.sequence_id, Place::Node(node.sequence_id), &node.actions)).collect();
        actions.extend(&mut at_edges);
        actions.sort_by_key(|(sequence, ..)| *sequence);
        let entries = actions
            .into_iter()
            .flat_map(|(_, place, actions)| actions.iter().map(move |action| Entry::new(action.clone(), place)));
        // Actions at once stay behind those of the order.
        let (mut order, instant): (Vec<_>, Vec<_>) =
            std::mem::take(&mut self.record.actions).into_iter().partition(|entry| entry.is_of_order());
        order.extend(entries);
        order.extend(instant);
        self.record.actions = order;
        self.record.nodes.extend(nodes);
        self.record.edges.extend(edges);
        self.has_changed = true;
        if self.record.nodes.len() > self.record.edges.len() {
            // The vehicle is at an order's first node, or it would have been refused.
            self.traverse(self.status.as_ref().map(|status| status.driven));
        }
    }

    /// Box 3.
    fn is_executing(&self) -> bool {
        !self.record.nodes.is_empty() || self.record.actions.iter().any(|entry| !entry.status.has_ended())
    }

    /// The first node that is left counts as traversed (6.10.2), where the vehicle had driven so far.
    fn traverse(&mut self, driven: Option<f64>) {
        self.driven_at_node = driven;
        let record = &mut self.record;
        if record.nodes.is_empty() {
            return;
        }
        let left = (record.edges.len() == record.nodes.len()).then(|| record.edges.remove(0));
        let node = record.nodes.remove(0);
        (record.last_node_id, record.last_node_sequence_id) = (node.node_id, node.sequence_id);
        for entry in &mut record.actions {
            if entry.place == Place::Node(node.sequence_id) {
                entry.is_triggered = true;
            }
            let is_on_left = left.as_ref().is_some_and(|edge| entry.place == Place::Edge(edge.sequence_id));
            if is_on_left && !entry.status.has_ended() {
                if entry.number == 0 {
                    entry.end(ActionStatus::Failed, Some("the edge was left".into()));
                } else {
                    entry.ends_as.get_or_insert(ActionStatus::Finished);
                }
            }
        }
        record.told = record.told.saturating_sub(1);
        record.drive = record.drive.filter(|_| record.told > 0).map(|number| number + 1);
        self.is_drive_sent &= record.told > 0;
        self.has_changed = true;
    }

    /// Ends what waits for the vehicle to stand: `cancelOrder` and `startPause`.
    fn settle(&mut self) {
        let Some(status) = &self.status else { return };
        let is_controlled = is_controlled(status.mode);
        // What is driven by hand moves, and has no order all the same.
        let stands = !is_controlled || !status.is_driving && !self.is_status_old;
        let stands = stands && !self.is_drive_sent && !self.is_halt_due;
        if !is_controlled {
            let why = "the vehicle is not in an automatic mode";
            if !self.record.is_cancelled && self.record.is_order_open() {
                self.give_up_order(why);
            }
            // Nothing begins beside somebody who works at the vehicle.
            self.give_up_actions(why, Entry::is_of_vehicle_at_once);
        }
        let is_cancelling = self.record.is_cancelled;
        if !stands {
            return;
        }
        let runs = self.record.actions.iter().any(|entry| entry.is_of_order() && !entry.status.has_ended());
        if is_cancelling && !runs && !self.record.nodes.is_empty() {
            self.record.nodes.clear();
            self.record.edges.clear();
            (self.record.drive, self.record.told) = (None, 0);
            self.has_changed = true;
        }
        for entry in &mut self.record.actions {
            let is_done = match entry.action.action_type.as_str() {
                "startPause" => true,
                "cancelOrder" => !runs,
                _ => false,
            };
            if !entry.is_of_order() && entry.status == ActionStatus::Running && is_done {
                entry.status = ActionStatus::Finished;
                self.has_changed = true;
            }
        }
    }

    /// The vehicle has said how it is. The first status of a link says what has become of what the link before had begun.
    pub fn status(&mut self, mut status: Status) {
        if self.out_of_service.is_some() {
            status.mode = OperatingMode::Service;
        }
        if self.status.is_none() {
            self.fail_what_is_late();
        }
        self.enter(status.mode);
        let floor = status.drive.max(status.action);
        if floor > self.record.number {
            // The record is older than what the vehicle has been told.
            self.record.number = floor;
            self.has_changed = true;
        }
        (0..self.passed(&status)).for_each(|_| self.traverse(Some(status.driven)));
        self.is_drive_sent &= status.is_ordered;
        self.is_status_old = false;
        for index in 0..self.record.actions.len() {
            self.learn(index, &status);
        }
        self.status = Some(status);
        self.settle();
    }

    /// What a mode does by itself, beside ending an order.
    fn enter(&mut self, mode: OperatingMode) {
        let was_controlled = self.status.as_ref().is_some_and(|status| is_controlled(status.mode));
        let known = self.record.errors.len();
        if is_controlled(mode) && !was_controlled {
            // In 2.x this is one of the errors that last until an order is taken.
            let name = Kind::NotAvailable.name(Version::V3);
            self.record.errors.retain(|error| error.error_type != name);
        }
        let forgets = self.policy.version.rules().service_forgets_node
            && matches!(mode, OperatingMode::Service | OperatingMode::Teachin)
            && !self.record.last_node_id.is_empty();
        if forgets {
            self.record.last_node_id.clear();
        }
        self.has_changed |= forgets || self.record.errors.len() != known;
    }

    /// What a status says of an action.
    fn learn(&mut self, index: usize, status: &Status) {
        let entry = &mut self.record.actions[index];
        if !entry.runs() {
            return;
        }
        if entry.number == status.action {
            let (ended, ends_as) = (status.action_status.has_ended(), entry.ends_as);
            if !ended && entry.status != status.action_status && status.action_status != ActionStatus::Waiting {
                entry.status = status.action_status;
                self.has_changed = true;
            }
            if ended {
                // What was to end may have ended well before.
                let how = match (status.action_status, ends_as) {
                    (ActionStatus::Failed, Some(ends_as)) => ends_as,
                    (how, _) => how,
                };
                self.end(index, how, &status.action_result, ends_as.is_some());
            }
        } else if entry.number < status.action {
            self.end(index, ActionStatus::Failed, "the vehicle has begun another action", false);
        } else if entry.boot != status.boot {
            self.end(index, ActionStatus::Failed, "the vehicle restarted: whether it ran is not known", false);
        } else if entry.ends_as.is_some() && !entry.is_sent {
            // The vehicle has never heard of it.
            let how = entry.ends_as.unwrap_or_default();
            self.end(index, how, "", true);
        }
    }

    fn end(&mut self, index: usize, how: ActionStatus, result: &str, was_wanted: bool) {
        let entry = &mut self.record.actions[index];
        entry.end(how, Some(result.to_owned()));
        self.has_changed = true;
        if how == ActionStatus::Failed && !was_wanted {
            let refusal = Refusal::new(Kind::Action, if result.is_empty() { "the action failed" } else { result });
            let about = refusal.about("actionId", &self.record.actions[index].action.action_id);
            self.refuse(&about);
        }
    }

    /// The link to the vehicle is lost: what moved on it has ended.
    pub fn vehicle_lost(&mut self) {
        self.status = None;
        self.is_drive_sent = false;
        self.is_halt_due = false;
        self.is_position_sent = false;
        self.is_status_old = false;
        (self.drive_refused, self.refused) = (None, 0);
        for entry in &mut self.record.actions {
            (entry.is_sent, entry.is_end_sent) = (false, false);
        }
    }

    /// The broker is there, or not. What came meanwhile is not known: a state is due.
    pub fn broker(&mut self, is_there: bool, now: Duration) {
        if is_there {
            self.had_broker = true;
            self.broker_lost = None;
            self.is_held = false;
            self.is_report_due = true;
            self.is_factsheet_due = true;
        } else if self.broker_lost.is_none() {
            self.broker_lost = Some((now, self.status.as_ref().map(|status| status.driven)));
        }
    }

    /// Whether the vehicle stands because the broker is away.
    fn hold(&mut self, now: Duration) {
        let Some((since, from)) = &mut self.broker_lost else { return };
        let driven = self.status.as_ref().map(|status| status.driven);
        // Counted from the first status, where there was none when the broker went.
        *from = from.or(driven);
        let is_over = match self.policy.on_broker_loss {
            OnBrokerLoss::Stop => true,
            OnBrokerLoss::FinishBase { seconds, metres } => {
                let too_long = now.saturating_sub(*since).as_secs_f64() > seconds;
                // A comparison that a NaN fails.
                too_long || !driven.zip(*from).is_none_or(|(driven, from)| driven - from <= metres)
            }
        };
        if !is_over || self.is_held {
            return;
        }
        self.is_held = true;
        let moves = self.record.nodes.first().is_some_and(|node| node.released) && !self.record.is_cancelled;
        // Before its first connection the program has stopped nothing.
        if self.had_broker && moves && !self.policy.resumes_by_itself && !self.record.is_paused {
            self.record.is_paused = true;
            self.refuse(&Refusal::new(Kind::BrokerLost, "the vehicle stopped while the broker was away"));
        }
    }

    /// What the vehicle is to give up now. That needs no record: neither a disk, a question to the vehicle nor a pause after a refusal
    /// may come before it.
    pub fn next_stop(&mut self, now: Duration) -> Option<Command> {
        self.hold(now);
        self.status.as_ref()?;
        if self.is_drive_sent && !self.may_drive() {
            self.is_drive_sent = false;
            self.is_halt_due = true;
        }
        if self.is_halt_due {
            return Some(Command::Halt);
        }
        let is_due = |entry: &&mut Entry| entry.ends_as.is_some() && entry.runs() && !entry.is_end_sent;
        let entry = self.record.actions.iter_mut().find(is_due)?;
        entry.is_end_sent = true;
        Some(Command::EndAction { number: entry.number })
    }

    /// The master is in control, and nothing has stopped the vehicle.
    fn is_able(&self) -> bool {
        let able =
            |status: &Status| is_controlled(status.mode) && status.e_stop == EStop::None && status.stopped.is_none();
        self.status.as_ref().is_some_and(able)
    }

    fn may_begin(&self) -> bool {
        self.is_able() && !self.record.is_paused && !self.is_held
    }

    fn may_drive(&self) -> bool {
        let is_stopped = self.record.is_paused || self.is_held || self.record.is_cancelled;
        self.is_able() && !is_stopped && !block_driving(&self.record.actions)
    }

    /// What the vehicle is to be told now, if anything. The record is to be written before, unless it [is a stop](Command::is_stop).
    pub fn next(&mut self, now: Duration) -> Option<Command> {
        if let Some(stop) = self.next_stop(now) {
            return Some(stop);
        }
        let boot = self.status.as_ref()?.boot;
        if now < self.retry_at {
            return None;
        }
        if let Some(command) = self.next_action(boot) {
            return Some(command);
        }
        if !self.may_drive() || self.is_drive_enough() {
            return None;
        }
        self.next_drive(boot)
    }

    /// Whether a command that has waited for the disk is still to be told.
    pub fn is_wanted(&mut self, command: &Command) -> bool {
        let may_begin = self.may_begin();
        match command {
            Command::Drive { .. } => self.is_drive_sent && self.may_drive(),
            Command::Halt | Command::EndAction { .. } => true,
            Command::InitPosition { .. } => self.is_position_sent,
            Command::Act { number, .. } => {
                let entry = self.record.actions.iter_mut().find(|entry| entry.number == *number && entry.runs());
                let Some(entry) = entry else { return false };
                entry.is_sent &= may_begin && entry.ends_as.is_none();
                entry.is_sent
            }
        }
    }

    fn next_action(&mut self, boot: u64) -> Option<Command> {
        let may_begin = self.may_begin();
        for entry in &mut self.record.actions {
            // Also one that has begun: it ended with the link or the lease, and the vehicle would go on with it.
            if may_begin && entry.runs() && entry.ends_as.is_none() && !entry.is_sent {
                entry.is_sent = true;
                return Some(Command::Act { number: entry.number, action: entry.action.clone() });
            }
            let is_new_position = entry.action.action_type == "initPosition" && entry.status == ActionStatus::Running;
            if is_new_position && !entry.is_of_order() && !self.is_position_sent {
                self.is_position_sent = true;
                return Some(Command::InitPosition { action: entry.action.clone() });
            }
        }
        if !may_begin {
            return None;
        }
        let index = startable(&self.record.actions, self.policy.actions_at_once)?;
        let drives = self.status.as_ref().is_none_or(|status| status.is_driving);
        let moves = self.is_drive_sent || self.is_status_old || drives;
        if moves && self.record.actions[index].action.blocking_type.blocks_driving() {
            // The vehicle stops for it first.
            return None;
        }
        self.record.number += 1;
        self.has_changed = true;
        let entry = &mut self.record.actions[index];
        (entry.number, entry.boot, entry.status) = (self.record.number, boot, ActionStatus::Running);
        entry.is_sent = true;
        Some(Command::Act { number: entry.number, action: entry.action.clone() })
    }

    /// What the vehicle has answered to a command: nothing, or a refusal for people. One that was refused comes again, but for an
    /// action, which fails.
    pub fn answered(&mut self, command: &Command, answer: Result<(), Failure>, now: Duration) {
        let failed = answer.as_ref().is_err();
        match command {
            Command::Drive { number, legs, goes_on } => {
                self.drive_answered(number + legs.len() as u64 - 1, *goes_on, answer);
            }
            Command::Halt => (self.is_halt_due, self.is_status_old) = (failed, true),
            Command::Act { number, .. } => self.acted(*number, answer),
            Command::EndAction { number } => {
                if let Some(entry) = self.record.actions.iter_mut().find(|entry| entry.number == *number) {
                    entry.is_end_sent = !failed;
                }
            }
            Command::InitPosition { action } => self.positioned(action, answer),
        }
        if failed {
            self.retry_at = now + BACK_OFF;
        }
        self.settle();
    }

    fn acted(&mut self, number: u64, answer: Result<(), Failure>) {
        let Some(index) = self.record.actions.iter().position(|entry| entry.number == number) else { return };
        match answer {
            Ok(()) => {}
            Err(Failure::Refused(why)) => self.end(index, ActionStatus::Failed, &why, false),
            // It may have begun: the same number is sent again.
            Err(_) => self.record.actions[index].is_sent = false,
        }
    }

    /// The state without its header; `None` while the vehicle is not linked, as nothing is known then.
    pub fn report(&self) -> Option<Report> {
        let status = self.status.as_ref()?;
        let mut report = self.record.report(status, &self.policy.can.maps, self.policy.version, self.is_held);
        let since = self.driven_at_node.map(|driven| status.driven - driven);
        report.distance_since_last_node = since.filter(|metres| metres.is_finite() && *metres >= 0.0);
        let out_of_service = self.out_of_service.as_ref().map(|why| Refusal::new(Kind::OutOfService, why));
        let drive = self.drive_error();
        let lasting = out_of_service.iter().chain(&drive).chain(&self.alarms);
        report.errors.extend(lasting.map(|refusal| refusal.error(self.policy.version)));
        Some(report)
    }
}

/// A digest of an order without its header, to see whether the same update comes with other content: FNV-1a, 64 bits.
fn content_of(order: &Order) -> u64 {
    let text = serde_json::to_vec(&Order { header: Header::default(), ..order.clone() }).unwrap_or_default();
    text.iter().fold(0xcbf2_9ce4_8422_2325, |hash, byte| (hash ^ u64::from(*byte)).wrapping_mul(0x0100_0000_01b3))
}

/// Whether the master's orders count in a mode.
const fn is_controlled(mode: OperatingMode) -> bool {
    matches!(mode, OperatingMode::Automatic | OperatingMode::Semiautomatic)
}
