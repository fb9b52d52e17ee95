//! A standby: an m_unit that commands once no manager of its identity is left (docs/concepts.md, "Two managers of one identity").
//! Until then it answers nobody and neither accepts nor opens links. It starts because answers are missing: so only a proven
//! answer keeps it waiting, and a question counts only if it was sent, the sockets were then read, and this unit did not pause.

use super::claims::{ClaimEvent, LOOK, PERIOD, QUESTIONS, Questions, Reports, Stage};
use super::search::{Search, fresh};
use super::{Node, NodeCounter};
use crate::config::MISSED_KEEP_ALIVES;
use crate::distribution::authenticator::Authenticator;
use crate::distribution::claim::{Claim, TaggedClaim};
use crate::distribution::datagram::Announce;
use crate::distribution::hello::{ClaimReport, Manager};
use crate::distribution::presence::PRESENCE_WAIT;
use crate::host::mailman::Mailman;
use crate::host::port::Port;
use crate::time::{Duration, Instant};

/// How long an answer to the last question may take. Live units answer at once.
const LISTENING: Duration = PRESENCE_WAIT;
/// Delay of the question on which a start depends, since answers are a little late and clocks differ.
const MARGIN: Duration = Duration::from_millis(20);

/// For ports, about a standby.
impl<P: Port> Node<P> {
    /// This m_unit stands by from now on, until a [`ClaimEvent::Lead`]. If it has stepped down, it ends all its links first. It
    /// needs keys: in plain mode anybody could keep it waiting, or answer for its vehicles.
    pub fn stand_by(&mut self, now: Instant) {
        // A random delay keeps standbys of one identity from asking, and starting, at the same time.
        let next = now + self.random.jitter(self.standby_period());
        self.claims.stand_by(now, next);
    }

    /// Whether this m_unit stands by.
    pub fn is_standby(&self) -> bool {
        P::MANAGES && P::STANDS_BY && self.claims.stage != Stage::Commands
    }

    /// Whether this m_unit has heard of a genuine claim above its own.
    pub const fn has_rival(&self) -> bool {
        self.claims.rival.is_some()
    }

    /// The claim above which this standby is to command: that of the last [`ClaimEvent::Lead`], or a higher one that was heard since.
    /// `None` once somebody has answered.
    pub fn starts_above(&self) -> Option<Claim> {
        let above = self.claims.rival.map_or(Claim::NONE, |rival| rival.claim);
        (self.claims.stage == Stage::Starts).then_some(above)
    }

    /// The port has stored this claim, in answer to [`ClaimEvent::Lead`]: the m_unit commands with it from here on. `false` where it
    /// still stands by: somebody has answered meanwhile, or may have, as it was not polled for long; or a higher claim was heard,
    /// above which it claims next.
    pub fn lead(&mut self, now: Instant, tagged: TaggedClaim) -> bool {
        if self.claims.stage != Stage::Starts || self.claims.questions.polled + PERIOD < now {
            return false;
        }
        let is_highest = self.claims.rival.is_none_or(|rival| rival.claim < tagged.claim);
        self.claims.stage = if is_highest { Stage::Commands } else { Stage::StandsBy };
        if !is_highest {
            return false;
        }
        self.claims.questions.next = now;
        self.set_claim(tagged);
        self.search = Search::new(now, self.role(), &mut self.random);
        true
    }
}

impl<P: Port> Node<P> {
    /// Interval between questions.
    fn standby_period(&self) -> Duration {
        self.config.constraints.keep_alive.min(PERIOD).max(LISTENING)
    }

    /// Processes an announce as a standby: only an answer to its last question counts.
    pub(super) fn standby_answered(&mut self, now: Instant, announce: &Announce, authenticator: &dyn Authenticator) {
        if announce.nonce == 0 || announce.nonce != self.claims.questions.nonce {
            return self.counters.count(NodeCounter::Unasked);
        }
        self.counters.count(NodeCounter::AnnounceHeard);
        let genuine = |report: &ClaimReport| report.tagged.is_genuine(&self.config.identity, authenticator);
        if announce.identity != self.config.identity {
            let Some(obeyed) = announce.obeyed.filter(genuine) else { return };
            self.heard_of_manager(now, obeyed.claim(), Duration::from_millis(obeyed.since.into()));
        } else if announce.epoch != self.config.epoch {
            let claim = announce.claim.filter(genuine);
            self.claims.questions.unanswered = 0;
            self.claims.reports = Reports::NONE;
            self.heard_of_manager(now, claim.map_or(Claim::NONE, |report| report.claim()), Duration::ZERO);
        }
    }

