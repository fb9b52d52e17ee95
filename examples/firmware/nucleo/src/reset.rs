//! Why the board started (reference manuals RM0410 and RM0433: RCC_CSR and RCC_RSR).

use cara_board::Reason;
use embassy_stm32::pac::RCC;

/// What the register tells of this start. It keeps reasons until they are cleared, which this does: ask once.
#[cfg(feature = "f7")]
pub(crate) fn reason() -> Reason {
    let cause = RCC.csr().read();
    RCC.csr().modify(|register| register.set_rmvf(true));
    match () {
        () if cause.wdgrstf() || cause.wwdgrstf() => Reason::Watchdog,
        () if cause.sftrstf() => Reason::Program,
        () if cause.porrstf() => Reason::PowerOn,
        () if cause.borrstf() => Reason::BrownOut,
        () if cause.padrstf() => Reason::Pin,
        () => Reason::Unknown,
    }
}

/// What the register tells of this start. It keeps reasons until they are cleared, which this does: ask once.
#[cfg(feature = "h7")]
pub(crate) fn reason() -> Reason {
    let cause = RCC.rsr().read();
    RCC.rsr().modify(|register| register.set_rmvf(true));
    match () {
        () if cause.iwdg1rstf() || cause.wwdg1rstf() => Reason::Watchdog,
        () if cause.sftrstf() => Reason::Program,
        () if cause.porrstf() => Reason::PowerOn,
        () if cause.borrstf() => Reason::BrownOut,
        () if cause.pinrstf() => Reason::Pin,
        () => Reason::Unknown,
    }
}
