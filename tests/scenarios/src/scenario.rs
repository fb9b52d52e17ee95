//! A scenario as the registry holds it: its rule, what it needs from a port, and what its runs must reach.

use crate::{Port, World};

/// What a scenario needs from the port beyond a network.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord)]
pub enum Need {
    /// Units that lose power or are killed, without a farewell.
    Crash,
    /// Paths that are cut and healed.
    Partition,
    /// Streams that hold what they carry.
    Freeze,
    /// Links that hold all that they carry, datagrams among it.
    FreezeLink,
    /// A peer that reads a stream slowly.
    SlowReader,
    /// Streams that are reset by the network.
    Reset,
    /// Datagrams that arrive twice, late or not at all, as the scenario says.
    Path,
    /// A unit that gets another address while it runs.
    AddressChange,
    /// A machine that sleeps.
    Suspend,
    /// Clients that are no unit, or none of this version or fleet.
    UnknownClients,
    /// Such a client without a key, which is accepted or told why it is not.
    UnprovenClients,
    /// Connections that wait to be accepted, as many as come.
    Backlog,
    /// An interface that goes and comes.
    Interface,
    /// More than two units.
    ThirdUnit,
    /// More units than a test on one machine should start.
    ManyUnits,
    /// Minutes of time.
    LongTime,
    /// Instants that do not depend on how busy the machine is.
    ExactTime,
    /// The same random numbers in each boot.
    SameSeed,
    /// A unit that goes on when a handler panics.
    Panics,
    /// An m_unit that is told to which m_units it connects.
    Choice,
    /// A unit that publishes streams, and reads those of others.
    Streams,
    /// A unit whose services tell why they fail and how far they are, and a caller that watches its calls.
    Details,
    /// Services of which a call that has begun waits for the handler of the one before.
    Turns,
    /// Hearts that are dropped.
    DroppedHearts,
}

impl Need {
    /// All of them.
    pub const ALL: [Self; 24] = [
        Self::Crash,
        Self::Partition,
        Self::Freeze,
        Self::FreezeLink,
        Self::SlowReader,
        Self::Reset,
        Self::Path,
        Self::AddressChange,
        Self::Suspend,
        Self::UnknownClients,
        Self::UnprovenClients,
        Self::Backlog,
        Self::Interface,
        Self::ThirdUnit,
        Self::ManyUnits,
        Self::LongTime,
        Self::ExactTime,
        Self::SameSeed,
        Self::Panics,
        Self::Choice,
        Self::Streams,
        Self::Details,
        Self::Turns,
        Self::DroppedHearts,
    ];

