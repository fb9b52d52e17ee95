//! Streams: those of this unit, and those of its nodes that it is subscribed to.
//!
//! However many handles of this process read a stream of a node, there is one subscription on the link: at the shortest
//! interval that any of them wants. It is made again whenever the node tells its list, so also after a reconnection.

use std::collections::{BTreeMap, VecDeque};
use std::sync::atomic::{AtomicU32, Ordering};
use std::sync::{Arc, Condvar, Mutex, OnceLock, PoisonError, Weak};
use std::task::Waker;

use cara_core::error::Error;
use cara_core::services::session::{GrantedStream, ReplyBlock};
use cara_core::services::stream::{Newest, Source, Value};
use cara_core::time::{Duration, Instant};

use crate::locks::lock;

/// A stream of this unit.
pub(crate) struct OwnStream {
    /// No lock rank: the link that sends a value takes buffers of the pool meanwhile, but no holder of buffers locks this.
    newest: Mutex<Newest<Box<[u8]>>>,
    /// Sequentially consistent with the links' subscription flags: of a new value and a new subscription one sees the other.
    version: AtomicU32,
    on_taken: OnceLock<Box<dyn Fn() + Send + Sync>>,
}

impl OwnStream {
    pub(crate) fn new(bytes: usize) -> Self {
        let newest = Mutex::new(Newest::new(vec![0; bytes].into()));
        Self { newest, version: AtomicU32::new(0), on_taken: OnceLock::new() }
    }

    /// Calls `taken` whenever a link has taken the newest value, with the link locked. Only the first one counts.
    pub(crate) fn on_taken(&self, taken: impl Fn() + Send + Sync + 'static) {
        let _ = self.on_taken.set(Box::new(taken));
    }

    pub(crate) fn put(&self, put: impl FnOnce(&mut Newest<Box<[u8]>>) -> Result<(), Error>) -> Result<(), Error> {
        let mut newest = lock(&self.newest);
        put(&mut newest)?;
        self.version.store(newest.version(), Ordering::SeqCst);
        Ok(())
    }
}

impl Source for OwnStream {
    fn version(&self) -> u32 {
        self.version.load(Ordering::SeqCst)
    }

    fn newest(&self, look: &mut dyn FnMut(&Value<'_>)) {
        if let Some(value) = lock(&self.newest).value() {
            look(&value);
        }
    }

    fn taken(&self) {
        if let Some(taken) = self.on_taken.get() {
            taken();
        }
    }
}

/// Bytes of values that wait for the handles that want each; what does not fit is lost, the oldest first.
const KEPT_BYTES: usize = 64 * 1024;

/// What a handle wants of a stream.
struct Want {
    /// The handle's number.
    id: u64,
    interval: Duration,
    /// Each value, also those that a newer one has replaced.
    each: bool,
}

/// A stream of a node, as the handles of this process share it.
pub(crate) struct Watched {
    pub(crate) name: String,
    state: Mutex<WatchedState>,
    changed: Condvar,
}

#[derive(Default)]
struct WatchedState {
    wants: Vec<Want>,
    last_id: u64,
    /// The last values, the newest last, while a handle wants each.
    kept: VecDeque<Received>,
    kept_bytes: usize,
    newest: Option<Received>,
    /// Values that have come.
    count: u64,
    /// The count of values when the newest one was passed on.
    passed: u64,
    refused: Option<Error>,
    relays: Vec<Weak<OwnStream>>,
    /// Wakers of the tasks that wait, each with the number of its handle.
    tasks: Vec<(u64, Waker)>,
}

/// A value as it came.
#[derive(Clone)]
pub(crate) struct Received {
    pub(crate) signature: Arc<[u8]>,
    pub(crate) block: Arc<[u8]>,
    /// On arrival.
    pub(crate) age: Duration,
    pub(crate) arrived: Instant,
}

impl Received {
    fn bytes(&self) -> usize {
        size_of::<Self>() + self.block.len()
    }

    pub(crate) fn age_at(&self, now: Instant) -> Duration {
        self.age + now.since(self.arrived)
    }
}

impl WatchedState {
    fn is_kept(&self) -> bool {
        self.wants.iter().any(|want| want.each)
    }

    fn put(&mut self, received: Received) {
        if self.is_kept() {
            self.kept_bytes += received.bytes();
            self.kept.push_back(received.clone());
            while self.kept_bytes > KEPT_BYTES
                && let Some(oldest) = self.kept.pop_front()
            {
                self.kept_bytes -= oldest.bytes();
            }
        }
        self.newest = Some(received);
        self.count += 1;
    }

