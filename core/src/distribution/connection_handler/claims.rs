//! Claims: which of two managers of one identity commands. Only what has been proven counts: a hello behind its handshake, the
//! answer to a question of this unit, and of a fence only one whose tag is genuine. Nothing that one peer says ends more than its
//! own link. The states are in `docs/wire.md`, "Claims".

use super::known::Newcomer;
use super::{Node, NodeCounter};
use crate::config::OBEYED_MANAGERS;
use crate::distribution::authenticator::Authenticator;
use crate::distribution::claim::{Claim, TaggedClaim};
use crate::distribution::datagram::Announce;
use crate::distribution::hello::{ClaimReport, Hello, Manager};
use crate::distribution::identity::{Epoch, Identity, Role};
use crate::error::Refusal;
use crate::host::mailman::Mailman;
use crate::host::port::Port;
use crate::time::{Duration, Instant};

/// From one question for this unit's own identity to the next.
pub(super) const PERIOD: Duration = Duration::from_secs(1);
/// How often the node looks meanwhile, so that it notices a pause of its own.
pub(super) const LOOK: Duration = Duration::from_millis(250);
/// Questions in a row that nobody answers before a claim is raised.
pub(super) const QUESTIONS: u8 = 3;
/// So long the manager of a higher claim was not heard before a claim is raised above it.
const UNHEARD: Duration = Duration::from_secs(3);
/// Between the first raise and the next one; it doubles.
const FIRST_PAUSE: Duration = Duration::from_secs(30);
const LONGEST_PAUSE: Duration = Duration::from_secs(3_600);
/// Between two raises of a manager that takes over.
const TAKE_OVER_PAUSE: Duration = Duration::from_millis(100);
/// A moving call waits at most so long until the claim that it is made under is stored.
pub(super) const STORING: Duration = Duration::from_secs(2);
/// Fences that are kept until the node is polled, which follows at once.
const FENCES: usize = 4;

/// What the port is to do about claims. To be asked for with [`Node::take_claim_event`] after each
/// [`datagram`](Node::datagram) and [`poll`](Node::poll), and after what a session did.
#[derive(Clone, Debug, PartialEq, Eq)]
#[non_exhaustive]
pub enum ClaimEvent {
    /// This claim of this manager is to be stored with the fingerprint of the pair key, unless both are stored already; a moving call
    /// may wait for it. The port answers with [`Node::claim_kept`], and then polls its sessions. A board stores while nothing moves.
    Keep(Identity, TaggedClaim),
    /// This claim is obeyed until this unit's next start: it could not be stored, or not in time. Under that of a manager that the
    /// unit was handed over to nothing moves meanwhile.
    Unkept(Identity, Claim),
    /// This m_unit is to claim the one above: the port draws a claimant, stores, calls [`Node::set_claim`], and has each session
    /// announce it. Where storing fails it does nothing; where it may not claim now it calls [`Node::not_raised`].
    Raise(Claim),
    /// A live manager of this m_unit's identity has this higher claim: the port stores it and stops. One that is to stand by ends all
    /// links instead, and calls [`Node::stand_by`].
    StepDown(TaggedClaim),
    /// This standby is to command with a claim above this one: the port draws a claimant, stores, and calls [`Node::lead`]. Where
    /// storing fails it calls [`Node::stand_by`].
    Lead(Claim),
}

/// Whether an m_unit commands.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Stage {
    Commands,
    /// It stands by.
    StandsBy,
    /// The same, and the port stores the claim with which it is to command.
    Starts,
}

/// Whether a claim that is obeyed is stored.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Keeping {
    /// No moving call was made under it.
    Unasked,
    /// A moving call waits, since then; whether the port has been told.
    Wanted(Instant, bool),
    Kept,
    /// The same, and the port is to look whether the pair key is still the one that the claim was stored with.
    KeptBefore,
    /// Too late, or it failed; whether the port has been told.
    Failed(bool),
}

/// Whether a moving call of a manager may begin.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum MayMove {
    Yes,
    /// Once its claim is stored, or it has taken too long.
    Waits,
    /// The unit belongs to another manager, or is on its way to one.
    No,
}

