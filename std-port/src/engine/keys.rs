//! The keys of a unit that runs: what proves it on each link, and how they follow their file.

use std::sync::{Arc, Mutex, OnceLock};

use cara_core::config::Mode;
use cara_core::distribution::hello::Hello;
use cara_core::distribution::identity::Identity;
use cara_core::services;
use cara_core::time::{Duration, Instant};
use cara_secure::keyring::{Codes, Keyring};
use cara_secure::link::{Cipher, Credentials};

use super::driving::Driver;
use super::link::Linux;
use crate::keys::{DiscoveryKey, KeyRing, LiveRing, PairKey, draw};
use crate::locks::Rank;

/// The file is looked at this often, and whenever somebody comes for whom there is no key.
const REFRESH: Duration = Duration::from_secs(3);

/// Where a unit's keys come from.
#[derive(Debug)]
pub(crate) enum Keys {
    /// Plain mode.
    Insecure,
    Ring(LiveRing),
}

/// Whether this host has instructions for AES-GCM. Without them it would be slow, and its time would depend on the key.
fn has_aes() -> bool {
    #[cfg(target_arch = "x86_64")]
    return is_x86_feature_detected!("aes")
        && is_x86_feature_detected!("pclmulqdq")
        && is_x86_feature_detected!("ssse3");
    #[cfg(target_arch = "aarch64")]
    return std::arch::is_aarch64_feature_detected!("aes") && std::arch::is_aarch64_feature_detected!("pmull");
    #[cfg(not(any(target_arch = "x86_64", target_arch = "aarch64")))]
    false
}

/// A ring as it is now, for as long as the core needs it.
#[derive(Clone, Debug)]
pub(crate) struct View(Arc<KeyRing>);

impl Keyring for View {
    fn discovery(&self) -> (&DiscoveryKey, Option<&DiscoveryKey>) {
        Keyring::discovery(&*self.0)
    }

    fn pair(&self, peer: &Identity) -> Option<(PairKey, Option<PairKey>)> {
        Keyring::pair(&*self.0, peer)
    }
}

impl Keys {
    pub(crate) const fn mode(&self) -> Mode {
        match self {
            Self::Insecure => Mode::Plain,
            Self::Ring(_) => Mode::Secured,
        }
    }

    pub(crate) const fn ring(&self) -> Option<&LiveRing> {
        match self {
            Self::Insecure => None,
            Self::Ring(live) => Some(live),
        }
    }

    /// The cipher of a link that begins.
    pub(crate) fn cipher(&self) -> Cipher {
        let cipher = Cipher::new(self.mode());
        if has_aes() { cipher.offering_aes() } else { cipher }
    }

    /// The codes of discovery, with the keys as they are now.
    pub(crate) fn codes(&self) -> Codes<View> {
        match self {
            Self::Insecure => Codes::Plain,
            Self::Ring(live) => Codes::Keyed(View(live.ring())),
        }
    }

    /// What proves this unit to `peer`; of a vehicle that was added just now as well.
    fn credentials(&self, peer: &Identity) -> Option<Credentials> {
        let Self::Ring(live) = self else { return None };
        let fresh = draw().inspect_err(|error| tracing::error!(%error, "no link can be proven")).ok()?;
        let found = View(live.ring()).credentials(peer, *fresh);
        if found.is_some() || !refresh(live) {
            return found;
        }
        View(live.ring()).credentials(peer, *fresh)
    }
}

/// The keys of a unit that runs, and how they follow their file.
#[derive(Debug)]
pub(crate) struct KeyWatch {
    keys: Keys,
    watched: Mutex<Watched>,
    /// How old the keys of a link become, instead of 12 h.
    renews_every: OnceLock<Duration>,
}

impl KeyWatch {
    pub(super) fn new(keys: Keys, born: Instant) -> Self {
        Self { keys, watched: Mutex::new(Watched::new(born)), renews_every: OnceLock::new() }
    }

    pub(crate) const fn keys(&self) -> &Keys {
        &self.keys
    }

    pub(crate) fn renew_every(&self, span: Duration) {
        let _ = self.renews_every.set(span);
    }

    pub(super) fn renews_every(&self) -> Option<Duration> {
        self.renews_every.get().copied()
    }

    /// Keys that were taken for a unit that came are to be held against all links at once.
    fn bring_forward(&self, now: Instant) -> bool {
        let Keys::Ring(live) = &self.keys else { return false };
        let mut watched = Rank::Leaf.lock(&self.watched);
        let is_news = watched.checked.as_ref().is_some_and(|checked| !Arc::ptr_eq(checked, &live.ring()));
        if is_news {
            watched.due = now;
        }
        is_news
    }

    /// Looks at the file if it is time; returns the ring where links have not been held against it yet, and when the file
    /// is looked at next.
    pub(super) fn look(&self, now: Instant) -> (Option<Arc<KeyRing>>, Instant) {
        let Keys::Ring(live) = &self.keys else { return (None, Instant::FAR_FUTURE) };
        let mut watched = Rank::Leaf.lock(&self.watched);
        if now < watched.due {
            return (None, watched.due);
        }
        watched.due = now + REFRESH;
        refresh(live);
        let ring = live.ring();
        (watched.is_news(&ring).then_some(ring), watched.due)
    }
}

/// When the keys are looked at next, and which links have been held against them.
#[derive(Debug)]
struct Watched {
    due: Instant,
    /// The ring in which every live link had its key. Another one may have been taken since, for a unit that came.
    checked: Option<Arc<KeyRing>>,
}

impl Watched {
    const fn new(born: Instant) -> Self {
        Self { due: born, checked: None }
    }

    /// Whether links have not been held against this ring yet; from here on they have.
    fn is_news(&mut self, ring: &Arc<KeyRing>) -> bool {
        let is_news = self.checked.as_ref().is_none_or(|checked| !Arc::ptr_eq(checked, ring));
        self.checked = Some(ring.clone());
        is_news
    }
}

/// Whether there is another ring now. A file that is refused is told once, and the ring stays as it was.
fn refresh(live: &LiveRing) -> bool {
    match live.refresh() {
        Ok(changed) => {
            if changed {
                let ring = live.ring();
                tracing::info!(generation = ring.generation(), peers = ring.peers().len(), "the keys have changed");
            }
            changed
        }
        Err(error) => {
            tracing::error!(%error, "the keys stay as they were");
            false
        }
    }
}

/// The keys, for sessions.
pub(super) struct KeyDoor<'e> {
    pub(super) watch: &'e KeyWatch,
    pub(super) driver: &'e Driver,
}

impl services::Keys<Linux> for KeyDoor<'_> {
    fn credentials(&mut self, hello: &Hello) -> Option<Credentials> {
        let credentials = self.watch.keys.credentials(&hello.identity);
        if self.watch.bring_forward(self.driver.clock().now()) {
            self.driver.wake_looker();
        }
        credentials
    }
}
