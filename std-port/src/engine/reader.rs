//! Which thread reads a link: one state machine, without sockets, locks or threads. The port runs it under the link's
//! lock, and the model of the hand-over (`std-port/tests/hand_over.rs`) runs it in every order of its threads.
//!
//! A link is read by the thread pool through epoll, or by the one thread that has its token and blocks in reading it. Two
//! kinds of threads ask for the token: a caller that waits for its own reply, and a thread of the pool that has just
//! served a quick call and waits for the next one. At every moment a thread reads the link, has been woken to do so, or is
//! expected back while the clock looks at the link.
//!
//! | state | cause | next |
//! |---|---|---|
//! | `Opening` | the connection is open, or has failed | `Pool` |
//! | `Pool`, `Offered`, `Kept` | a caller wants to read | `Led` |
//! | `Pool` | a worker wants to stay, and calls follow each other at once | `Led` |
//! | `Led` by a worker | its handler begins | `Serving` |
//! | `Serving` | its handler ends | `Led` |
//! | `Led`, `Serving`, `Offered` | a thread leaves | `Offered` if a caller waits, else `Pool` |
//! | `Led` | the caller has its reply, and its calls follow each other at once | `Kept`, or as if it left |
//! | `Kept` | something waits here that does not read; or the clock finds no further call | `Pool` |
//! | `Serving` | the clock finds that the handler takes long | `Offered` or `Pool` |
//!
//! All else changes nothing.

use cara_core::services::requests::CallId;
use cara_core::time::{Duration, Instant};

/// The clock looks at links after this time, as long as anything happens there, and ends what a caller keeps that has not
/// called again for as long.
pub(super) const LOOK: Duration = Duration::from_millis(2);
/// A handler that runs longer than this while its thread has the token loses it.
pub(super) const RELIEF: Duration = Duration::from_millis(1);
/// A handler that takes less than this is quick: the thread that ran it may stay on the link.
const QUICK: Duration = Duration::from_micros(50);
/// Calls of the peer that come within this time of each other follow each other at once.
const AT_ONCE: Duration = Duration::from_millis(1);
/// A worker stays on a link that is served again after at most this many calls of other links. With more busy links than
/// that, staying would keep threads from those that have something to read.
const FEW: usize = 4;

/// Where the token of a link is.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum Reader {
    /// The connection is being opened: the pool waits for its end, and there is nothing to read.
    Opening,
    /// With the pool: the epoll set reports the link.
    Pool,
    /// With a thread that blocks in reading, or is about to.
    Led { token: Token, by: Role },
    /// With a worker that runs a handler since then, and reads nothing meanwhile.
    Serving { token: Token, since: Instant },
    /// A waiting caller has been woken to take it, and has not come yet.
    Offered,
    /// A caller that calls back to back has left with its reply, and is expected back at once.
    Kept { since: Instant },
}

/// What kind of thread has the token.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum Role {
    Caller,
    Worker,
}

/// Proves that a thread was given the right to read; whether it still has it, [`ReadPolicy::is_held`] tells.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) struct Token(u32);

/// What may change which thread reads. A `waiter` is a caller that waits for its reply and could take the token.
#[derive(Clone, Copy, Debug)]
pub(crate) enum Cause {
    /// The connection is open, or could not be opened.
    Opened,
    /// A caller asks for the token.
    Wants,
    /// A worker that has served a call asks for the token; `served` counts the calls of all links, and where it may not,
    /// the port's reason is another one than the link's pace.
    Stays { served: usize, may: bool },
    /// The holder runs a handler.
    Begins(Token),
    /// It reads again.
    Ends(Token),
    /// A thread no longer waits for the link, with the token or without.
    Leaves { token: Option<Token>, waiter: Option<CallId> },
    /// A caller leaves with the reply to what it asked at `asked`.
    Replied { token: Token, asked: Instant, may_keep: bool, waiter: Option<CallId> },
    /// Something waits for the peer that does not read: a future, or a ping.
    NeedsPool,
    /// The clock looks at the link.
    Looks { waiter: Option<CallId> },
}

