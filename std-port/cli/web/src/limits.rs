//! Every limit of the server: what it holds, what is in use, and how often it refused. The page shows them.

use std::sync::Arc;
use std::sync::atomic::{AtomicU64, AtomicUsize, Ordering};

use serde_json::{Value, json};

/// Open connections of browsers. For the next one another one gives way.
pub(crate) const CONNECTIONS: usize = 64;
/// Of these so many are for connections that have not shown the token, also where all others have.
pub(crate) const NEWCOMERS: usize = CONNECTIONS / 4;
/// Requests with the token that are carried out at a time, besides stops.
pub(crate) const REQUESTS: usize = CONNECTIONS - NEWCOMERS;
/// Pages that are told what changes.
pub(crate) const PAGES: usize = 16;
/// Calls and holds that run at a time. Each has a connection to the manager, which has few.
pub(crate) const CALLS: usize = 2;
/// Stops of all that run at a time, and those of one node. The next one waits for its turn, and no other question takes it.
pub(crate) const STOPS_OF_ALL: usize = 2;
pub(crate) const STOPS_OF_ONE: usize = 1;
/// Resets that run at a time.
pub(crate) const RESETS: usize = 1;
/// Bytes of a request's body.
pub(crate) const BODY: usize = 1024 * 1024;
/// Streams that are shown.
pub(crate) const STREAMS: usize = 4096;
/// Events that are kept for pages that come later.
pub(crate) const EVENTS: usize = 200;
/// Lines of a log that are shown of each node, and characters of a line; the rest of a longer one is left out.
pub(crate) const LOG_LINES: usize = 30;
pub(crate) const LOG_LINE: usize = 400;
/// Cells of a map.
pub(crate) const CELLS: usize = 4 * 1024 * 1024;

/// One limit.
#[derive(Debug)]
pub(crate) struct Limit {
    name: &'static str,
    /// `None` for a check that has no number.
    most: Option<usize>,
    used: AtomicUsize,
    refused: AtomicU64,
}

impl Limit {
    const fn new(name: &'static str, most: Option<usize>) -> Self {
        Self { name, most, used: AtomicUsize::new(0), refused: AtomicU64::new(0) }
    }

    /// Counts a refusal.
    pub(crate) fn refuse(&self) {
        self.refused.fetch_add(1, Ordering::Relaxed);
    }

    /// Counts several.
    pub(crate) fn refuse_many(&self, count: u64) {
        self.refused.fetch_add(count, Ordering::Relaxed);
    }

    /// Says how much is in use.
    pub(crate) fn uses(&self, count: usize) {
        self.used.store(count, Ordering::Relaxed);
    }

    fn json(&self) -> Value {
        let (used, refused) = (self.used.load(Ordering::Relaxed), self.refused.load(Ordering::Relaxed));
        json!({ "name": self.name, "most": self.most, "used": used, "refused": refused })
    }
}

/// All of them.
#[derive(Debug)]
pub(crate) struct Limits {
    pub(crate) connections: Limit,
    pub(crate) pages: Limit,
    pub(crate) calls: Limit,
    pub(crate) stops: Limit,
    pub(crate) resets: Limit,
    pub(crate) bodies: Limit,
    pub(crate) streams: Limit,
    pub(crate) events: Limit,
    pub(crate) hosts: Limit,
    pub(crate) origins: Limit,
    pub(crate) tokens: Limit,
    pub(crate) requests: Limit,
    pub(crate) gave_way: Limit,
    pub(crate) handshakes: Limit,
    pub(crate) heads: Limit,
    pub(crate) slow_bodies: Limit,
    pub(crate) takes: Limit,
}

impl Limits {
    pub(crate) const fn new() -> Self {
        Self {
            connections: Limit::new("connections of browsers; refused: all were at work", Some(CONNECTIONS)),
            pages: Limit::new("pages", Some(PAGES)),
            calls: Limit::new("calls at a time", Some(CALLS)),
            stops: Limit::new("stops at a time; refused: had to wait", Some(STOPS_OF_ALL + STOPS_OF_ONE)),
            resets: Limit::new("resets at a time", Some(RESETS)),
            bodies: Limit::new("bytes of a request; refused: longer ones", Some(BODY)),
            streams: Limit::new("streams", Some(STREAMS)),
            events: Limit::new("events kept; refused: passed over by a page", Some(EVENTS)),
            hosts: Limit::new("requests for another host name", None),
            origins: Limit::new("requests from another site", None),
            tokens: Limit::new("requests without the token", None),
            requests: Limit::new("requests at a time, besides stops", Some(REQUESTS)),
            gave_way: Limit::new("connections that gave way to others", None),
            handshakes: Limit::new("connections whose TLS failed", None),
            heads: Limit::new("requests that did not come within 5 s", None),
            slow_bodies: Limit::new("requests whose content did not come within 5 s", None),
            takes: Limit::new("browsers that took nothing for 10 s", None),
        }
    }

    pub(crate) fn json(&self) -> Value {
        let all = [
            &self.connections,
            &self.pages,
            &self.calls,
            &self.stops,
            &self.resets,
            &self.bodies,
            &self.streams,
            &self.events,
            &self.hosts,
            &self.origins,
            &self.tokens,
            &self.requests,
            &self.gave_way,
            &self.handshakes,
            &self.heads,
            &self.slow_bodies,
            &self.takes,
        ];
        all.map(Limit::json).into_iter().collect()
    }
}

/// A place below a limit, until it is dropped.
#[derive(Debug)]
pub(crate) struct Place {
    limits: Arc<Limits>,
    which: fn(&Limits) -> &Limit,
}

impl Place {
    /// `None`, and counted, where all are taken.
    pub(crate) fn take(limits: &Arc<Limits>, which: fn(&Limits) -> &Limit) -> Option<Self> {
        let limit = which(limits);
        let most = limit.most.unwrap_or(usize::MAX);
        let taken =
            limit.used.fetch_update(Ordering::Relaxed, Ordering::Relaxed, |used| (used < most).then_some(used + 1));
        if taken.is_err() {
            limit.refuse();
            return None;
        }
        Some(Self { limits: limits.clone(), which })
    }
}

impl Drop for Place {
    fn drop(&mut self) {
        (self.which)(&self.limits).used.fetch_sub(1, Ordering::Relaxed);
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn places_are_given_back_and_refusals_counted() {
        let limits = Arc::new(Limits::new());
        let taken: Vec<_> = (0..CALLS).map(|_| Place::take(&limits, |limits| &limits.calls).unwrap()).collect();
        assert!(Place::take(&limits, |limits| &limits.calls).is_none());
        assert_eq!(limits.calls.json()["refused"], 1);
        drop(taken);
        assert_eq!(limits.calls.json()["used"], 0);
        assert!(Place::take(&limits, |limits| &limits.calls).is_some());
    }
}
