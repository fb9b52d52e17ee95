//! Why a board started, in words that all boards share.

/// Why the board started.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
#[cfg_attr(feature = "defmt", derive(defmt::Format))]
pub enum Reason {
    /// Power came.
    PowerOn,
    /// The reset pin.
    Pin,
    /// The voltage was too low.
    BrownOut,
    /// The program hung.
    Watchdog,
    /// The program asked for it, after a panic or a fault.
    Program,
    /// The chip does not say.
    Unknown,
}
