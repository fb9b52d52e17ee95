//! The devices of a board with a W5500, taken and started. Pins are those of WIZnet's W5500-EVB-Pico and -Pico2; on a
//! Pico, wire a W5500 module the same way.

use cara_settings::Settings;
use embassy_executor::{SpawnError, Spawner};
use embassy_net::Stack;
use embassy_net_wiznet::chip::W5500;
use embassy_net_wiznet::{Runner, State};
use embassy_rp::clocks::RoscRng;
use embassy_rp::gpio::{Input, Level, Output, Pull};
use embassy_rp::peripherals::{DMA_CH0, DMA_CH1, SPI0};
use embassy_rp::spi::{Async, Config, Spi};
use embassy_rp::{bind_interrupts, dma, watchdog};
use embassy_time::{Delay, Duration, Timer};
use embedded_hal_bus::spi::ExclusiveDevice;
use static_cell::StaticCell;

use crate::parts::{Button, Watchdog};
use crate::settings::{Flash, Lives};
use crate::{motor, reset, settings};

bind_interrupts!(struct Interrupts {
    DMA_IRQ_0 => dma::InterruptHandler<DMA_CH0>, dma::InterruptHandler<DMA_CH1>;
});

/// The network controller.
pub type Device = embassy_net_wiznet::Device<'static>;
type Bus = ExclusiveDevice<Spi<'static, SPI0, Async>, Output<'static>, Delay>;

/// The W5500 takes up to 80 MHz; wires on a breadboard take less.
const SPI_HERTZ: u32 = 20_000_000;
/// How long to wait for a W5500 that does not answer, before asking again.
const ABSENT: Duration = Duration::from_secs(2);

/// The board.
pub struct Board {
    /// The pages of flash that hold its settings.
    pub pages: [&'static [u8]; 2],
    /// Counts its lives, and stores the claim that it obeys.
    pub lives: &'static mut Lives,
    /// A number that differs from boot to boot, from the jitter of the ring oscillator.
    pub seed: u64,
    /// GP25, the LED on the board.
    pub led: Led,
    /// GP14 to ground.
    pub button: Button,
    /// Not yet running.
    pub watchdog: Watchdog,
    /// The network, not yet started.
    pub network: Network,
}

/// The network, not yet started.
pub struct Network {
    bus: Bus,
    interrupt: Input<'static>,
    reset: Output<'static>,
    address: [u8; 6],
}

impl Board {
    /// Takes the devices; call it first, once.
    pub async fn start(_: Spawner) -> Self {
        let chip = embassy_rp::init(Default::default());
        let watchdog = watchdog::Watchdog::new(chip.WATCHDOG);
        let (reason, place) = cara_board::reason(reset::reason(&watchdog));
        motor::start(chip.PIN_15);
        defmt::info!("started because of {}; the program before ended at {=u32:#x}", reason, place);
        let mut config = Config::default();
        config.frequency = SPI_HERTZ;
        let (clock, send, receive) = (chip.PIN_18, chip.PIN_19, chip.PIN_16);
        let spi = Spi::new(chip.SPI0, clock, send, receive, chip.DMA_CH0, chip.DMA_CH1, Interrupts, config);
        // A pin that can be set always can: the error is of a type without values.
        let bus = match ExclusiveDevice::new(spi, Output::new(chip.PIN_17, Level::High), Delay) {
            Ok(bus) => bus,
            Err(never) => match never {},
        };
        #[cfg(feature = "rp2040")]
        let mut flash = Flash::new_blocking(chip.FLASH);
        #[cfg(feature = "rp2350")]
        let flash = Flash::new_blocking(chip.FLASH);
        #[cfg(feature = "rp2040")]
        let address = hardware_address(&mut flash);
        #[cfg(feature = "rp2350")]
        let address = hardware_address();
        let (interrupt, reset) = (Input::new(chip.PIN_21, Pull::Up), Output::new(chip.PIN_20, Level::High));
        Self {
            pages: settings::pages(),
            lives: settings::lives(flash),
            seed: RoscRng.next_u64(),
            led: Led(Output::new(chip.PIN_25, Level::Low)),
            button: Button(Input::new(chip.PIN_14, Pull::Up)),
            watchdog: Watchdog(watchdog),
            network: Network { bus, interrupt, reset, address },
        }
    }
}

impl Network {
    /// Starts the controller, and the task that serves it.
    pub async fn start(self, spawner: Spawner) -> Result<(Device, Uplink), SpawnError> {
        static STATE: StaticCell<State<4, 4>> = StaticCell::new();
        let Self { bus, interrupt, reset, address } = self;
        let state = STATE.init_with(State::new);
        match embassy_net_wiznet::new(address, state, bus, interrupt, reset).await {
            Ok((device, runner)) => {
                spawner.spawn(serve(runner)?);
                Ok((device, Uplink))
            }
            Err(_) => loop {
                defmt::error!("no W5500 answers on SPI0: look at its wires and its power, then reset the board");
                Timer::after(ABSENT).await;
            },
        }
    }
}

/// What joins a network; a cable needs none of it.
pub struct Uplink;

impl Uplink {
    /// Nothing to do.
    pub fn keep(self, _: Spawner, _: Stack<'static>, _: Option<&Settings>) -> Result<(), SpawnError> {
        Ok(())
    }

    /// Nothing to do.
    pub async fn only_led(self) -> ! {
        core::future::pending().await
    }
}

#[embassy_executor::task]
async fn serve(runner: Runner<'static, W5500, Bus, Input<'static>, Output<'static>>) -> ! {
    runner.run().await
}

/// From the number of the flash chip: an RP2040 has none of its own.
#[cfg(feature = "rp2040")]
fn hardware_address(flash: &mut Flash) -> [u8; 6] {
    let mut number = [0; 8];
    if flash.blocking_unique_id(&mut number).is_err() {
        defmt::warn!("the flash has no number: two boards of this kind would share a hardware address");
    }
    cara_vehicle::hardware_address(&number)
}

/// From the chip's number.
#[cfg(feature = "rp2350")]
fn hardware_address() -> [u8; 6] {
    let number = embassy_rp::otp::get_chipid().unwrap_or_else(|_| {
        defmt::warn!("the chip has no number: two boards of this kind would share a hardware address");
        0
    });
    cara_vehicle::hardware_address(&number.to_le_bytes())
}

/// An LED.
pub struct Led(Output<'static>);

impl Led {
    /// Switches it.
    pub async fn set(&mut self, on: bool) {
        self.0.set_level(Level::from(on));
    }
}
