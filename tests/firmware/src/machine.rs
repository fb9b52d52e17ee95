//! The boards that are emulated.

use clap::ValueEnum;

/// A board.
#[derive(Clone, Copy, Debug, PartialEq, Eq, ValueEnum)]
pub(crate) enum Machine {
    Lm3s6965evb,
    Mps2An386,
    /// With a W5500, in rp2040js.
    Rp2040,
}

impl Machine {
    /// What QEMU and `cara provision` call it.
    pub(crate) const fn name(self) -> &'static str {
        match self {
            Self::Lm3s6965evb => "lm3s6965evb",
            Self::Mps2An386 => "mps2-an386",
            Self::Rp2040 => "rp2040",
        }
    }

    /// What QEMU calls its Ethernet controller.
    pub(crate) const fn controller(self) -> &'static str {
        match self {
            Self::Mps2An386 => "lan9118",
            _ => "stellaris",
        }
    }

    /// Where its clock counts instructions, each takes 2 to this power of nanoseconds: 1.6 cycles of its 12.5 or 25 MHz.
    pub(crate) const fn instruction(self) -> u32 {
        match self {
            Self::Mps2An386 => 6,
            _ => 7,
        }
    }
}