    /// Why a port lacks it; `None` where it does not.
    pub const fn missing_on(self, port: Port) -> Option<&'static str> {
        match port {
            Port::Simulator => self.missing_on_simulator(),
            Port::Secured => self.missing_on_secured(),
            Port::Linux => self.missing_on_linux(),
            Port::Embassy => self.missing_on_embassy(),
            Port::Line => self.missing_on_line(),
        }
    }

    const fn missing_on_simulator(self) -> Option<&'static str> {
        match self {
            Self::Turns => {
                Some("its handlers are futures that run side by side: a call that has begun waits for nothing")
            }
            _ => None,
        }
    }

    /// Of the simulator with secured units.
    const fn missing_on_secured(self) -> Option<&'static str> {
        match self {
            Self::UnprovenClients => Some(
                "a client without a proof is neither accepted nor told why; `tests/sim/tests/security` has what it tries",
            ),
            _ => self.missing_on_simulator(),
        }
    }

    /// Of Linux over loopback in one process.
    const fn missing_on_linux(self) -> Option<&'static str> {
        Some(match self {
            Self::Crash => "units of one process cannot crash one by one",
            Self::Partition => "loopback cannot be cut without root",
            Self::FreezeLink => "datagrams on loopback cannot be frozen without root",
            Self::Path => "loopback has one quality",
            Self::AddressChange => "loopback has one address",
            Self::Suspend => "units of one process cannot be suspended one by one",
            Self::Interface => "loopback is always up; `std-port/tests/namespaces.rs` has interfaces of its own",
            Self::ManyUnits => "too many threads and sockets for a test",
            Self::LongTime => "minutes of real time",
            Self::ExactTime => "instants depend on the machine's load",
            Self::Panics
            | Self::Choice
            | Self::Streams
            | Self::Details
            | Self::Turns
            | Self::DroppedHearts
            | Self::Freeze
            | Self::Reset
            | Self::SlowReader
            | Self::ThirdUnit
            | Self::UnknownClients
            | Self::UnprovenClients
            | Self::Backlog => {
                return None;
            }
            Self::SameSeed => "seeds come from the operating system",
        })
    }

    /// Of boards on a switch in memory.
    const fn missing_on_embassy(self) -> Option<&'static str> {
        Some(match self {
            Self::SlowReader => "the switch carries frames, and a board's stack reads what it can",
            Self::Backlog => "a board refuses connections while its few sockets are busy",
            Self::ManyUnits => "more nodes than a board has links for",
            Self::Panics => "a panic restarts a board",
            Self::Streams => "its nodes are those of boards without the feature `streams`",
            Self::Details => "its nodes are those of boards without the feature `details`",
            Self::DroppedHearts => "a board's heart is a static, which is never dropped",
            Self::Choice => "a board that is an m_unit has few links, and meets every m_unit",
            _ => return None,
        })
    }

    /// Of two boards on a serial line.
    const fn missing_on_line(self) -> Option<&'static str> {
        Some(match self {
            Self::ThirdUnit | Self::ManyUnits => "a line has two ends",
            Self::Freeze | Self::FreezeLink => "a wire holds nothing back: what is not read at once is lost",
            Self::Reset => "nothing between its ends can reset the stream of a wire",
            Self::Path => "a wire has one rate, and keeps the order",
            Self::AddressChange => "a line has no addresses",
            Self::UnknownClients | Self::UnprovenClients => "whoever else is on a line is its other end",
            Self::Interface => "nothing tells a unit whether its wire is plugged in",
            _ => return self.missing_on_embassy(),
        })
    }
}

/// What the network does by itself during the runs over many seeds.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum FaultProfile {
    /// Loss, delay, jitter, reordering, duplication, short partitions, split reads.
    Rough,
    /// Delay, jitter, reordering, duplication, split reads; nothing is lost.
    Light,
    /// Only what the scenario injects.
    Own,
}

/// One rule, shown on every port that can.
#[derive(Clone, Copy)]
pub struct Scenario {
    /// What happens in it, as the function's name says.
    pub name: &'static str,
    /// The rule that it shows: numbers of `docs/paper.md`, or the name of a behaviour that the design decides.
    pub rule: &'static str,
    /// What the network does by itself.
    pub profile: FaultProfile,
    /// What it needs from the port.
    pub needs: &'static [Need],
    /// Faults and states that its runs over many seeds must reach, beside those of its fault profile.
    pub expects: &'static [&'static str],
    /// Runs it; panics where the rule is broken.
    pub run: fn(&mut dyn World),
}

impl Scenario {
    /// Why it does not run on a port; nothing where it does.
    pub fn missing_on(&self, port: Port) -> Option<&'static str> {
        self.needs.iter().find_map(|need| need.missing_on(port))
    }

    /// The faults that its profile injects.
    pub fn profile_faults(&self) -> &'static [&'static str] {
        match self.profile {
            FaultProfile::Rough => {
                &["loss", "retransmission", "delay", "jitter", "reorder", "duplicate", "split-read", "partition"]
            }
            FaultProfile::Light => &["delay", "jitter", "reorder", "duplicate", "split-read"],
            FaultProfile::Own => &[],
        }
    }
}

/// Declares the scenarios of a file: `scenarios![name: "rule", FaultProfile, [needs], [expects]; …]`.
macro_rules! scenarios {
    ($($run:ident: $rule:literal, $profile:ident, [$($need:ident),*], [$($expects:literal),*];)*) => {
        pub(super) const SCENARIOS: &[$crate::Scenario] = &[$($crate::Scenario {
            name: stringify!($run),
            rule: $rule,
            profile: $crate::FaultProfile::$profile,
            needs: &[$($crate::Need::$need),*],
            expects: &[$($expects),*],
            run: $run,
        }),*];
    };
}
pub(crate) use scenarios;