/// The highest claim of a manager that this unit has obeyed.
#[derive(Clone, Copy, Debug)]
struct Obeyed {
    tagged: TaggedClaim,
    keeping: Keeping,
    /// When that manager was last heard, at the latest; the far future while it is connected and misses no keep-alive.
    heard: Instant,
}

impl Obeyed {
    /// The pair key may be another one than the claim was stored with.
    fn look_again(&mut self) {
        if self.keeping == Keeping::Kept {
            self.keeping = Keeping::KeptBefore;
        }
    }
}

/// A genuine claim above this manager's; of a standby the highest that it has heard.
#[derive(Clone, Copy, Debug)]
pub(super) struct Rival {
    pub(super) claim: Claim,
    /// For how long its manager had not been heard, by whoever heard it last, when a vehicle said so last. That nobody says anything
    /// any more is no sign that it is gone: this unit may be cut off from both. With an authority's key it may command all the same.
    silent: Duration,
    reported: Instant,
}

impl Rival {
    /// From when on nobody has heard its manager for this long, as far as was said.
    pub(super) fn silent_from(&self, silence: Duration) -> Instant {
        if self.silent >= silence { Instant::START } else { self.reported + (silence - self.silent) }
    }
}

/// When the manager was last heard, by the answers to a standby's last questions. A vehicle that misses no keep-alive yet says
/// that it hears the manager, and knows better a question later: so as many answers as before take the place of those. Where
/// some were lost, both count.
#[derive(Clone, Copy, Debug)]
pub(super) struct Reports {
    /// By the answers to the last question, and to those before.
    heard: [Instant; 2],
    answers: [u16; 2],
}

impl Reports {
    pub(super) const NONE: Self = Self { heard: [Instant::START; 2], answers: [0; 2] };

    pub(super) fn note(&mut self, heard: Instant) {
        self.heard[0] = self.heard[0].max(heard);
        self.answers[0] = self.answers[0].saturating_add(1);
    }

    /// What comes from here on answers another question.
    pub(super) fn ask(&mut self) {
        if self.answers[0] > 0 {
            let before = self.heard().unwrap_or(Instant::START);
            *self = Self { heard: [Instant::START, before], answers: [0, self.answers[0].max(self.answers[1])] };
        }
    }

    /// `None` without an answer.
    pub(super) fn heard(&self) -> Option<Instant> {
        let ([last, before], [answers, answers_before]) = (self.heard, self.answers);
        let heard = if answers >= answers_before { last } else { last.max(before) };
        (answers.max(answers_before) > 0).then_some(heard)
    }
}

/// The questions for this unit's own identity.
#[derive(Clone, Copy, Debug)]
pub(super) struct Questions {
    /// Of the last one; another each time.
    pub(super) nonce: u64,
    /// When it was asked; none is open before the first.
    pub(super) asked: Option<Instant>,
    pub(super) unanswered: u8,
    /// Vehicles were asked as well, a question ago.
    asked_vehicles: bool,
    pub(super) polled: Instant,
    pub(super) next: Instant,
}

impl Questions {
    /// Nothing that was asked until now counts as unanswered.
    const fn begin_anew(&mut self) {
        (self.unanswered, self.asked, self.asked_vehicles) = (0, None, false);
    }
}

/// The claim of an m_unit, those that it has heard, and those that a vehicle obeys.
#[derive(Debug)]
pub(super) struct Claims {
    pub(super) stage: Stage,
    /// It has stood by before it commanded.
    pub(super) has_stood_by: bool,
    pub(super) own: TaggedClaim,
    took_over: Option<Instant>,
    /// It raises its claim until it was the highest once.
    takes_over: bool,
    fences: heapless::Vec<ClaimReport, FENCES>,
    pub(super) rival: Option<Rival>,
    pub(super) reports: Reports,
    pub(super) questions: Questions,
    next_raise: Instant,
    pause: Duration,
    pub(super) event: Option<ClaimEvent>,
    /// This m_unit claims only while an authority has given it the key.
    by_key: bool,
    /// The port stores what this unit obeys.
    stores: bool,
    obeyed: heapless::Vec<(Identity, Obeyed), OBEYED_MANAGERS>,
}

