//! Devices that all of these boards have: a button on a pin, and the watchdog.

use embassy_rp::gpio::Input;
use embassy_time::{Duration, Timer};

/// A board that has not been fed for so long starts again.
const HANGS: Duration = Duration::from_secs(4);
/// A button that bounces is pressed once.
const BOUNCES: Duration = Duration::from_millis(50);

/// A button between a pin and ground.
pub struct Button(pub(crate) Input<'static>);

impl Button {
    /// Waits until it is pressed.
    pub async fn pressed(&mut self) {
        self.0.wait_for_high().await;
        Timer::after(BOUNCES).await;
        self.0.wait_for_low().await;
    }
}

/// Starts the board again when tasks do not get their turn.
pub struct Watchdog(pub(crate) embassy_rp::watchdog::Watchdog);

impl Watchdog {
    /// Feeds it for as long as tasks get their turn.
    pub async fn run(mut self) -> ! {
        self.0.pause_on_debug(true);
        self.0.start(HANGS);
        loop {
            self.0.feed(HANGS);
            Timer::after(HANGS / 4).await;
        }
    }
}
