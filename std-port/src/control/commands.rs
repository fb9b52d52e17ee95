//! What operators ask of a unit that changes something, and what its program calls, reported to those that follow it, such as a
//! recording. Whoever asks or calls never waits for them.

use std::ops::Range;
use std::sync::atomic::{AtomicBool, AtomicU64, Ordering};
use std::sync::{Arc, Mutex};
use std::time::{Duration, Instant};

use cara_core::distribution::block::{self, SliceWriter};
use cara_core::distribution::function::{Signature, VariableSpecs};
use cara_core::distribution::parameters::ParametersView;
use cara_core::error::Error;

use super::audit::{ProgramCall, Who, changes_something};
use super::protocol::{Answer, By, CallQuestion, LONGEST_LINE, Question, unix_ms};
use super::values;
use crate::engine::peer_cell::PeerCell;
use crate::locks::Rank;

/// Bytes that may wait for a follower.
const MOST_BYTES: usize = 8 << 20;
/// The largest report. Who follows reads no line much longer, so a larger one is counted and dropped.
const LARGEST: usize = LONGEST_LINE / 4;
/// Room that is never given back.
const KEPT: usize = 64 << 10;

/// The followers. Without any, a call costs one look at a flag.
#[derive(Default)]
pub(crate) struct Commands {
    are_followed: AtomicBool,
    followers: Mutex<Vec<Follower>>,
}

/// Where reports wait for one that follows.
struct Follower {
    /// That of its [`Followed`].
    id: u64,
    capacity: usize,
    waiting: Waiting,
}

/// Reports, each with its bytes. The one that callers fill and the one that is read change places, so that a call allocates
/// nothing here.
#[derive(Default)]
struct Waiting {
    reports: Vec<(Report, Range<usize>)>,
    bytes: Vec<u8>,
    /// Reports that found no place.
    lost: u64,
}

#[derive(Clone)]
enum Report {
    /// The bytes are the command, as JSON.
    Asked,
    Called(Call),
}

impl Commands {
    /// Reports what is asked and called from here on. What finds more than `capacity` waiting is counted and dropped.
    pub(super) fn follow(self: &Arc<Self>, capacity: usize) -> Followed {
        static IDS: AtomicU64 = AtomicU64::new(0);
        let id = IDS.fetch_add(1, Ordering::Relaxed);
        let mut followers = Rank::Leaf.lock(&self.followers);
        followers.push(Follower { id, capacity, waiting: Waiting::default() });
        self.are_followed.store(true, Ordering::Relaxed);
        Followed { commands: self.clone(), id, taken: Waiting::default() }
    }

    pub(crate) fn are_followed(&self) -> bool {
        self.are_followed.load(Ordering::Relaxed)
    }

    fn report(&self, report: &Report, bytes: &[u8]) {
        Rank::Leaf.lock(&self.followers).iter_mut().for_each(|follower| follower.take(report, bytes));
    }

    fn report_asked(&self, command: &Answer) {
        match serde_json::to_vec(command) {
            Ok(bytes) => self.report(&Report::Asked, &bytes),
            Err(error) => debug_assert!(false, "{error}"),
        }
    }
}

impl Follower {
    fn take(&mut self, report: &Report, bytes: &[u8]) {
        let Waiting { reports, bytes: all, lost } = &mut self.waiting;
        let start = all.len();
        let is_full = reports.len() >= self.capacity || start + bytes.len() > MOST_BYTES;
        if is_full || bytes.len() > LARGEST {
            *lost += 1;
            return;
        }
        all.extend_from_slice(bytes);
        reports.push((report.clone(), start..all.len()));
    }
}

/// One that follows. Dropped, it follows no longer.
pub(super) struct Followed {
    commands: Arc<Commands>,
    id: u64,
    taken: Waiting,
}

impl Followed {
    /// The commands that have come since it was asked last, and how many more found no place.
    pub(super) fn take(&mut self) -> (impl Iterator<Item = Answer>, u64) {
        self.taken.clear();
        if let Some(own) = Rank::Leaf.lock(&self.commands.followers).iter_mut().find(|own| own.id == self.id) {
            std::mem::swap(&mut own.waiting, &mut self.taken);
        }
        let Waiting { reports, bytes, lost } = &mut self.taken;
        let answers = reports.drain(..).filter_map(|(report, place)| {
            let bytes = bytes.get(place).unwrap_or_default();
            match report {
                Report::Asked => serde_json::from_slice(bytes).ok(),
                Report::Called(call) => Some(call.command(bytes)),
            }
        });
        (answers, *lost)
    }
}

