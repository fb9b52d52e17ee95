//! The connections that have a place: what each is doing, whether it has shown the token, and which one gives its place up where
//! all are taken.

use std::cmp::Reverse;
use std::net::IpAddr;
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};
use std::task::{Context, Waker};
use std::time::Duration;

use axum::extract::connect_info::Connected;
use axum::serve::IncomingStream;
use tokio::time::Instant;

use crate::door::Door;
use crate::limits::{CONNECTIONS, Limit, Limits, NEWCOMERS};

/// How long the head of a request may take as a whole: the first from the connection's begin, each other from its first byte.
pub(crate) const HEAD: Duration = Duration::from_secs(5);
/// A connection that has shown the token is kept for so long without a request; another one for [`HEAD`].
const IDLE: Duration = Duration::from_secs(60);
/// How long the answer to a request without the token may take: a file of the page, or a refusal.
const ANSWER: Duration = Duration::from_secs(10);

/// What a deadline that has passed counts as.
type Counted = fn(&Limits) -> &Limit;

/// All of them.
pub(crate) struct Lines {
    open: Mutex<Vec<Arc<Line>>>,
    limits: Arc<Limits>,
}

/// One, as its bytes and its requests share it.
pub(crate) struct Line {
    address: IpAddr,
    state: Mutex<State>,
}

struct State {
    /// Its last request was for data and had the token.
    is_proven: bool,
    phase: Phase,
    /// When the phase began.
    since: Instant,
    gives_way: bool,
    waker: Option<Waker>,
}

#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Phase {
    /// Nothing of the next request has come.
    Idle,
    Head,
    /// The content of a request is on the way. Its time is that of [`guard`](crate::guard).
    Content,
    /// A request is carried out, or its answer is on the way.
    Asked,
}

/// The place of a connection, until it is dropped.
pub(crate) struct Entry {
    pub(crate) line: Arc<Line>,
    lines: Arc<Lines>,
}

impl Lines {
    pub(crate) fn new(limits: Arc<Limits>) -> Arc<Self> {
        Arc::new(Self { open: Mutex::default(), limits })
    }

    /// Gives a new connection a place, which another one gives up if all are taken. `None` if all of those carry out what pages
    /// with the token have asked for.
    pub(crate) fn enter(self: &Arc<Self>, address: IpAddr) -> Option<Entry> {
        if self.open().len() >= CONNECTIONS && !self.one_gives_way() {
            self.limits.connections.refuse();
            return None;
        }
        let state =
            State { is_proven: false, phase: Phase::Head, since: Instant::now(), gives_way: false, waker: None };
        let line = Arc::new(Line { address, state: Mutex::new(state) });
        let mut open = self.open();
        open.push(line.clone());
        self.limits.connections.uses(open.len());
        Some(Entry { line, lines: self.clone() })
    }

    /// Ends a connection: of those without the token the oldest one of the address that has most of them, so that a flood ends
    /// its own. While those are few they have not had time to show it, and the one with the token that has asked for nothing for
    /// the longest time goes first.
    pub(crate) fn one_gives_way(&self) -> bool {
        let mut open = self.open();
        let states: Vec<_> = open
            .iter()
            .map(|line| {
                let state = line.state();
                (line.address, state.is_proven, state.phase, state.since)
            })
            .collect();
        let unproven = |of: Option<IpAddr>| {
            let those =
                states.iter().filter(|(address, is_proven, ..)| !is_proven && of.is_none_or(|of| of == *address));
            those.count()
        };
        let are_few = unproven(None) < NEWCOMERS;
        let least = states
            .iter()
            .enumerate()
            .filter(|(_, (_, is_proven, phase, _))| !is_proven || *phase != Phase::Asked)
            .max_by_key(|(_, (address, is_proven, _, since))| {
                (*is_proven == are_few, if *is_proven { 0 } else { unproven(Some(*address)) }, Reverse(*since))
            });
        let Some((index, _)) = least else { return false };
        let line = open.swap_remove(index);
        self.limits.connections.uses(open.len());
        self.limits.gave_way.refuse();
        drop(open);
        let mut state = line.state();
        state.gives_way = true;
        state.waker.take().into_iter().for_each(Waker::wake);
        true
    }

    fn open(&self) -> MutexGuard<'_, Vec<Arc<Line>>> {
        self.open.lock().unwrap_or_else(PoisonError::into_inner)
    }
}

impl Entry {
    pub(crate) fn limits(&self) -> &Limits {
        &self.lines.limits
    }
}

impl Drop for Entry {
    fn drop(&mut self) {
        let mut open = self.lines.open();
        open.retain(|line| !Arc::ptr_eq(line, &self.line));
        self.lines.limits.connections.uses(open.len());
    }
}

impl Line {
    /// Whether it has to end for another one. If not, the task is woken when it has to.
    pub(crate) fn gives_way(&self, cx: &Context<'_>) -> bool {
        let mut state = self.state();
        if !state.gives_way {
            state.waker = Some(cx.waker().clone());
        }
        state.gives_way
    }

    /// The first request is due.
    pub(crate) fn begins(&self) {
        self.state().enters(Phase::Head);
    }

    /// Bytes have come.
    pub(crate) fn heard(&self) {
        let mut state = self.state();
        if state.phase == Phase::Idle {
            state.enters(Phase::Head);
        }
    }