impl Claims {
    pub(super) const fn new(now: Instant) -> Self {
        Self {
            stage: Stage::Commands,
            has_stood_by: false,
            own: TaggedClaim::NONE,
            took_over: None,
            takes_over: false,
            fences: heapless::Vec::new(),
            rival: None,
            reports: Reports::NONE,
            questions: Questions {
                nonce: 0,
                asked: None,
                unanswered: 0,
                asked_vehicles: false,
                polled: now,
                next: Instant::FAR_FUTURE,
            },
            next_raise: Instant::START,
            pause: FIRST_PAUSE,
            event: None,
            by_key: false,
            stores: false,
            obeyed: heapless::Vec::new(),
        }
    }

    pub(super) const fn next(&self) -> Instant {
        self.questions.next
    }

    /// From here on it stands by, and asks next at `next`. What it has heard, and obeyed of others, stays.
    pub(super) fn stand_by(&mut self, now: Instant, next: Instant) {
        let obeyed = core::mem::take(&mut self.obeyed);
        let Self { rival, by_key, stores, .. } = *self;
        *self = Self { stage: Stage::StandsBy, has_stood_by: true, rival, by_key, stores, obeyed, ..Self::new(now) };
        if let Some(rival) = rival {
            self.reports.note(rival.reported - rival.silent);
        }
        self.questions.next = next;
    }

    /// A standby that was about to command waits on.
    pub(super) fn start_no_more(&mut self) {
        if self.stage == Stage::Starts {
            (self.stage, self.event) = (Stage::StandsBy, None);
        }
    }

    fn of(&self, manager: &Identity) -> Option<&Obeyed> {
        self.obeyed.iter().find(|(identity, _)| identity == manager).map(|(_, obeyed)| obeyed)
    }

    fn of_mut(&mut self, manager: &Identity) -> Option<&mut Obeyed> {
        self.obeyed.iter_mut().find(|(identity, _)| identity == manager).map(|(_, obeyed)| obeyed)
    }

    /// Whether this unit can store what it obeys of a manager.
    pub(super) fn can_keep(&self, manager: &Identity) -> bool {
        self.stores && (self.knows(manager) || !self.obeyed.is_full())
    }

    /// Has the port store the claim of a manager now, whatever was stored of it before.
    pub(super) fn want_kept(&mut self, now: Instant, manager: &Identity) {
        if let Some(obeyed) = self.of_mut(manager) {
            obeyed.keeping = Keeping::Wanted(now, false);
            self.questions.next = now;
        }
    }

    /// Whether the claim of a manager could not be stored.
    pub(super) fn has_failed(&self, manager: &Identity) -> bool {
        self.of(manager).is_some_and(|obeyed| matches!(obeyed.keeping, Keeping::Failed(_)))
    }

    /// Whether this unit has obeyed a manager by a claim.
    pub(super) fn knows(&self, manager: &Identity) -> bool {
        self.of(manager).is_some()
    }

    /// Whether nobody has asked the port to store the claim of a manager.
    pub(super) fn is_unasked(&self, manager: &Identity) -> bool {
        self.of(manager).is_some_and(|obeyed| obeyed.keeping == Keeping::Unasked)
    }

    pub(super) fn meet_rival(&mut self, now: Instant, claim: Claim, silent: Duration) {
        let rival = self.rival.get_or_insert(Rival { claim, silent, reported: now });
        let known = rival.silent + now.since(rival.reported);
        *rival = Rival { claim: rival.claim.max(claim), silent: known.min(silent), reported: now };
        self.questions.next = self.questions.next.min(now);
    }
}

/// The claim that a report names; the lowest one without a report.
pub(super) const fn claim_of(report: Option<&ClaimReport>) -> Claim {
    match report {
        Some(report) => report.tagged.claim,
        None => Claim::NONE,
    }
}