/// What a change asks of the port, at once and under the same lock. Arming is not among them: it follows from the state,
/// each time that the link's lock is given up ([`ReadPolicy::registration`]), so that no order of changes can lose it.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub(crate) struct Duties {
    /// The thread that asked may read.
    pub(crate) token: Option<Token>,
    /// This caller is to be woken: the token waits for it.
    pub(crate) wake: Option<CallId>,
    /// The clock looks at the link by then. Where its own look leads to `None`, the link is off its list.
    pub(crate) look_at: Option<Instant>,
    /// The link is not on the clock's list yet.
    pub(crate) enlist: bool,
}

/// What the epoll set is told of a link.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) struct Registration {
    pub(crate) readable: bool,
    pub(crate) writable: bool,
    /// It is not in the set: there each arrival costs a percent of a small round trip, although no thread is told of it.
    pub(crate) is_out: bool,
}

/// Which thread reads a link, and how calls follow each other there.
#[derive(Clone, Copy, Debug)]
pub(crate) struct ReadPolicy {
    reader: Reader,
    tokens: u32,
    /// It is on the clock's list.
    is_listed: bool,
    pace: Pace,
}

#[derive(Clone, Copy, Debug, Default)]
struct Pace {
    /// The last handler that ran for the link was quick.
    is_quick: bool,
    /// The peer has called here.
    is_called: bool,
    /// The count of calls of all links when this one was last served.
    served: usize,
    served_at: Option<Instant>,
    /// When a caller last had its reply.
    replied_at: Option<Instant>,
}

impl ReadPolicy {
    pub(crate) fn new(is_opening: bool) -> Self {
        let reader = if is_opening { Reader::Opening } else { Reader::Pool };
        Self { reader, tokens: 0, is_listed: false, pace: Pace::default() }
    }

    /// The one place where the reader changes. Inlined where the cause is known: a round trip has five of them.
    #[inline]
    pub(crate) fn on(&mut self, now: Instant, cause: Cause) -> Duties {
        let before = self.reader;
        let mut duties = Duties::default();
        match (before, cause) {
            (Reader::Opening, Cause::Opened) => self.reader = Reader::Pool,
            // Offered to another caller, it goes to the one that comes first: the other one finds it taken, and waits.
            (Reader::Pool | Reader::Offered | Reader::Kept { .. }, Cause::Wants) => {
                duties.token = Some(self.grant(Role::Caller));
            }
            // The pace is noted wherever the token is.
            (_, Cause::Stays { served, may }) => {
                let stays = self.pace.continues(now, served) && may && before == Reader::Pool;
                duties.token = stays.then(|| self.grant(Role::Worker));
            }
            (Reader::Led { token, .. }, Cause::Begins(holder)) if token == holder => {
                self.reader = Reader::Serving { token, since: now };
                self.look_after(now, &mut duties);
            }
            (Reader::Serving { token, .. }, Cause::Ends(holder)) if token == holder => {
                self.reader = Reader::Led { token, by: Role::Worker };
            }
            (
                Reader::Led { token, .. } | Reader::Serving { token, .. },
                Cause::Leaves { token: Some(holder), waiter },
            ) if token == holder => {
                duties.wake = self.pass_on(waiter);
            }
            // The thread that leaves may be the one that was woken, and the token must not be lost with it.
            (Reader::Offered, Cause::Leaves { waiter, .. }) => duties.wake = self.pass_on(waiter),
            (Reader::Led { token, .. }, Cause::Replied { token: holder, asked, may_keep, waiter })
                if token == holder =>
            {
                let at_once = self.pace.is_asked_at_once(now, asked);
                // A peer that calls here would find no reader while the link is kept, and a waiter would not be woken.
                if at_once && may_keep && !self.pace.is_called && waiter.is_none() {
                    self.reader = Reader::Kept { since: now };
                    self.look_after(now, &mut duties);
                } else {
                    duties.wake = self.pass_on(waiter);
                }
            }
            (Reader::Kept { .. }, Cause::NeedsPool) => self.reader = Reader::Pool,
            (_, Cause::Looks { waiter }) => {
                match before {
                    Reader::Kept { since } if now >= since + LOOK => self.reader = Reader::Pool,
                    Reader::Serving { since, .. } if now >= since + RELIEF => duties.wake = self.pass_on(waiter),
                    Reader::Kept { since } | Reader::Serving { since, .. } => duties.look_at = Some(since + LOOK),
                    Reader::Opening | Reader::Pool | Reader::Led { .. } | Reader::Offered => {}
                }
                self.is_listed = duties.look_at.is_some();
            }
            _ => {}
        }
        if tracing::enabled!(tracing::Level::TRACE) {
            self.log(before, cause);
        }
        duties
    }

