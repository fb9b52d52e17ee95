//! Whether there is a network at all: the interfaces that can be used are looked at now and then, and what changes is told.

use std::sync::Mutex;

use cara_core::time::{Duration, Instant};

use super::driving::Driver;
use super::hub::SharedHub;
use crate::locks::lock;
use crate::sys::datagram::Datagrams;

/// A unit that is connected to nobody looks this often; a cable that is plugged in leads to a search at once.
const ALONE: Duration = Duration::from_secs(3);
/// Any other looks this often.
const CONNECTED: Duration = Duration::from_secs(30);

/// What is known of the interfaces.
#[derive(Debug, Default)]
pub(super) struct InterfaceWatch(Mutex<Watched>);

#[derive(Debug, Default)]
struct Watched {
    due: Instant,
    /// Names of those that can be used; `None` before the first look.
    up: Option<Vec<String>>,
}

impl InterfaceWatch {
    /// Looks at the interfaces if it is time; returns when it will be, and what subscribers are to hear of: those that
    /// are up.
    pub(super) fn look(&self, sockets: &Datagrams, hub: &SharedHub, driver: &Driver) -> (Instant, Option<Vec<String>>) {
        let now = driver.clock().now();
        let mut watch = lock(&self.0);
        if now < watch.due {
            return (watch.due, None);
        }
        let mut up = sockets.usable();
        up.sort();
        let reaches = sockets.reaches_others(&up);
        watch.due = now + if hub.lock().hub.node.connected() == 0 { ALONE } else { CONNECTED };
        let due = watch.due;
        let first = watch.up.is_none();
        if watch.up.as_ref() == Some(&up) {
            return (due, None);
        }
        watch.up = Some(up.clone());
        drop(watch);
        if !reaches {
            tracing::warn!(
                ?up,
                "no network interface is up, so no node on another host can be found: plug in a cable or check `ip link`"
            );
        } else if !first {
            tracing::info!(?up, "the network interfaces have changed");
        }
        if !first {
            hub.lock().hub.node.network_changed(now);
            driver.wake();
        }
        (due, (!first || !reaches).then_some(up))
    }
}