/// Of the port, about claims.
impl<P: Port> Node<P> {
    /// The claim of an m_unit; of an s_unit the highest that it has obeyed.
    pub fn claim(&self) -> Claim {
        match &self.target {
            Some(manager) => self.obeyed(manager),
            None => self.claims.own.claim,
        }
    }

    /// This m_unit's own claim, which the port has stored: what hellos and answers say from here on. Links that there are stay as
    /// they are; the port has their sessions announce it. A lower one than it has is not taken.
    pub fn set_claim(&mut self, tagged: TaggedClaim) {
        if tagged.claim < self.claims.own.claim {
            return;
        }
        self.claims.own = tagged;
        self.claims.rival = self.claims.rival.filter(|rival| rival.claim > tagged.claim);
        if self.claims.rival.is_none() {
            // The next rival is another one: questions about the last one say nothing about it.
            self.claims.questions.begin_anew();
        }
    }

    /// This m_unit may not claim now, so that a [`ClaimEvent::Raise`] was not done: it comes again, as if for the first time,
    /// once new questions to its own identity and to the vehicles have brought no sign of the other manager.
    pub fn not_raised(&mut self, now: Instant) {
        (self.claims.next_raise, self.claims.pause) = (now + UNHEARD, FIRST_PAUSE);
        (self.claims.questions.unanswered, self.claims.questions.asked_vehicles) = (0, false);
    }

    /// This m_unit starts beside a live one, or to take over from one that hangs: it raises its claim above all genuine ones until
    /// it was the highest once.
    pub fn take_over(&mut self, now: Instant) {
        (self.claims.took_over, self.claims.takes_over) = (Some(now), true);
    }

    /// An authority decides which m_unit of this identity may claim: without its key the port answers [`ClaimEvent::Raise`] by
    /// [`Self::not_raised`]. So one that has the key need not wait for vehicles that are gone to say that the other one is, too.
    pub fn claims_by_key(&mut self) {
        self.claims.by_key = true;
    }

    /// The port stores what this unit obeys, and answers [`ClaimEvent::Keep`].
    pub fn store_claims(&mut self) {
        self.claims.stores = true;
    }

    /// A claim of this manager was obeyed and stored in an earlier life.
    pub fn keep_obeyed(&mut self, now: Instant, manager: &Identity, tagged: TaggedClaim) {
        let obeyed = Obeyed { tagged, keeping: Keeping::Kept, heard: now };
        if self.claims.obeyed.push((manager.clone(), obeyed)).is_err() {
            self.counters.count(NodeCounter::ClaimsNotKept);
        }
    }

    /// The highest claim of a manager that this unit has obeyed.
    pub fn obeyed(&self, manager: &Identity) -> Claim {
        self.claims.of(manager).map_or(Claim::NONE, |obeyed| obeyed.tagged.claim)
    }

    /// What was stored in answer to [`ClaimEvent::Keep`], or could not be.
    pub fn claim_kept(&mut self, manager: &Identity, claim: Claim, kept: bool) {
        let Some(obeyed) = self.claims.of_mut(manager).filter(|obeyed| obeyed.tagged.claim == claim) else { return };
        let is_target = self.target.as_ref() == Some(manager);
        match (kept, obeyed.keeping) {
            (true, _) => {
                obeyed.keeping = Keeping::Kept;
                if is_target {
                    self.moving.commit(manager);
                }
            }
            (false, Keeping::Failed(_)) => {}
            (false, _) => {
                obeyed.keeping = Keeping::Failed(false);
                self.counters.count(NodeCounter::ClaimsNotKept);
            }
        }
    }