    /// When it is closed unless it goes on to its next phase, and what that counts as.
    pub(crate) fn deadline(&self) -> Option<(Instant, Option<Counted>)> {
        let state = self.state();
        let (span, counted): (_, Option<Counted>) = match (state.phase, state.is_proven) {
            (Phase::Head, _) => (HEAD, Some(|limits| &limits.heads)),
            (Phase::Idle, true) => (IDLE, None),
            (Phase::Idle, false) => (HEAD, None),
            (Phase::Asked, true) | (Phase::Content, _) => return None,
            (Phase::Asked, false) => (ANSWER, Some(|limits| &limits.takes)),
        };
        Some((state.since + span, counted))
    }

    fn state(&self) -> MutexGuard<'_, State> {
        self.state.lock().unwrap_or_else(PoisonError::into_inner)
    }
}

impl State {
    fn enters(&mut self, phase: Phase) {
        (self.phase, self.since) = (phase, Instant::now());
    }
}

/// The connection of a request.
#[derive(Clone)]
pub(crate) struct Caller(Arc<Line>);

impl Connected<IncomingStream<'_, Door>> for Caller {
    fn connect_info(stream: IncomingStream<'_, Door>) -> Self {
        Self(stream.io().line())
    }
}

impl Caller {
    /// The head of a request has come, which goes on until its answer is dropped.
    pub(crate) fn asks(&self) -> Asks {
        self.0.state().enters(Phase::Asked);
        Asks(self.0.clone())
    }
}

/// A request that is carried out or answered.
pub(crate) struct Asks(Arc<Line>);

impl Asks {
    /// Whether it is for data and has the token. Then it goes on with its content.
    pub(crate) fn proves(&self, is_proven: bool) {
        let mut state = self.0.state();
        state.is_proven = is_proven;
        if is_proven {
            state.enters(Phase::Content);
        }
    }

    /// All of its content has come.
    pub(crate) fn is_whole(&self) {
        self.0.state().enters(Phase::Asked);
    }
}

impl Drop for Asks {
    fn drop(&mut self) {
        self.0.state().enters(Phase::Idle);
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const HOME: IpAddr = IpAddr::V4(std::net::Ipv4Addr::LOCALHOST);
    const ELSEWHERE: IpAddr = IpAddr::V4(std::net::Ipv4Addr::new(10, 0, 0, 9));

    fn gone(entry: &Entry) -> bool {
        entry.line.state().gives_way
    }

    fn asks(entry: &Entry) -> Asks {
        let asks = Caller(entry.line.clone()).asks();
        asks.proves(true);
        asks.is_whole();
        asks
    }

    #[test]
    fn a_flood_ends_its_own_connections() {
        let lines = Lines::new(Arc::new(Limits::new()));
        let quiet = lines.enter(HOME).unwrap();
        let page = lines.enter(HOME).unwrap();
        drop(asks(&page));
        let flood: Vec<_> = (0..CONNECTIONS * 3).map(|_| lines.enter(ELSEWHERE).unwrap()).collect();
        assert!(!gone(&quiet) && !gone(&page), "those are of another address, or have the token");
        assert_eq!(flood.iter().filter(|entry| !gone(entry)).count(), CONNECTIONS - 2);
        assert!(gone(&flood[0]) && !gone(flood.last().unwrap()), "the oldest ones");
    }

    #[test]
    fn newcomers_have_time_to_show_the_token() {
        let lines = Lines::new(Arc::new(Limits::new()));
        let pages: Vec<_> = (0..CONNECTIONS).map(|_| lines.enter(HOME).unwrap()).collect();
        pages.iter().for_each(|page| drop(asks(page)));
        let newcomers: Vec<_> = (0..NEWCOMERS * 9).map(|_| lines.enter(HOME).unwrap()).collect();
        assert!(newcomers.iter().rev().take(NEWCOMERS).all(|entry| !gone(entry)));
        assert_eq!(pages.iter().filter(|entry| gone(entry)).count(), NEWCOMERS, "the others are kept for pages");
    }

    #[test]
    fn what_is_asked_with_the_token_never_gives_way() {
        let lines = Lines::new(Arc::new(Limits::new()));
        let pages: Vec<_> = (0..CONNECTIONS).map(|_| lines.enter(HOME).unwrap()).collect();
        let mut asked: Vec<_> = pages.iter().map(asks).collect();
        assert!(lines.enter(HOME).is_none());
        asked.swap_remove(7);
        let next = lines.enter(HOME).unwrap();
        assert!(gone(&pages[7]) && !gone(&next));
        assert_eq!(pages.iter().filter(|entry| gone(entry)).count(), 1);
        drop(pages);
        assert_eq!(lines.open().len(), 1, "places are given back");
        // Content that does not come is nothing that is carried out.
        let slow: Vec<_> = (0..CONNECTIONS).map(|_| lines.enter(HOME).unwrap()).collect();
        let _slow: Vec<_> = slow
            .iter()
            .map(|entry| {
                let asks = Caller(entry.line.clone()).asks();
                asks.proves(true);
                asks
            })
            .collect();
        assert!(lines.enter(HOME).is_some());
    }

    #[tokio::test]
    async fn no_byte_extends_a_head() {
        let lines = Lines::new(Arc::new(Limits::new()));
        let entry = lines.enter(HOME).unwrap();
        let at = || entry.line.deadline().map(|(at, counted)| (at, counted.is_some()));
        let (deadline, is_head) = at().unwrap();
        entry.line.heard();
        assert!(is_head && at() == Some((deadline, true)));
        let asks = asks(&entry);
        assert_eq!(at(), None, "an answer may take as long as a call");
        drop(asks);
        assert!(at().is_some_and(|(at, is_head)| at > deadline && !is_head));
        entry.line.heard();
        assert!(at().is_some_and(|(at, is_head)| at <= Instant::now() + HEAD && is_head));
    }
}