    #[cold]
    fn log(&self, before: Reader, cause: Cause) {
        tracing::trace!(?before, after = ?self.reader, ?cause);
    }

    /// A handler has run for the link, on whatever thread.
    pub(crate) fn ran(&mut self, took: Duration) {
        self.pace.is_quick = took < QUICK;
        self.pace.is_called = true;
    }

    fn grant(&mut self, by: Role) -> Token {
        self.tokens = self.tokens.wrapping_add(1);
        let token = Token(self.tokens);
        self.reader = Reader::Led { token, by };
        token
    }

    /// The next waiting caller gets the token, or else the pool. Returns the caller that is to be woken.
    fn pass_on(&mut self, waiter: Option<CallId>) -> Option<CallId> {
        self.reader = if waiter.is_some() { Reader::Offered } else { Reader::Pool };
        waiter
    }

    /// The clock looks at links whose holder is expected back. Only its own look takes a link off its list, so that calls
    /// that follow each other put it there once.
    fn look_after(&mut self, since: Instant, duties: &mut Duties) {
        duties.look_at = Some(since + LOOK);
        duties.enlist = !std::mem::replace(&mut self.is_listed, true);
    }

    /// Whether a token is still good.
    pub(crate) fn is_held(&self, token: Token) -> bool {
        matches!(self.reader, Reader::Led { token: held, .. } | Reader::Serving { token: held, .. } if held == token)
    }

    /// Whether a thread of the pool that is told of the link may read it. While a thread has the token two would read one
    /// stream, and take each other's halves of a frame.
    pub(crate) fn is_free(&self) -> bool {
        matches!(self.reader, Reader::Pool | Reader::Offered | Reader::Kept { .. })
    }

    /// Whether the connection is still being opened.
    pub(crate) fn is_opening(&self) -> bool {
        self.reader == Reader::Opening
    }

    /// Where the token is.
    #[cfg(test)]
    pub(crate) const fn reader(&self) -> Reader {
        self.reader
    }

    /// Whether the last handler that ran for the link was quick.
    pub(crate) const fn is_quick(&self) -> bool {
        self.pace.is_quick
    }

    /// What the epoll set is to be told, where it was told `before`.
    #[inline]
    pub(crate) fn registration(&self, before: Registration, is_paused: bool, wants_to_write: bool) -> Registration {
        let is_opening = self.reader == Reader::Opening;
        let readable = (is_opening || self.reader == Reader::Pool) && !is_paused;
        let writable = is_opening || wants_to_write;
        // Taking a link out and putting it back costs more than disarming and arming it, so a single call does not.
        let for_long = match self.reader {
            Reader::Led { by: Role::Worker, .. } | Reader::Serving { .. } | Reader::Kept { .. } => true,
            Reader::Opening | Reader::Pool | Reader::Led { by: Role::Caller, .. } | Reader::Offered => false,
        };
        Registration { readable, writable, is_out: !readable && !writable && (for_long || before.is_out) }
    }
}

impl Pace {
    /// A call of the peer has been served: whether the next one is expected at once, and quick.
    fn continues(&mut self, now: Instant, served: usize) -> bool {
        let others = served.wrapping_sub(std::mem::replace(&mut self.served, served));
        let before = self.served_at.replace(now);
        self.is_quick && others <= FEW && before.is_some_and(|before| now < before + AT_ONCE)
    }

    /// A caller has its reply at `now`: whether it had asked at once after the reply before.
    fn is_asked_at_once(&mut self, now: Instant, asked: Instant) -> bool {
        // By the pause between calls, and not by the time between replies: a call may take long.
        self.replied_at.replace(now).is_some_and(|before| asked < before + LOOK)
    }
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;

    use super::*;