    /// What the port is to do about claims; one at a time, until there is none.
    pub fn take_claim_event(&mut self) -> Option<ClaimEvent> {
        if P::MANAGES
            && let Some(event) = self.claims.event.take()
        {
            return Some(event);
        }
        if let Some(manager) = self.target.as_ref().filter(|_| self.moving.take_lateness()) {
            return Some(ClaimEvent::Unkept(manager.clone(), self.obeyed(manager)));
        }
        self.claims.obeyed.iter_mut().find_map(|(manager, obeyed)| match obeyed.keeping {
            Keeping::KeptBefore => {
                obeyed.keeping = Keeping::Kept;
                Some(ClaimEvent::Keep(manager.clone(), obeyed.tagged))
            }
            Keeping::Wanted(since, false) => {
                obeyed.keeping = Keeping::Wanted(since, true);
                Some(ClaimEvent::Keep(manager.clone(), obeyed.tagged))
            }
            Keeping::Failed(false) => {
                obeyed.keeping = Keeping::Failed(true);
                Some(ClaimEvent::Unkept(manager.clone(), obeyed.tagged.claim))
            }
            _ => None,
        })
    }

    /// The port could not read its sockets empty: a question that seems unanswered may have been answered.
    pub fn left_unread(&mut self) {
        self.claims.questions.unanswered = 0;
        self.claims.start_no_more();
    }
}

impl<P: Port> Node<P> {
    /// What this m_unit's hellos and answers say of its own claim.
    pub(crate) fn own_report(&self, now: Instant) -> Option<ClaimReport> {
        let tagged = self.claims.own;
        let since = self.claims.took_over.map_or(ClaimReport::NEVER, |at| millis(now.since(at)));
        (P::MANAGES && tagged.claim != Claim::NONE).then_some(ClaimReport { tagged, since })
    }

    /// What this unit tells a manager of the claims of that one's identity.
    pub(crate) fn obeyed_report(&self, now: Instant, manager: &Identity) -> Option<ClaimReport> {
        let obeyed = self.claims.of(manager)?;
        let since = millis(now.since(obeyed.heard));
        Some(ClaimReport { tagged: obeyed.tagged, since })
    }

    /// Whether the manager of a link may command its vehicle, whichever of the two this unit is, or each to the other.
    pub(super) fn check_claim(&self, hello: &Hello) -> Result<(), Refusal> {
        let is_fenced_here = claim_of(hello.claim.as_ref()) < self.obeyed(&hello.identity);
        if is_fenced_here || self.is_fence(hello.obeyed.as_ref()) { Err(Refusal::Fenced) } else { Ok(()) }
    }

    fn is_fence(&self, obeyed: Option<&ClaimReport>) -> bool {
        self.role() == Role::MUnit && claim_of(obeyed) > self.claims.own.claim
    }

    /// A node that has proven itself says which claim of this m_unit's identity it has obeyed. A higher one costs that node, and
    /// nothing else.
    pub(super) fn hear_obeyed(
        &mut self,
        now: Instant,
        from: P::Endpoint,
        peer: &Identity,
        obeyed: Option<&ClaimReport>,
    ) {
        let Some(report) = obeyed.filter(|obeyed| self.is_fence(Some(obeyed))) else { return };
        if let Some((place, forgotten)) = self.table.place_of(peer, from, Epoch(0)) {
            self.count_forgotten(forgotten);
            self.table.keep_index(place);
            if let Some(known) = self.table.node_mut(place) {
                known.under = Some(report.claim());
            }
        }
        self.counters.count(NodeCounter::Fenced);
        // Its tag is checked when the node is polled.
        let _ = self.claims.fences.push(*report);
        self.claims.questions.next = self.claims.questions.next.min(now);
    }

    /// A manager that has joined is obeyed from here on; its claim is stored before the first moving call.
    pub(super) fn obey(&mut self, manager: &Identity, claim: Option<&ClaimReport>) {
        let Some(tagged) = claim.map(|report| report.tagged) else { return };
        match self.claims.of_mut(manager) {
            Some(obeyed) if tagged.claim < obeyed.tagged.claim => {}
            Some(obeyed) if tagged.claim == obeyed.tagged.claim => {
                // Its tag is another one where the manager's keys are.
                (obeyed.tagged, obeyed.heard) = (tagged, Instant::FAR_FUTURE);
                obeyed.look_again();
            }
            Some(obeyed) => *obeyed = Obeyed { tagged, keeping: Keeping::Unasked, heard: Instant::FAR_FUTURE },
            None => {
                let obeyed = Obeyed { tagged, keeping: Keeping::Unasked, heard: Instant::FAR_FUTURE };
                if self.claims.obeyed.push((manager.clone(), obeyed)).is_err() {
                    self.counters.count(NodeCounter::ClaimsNotKept);
                }
            }
        }
    }

