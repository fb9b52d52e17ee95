//! What a service manager hears (`sd_notify(3)`): that the node is up, that it lives, that it ends. Where there is none, nothing.

use std::time::Duration;

use sd_notify::NotifyState;

use super::unit::Node;

/// The node is up. Where a watchdog is asked for, it hears of the unit twice in its time at least, as long as that ends leases in time.
pub(super) fn up(node: &Node) {
    say(NotifyState::Ready);
    let Some(limit) = sd_notify::watchdog_enabled() else { return };
    let (lives, pause) = (node.lives(), limit / 4);
    let watch = move || {
        while let Some(lives) = lives(pause) {
            if lives {
                say(NotifyState::Watchdog);
            } else {
                tracing::error!("this unit does not keep time: its service manager hears nothing of it");
            }
            std::thread::sleep(pause.max(SHORTEST));
        }
    };
    if let Err(error) = std::thread::Builder::new().name("cara-watchdog".into()).spawn(watch) {
        tracing::error!(%error, "no thread is left to serve the watchdog with: the service manager will restart this node");
    }
}

/// A watchdog whose time is 0 would otherwise keep a processor busy.
const SHORTEST: Duration = Duration::from_millis(10);

/// The node ends.
pub(super) fn ends() {
    say(NotifyState::Stopping);
}

fn say(state: NotifyState<'_>) {
    if let Err(error) = sd_notify::notify(&[state]) {
        tracing::warn!(%error, "the service manager (NOTIFY_SOCKET) does not hear this node");
    }
}
