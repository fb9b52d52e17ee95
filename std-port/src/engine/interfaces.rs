//! Whether there is a network at all: the interfaces that can be used are looked at now and then, and what changes is told.

use cara_core::time::{Duration, Instant};

use super::Engine;
use crate::event::UnitEvent;
use crate::locks::lock;

/// A unit that is connected to nobody looks this often; a cable that is plugged in leads to a search at once.
const ALONE: Duration = Duration::from_secs(3);
/// Any other looks this often.
const CONNECTED: Duration = Duration::from_secs(30);

/// What is known of the interfaces.
#[derive(Debug, Default)]
pub(super) struct InterfaceWatch {
    due: Instant,
    /// Names of those that can be used; `None` before the first look.
    up: Option<Vec<String>>,
}

impl<T: Send + 'static> Engine<T> {
    /// Looks at the interfaces if it is time; returns when it will be.
    pub(super) fn watch_interfaces(&self) -> Instant {
        let now = self.now();
        let mut watch = lock(&self.sockets.interfaces);
        if now < watch.due {
            return watch.due;
        }
        let mut up = self.sockets.datagrams.usable();
        up.sort();
        let reaches = self.sockets.datagrams.reaches_others(&up);
        watch.due = now + if self.hub().hub.node.connected() == 0 { ALONE } else { CONNECTED };
        let due = watch.due;
        let first = watch.up.is_none();
        if watch.up.as_ref() == Some(&up) {
            return due;
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
            self.hub().hub.node.network_changed(now);
            self.wake_clock();
        }
        if !first || !reaches {
            self.notify(UnitEvent::NetworkChanged { up });
        }
        due
    }
}
