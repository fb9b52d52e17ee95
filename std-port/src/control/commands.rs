//! What operators ask of a unit that changes something, and what its program calls, reported to those that follow it, such as a
//! recording. Whoever asks or calls never waits for them.

use std::sync::atomic::{AtomicBool, AtomicU64, Ordering};
use std::sync::mpsc::{Receiver, SyncSender, TrySendError, sync_channel};
use std::sync::{Arc, Mutex};
use std::time::Instant;

use cara_core::distribution::function::Definition;
use cara_core::distribution::parameters::ParametersView;
use cara_core::error::Error;

use super::audit::{ProgramCall, Who, changes_something};
use super::protocol::{Answer, Argument, By, CallQuestion, Question, unix_ms};
use super::values;
use crate::Identity;
use crate::locks::Rank;

/// Commands as they come, and how many found no place.
pub(super) type Followed = (Receiver<Answer>, Arc<AtomicU64>);

/// The followers. Without any, a call costs one look at a flag.
#[derive(Debug, Default)]
pub(crate) struct Commands {
    are_followed: AtomicBool,
    followers: Mutex<Vec<Follower>>,
}

#[derive(Debug)]
struct Follower {
    sender: SyncSender<Answer>,
    lost: Arc<AtomicU64>,
}

impl Commands {
    /// Reports what is asked and called from here on. What finds more than `capacity` waiting is counted and dropped.
    pub(super) fn follow(&self, capacity: usize) -> Followed {
        let (sender, receiver) = sync_channel(capacity);
        let lost = Arc::<AtomicU64>::default();
        let mut followers = Rank::Leaf.lock(&self.followers);
        followers.push(Follower { sender, lost: lost.clone() });
        self.are_followed.store(true, Ordering::Relaxed);
        (receiver, lost)
    }

    pub(crate) fn are_followed(&self) -> bool {
        self.are_followed.load(Ordering::Relaxed)
    }

    /// Reports what was asked for and one of its outcomes; `None` if its client has gone before.
    pub(super) fn report(&self, by: By, question: Question, outcome: Option<Answer>) {
        let (question, outcome) = (Box::new(question), outcome.map(Box::new));
        let mut command = Some(Answer::Command { unix_ms: unix_ms(), by, question, outcome });
        let mut followers = Rank::Leaf.lock(&self.followers);
        let mut left = followers.len();
        followers.retain(|follower| {
            left -= 1;
            // The last one gets it without a copy.
            let Some(command) = (if left == 0 { command.take() } else { command.clone() }) else { return true };
            match follower.sender.try_send(command) {
                Ok(()) => true,
                Err(TrySendError::Full(_)) => {
                    follower.lost.fetch_add(1, Ordering::Relaxed);
                    true
                }
                Err(TrySendError::Disconnected(_)) => false,
            }
        });
        self.are_followed.store(!followers.is_empty(), Ordering::Relaxed);
    }
}

/// A question of an operator that changes something, until its last outcome.
pub(super) struct Asked<'a> {
    commands: &'a Commands,
    by: By,
    question: &'a Question,
    /// No outcome is to come.
    is_over: bool,
}

impl<'a> Asked<'a> {
    /// `None` without a follower, and for a question that only looks.
    pub(super) fn of(commands: &'a Commands, who: &Who, question: &'a Question) -> Option<Self> {
        let is_reported = commands.are_followed() && changes_something(question);
        is_reported.then(|| Self { commands, by: who.by(), question, is_over: false })
    }

    /// An answer on its way to the operator.
    pub(super) fn note(&mut self, answer: &Answer) {
        match answer {
            Answer::Called { error, .. } => {
                // What is held has an end as well.
                self.is_over = !matches!(self.question, Question::Hold(_)) || error.is_some();
                self.report(Some(answer));
            }
            Answer::Unread { .. } => self.report(Some(answer)),
            Answer::Ended { .. } | Answer::Failed(_) | Answer::Done if !self.is_over => {
                self.is_over = true;
                self.report(Some(answer));
            }
            _ => {}
        }
    }

    fn report(&self, outcome: Option<&Answer>) {
        self.commands.report(self.by.clone(), self.question.clone(), outcome.cloned());
    }
}

impl Drop for Asked<'_> {
    fn drop(&mut self) {
        if !self.is_over {
            self.report(None);
        }
    }
}

/// A call of the unit's own program, as the audit log and the followers get it.
#[derive(Debug)]
pub(crate) struct Recorded {
    audited: Option<ProgramCall>,
    /// Boxed, since almost no call has one.
    followed: Option<Box<FollowedCall>>,
}

impl Recorded {
    /// `None` if neither wants it.
    pub(crate) fn of(audited: Option<ProgramCall>, followed: Option<FollowedCall>) -> Option<Self> {
        (audited.is_some() || followed.is_some()).then(|| Self { audited, followed: followed.map(Box::new) })
    }

    /// Its arguments.
    pub(crate) fn asks(&mut self, arguments: &ParametersView) {
        if let Some(call) = &mut self.followed {
            call.arguments = values::arguments(call.definition.signature().arguments(), arguments);
        }
    }

