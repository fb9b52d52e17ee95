//! The ports as scenarios see them.

mod linux;
mod simulator;

use crate::{Weather, World};

/// A fleet on the virtual network; the seed decides everything.
pub fn simulator(seed: u64, weather: Weather) -> Box<dyn World> {
    Box::new(simulator::SimWorld::new(seed, weather))
}

/// A fleet of its own over loopback, with a random number.
pub fn linux() -> Box<dyn World> {
    Box::new(linux::LinuxWorld::new())
}
