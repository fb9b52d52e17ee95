//! Devices that all of these boards have: a button on a pin, and the watchdog.

use embassy_rp::gpio::Input;
use embassy_time::{Duration, Timer};

/// A board that has not been fed for so long starts again.
pub(crate) const HANGS: Duration = Duration::from_secs(4);
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

/// Starts the board again when the unit's task or the motors' interrupt does not run.
pub struct Watchdog(pub(crate) embassy_rp::watchdog::Watchdog);

impl Watchdog {
    /// Starts it; the motors' interrupt feeds it.
    pub fn start(mut self) {
        self.0.pause_on_debug(true);
        self.0.start(HANGS);
    }
}