    /// Somebody last heard the manager with this claim this long ago.
    fn heard_of_manager(&mut self, now: Instant, claim: Claim, silent: Duration) {
        self.claims.reports.note(now - silent);
        self.claims.meet_rival(now, claim, silent);
        if silent < self.silence() {
            self.claims.start_no_more();
        }
    }

    /// For how long nobody may have heard the manager before a start.
    fn silence(&self) -> Duration {
        self.config.constraints.keep_alive.times(MISSED_KEEP_ALIVES.into())
    }

    pub(super) fn poll_standby(
        &mut self,
        now: Instant,
        mailman: &mut dyn Mailman<P::Endpoint>,
        authenticator: &dyn Authenticator,
    ) {
        let silent = self.silent_from();
        let claims = &mut self.claims;
        if core::mem::replace(&mut claims.questions.polled, now) + PERIOD < now {
            // Answers that arrived during the pause may not have been read yet.
            (claims.questions.unanswered, claims.questions.asked) = (0, None);
            claims.start_no_more();
        }
        let questions = &claims.questions;
        if now < questions.next {
            return;
        }
        // If the manager had been heard since, the answers to this question would have said so.
        let listened = |asked| now >= asked + LISTENING && asked >= silent;
        let is_alone = questions.unanswered >= QUESTIONS && questions.asked.is_some_and(listened);
        if is_alone && claims.stage == Stage::StandsBy {
            claims.stage = Stage::Starts;
            claims.event = Some(ClaimEvent::Lead(claims.rival.map_or(Claim::NONE, |rival| rival.claim)));
        }
        if now >= self.next_question(now) {
            self.ask_as_standby(now, mailman, authenticator);
        }
        let listened = self.claims.questions.asked.map(|asked| asked + LISTENING).filter(|end| *end > now);
        self.claims.questions.next =
            self.next_question(now).min(now + LOOK).min(listened.unwrap_or(Instant::FAR_FUTURE));
    }

    /// One interval after the last question; after an unanswered one, at the end of the manager's silence, if that is near.
    fn next_question(&self, now: Instant) -> Instant {
        let Questions { asked: Some(asked), unanswered, .. } = self.claims.questions else { return now };
        let (due, silent) = (asked + self.standby_period(), self.silent_from() + MARGIN);
        let is_soon = silent > asked && silent <= due + LISTENING;
        if unanswered > 0 && is_soon { silent.max(asked + LISTENING) } else { due }
    }

    /// From when on nobody has heard the manager for long enough, as far as was reported.
    fn silent_from(&self) -> Instant {
        self.claims.reports.heard().map_or(Instant::START, |heard| heard + self.silence())
    }

    /// Asks for this unit's own identity; once that is unanswered, also all vehicles.
    fn ask_as_standby(
        &mut self,
        now: Instant,
        mailman: &mut dyn Mailman<P::Endpoint>,
        authenticator: &dyn Authenticator,
    ) {
        let nonce = fresh(&mut self.random);
        let is_answered = self.claims.questions.unanswered == 0;
        let own = Manager::new(self.config.identity.name(), self.config.identity.id()).ok();
        self.search.nonce = nonce;
        let sent =
            self.say_who_has(own.filter(|_| is_answered), 0, authenticator, |datagram| mailman.broadcast(datagram));
        self.counters.count(if sent { NodeCounter::WhoHasSent } else { NodeCounter::SendFailed });
        self.claims.reports.ask();
        let questions = &mut self.claims.questions;
        (questions.nonce, questions.asked) = (nonce, Some(now));
        questions.unanswered = if sent { questions.unanswered.saturating_add(1) } else { 0 };
    }
}
