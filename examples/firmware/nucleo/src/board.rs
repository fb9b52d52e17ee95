//! The board's devices, taken and started. Pins are those of a Nucleo-144 (ST, UM1974 and UM2407).

use embassy_stm32::eth::{self, Ethernet, GenericPhy, PacketQueue, Sma};
use embassy_stm32::exti::{self, ExtiInput};
use embassy_stm32::gpio::{Level, Output, Pull, Speed};
use embassy_stm32::interrupt::typelevel::EXTI15_10;
use embassy_stm32::mode::Async;
#[cfg(feature = "f7")]
use embassy_stm32::peripherals::IWDG;
#[cfg(feature = "h7")]
use embassy_stm32::peripherals::IWDG1 as IWDG;
use embassy_stm32::peripherals::{ETH, ETH_SMA, RNG};
use embassy_stm32::rng::{self, Rng};
use embassy_stm32::wdg::IndependentWatchdog;
use embassy_stm32::{bind_interrupts, uid};
use embassy_time::{Duration, Timer};
use static_cell::StaticCell;

use crate::settings::{Flash, Lives};
use crate::{clocks, motor, reset, settings};

bind_interrupts!(struct Interrupts {
    ETH => eth::InterruptHandler;
    EXTI15_10 => exti::InterruptHandler<EXTI15_10>;
    RNG => rng::InterruptHandler<RNG>;
});

/// The network controller.
pub type Device = Ethernet<'static, ETH, GenericPhy<Sma<'static, ETH_SMA>>>;

/// A board that has not been fed for so long starts again.
const HANGS: Duration = Duration::from_secs(4);
/// A button that bounces is pressed once.
const BOUNCES: Duration = Duration::from_millis(50);

/// The board.
pub struct Board {
    /// The pages of flash that hold its settings.
    pub pages: [&'static [u8]; 2],
    /// Counts its lives, and stores the claim that it obeys.
    pub lives: &'static mut Lives,
    /// A number that differs from boot to boot, from the chip's random number generator.
    pub seed: u64,
    /// The network.
    pub device: Device,
    /// LD1, green.
    pub led: Led,
    /// B1, blue.
    pub button: Button,
    /// Not yet running.
    pub watchdog: Watchdog,
}

impl Board {
    /// Takes the devices; call it first, once.
    pub fn start() -> Self {
        static PACKETS: StaticCell<PacketQueue<4, 4>> = StaticCell::new();
        let (reason, place) = cara_board::reason(reset::reason());
        let chip = embassy_stm32::init(clocks::config());
        motor::start(chip.PF13);
        defmt::info!("started because of {}; the program before ended at {=u32:#x}", reason, place);
        let mut random = Rng::new(chip.RNG, Interrupts);
        let mut seed = [0; 8];
        random.fill_bytes(&mut seed);
        let packets = PACKETS.init_with(PacketQueue::new);
        let address = cara_vehicle::hardware_address(&uid::uid());
        let device = Ethernet::new(
            packets,
            chip.ETH,
            Interrupts,
            chip.PA1,
            chip.PA7,
            chip.PC4,
            chip.PC5,
            chip.PG13,
            chip.PB13,
            chip.PG11,
            address,
            chip.ETH_SMA,
            chip.PA2,
            chip.PC1,
        );
        Self {
            pages: settings::pages(),
            lives: settings::lives(Flash::new_blocking(chip.FLASH)),
            seed: u64::from_le_bytes(seed),
            device,
            led: Led(Output::new(chip.PB0, Level::Low, Speed::Low)),
            button: Button(ExtiInput::new(chip.PC13, chip.EXTI13, Pull::Down, Interrupts)),
            #[cfg(feature = "f7")]
            watchdog: Watchdog(IndependentWatchdog::new(chip.IWDG, HANGS.as_micros() as u32)),
            #[cfg(feature = "h7")]
            watchdog: Watchdog(IndependentWatchdog::new(chip.IWDG1, HANGS.as_micros() as u32)),
        }
    }
}

/// An LED.
pub struct Led(Output<'static>);

impl Led {
    /// Switches it.
    pub fn set(&mut self, on: bool) {
        self.0.set_level(Level::from(on));
    }
}

/// A button.
pub struct Button(ExtiInput<'static, Async>);

impl Button {
    /// Waits until it is pressed.
    pub async fn pressed(&mut self) {
        self.0.wait_for_low().await;
        Timer::after(BOUNCES).await;
        self.0.wait_for_high().await;
    }
}

/// Starts the board again when the unit's task or the motors' interrupt does not run. It cannot be stopped.
pub struct Watchdog(IndependentWatchdog<'static, IWDG>);

impl Watchdog {
    /// Starts it; the motors' interrupt feeds it.
    pub fn start(mut self) {
        self.0.unleash();
    }
}