    const START: Instant = Instant::START;
    const WAITER: Option<CallId> = Some(CallId(7));
    const NOTHING: Duties = Duties { token: None, wake: None, look_at: None, enlist: false };

    const OUT: Registration = Registration { readable: false, writable: false, is_out: true };

    fn at(micros: u64) -> Instant {
        Instant::from_micros(micros)
    }

    /// A link that the pool reads.
    fn pool() -> ReadPolicy {
        ReadPolicy::new(false)
    }

    /// A link that a worker has just served, quickly, and so may stay on.
    fn busy() -> ReadPolicy {
        let mut policy = pool();
        policy.ran(Duration::ZERO);
        assert_eq!(policy.on(START, Cause::Stays { served: 1, may: true }), NOTHING, "it is the first call");
        policy
    }

    fn wants(policy: &mut ReadPolicy) -> Option<Token> {
        policy.on(START, Cause::Wants).token
    }

    fn stays(policy: &mut ReadPolicy) -> Option<Token> {
        policy.on(START, Cause::Stays { served: 2, may: true }).token
    }

    /// The caller that the change wakes.
    fn leaves(policy: &mut ReadPolicy, token: Option<Token>, waiter: Option<CallId>) -> Option<CallId> {
        policy.on(START, Cause::Leaves { token, waiter }).wake
    }

    fn replied(policy: &mut ReadPolicy, now: Instant, token: Token, waiter: Option<CallId>) -> Duties {
        policy.on(now, Cause::Replied { token, asked: now, may_keep: true, waiter })
    }

    #[test]
    fn a_link_that_opens_is_read_by_nothing() {
        let mut policy = ReadPolicy::new(true);
        assert_eq!(wants(&mut policy), None);
        assert!(policy.is_opening() && !policy.is_free());
        policy.on(START, Cause::Opened);
        assert_eq!(policy.reader(), Reader::Pool);
    }

    #[test]
    fn the_pool_reads_unless_a_thread_has_the_token() {
        let mut policy = pool();
        assert!(policy.reader() == Reader::Pool && policy.is_free());
        let token = wants(&mut policy).unwrap();
        assert!(!policy.is_free() && policy.is_held(token));
        assert_eq!(wants(&mut policy), None);
        assert_eq!(leaves(&mut policy, Some(token), None), None);
        assert_eq!(policy.reader(), Reader::Pool);
        assert_ne!(wants(&mut policy), Some(token), "each token is another one");
    }

    #[test]
    fn a_token_that_is_offered_keeps_the_pool_off_until_it_is_taken() {
        let mut policy = pool();
        let token = wants(&mut policy).unwrap();
        assert_eq!(leaves(&mut policy, Some(token), WAITER), WAITER);
        assert_eq!(policy.reader(), Reader::Offered);
        let next = wants(&mut policy).unwrap();
        leaves(&mut policy, Some(next), None);
        assert_eq!(policy.reader(), Reader::Pool);
    }

    /// A caller that was woken may have its reply by then, or give up: the token goes on to the next one.
    #[test]
    fn a_caller_that_was_woken_and_leaves_passes_the_token_on() {
        let mut policy = pool();
        let token = wants(&mut policy).unwrap();
        leaves(&mut policy, Some(token), WAITER);
        assert_eq!(leaves(&mut policy, None, Some(CallId(8))), Some(CallId(8)));
        assert_eq!(policy.reader(), Reader::Offered);
        assert_eq!(leaves(&mut policy, None, None), None);
        assert_eq!(policy.reader(), Reader::Pool);
    }

    #[test]
    fn a_thread_that_leaves_without_the_token_changes_nothing() {
        let mut policy = pool();
        assert_eq!(leaves(&mut policy, None, WAITER), None);
        let token = wants(&mut policy).unwrap();
        assert_eq!(leaves(&mut policy, None, WAITER), None);
        assert!(policy.is_held(token));
    }