    /// The newest value, or for a handle that wants each the oldest that it has not `seen`; and how many values have come up to it.
    fn after(&self, seen: u64, id: u64) -> Option<(Received, u64)> {
        let newest = self.newest.as_ref().filter(|_| self.count > seen)?;
        if self.wants.iter().any(|want| want.id == id && want.each) {
            let before = self.count - self.kept.len() as u64;
            let index = seen.saturating_sub(before);
            if let Some(received) = self.kept.get(index as usize) {
                return Some((received.clone(), before + index + 1));
            }
        }
        Some((newest.clone(), self.count))
    }
}

impl Watched {
    pub(super) fn new(name: &str) -> Self {
        Self { name: name.to_owned(), state: Mutex::default(), changed: Condvar::new() }
    }

    /// The newest value, and how many have come.
    pub(crate) fn newest(&self) -> (Option<Received>, u64) {
        let state = lock(&self.state);
        (state.newest.clone(), state.count)
    }

    /// Waits until more than `seen` values have come, or for so long; [`Error::TimedOut`], or why there is no subscription.
    pub(crate) fn wait(&self, id: u64, seen: u64, at_most: std::time::Duration) -> Result<(Received, u64), Error> {
        let mut state = lock(&self.state);
        let waits = |state: &mut WatchedState| state.refused.is_none() && state.count <= seen;
        if waits(&mut state) {
            let waited = self.changed.wait_timeout_while(state, at_most, waits);
            state = waited.unwrap_or_else(PoisonError::into_inner).0;
        }
        state.refused.map_or(Ok(()), Err)?;
        state.after(seen, id).ok_or(Error::TimedOut)
    }

    /// Values go on to this stream of the unit's own.
    pub(crate) fn relay_to(&self, own: &Arc<OwnStream>) {
        let mut state = lock(&self.state);
        state.relays.retain(|relay| relay.strong_count() > 0);
        state.relays.push(Arc::downgrade(own));
    }

    /// As [`wait`](Self::wait) for a task, which is woken where there is nothing yet.
    #[cfg(feature = "async")]
    pub(crate) fn poll(&self, id: u64, seen: u64, waker: &Waker) -> Option<Result<(Received, u64), Error>> {
        let mut state = lock(&self.state);
        match (&state.newest, state.refused) {
            (_, Some(error)) => return Some(Err(error)),
            (Some(newest), None) if state.count > seen => return Some(Ok((newest.clone(), state.count))),
            _ => {}
        }
        let earlier =
            state.tasks.iter().position(|(known, _)| *known == id).map(|index| state.tasks.swap_remove(index));
        state.tasks.push((id, waker.clone()));
        // Dropped without the lock: a dropped waker may end a task, and with it a subscription.
        drop(state);
        drop(earlier);
        None
    }

    /// The tasks that wait look again; called without a lock.
    fn wake_tasks(&self) {
        let tasks = std::mem::take(&mut lock(&self.state).tasks);
        tasks.into_iter().for_each(|(_, task)| task.wake());
    }

    /// A value has come; whether it is to go on. The tasks that wait for it are put into `woken`.
    fn receive(&self, now: Instant, age: Duration, block: &ReplyBlock<'_>, woken: &mut Vec<Waker>) -> bool {
        let mut state = lock(&self.state);
        let signature = block.signature();
        let known = state.newest.as_ref().map(|newest| &newest.signature);
        let signature = match known.filter(|known| known[..] == *signature.as_bytes()) {
            Some(known) => known.clone(),
            None => signature.as_bytes().into(),
        };
        state.put(Received { signature, block: block.bytes().into(), age, arrived: now });
        state.refused = None;
        woken.extend(state.tasks.drain(..).map(|(_, task)| task));
        self.changed.notify_all();
        !state.relays.is_empty()
    }

    /// Called without a lock.
    pub(super) fn was_answered(&self, answer: Result<GrantedStream, Error>) {
        lock(&self.state).refused = answer.err();
        self.changed.notify_all();
        self.wake_tasks();
    }

    fn interval(&self) -> Option<Duration> {
        lock(&self.state).wants.iter().map(|want| want.interval).min()
    }

    fn want(&self, interval: Duration, each: bool) -> u64 {
        let mut state = lock(&self.state);
        state.last_id += 1;
        let id = state.last_id;
        state.wants.push(Want { id, interval, each });
        id
    }

    /// Whether no handle is left.
    fn want_no_more(&self, id: u64) -> bool {
        let mut state = lock(&self.state);
        state.wants.retain(|want| want.id != id);
        if !state.is_kept() {
            state.kept.clear();
            state.kept_bytes = 0;
        }
        let (is_last, task) = (state.wants.is_empty(), state.tasks.iter().position(|(known, _)| *known == id));
        let task = task.map(|index| state.tasks.swap_remove(index));
        drop(state);
        drop(task);
        is_last
    }