impl Drop for Followed {
    fn drop(&mut self) {
        let mut followers = Rank::Leaf.lock(&self.commands.followers);
        let place = followers.iter().position(|follower| follower.id == self.id);
        // What waits is freed without the lock, for which callers wait.
        let _own = place.map(|place| followers.swap_remove(place));
        self.commands.are_followed.store(!followers.is_empty(), Ordering::Relaxed);
        drop(followers);
    }
}

impl Waiting {
    /// Keeps its room, unless that is much more than was used.
    fn clear(&mut self) {
        let used = self.bytes.len();
        self.lost = 0;
        self.reports.clear();
        self.bytes.clear();
        if used < self.bytes.capacity() / 4 {
            self.bytes.shrink_to(KEPT);
            self.reports.shrink_to(KEPT / size_of::<Report>());
        }
    }
}

/// What was asked for and one of its outcomes; `None` if its client has gone before.
fn command(unix_ms: u64, by: By, question: Question, outcome: Option<Answer>) -> Answer {
    Answer::Command { unix_ms, by, question: Box::new(question), outcome: outcome.map(Box::new) }
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
        let command = command(unix_ms(), self.by.clone(), self.question.clone(), outcome.cloned());
        self.commands.report_asked(&command);
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
pub(crate) struct Recorded {
    audited: Option<ProgramCall>,
    followed: Option<FollowedCall>,
}

impl Recorded {
    /// `None` if neither wants it.
    pub(crate) fn of(audited: Option<ProgramCall>, followed: Option<FollowedCall>) -> Option<Self> {
        (audited.is_some() || followed.is_some()).then_some(Self { audited, followed })
    }

    /// Its arguments.
    pub(crate) fn asks(&mut self, arguments: &ParametersView) {
        if let Some(call) = &mut self.followed {
            call.asks(arguments);
        }
    }

    /// Its results.
    pub(crate) fn answers(&mut self, results: &ParametersView) {
        if let Some(call) = &mut self.followed {
            call.answers(results);
        }
    }

    /// How it has ended; with the call's ID if it was not waited for.
    pub(crate) fn ended(self, ended: Result<Option<u32>, Error>) {
        if let Some(audited) = self.audited {
            audited.ended(ended.map(drop));
        }
        if let Some(mut followed) = self.followed {
            followed.ended(Some(ended));
        }
    }
}

/// A call of the unit's own program that is followed, until it has ended. Its caller only copies bytes: who follows makes the
/// command of them.
pub(crate) struct FollowedCall {
    commands: Arc<Commands>,
    peer: Arc<PeerCell>,
    started: Instant,
    call: Call,
    /// The function's signature, the blocks of arguments and results, and the peer's name.
    bytes: Vec<u8>,
    is_over: bool,
}

/// What else is known of a call.
#[derive(Clone)]
struct Call {
    peer: u32,
    take_over: bool,
    /// Bytes of its function's signature, which come first.
    signature: usize,
    arguments: Values,
    results: Values,
    /// Where the peer's name is, the last bytes.
    name: usize,
    unix_ms: u64,
    took: Duration,
    ended: Option<Result<Option<u32>, Error>>,
}

/// Where the arguments or the results of a call are.
#[derive(Clone, Default)]
struct Values {
    place: Range<usize>,
    /// As a block; else, where they are not as the function wants them, as JSON.
    are_block: bool,
}

impl FollowedCall {
    pub(crate) fn of(commands: &Arc<Commands>, peer: &Arc<PeerCell>, function: Signature<'_>, take_over: bool) -> Self {
        let (started, signature) = (Instant::now(), function.as_bytes());
        let call = Call {
            peer: peer.identity.id(),
            take_over,
            signature: signature.len(),
            arguments: Values::default(),
            results: Values::default(),
            name: 0,
            unix_ms: 0,
            took: Duration::ZERO,
            ended: None,
        };
        // Room for short values as well.
        let mut bytes = Vec::with_capacity((2 * signature.len()).next_multiple_of(512));
        bytes.extend_from_slice(signature);
        Self { commands: commands.clone(), peer: peer.clone(), started, call, bytes, is_over: false }
    }

    fn asks(&mut self, arguments: &ParametersView) {
        // A call that waits is asked for again.
        self.bytes.truncate(self.call.signature);
        self.call.arguments = self.kept(|function| function.arguments(), arguments);
    }

    fn answers(&mut self, results: &ParametersView) {
        self.call.results = self.kept(|function| function.results(), results);
    }

    /// Keeps those of `parameters` that the function has.
    fn kept(
        &mut self,
        specs: impl for<'s> Fn(Signature<'s>) -> VariableSpecs<'s>,
        parameters: &ParametersView,
    ) -> Values {
        let (signature, start) = (self.call.signature, self.bytes.len());
        let wanted = specs(signature_in(&self.bytes, signature));
        let Ok(length) = block::measure(wanted, parameters) else {
            let shown = serde_json::to_vec(&values::arguments(wanted, parameters)).unwrap_or_default();
            self.bytes.extend_from_slice(&shown);
            return Values { place: start..self.bytes.len(), are_block: false };
        };
        self.bytes.resize(start + length, 0);
        let (before, block) = self.bytes.split_at_mut(start);
        block::write(specs(signature_in(before, signature)), parameters, &mut SliceWriter::new(block));
        Values { place: start..start + length, are_block: true }
    }

    fn ended(&mut self, ended: Option<Result<Option<u32>, Error>>) {
        self.is_over = true;
        self.call.unix_ms = unix_ms();
        self.call.took = self.started.elapsed();
        self.call.ended = ended;
        self.call.name = self.bytes.len();
        self.bytes.extend_from_slice(self.peer.identity.name().as_bytes());
        self.commands.report(&Report::Called(self.call.clone()), &self.bytes);
    }
}

