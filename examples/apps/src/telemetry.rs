//! A stream of measurements where the newest counts and a lost one is no loss.

use cara_core::distribution::parameters::{Parameters, ParametersView};
use cara_core::error::{Error, ServiceError};

/// Takes one measurement.
pub const REPORT: &str = "report(number: int, speed: float)";

/// One measurement as parameters.
pub fn report(number: i64, speed: f64) -> Result<Parameters, Error> {
    let mut parameters = Parameters::new();
    parameters.add_int("number", 1)?;
    parameters.add_float("speed", 1)?;
    parameters.set_value("number", number)?;
    parameters.set_value("speed", speed)?;
    Ok(parameters)
}

/// The receiver's view of a stream whose numbers begin with 1.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct Received {
    /// Measurements that came.
    pub count: i64,
    /// The highest number that came.
    pub newest: i64,
    /// What the newest one said.
    pub speed: f64,
}

impl Received {
    /// Serves [`REPORT`]. A measurement that was overtaken is counted and not used.
    pub fn report(&mut self, parameters: &ParametersView) -> Result<(), ServiceError> {
        let number: i64 = parameters.variable("number")?;
        let speed: f64 = parameters.variable("speed")?;
        self.count = self.count.saturating_add(1);
        if number > self.newest {
            self.newest = number;
            self.speed = speed;
        }
        Ok(())
    }

    /// How many measurements below the newest never came.
    pub const fn missed(&self) -> i64 {
        self.newest.saturating_sub(self.count)
    }
}

#[cfg(test)]
mod tests {
    use super::{Received, report};

    #[test]
    fn the_newest_counts() {
        let mut received = Received::default();
        for (number, speed) in [(1, 0.5), (4, 2.0), (3, 1.5)] {
            received.report(&report(number, speed).unwrap()).unwrap();
        }
        assert_eq!(received, Received { count: 3, newest: 4, speed: 2.0 });
        assert_eq!(received.missed(), 1);
    }
}