    #[test]
    fn only_a_holder_that_runs_a_handler_is_relieved_and_only_after_the_limit() {
        let mut policy = busy();
        let looks = Cause::Looks { waiter: None };
        assert_eq!(policy.on(at(10_000), looks), NOTHING);
        let token = stays(&mut policy).unwrap();
        assert_eq!(policy.on(at(10_000), looks), NOTHING, "it reads");
        let begins = policy.on(at(100), Cause::Begins(token));
        assert_eq!(begins, Duties { look_at: Some(at(2_100)), enlist: true, ..NOTHING });
        assert_eq!(policy.on(at(1_099), looks), Duties { look_at: Some(at(2_100)), ..NOTHING });
        policy.on(at(1_099), Cause::Ends(token));
        assert_eq!(policy.on(at(10_000), looks), NOTHING, "it reads again");
        assert!(policy.on(at(20_000), Cause::Begins(token)).enlist, "it is off the clock's list");
        assert_eq!(policy.on(at(21_000), Cause::Looks { waiter: WAITER }), Duties { wake: WAITER, ..NOTHING });
        assert!(policy.reader() == Reader::Offered && !policy.is_held(token));
    }

    #[test]
    fn a_link_is_kept_until_its_caller_is_back_or_the_clock_gives_up() {
        let mut policy = pool();
        let token = wants(&mut policy).unwrap();
        assert_eq!(replied(&mut policy, at(10), token, None), NOTHING, "it is the first call");
        let token = wants(&mut policy).unwrap();
        let kept = replied(&mut policy, at(20), token, None);
        assert_eq!(kept, Duties { look_at: Some(at(2_020)), enlist: true, ..NOTHING });
        assert_eq!(policy.reader(), Reader::Kept { since: at(20) });
        let token = wants(&mut policy).unwrap();
        assert_eq!(
            replied(&mut policy, at(30), token, WAITER),
            Duties { wake: WAITER, ..NOTHING },
            "another one waits"
        );
        let next = wants(&mut policy).unwrap();
        assert_eq!(replied(&mut policy, at(40), token, None), NOTHING, "only the holder keeps");
        assert!(policy.is_held(next));
        assert!(!replied(&mut policy, at(50), next, None).enlist, "it is on the clock's list");
        let looks = Cause::Looks { waiter: None };
        assert_eq!(policy.on(at(2_049), looks).look_at, Some(at(2_050)));
        assert_eq!(policy.on(at(2_050), looks), NOTHING);
        assert_eq!(policy.reader(), Reader::Pool);
    }

    #[test]
    fn a_link_is_not_kept_where_calls_are_apart_or_something_would_wait() {
        let mut policy = pool();
        let mut keeps = |now: u64, asked: u64, may_keep| {
            let token = wants(&mut policy).unwrap();
            policy.on(at(now), Cause::Replied { token, asked: at(asked), may_keep, waiter: None });
            let keeps = policy.reader() == Reader::Kept { since: at(now) };
            policy.on(at(now), Cause::NeedsPool);
            assert_eq!(policy.reader(), Reader::Pool);
            keeps
        };
        assert!(!keeps(1_000, 0, true));
        assert!(keeps(90_000, 2_999, true), "by the pause, and not by how long the call took");
        assert!(!keeps(92_500, 92_000, true), "it came 2 ms after the last reply");
        assert!(!keeps(92_600, 92_600, false));
        policy.ran(Duration::ZERO);
        let token = wants(&mut policy).unwrap();
        replied(&mut policy, at(92_700), token, None);
        assert_eq!(policy.reader(), Reader::Pool, "the peer calls here");
    }

    #[test]
    fn a_worker_stays_where_calls_are_quick_and_follow_each_other() {
        let stays = |now: u64, served, may, took| {
            let mut policy = busy();
            policy.ran(took);
            policy.on(at(now), Cause::Stays { served, may }).token.is_some()
        };
        assert!(stays(999, 5, true, Duration::from_micros(49)));
        assert!(!stays(1_000, 5, true, Duration::ZERO), "calls are apart");
        assert!(!stays(1, 6, true, Duration::ZERO), "many links are busy");
        assert!(!stays(1, 2, false, Duration::ZERO));
        assert!(!stays(1, 2, true, Duration::from_micros(50)), "handlers are slow");
        let mut policy = busy();
        wants(&mut policy);
        assert_eq!(self::stays(&mut policy), None, "a caller has the token");
    }

