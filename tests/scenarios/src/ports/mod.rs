//! The ports as scenarios see them.

mod embassy;
mod keys;
mod linux;
mod relay;
mod simulator;

use cara_core::config::Mode;
use cara_core::services::access::{Access, Rule};

use crate::{FaultProfile, Need, World};

/// A fleet on the virtual network; the seed decides everything.
pub fn simulator(seed: u64, profile: FaultProfile, mode: Mode) -> Box<dyn World> {
    Box::new(simulator::SimWorld::new(seed, profile, mode))
}

/// A fleet of its own over loopback, with a random number. Where a scenario needs streams that can be disturbed, AGVs
/// dial their managers through a relay. Units have keys, as is the default; but where unknown clients come they are plain.
pub fn linux(needs: &[Need]) -> Box<dyn World> {
    let disturbed = [Need::Freeze, Need::Reset, Need::SlowReader];
    // Unknown clients speak plain.
    let mode = if needs.contains(&Need::UnknownClients) { Mode::Plain } else { Mode::Secured };
    Box::new(linux::LinuxWorld::new(needs.iter().any(|need| disturbed.contains(need)), mode))
}

/// A fleet of boards on a switch in memory; the seed decides everything. Unknown clients speak plain, so where a scenario has
/// some its units are insecure, and secured in all others.
pub fn embassy(seed: u64, profile: FaultProfile, needs: &[Need]) -> Box<dyn World> {
    let mode = if needs.contains(&Need::UnknownClients) { Mode::Plain } else { Mode::Secured };
    Box::new(embassy::EmbassyWorld::new(seed, profile, mode))
}

/// Two boards with keys on a serial line; the seed decides everything.
pub fn line(seed: u64, profile: FaultProfile) -> Box<dyn World> {
    Box::new(embassy::EmbassyWorld::on_line(seed, profile))
}

/// A table as a board has it: there for good.
fn lent(table: Option<&'static [Rule]>) -> Option<&'static dyn Access> {
    table.map(|rules| &*Box::leak(Box::new(rules)) as &'static dyn Access)
}