/// A call that a task dropped before it ended has no outcome.
impl Drop for FollowedCall {
    fn drop(&mut self) {
        if !self.is_over {
            self.ended(None);
        }
    }
}

fn signature_in(bytes: &[u8], length: usize) -> Signature<'_> {
    Signature::of_checked(bytes.get(..length).unwrap_or_default())
}

impl Call {
    fn command(self, bytes: &[u8]) -> Answer {
        let function = signature_in(bytes, self.signature);
        let name = bytes.get(self.name..).unwrap_or_default();
        let name = std::str::from_utf8(name).unwrap_or_default().to_owned();
        let node = Some(format!("{name}/{}", self.peer));
        let shown = |specs, values: Values| {
            let bytes = bytes.get(values.place).unwrap_or_default();
            // There are none where a call has no results.
            if values.are_block {
                values::in_block(specs, bytes)
            } else {
                serde_json::from_slice(bytes).unwrap_or_default()
            }
        };
        let results = shown(function.results(), self.results);
        let outcome = self.ended.map(|ended| Answer::Called {
            node: name,
            id: self.peer,
            results,
            call: ended.unwrap_or_default(),
            error: ended.err().map(Into::into),
            took_us: self.took.as_micros() as u64,
            functions: Vec::new(),
        });
        let question = CallQuestion {
            node,
            function: function.name().to_owned(),
            arguments: shown(function.arguments(), self.arguments),
            take_over: self.take_over,
            ..CallQuestion::default()
        };
        command(self.unix_ms, By::default(), Question::Call(question), outcome)
    }
}

#[cfg(test)]
mod tests {
    use cara_core::distribution::function::Definition;

    use super::super::protocol::{Argument, ArgumentValue, CallQuestion, Failure};
    use super::*;
    use crate::growing::GrowingParameters;

    fn called(error: Option<Failure>) -> Answer {
        let (node, results, functions) = ("agv".to_owned(), Vec::new(), Vec::new());
        Answer::Called { node, id: 7, results, call: None, error, took_us: 1, functions }
    }

