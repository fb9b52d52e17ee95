//! Status LED of a board.

use embassy_time::{Duration, Ticker};

use crate::{DRIVING, Vehicle, now};

/// What it shows.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Sign {
    /// The board has no settings, or no keys: it flickers, five times a second.
    Unprovisioned,
    /// It looks for its manager: it blinks once a second, on for half of it.
    Looking,
    /// The manager is there: a short flash every two seconds.
    Connected,
    /// It drives, or may drive: on.
    Driving,
}

const TICK: Duration = Duration::from_millis(100);

impl Sign {
    /// Of a vehicle.
    pub fn of(vehicle: &Vehicle) -> Self {
        match (vehicle.is_connected(), DRIVING.is_live(now())) {
            (_, true) => Self::Driving,
            (true, false) => Self::Connected,
            (false, false) => Self::Looking,
        }
    }

    /// Whether the LED is on in this tick; there are ten in a second.
    pub const fn is_on(self, tick: u32) -> bool {
        match self {
            Self::Unprovisioned => tick.is_multiple_of(2),
            Self::Looking => tick % 10 < 5,
            Self::Connected => tick.is_multiple_of(20),
            Self::Driving => true,
        }
    }
}

/// Shows the state of the vehicle, for ever.
pub async fn show(vehicle: Vehicle, set: impl AsyncFnMut(bool)) -> ! {
    shine(|| Sign::of(&vehicle), set).await
}

/// Shows [`Sign::Unprovisioned`], for ever.
pub async fn unprovisioned(set: impl AsyncFnMut(bool)) -> ! {
    shine(|| Sign::Unprovisioned, set).await
}

async fn shine(sign: impl Fn() -> Sign, mut set: impl AsyncFnMut(bool)) -> ! {
    let mut ticker = Ticker::every(TICK);
    let mut tick: u32 = 0;
    let mut was_on = None;
    loop {
        let on = sign().is_on(tick);
        if was_on != Some(on) {
            set(on).await;
        }
        was_on = Some(on);
        tick = tick.wrapping_add(1);
        ticker.next().await;
    }
}

#[cfg(test)]
mod tests {
    use super::Sign;

    fn ticks_on(sign: Sign) -> usize {
        (0..20).filter(|tick| sign.is_on(*tick)).count()
    }

    #[test]
    fn signs_are_distinguished() {
        let signs = [Sign::Unprovisioned, Sign::Looking, Sign::Connected, Sign::Driving];
        let changes = |sign: Sign| (0..20).filter(|tick| sign.is_on(*tick) != sign.is_on(tick + 1)).count();
        assert_eq!(signs.map(ticks_on), [10, 10, 1, 20]);
        assert_eq!(signs.map(changes), [20, 4, 2, 0]);
    }
}