    /// A connected manager has proven itself anew.
    pub(crate) fn proven_anew(&mut self, manager: &Identity) {
        if let Some(obeyed) = self.claims.of_mut(manager) {
            obeyed.look_again();
        }
    }

    /// A connected manager has raised its claim. Returns whether it need not give way any more: nobody has shown a higher claim.
    pub(crate) fn claim_raised(&mut self, manager: &Identity, claim: &ClaimReport) -> bool {
        let before = self.obeyed(manager);
        self.obey(manager, Some(claim));
        if self.moving.is_underway() {
            // What is being stored is no longer the claim that is obeyed.
            self.claims.questions.next = Instant::START;
        }
        self.obeyed(manager) > before && !self.is_outranked(manager)
    }

    /// Whether another manager of this identity, which waits or has answered, has a higher claim than the one that is obeyed.
    pub(crate) fn is_outranked(&self, manager: &Identity) -> bool {
        let Some(known) = self.node(manager) else { return false };
        let waits = known.newcomer.as_ref().map(Newcomer::claim);
        waits.max(known.offered.map(|(offered, _)| offered)) > Some(self.obeyed(manager))
    }

    /// A connected manager misses keep-alives and was last heard at `heard`; in the far future, it is heard again.
    pub(crate) fn manager_heard(&mut self, heard: Instant, manager: &Identity) {
        if let Some(obeyed) = self.claims.of_mut(manager) {
            obeyed.heard = heard;
        }
    }

    /// The link of a manager has ended.
    pub(super) fn manager_left(&mut self, now: Instant, manager: &Identity) {
        if let Some(obeyed) = self.claims.of_mut(manager) {
            obeyed.heard = obeyed.heard.min(now);
        }
    }

    /// Whether a moving call of this manager may begin: its claim is stored, cannot be, or takes too long.
    pub(crate) fn may_move(&mut self, now: Instant, manager: &Identity) -> MayMove {
        if let Some(may) = self.may_move_on_the_way(manager) {
            return may;
        }
        if !self.claims.stores {
            return MayMove::Yes;
        }
        let Some(obeyed) = self.claims.of_mut(manager) else { return MayMove::Yes };
        match obeyed.keeping {
            Keeping::Kept | Keeping::KeptBefore | Keeping::Failed(_) => return MayMove::Yes,
            Keeping::Unasked => obeyed.keeping = Keeping::Wanted(now, false),
            Keeping::Wanted(since, _) if now < since + STORING => {}
            Keeping::Wanted(..) => {
                obeyed.keeping = Keeping::Failed(false);
                self.counters.count(NodeCounter::ClaimsNotKept);
                return MayMove::Yes;
            }
        }
        // The port is asked to store it.
        self.claims.questions.next = self.claims.questions.next.min(now);
        MayMove::Waits
    }

    /// Another m_unit with this one's identity has answered, to be heard only if it answers a question of this one.
    pub(super) fn another_answered(&mut self, now: Instant, announce: &Announce, authenticator: &dyn Authenticator) {
        let claims = &mut self.claims;
        let is_asked = announce.nonce != 0 && [self.search.nonce, claims.questions.nonce].contains(&announce.nonce);
        if !is_asked {
            return;
        }
        claims.questions.unanswered = 0;
        let report = announce.claim.filter(|claim| claim.tagged.is_genuine(&self.config.identity, authenticator));
        let Some(tagged) = report.map(|report| report.tagged) else { return };
        if tagged.claim <= claims.own.claim {
            // The other one is to hear of this one, and steps down.
            claims.takes_over = false;
            if tagged.claim < claims.own.claim {
                self.broadcast(now);
            }
        } else if claims.takes_over {
            claims.meet_rival(now, tagged.claim, Duration::ZERO);
        } else {
            // What it has heard, if it stands by from here on.
            claims.meet_rival(now, tagged.claim, Duration::ZERO);
            claims.event = Some(ClaimEvent::StepDown(tagged));
            // The port asks for it when it has polled.
            claims.questions.next = now;
        }
    }

