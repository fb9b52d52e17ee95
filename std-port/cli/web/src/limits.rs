//! Every limit of the server: what it holds, what is in use, and how often it refused. The page shows them.

use std::sync::Arc;
use std::sync::atomic::{AtomicU64, AtomicUsize, Ordering};

use serde_json::{Value, json};

/// Open connections of browsers. The next one waits.
pub(crate) const CONNECTIONS: usize = 64;
/// Pages that are told what changes.
pub(crate) const PAGES: usize = 16;
/// Calls and holds that run at a time. Each has a connection to the manager, which has few.
pub(crate) const CALLS: usize = 2;
/// Stops and resets that run at a time.
pub(crate) const STOPS: usize = 3;
/// Bytes of a request's body.
pub(crate) const BODY: usize = 1024 * 1024;
/// Streams that are shown.
pub(crate) const STREAMS: usize = 4096;
/// Events that are kept for pages that come later.
pub(crate) const EVENTS: usize = 200;
/// Cells of a map.
pub(crate) const CELLS: usize = 1024 * 1024;

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
    pub(crate) bodies: Limit,
    pub(crate) streams: Limit,
    pub(crate) events: Limit,
    pub(crate) hosts: Limit,
    pub(crate) origins: Limit,
    pub(crate) tokens: Limit,
}

impl Limits {
    pub(crate) const fn new() -> Self {
        Self {
            connections: Limit::new("connections of browsers; refused: TLS failed", Some(CONNECTIONS)),
            pages: Limit::new("pages", Some(PAGES)),
            calls: Limit::new("calls at a time", Some(CALLS)),
            stops: Limit::new("stops and resets at a time", Some(STOPS)),
            bodies: Limit::new("bytes of a request; refused: longer ones", Some(BODY)),
            streams: Limit::new("streams", Some(STREAMS)),
            events: Limit::new("events kept; refused: passed over by a page", Some(EVENTS)),
            hosts: Limit::new("requests for another host name", None),
            origins: Limit::new("requests from another site", None),
            tokens: Limit::new("requests without the token", None),
        }
    }

    pub(crate) fn json(&self) -> Value {
        let all = [
            &self.connections,
            &self.pages,
            &self.calls,
            &self.stops,
            &self.bodies,
            &self.streams,
            &self.events,
            &self.hosts,
            &self.origins,
            &self.tokens,
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