    /// The outcomes that a follower gets of what is asked and answered so.
    fn outcomes(question: &Question, answers: &[Answer]) -> Vec<Option<Answer>> {
        let commands = Arc::<Commands>::default();
        let mut followed = commands.follow(8);
        if let Some(mut asked) = Asked::of(&commands, &Who::own(), question) {
            answers.iter().for_each(|answer| asked.note(answer));
        }
        let outcome = |command| match command {
            Answer::Command { outcome, .. } => outcome.map(|outcome| *outcome),
            other => panic!("{other:?}"),
        };
        followed.take().0.map(outcome).collect()
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

    /// A call of `go(x: int, s: string[400000]) -> (x: int, y: {z: bool})` with these values, as its followers get it.
    fn followed(arguments: &ParametersView, end: impl FnOnce(Recorded)) -> [Vec<(CallQuestion, Option<Answer>)>; 2] {
        let commands = Arc::<Commands>::default();
        let mut followers = [commands.follow(8), commands.follow(8)];
        let peer = PeerCell::new(&crate::Identity::new("agv", 7, crate::Role::SUnit).unwrap());
        let function = Definition::parse("go(x: int, s: string[400000]) -> (x: int, y: {z: bool})").unwrap();
        let call = FollowedCall::of(&commands, &peer, function.signature(), true);
        let mut recorded = Recorded::of(None, Some(call)).unwrap();
        // One that waits is asked for again.
        let mut earlier = GrowingParameters::new();
        earlier.add_int("x", 1).unwrap();
        recorded.asks(&earlier);
        let lengths = [(); 2].map(|()| {
            recorded.asks(arguments);
            recorded.followed.as_ref().unwrap().bytes.len()
        });
        assert_eq!(lengths[0], lengths[1], "what was asked first is kept");
        end(recorded);
        let call = |command| match command {
            Answer::Command { question, outcome, .. } => match *question {
                Question::Call(question) => (question, outcome.map(|outcome| *outcome)),
                other => panic!("{other:?}"),
            },
            other => panic!("{other:?}"),
        };
        followers.each_mut().map(|follower| follower.take().0.map(call).collect())
    }

    #[test]
    fn a_followed_call_has_its_values_and_its_end() {
        let mut values = GrowingParameters::new();
        values.add_int("x", 1).unwrap();
        values.add_string("s", 100).unwrap();
        values.set_value("x", 3).unwrap();
        values.set_value("s", "east").unwrap();
        let argument = |name: &str, size, value| Argument { name: name.to_owned(), size, value };
        let int = |value| argument("x", 1, ArgumentValue::Int(vec![value]));
        let text = |size| argument("s", size, ArgumentValue::String("east".into()));
        let y = argument("y", 1, ArgumentValue::Record(serde_json::json!({ "z": true })));

        let mut results = values.clone();
        results.set_value("x", 4).unwrap();
        let y_spec = Definition::parse("y() -> (y: {z: bool})").unwrap();
        y_spec.signature().results().try_for_each(|spec| results.add_spec(spec)).unwrap();
        results.set_record("y", |record| record.set("z", true)).unwrap();
        let answered = |mut recorded: Recorded| {
            recorded.answers(&results);
            std::thread::sleep(Duration::from_millis(2));
            recorded.ended(Ok(Some(9)));
        };
        let [one, other] = followed(&values, answered);
        assert_eq!(one, other);
        let [(question, Some(answer))] = &one[..] else { panic!("{one:?}") };
        let Answer::Called { node, id: 7, results, call: Some(9), error: None, took_us: 2_000.., .. } = answer else {
            panic!("{answer:?}")
        };
        assert_eq!((question.node.as_deref(), node.as_str(), question.function.as_str()), (Some("agv/7"), "agv", "go"));
        assert!(question.take_over);
        assert_eq!((&question.arguments[..], &results[..]), (&[int(3), text(400_000)][..], &[int(4), y][..]));

        // What the function refuses is shown as well, as far as it has such variables.
        let wrong = Error::MissingArgument { index: 1 };
        let mut few = GrowingParameters::new();
        few.add_int("x", 1).unwrap();
        few.add_int("other", 1).unwrap();
        let [one, _] = followed(&few, |recorded| recorded.ended(Err(wrong)));
        let [(question, Some(Answer::Called { results, error: Some(error), .. }))] = &one[..] else {
            panic!("{one:?}")
        };
        assert_eq!((&question.arguments[..], results.len()), (&[int(0)][..], 0));
        assert_eq!(*error, wrong.into());

        // A task has dropped it.
        let [one, _] = followed(&values, drop);
        assert!(matches!(&one[..], [(question, None)] if question.arguments.len() == 2), "{one:?}");
    }

    #[test]
    fn a_follower_that_does_not_keep_up_loses_and_one_that_is_gone_is_forgotten() {
        let commands = Arc::<Commands>::default();
        let mut followed = commands.follow(1);
        let search = || command(unix_ms(), Who::own().by(), Question::Search, None);
        for _ in 0..3 {
            commands.report_asked(&search());
        }
        let (taken, lost) = followed.take();
        assert_eq!((taken.count(), lost), (1, 2));
        let (taken, lost) = followed.take();
        assert_eq!((taken.count(), lost), (0, 0));
        drop(followed);
        assert!(!commands.are_followed());
    }

    #[test]
    fn bytes_of_calls_that_nobody_reads_are_bounded() {
        let commands = Arc::<Commands>::default();
        let mut followed = commands.follow(2 * MOST_BYTES / LARGEST);
        let bytes = vec![0; LARGEST + 1];
        let most = MOST_BYTES / LARGEST;
        for (size, count, lost) in [(LARGEST + 1, 1, 1), (LARGEST, most, 0), (LARGEST, most + 2, 2)] {
            (0..count).for_each(|_| commands.report(&Report::Asked, &bytes[..size]));
            assert_eq!(followed.take().1, lost);
        }
        // Both rooms are given back once little is used of them.
        for _ in 0..3 {
            assert!(followed.take().0.next().is_none());
        }
        let waiting = commands.followers.lock().unwrap()[0].waiting.bytes.capacity();
        assert!(followed.taken.bytes.capacity().max(waiting) <= KEPT);
    }
}