    /// Its results.
    pub(crate) fn answers(&mut self, results: &ParametersView) {
        if let Some(call) = &mut self.followed {
            call.results = values::arguments(call.definition.signature().results(), results);
        }
    }

    /// How it has ended; with the call's ID if it was not waited for.
    pub(crate) fn ended(self, ended: Result<Option<u32>, Error>) {
        if let Some(audited) = self.audited {
            audited.ended(ended.map(drop));
        }
        if let Some(mut followed) = self.followed {
            followed.ended(ended);
        }
    }
}

/// A call of the unit's own program that is followed.
#[derive(Debug)]
pub(crate) struct FollowedCall {
    commands: Arc<Commands>,
    definition: Definition,
    node: Identity,
    take_over: bool,
    arguments: Vec<Argument>,
    results: Vec<Argument>,
    started: Instant,
    is_over: bool,
}

impl FollowedCall {
    pub(crate) fn of(commands: &Arc<Commands>, node: &Identity, definition: Definition, take_over: bool) -> Self {
        let (commands, node, started) = (commands.clone(), node.clone(), Instant::now());
        let (arguments, results, is_over) = (Vec::new(), Vec::new(), false);
        Self { commands, definition, node, take_over, arguments, results, started, is_over }
    }

    fn ended(&mut self, ended: Result<Option<u32>, Error>) {
        let outcome = Answer::Called {
            node: self.node.name().to_owned(),
            id: self.node.id(),
            results: std::mem::take(&mut self.results),
            call: ended.as_ref().copied().unwrap_or_default(),
            error: ended.err().map(Into::into),
            took_us: self.started.elapsed().as_micros() as u64,
            functions: Vec::new(),
        };
        self.report(Some(outcome));
    }

    fn report(&mut self, outcome: Option<Answer>) {
        self.is_over = true;
        let question = CallQuestion {
            node: Some(self.node.to_string()),
            function: self.definition.name().to_owned(),
            arguments: std::mem::take(&mut self.arguments),
            take_over: self.take_over,
            ..CallQuestion::default()
        };
        self.commands.report(By::default(), Question::Call(question), outcome);
    }
}

/// A call that a task dropped before it ended has no outcome.
impl Drop for FollowedCall {
    fn drop(&mut self) {
        if !self.is_over {
            self.report(None);
        }
    }
}

#[cfg(test)]
mod tests {
    use super::super::protocol::{CallQuestion, Failure};
    use super::*;

    fn called(error: Option<Failure>) -> Answer {
        let (node, results, functions) = ("agv".to_owned(), Vec::new(), Vec::new());
        Answer::Called { node, id: 7, results, call: None, error, took_us: 1, functions }
    }

    /// The outcomes that a follower gets of what is asked and answered so.
    fn outcomes(question: &Question, answers: &[Answer]) -> Vec<Option<Answer>> {
        let commands = Commands::default();
        let (followed, _) = commands.follow(8);
        if let Some(mut asked) = Asked::of(&commands, &Who::own(), question) {
            answers.iter().for_each(|answer| asked.note(answer));
        }
        let outcome = |command| match command {
            Answer::Command { outcome, .. } => outcome.map(|outcome| *outcome),
            other => panic!("{other:?}"),
        };
        followed.try_iter().map(outcome).collect()
    }

    #[test]
    fn each_outcome_is_reported_and_that_the_client_has_gone() {
        let (call, hold) = (Question::Call(CallQuestion::default()), Question::Hold(CallQuestion::default()));
        let refused = Answer::Failed(Failure::configuration("NotAllowed", "no"));
        let ended = Answer::Ended { expired: false };
        assert_eq!(
            outcomes(&call, &[called(None), called(None), Answer::Done]),
            [Some(called(None)), Some(called(None))]
        );
        assert_eq!(outcomes(&call, std::slice::from_ref(&refused)), [Some(refused)]);
        assert_eq!(outcomes(&call, &[]), [None]);
        assert_eq!(outcomes(&hold, &[called(None)]), [Some(called(None)), None], "it is released");
        assert_eq!(outcomes(&hold, &[called(None), ended.clone(), Answer::Done]), [Some(called(None)), Some(ended)]);
        let retire = Question::Retire { node: "agv/7".to_owned() };
        assert_eq!(outcomes(&retire, &[Answer::Done]), [Some(Answer::Done)]);
        assert_eq!(outcomes(&Question::Unit, &[Answer::Done]), [], "it only looks");
    }

    #[test]
    fn a_follower_that_does_not_keep_up_loses_and_one_that_is_gone_is_forgotten() {
        let commands = Commands::default();
        let (followed, lost) = commands.follow(1);
        let by = Who::own().by();
        for _ in 0..3 {
            commands.report(by.clone(), Question::Search, None);
        }
        assert_eq!((followed.try_iter().count(), lost.load(Ordering::Relaxed)), (1, 2));
        drop(followed);
        commands.report(by.clone(), Question::Search, None);
        assert!(!commands.are_followed());
    }
}