    /// Passes the newest value on; whether there was anything to pass on to.
    fn pass_on(&self, now: Instant) -> bool {
        let (newest, relays) = {
            let mut state = lock(&self.state);
            if state.passed == state.count {
                return false;
            }
            state.passed = state.count;
            (state.newest.clone(), state.relays.clone())
        };
        let Some(newest) = newest else { return false };
        let passed = relays.iter().filter_map(Weak::upgrade).map(|own| {
            // A value that is longer than declared here belongs to another signature, which the relay does not have.
            own.put(|own| own.pass_on(now, newest.age_at(now), &newest.block))
        });
        passed.filter(Result::is_ok).count() > 0
    }
}

/// The streams of one node that are read here.
#[derive(Default)]
pub(crate) struct Streams(Mutex<BTreeMap<String, Arc<Watched>>>);

impl Streams {
    /// The stream of this name, if it is read here.
    fn get(&self, name: &str) -> Option<Arc<Watched>> {
        lock(&self.0).get(name).cloned()
    }

    pub(super) fn all(&self) -> Vec<Arc<Watched>> {
        lock(&self.0).values().cloned().collect()
    }

    /// The shortest interval that a handle wants a stream at, if any reads it.
    pub(super) fn interval(&self, name: &str) -> Option<Duration> {
        self.get(name)?.interval()
    }

    /// One more handle reads a stream, its newest value or `each`; its number there. The node is to be told.
    pub(crate) fn subscribe(&self, name: &str, interval: Duration, each: bool) -> (Arc<Watched>, u64) {
        let mut streams = lock(&self.0);
        let watched = streams.entry(name.to_owned()).or_insert_with(|| Arc::new(Watched::new(name))).clone();
        let id = watched.want(interval, each);
        (watched, id)
    }

    /// A handle is dropped. The node is to be told.
    pub(crate) fn unsubscribe(&self, watched: &Watched, id: u64) {
        let mut streams = lock(&self.0);
        if watched.want_no_more(id) {
            streams.remove(&watched.name);
        }
    }

    /// A value has come; whether it is to go on to a stream of this unit. The tasks that wait for it are put into `woken`.
    pub(super) fn receive(&self, now: Instant, age: Duration, block: &ReplyBlock<'_>, woken: &mut Vec<Waker>) -> bool {
        self.get(block.signature().name()).is_some_and(|watched| watched.receive(now, age, block, woken))
    }

    /// The node has answered a subscription.
    pub(super) fn answered(&self, name: &str, answer: Result<GrantedStream, Error>) {
        if let Some(watched) = self.get(name) {
            watched.was_answered(answer);
        }
    }

    /// Values have come that go on to streams of this unit; whether any has.
    pub(super) fn pass_on(&self, now: Instant) -> bool {
        self.all().iter().filter(|watched| watched.pass_on(now)).count() > 0
    }

    /// The unit has been stopped: tasks that wait for values look again.
    #[cfg(feature = "async")]
    pub(super) fn wake_tasks(&self) {
        self.all().iter().for_each(|watched| watched.wake_tasks());
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn value(number: u8) -> Received {
        let block = vec![number; KEPT_BYTES / 8].into();
        Received { signature: Arc::from([]), block, age: Duration::ZERO, arrived: Instant::START }
    }

    #[test]
    fn a_late_reader_of_each_value_gets_them_in_order_and_another_the_newest() {
        let streams = Streams::default();
        let (watched, newest) = streams.subscribe("log", Duration::ZERO, false);
        lock(&watched.state).put(value(0));
        let (_, each) = streams.subscribe("log", Duration::ZERO, true);
        let read =
            |id, seen| watched.wait(id, seen, std::time::Duration::ZERO).map(|(value, seen)| (value.block[0], seen));
        assert_eq!(read(each, 0), Ok((0, 1)), "the last of before");
        (1..=3).for_each(|number| lock(&watched.state).put(value(number)));
        assert_eq!([1, 2, 3].map(|seen| read(each, seen)), [Ok((1, 2)), Ok((2, 3)), Ok((3, 4))]);
        assert_eq!(read(each, 4), Err(Error::TimedOut));
        assert_eq!(read(newest, 1), Ok((3, 4)));
        (4..20).for_each(|number| lock(&watched.state).put(value(number)));
        assert_eq!(read(each, 4), Ok((13, 14)), "only so much is kept");
        assert!(lock(&watched.state).kept_bytes <= KEPT_BYTES);
        streams.unsubscribe(&watched, each);
        lock(&watched.state).put(value(20));
        assert!(lock(&watched.state).kept.is_empty());
    }
}
