//! Clocks: the processor at 216 MHz (F767) or 400 MHz (H743), and 48 MHz for the random number generator.

use embassy_stm32::Config;
use embassy_stm32::rcc::*;

/// Cycles of the processor in a millisecond.
#[cfg(feature = "f7")]
pub(crate) const CYCLES: u32 = 216_000;
/// Cycles of the processor in a millisecond.
#[cfg(feature = "h7")]
pub(crate) const CYCLES: u32 = 400_000;

/// Clocks from the 8 MHz that the board's debug probe gives.
#[cfg(feature = "f7")]
pub(crate) fn config() -> Config {
    use embassy_stm32::time::Hertz;

    let mut config = Config::default();
    let rcc = &mut config.rcc;
    rcc.hse = Some(Hse { freq: Hertz(8_000_000), mode: HseMode::Bypass });
    rcc.pll_src = PllSource::HSE;
    rcc.pll = Some(Pll {
        prediv: PllPreDiv::DIV4,
        mul: PllMul::MUL216,
        divp: Some(PllPDiv::DIV2),
        divq: Some(PllQDiv::DIV9),
        divr: None,
    });
    rcc.ahb_pre = AHBPrescaler::DIV1;
    rcc.apb1_pre = APBPrescaler::DIV4;
    rcc.apb2_pre = APBPrescaler::DIV2;
    rcc.sys = Sysclk::PLL1_P;
    config
}

/// Clocks from the chip's own oscillator.
#[cfg(feature = "h7")]
pub(crate) fn config() -> Config {
    let mut config = Config::default();
    let rcc = &mut config.rcc;
    rcc.hsi = Some(HSIPrescaler::DIV1);
    rcc.csi = true;
    rcc.hsi48 = Some(Default::default());
    rcc.pll1 = Some(Pll {
        source: PllSource::HSI,
        prediv: PllPreDiv::DIV4,
        mul: PllMul::MUL50,
        fracn: None,
        divp: Some(PllDiv::DIV2),
        divq: None,
        divr: None,
    });
    rcc.sys = Sysclk::PLL1_P;
    rcc.ahb_pre = AHBPrescaler::DIV2;
    rcc.apb1_pre = APBPrescaler::DIV2;
    rcc.apb2_pre = APBPrescaler::DIV2;
    rcc.apb3_pre = APBPrescaler::DIV2;
    rcc.apb4_pre = APBPrescaler::DIV2;
    rcc.voltage_scale = VoltageScale::Scale1;
    config
}