    #[test]
    fn a_worker_that_was_relieved_disturbs_the_next_holder_no_more() {
        let mut policy = busy();
        let old = stays(&mut policy).unwrap();
        policy.on(START, Cause::Begins(old));
        policy.on(at(1_000), Cause::Looks { waiter: None });
        let new = wants(&mut policy).unwrap();
        assert_eq!(policy.on(at(2_000), Cause::Begins(old)), NOTHING);
        assert_eq!(policy.on(at(9_000), Cause::Looks { waiter: None }), NOTHING, "the new one reads");
        assert_eq!(leaves(&mut policy, Some(old), WAITER), None);
        assert!(policy.is_held(new));
    }

    #[test]
    fn a_link_leaves_the_epoll_set_only_for_a_row_of_calls() {
        let armed = Registration { readable: true, writable: false, is_out: false };
        let out = OUT;
        let mut policy = busy();
        let reported = |policy: &ReadPolicy, before| policy.registration(before, false, false);
        assert_eq!(reported(&policy, out), armed);
        assert_eq!(policy.registration(armed, true, false), Registration { is_out: false, ..out }, "it is paused");
        let token = wants(&mut policy).unwrap();
        assert_eq!(reported(&policy, armed), Registration { is_out: false, ..out }, "a call alone disarms it");
        assert_eq!(reported(&policy, out), out, "it is not put back from call to call");
        assert_eq!(
            policy.registration(out, false, true),
            Registration { readable: false, writable: true, is_out: false }
        );
        leaves(&mut policy, Some(token), None);
        stays(&mut policy).unwrap();
        assert_eq!(reported(&policy, armed), out);
        let opening = ReadPolicy::new(true).registration(armed, false, false);
        assert_eq!(opening, Registration { readable: true, writable: true, is_out: false });
    }

    /// Threads as the policy sees them: each has at most one token, and callers wait or do not.
    fn causes() -> impl Strategy<Value = Vec<(u8, u64, bool)>> {
        prop::collection::vec((0..9_u8, 0..3_000_u64, any::<bool>()), 1..60)
    }

    proptest! {
        // The planted bug fails it, and leaves no file behind.
        #![proptest_config(ProptestConfig { failure_persistence: None, ..ProptestConfig::default() })]

        /// Whatever happens in whatever order: one token is good at most, and a link that no thread reads is with the pool,
        /// has woken a caller, or is looked at by the clock.
        #[test]
        fn a_link_is_never_left_without_a_reader(causes in causes()) {
            let (mut policy, mut now, mut tokens, mut is_listed) = (pool(), START, Vec::new(), false);
            for (kind, passes, flag) in causes {
                now = now + Duration::from_micros(passes);
                let waiter = WAITER.filter(|_| flag);
                let any = tokens.last().copied().unwrap_or(Token(0));
                let cause = match kind {
                    0 => Cause::Wants,
                    1 => Cause::Stays { served: 0, may: flag },
                    2 => Cause::Begins(any),
                    3 => Cause::Ends(any),
                    4 => Cause::Opened,
                    5 => Cause::Leaves { token: tokens.pop().filter(|_| flag), waiter },
                    6 => Cause::Replied { token: any, asked: now, may_keep: true, waiter },
                    7 => Cause::NeedsPool,
                    _ => Cause::Looks { waiter },
                };
                if flag {
                    policy.ran(Duration::from_micros(passes));
                }
                let before = policy.reader();
                let duties = policy.on(now, cause);
                tokens.extend(duties.token);
                prop_assert!(tokens.iter().filter(|token| policy.is_held(**token)).count() <= 1);
                prop_assert_eq!(duties.token.is_some_and(|token| !policy.is_held(token)), false);
                is_listed = (is_listed || duties.enlist) && (kind < 8 || duties.look_at.is_some());
                match policy.reader() {
                    Reader::Offered => prop_assert!(duties.wake.is_some() || before == Reader::Offered),
                    Reader::Kept { .. } | Reader::Serving { .. } => prop_assert!(is_listed, "the clock forgets it"),
                    Reader::Pool => prop_assert!(policy.registration(OUT, false, false).readable),
                    Reader::Opening | Reader::Led { .. } => prop_assert_eq!(duties.wake, None),
                }
            }
        }
    }
}