    /// A vehicle has taken this manager: its claim was the highest once.
    pub(super) fn was_obeyed(&mut self) {
        self.claims.takes_over = false;
    }

    /// Looks at fences, asks for this unit's own identity while one is genuine, and raises the claim when nobody answers.
    pub(super) fn poll_claims(
        &mut self,
        now: Instant,
        mailman: &mut dyn Mailman<P::Endpoint>,
        authenticator: &dyn Authenticator,
    ) {
        if !P::MANAGES {
            self.claims.questions.next = Instant::FAR_FUTURE;
            return;
        }
        if core::mem::replace(&mut self.claims.questions.polled, now) + PERIOD < now {
            (self.claims.questions.unanswered, self.claims.questions.asked) = (0, None);
        }
        while let Some(fence) = self.claims.fences.pop() {
            if fence.claim() > self.claims.own.claim && fence.tagged.is_genuine(&self.config.identity, authenticator) {
                self.claims.meet_rival(now, fence.claim(), Duration::from_millis(fence.since.into()));
            }
        }
        let Some(rival) = self.claims.rival else {
            self.claims.questions.next = Instant::FAR_FUTURE;
            return;
        };
        if now < self.claims.questions.next {
            return;
        }
        self.claims.questions.next = now + LOOK;
        if self.claims.takes_over {
            return self.raise(now, rival, TAKE_OVER_PAUSE);
        }
        if self.claims.questions.asked.is_none_or(|asked| now >= asked + PERIOD) {
            let questions = &mut self.claims.questions;
            questions.unanswered = questions.unanswered.saturating_add(questions.asked.is_some().into());
            let is_silent =
                if self.claims.by_key { now >= rival.silent_from(UNHEARD) } else { rival.silent >= UNHEARD };
            let is_alone = questions.unanswered >= QUESTIONS && is_silent;
            let is_allowed = is_alone && now >= self.claims.next_raise;
            let asked_vehicles = core::mem::replace(&mut questions.asked_vehicles, is_allowed);
            if is_allowed && asked_vehicles {
                let pause = self.claims.pause;
                self.raise(now, rival, pause);
            } else if is_allowed {
                // One that is under the other manager says that it hears it.
                self.broadcast(now);
            }
            self.ask_for_itself(now, mailman, authenticator);
        }
    }

    fn raise(&mut self, now: Instant, rival: Rival, pause: Duration) {
        if now < self.claims.next_raise {
            return;
        }
        self.claims.next_raise = now + pause;
        if pause == self.claims.pause {
            self.claims.pause = pause.times(2).min(LONGEST_PAUSE);
        }
        self.claims.event = Some(ClaimEvent::Raise(rival.claim));
    }

    fn ask_for_itself(
        &mut self,
        now: Instant,
        mailman: &mut dyn Mailman<P::Endpoint>,
        authenticator: &dyn Authenticator,
    ) {
        let nonce = self.random.bits() | 1;
        let questions = &mut self.claims.questions;
        (questions.nonce, questions.asked) = (nonce, Some(now));
        let wanted = Manager::new(self.config.identity.name(), self.config.identity.id()).ok();
        let search = core::mem::replace(&mut self.search.nonce, nonce);
        let sent = self.say_who_has(wanted, 0, authenticator, |datagram| mailman.broadcast(datagram));
        self.search.nonce = search;
        self.counters.count(if sent { NodeCounter::OwnIdentityAsked } else { NodeCounter::SendFailed });
    }
}

fn millis(span: Duration) -> u32 {
    u32::try_from(span.as_millis()).unwrap_or(u32::MAX)
}
