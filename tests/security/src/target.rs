//! The unit under attack: anything that accepts or opens a connection and reports what its application saw.

use std::collections::HashSet;
use std::net::TcpStream;

use anyhow::Result;
use cara_core::config::Mode;
use cara_secure::keys::PairKey;

use crate::ground::Keys;
use crate::speaker::{Claim, Speaker};
use crate::tally::Counters;

/// A unit that is attacked.
pub trait Target: Sync {
    /// Its name in the table.
    fn name(&self) -> &str;

    /// How many connections at a time.
    fn workers(&self) -> usize;

    /// A connection with it, opened by either end.
    fn visit(&self) -> Result<Visit<'_>>;

    /// Its counters since it started.
    fn counters(&self) -> Result<Counters>;

    /// Whether it reports the calls that it ran. Otherwise only joins are seen.
    fn reports_calls(&self) -> bool {
        true
    }

    /// How many of so many attempts it has time for.
    fn share(&self, attempts: usize) -> usize {
        attempts
    }
}

/// What an application saw of one peer.
#[derive(Clone, Debug, Default)]
pub struct Seen {
    /// How often it joined.
    pub joins: usize,
    /// The numbers of the calls that were run for it.
    pub marks: Vec<i64>,
}

/// A connection between an attacker and a target.
pub struct Visit<'t> {
    /// The connection.
    pub stream: TcpStream,
    /// The attacker has opened it.
    pub dials: bool,
    /// The identity that the attacker claims; there is a key for it.
    pub claim: Claim,
    /// What keys there are.
    pub keys: Keys,
    /// What the application saw on this visit, now that the connection has ended.
    pub seen: Box<dyn Fn() -> Result<Seen> + Send + 't>,
}

impl Visit<'_> {
    /// A speaker at the attacker's end of the connection.
    pub fn speaker(&self, key: &PairKey) -> Result<Speaker> {
        self.speaker_as(Mode::Secured, self.claim.clone(), key)
    }

    /// A speaker with another claim.
    pub fn speaker_as(&self, mode: Mode, claim: Claim, key: &PairKey) -> Result<Speaker> {
        Ok(Speaker::new(self.stream.try_clone()?, self.dials, mode, claim, key.clone())?)
    }

    /// Whether the application saw anything of a speaker without a key.
    pub fn was_seen(&self, mut speaker: Speaker) -> Result<bool> {
        speaker.finish();
        let seen = (self.seen)()?;
        Ok(speaker.reported || seen.joins > 0 || !seen.marks.is_empty())
    }

    /// Whether the application saw more than a genuine peer sent: more than `joins` joins, a request that is not in
    /// `allowed`, or one of them twice.
    pub fn saw_more(&self, mut speaker: Speaker, joins: usize, allowed: &[i64]) -> Result<bool> {
        speaker.finish();
        let seen = (self.seen)()?;
        let once: HashSet<_> = seen.marks.iter().collect();
        Ok(seen.joins > joins || once.len() < seen.marks.len() || once.iter().any(|mark| !allowed.contains(mark)))
    }
}
