//! The devices of a Raspberry Pi Pico 2 W, taken and started. The radio has the board's LED on one of its own pins, so
//! that the LED goes on only once the radio runs.

use cara_settings::{Settings, Wifi};
use cyw43::{A4, Aligned, Control, JoinOptions, NetDriver, PowerManagementMode, Runner, SpiBus, State};
use cyw43_pio::{PioSpi, RM2_CLOCK_DIVIDER};
use embassy_executor::{SpawnError, Spawner};
use embassy_net::Stack;
use embassy_rp::clocks::RoscRng;
use embassy_rp::gpio::{Input, Level, Output, Pull};
use embassy_rp::peripherals::{DMA_CH0, PIO0};
use embassy_rp::pio::Pio;
use embassy_rp::{bind_interrupts, dma, pio, watchdog};
use embassy_sync::blocking_mutex::raw::CriticalSectionRawMutex;
use embassy_sync::signal::Signal;
use embassy_time::{Duration, Timer, with_timeout};
use static_cell::StaticCell;

use crate::parts::{Button, Watchdog};
use crate::settings::{Flash, Lives};
use crate::{motor, reset, settings};

bind_interrupts!(struct Interrupts {
    DMA_IRQ_0 => dma::InterruptHandler<DMA_CH0>;
    PIO0_IRQ_0 => pio::InterruptHandler<PIO0>;
});

/// The network controller.
pub type Device = NetDriver<'static>;
type Radio = SpiBus<Output<'static>, PioSpi<'static, PIO0, 0>>;

static FIRMWARE: &Aligned<A4, [u8]> = &Aligned(*include_bytes!(concat!(env!("OUT_DIR"), "/43439A0.bin")));
static BOARD_DATA: &Aligned<A4, [u8]> = &Aligned(*include_bytes!(concat!(env!("OUT_DIR"), "/nvram_rp2040.bin")));
static REGULATORY: &[u8] = include_bytes!(concat!(env!("OUT_DIR"), "/43439A0_clm.bin"));

/// The LED's pin of the radio.
const LED: u8 = 0;
/// How often the radio is asked at least whether it is still joined.
const LOOKED_AT: Duration = Duration::from_secs(2);
/// How long an access point may take to let the board in.
const JOINS: Duration = Duration::from_secs(15);

/// The wanted state of the LED.
static LIGHT: Signal<CriticalSectionRawMutex, bool> = Signal::new();

/// The board.
pub struct Board {
    /// The pages of flash that hold its settings.
    pub pages: [&'static [u8]; 2],
    /// Counts its lives, and stores the claim that it obeys.
    pub lives: &'static mut Lives,
    /// A number that differs from boot to boot, from the jitter of the ring oscillator.
    pub seed: u64,
    /// The LED on the board, which the radio switches.
    pub led: Led,
    /// GP14 to ground.
    pub button: Button,
    /// Not yet running.
    pub watchdog: Watchdog,
    /// The network, started but not joined to anything.
    pub network: Network,
}

/// The network, started but not joined to anything.
pub struct Network {
    device: Device,
    control: Control<'static>,
}

impl Board {
    /// Takes the devices and starts the radio; call it first, once.
    pub async fn start(spawner: Spawner) -> Self {
        let chip = embassy_rp::init(Default::default());
        let watchdog = watchdog::Watchdog::new(chip.WATCHDOG);
        let (reason, place) = cara_board::reason(reset::reason(&watchdog));
        motor::start(chip.PIN_15);
        defmt::info!("started because of {}; the program before ended at {=u32:#x}", reason, place);
        let (power, select) = (Output::new(chip.PIN_23, Level::Low), Output::new(chip.PIN_25, Level::High));
        let Pio { mut common, irq0, sm0, .. } = Pio::new(chip.PIO0, Interrupts);
        let channel = dma::Channel::new(chip.DMA_CH0, Interrupts);
        let (data, clock) = (chip.PIN_24, chip.PIN_29);
        let bus = PioSpi::new(&mut common, sm0, RM2_CLOCK_DIVIDER, irq0, select, data, clock, channel);
        let (device, control) = defmt::unwrap!(start_radio(spawner, power, bus).await);
        Self {
            pages: settings::pages(),
            lives: settings::lives(Flash::new_blocking(chip.FLASH)),
            seed: RoscRng.next_u64(),
            led: Led(()),
            button: Button(Input::new(chip.PIN_14, Pull::Up)),
            watchdog: Watchdog(watchdog),
            network: Network { device, control },
        }
    }
}

async fn start_radio(
    spawner: Spawner,
    power: Output<'static>,
    bus: PioSpi<'static, PIO0, 0>,
) -> Result<(Device, Control<'static>), SpawnError> {
    static STATE: StaticCell<State> = StaticCell::new();
    while FIRMWARE.is_empty() {
        defmt::error!("this image was linked without the radio's firmware: set CARA_CYW43_FIRMWARE and build it again");
        Timer::after(LOOKED_AT).await;
    }
    let (device, mut control, runner) = cyw43::new(STATE.init_with(State::new), power, bus, FIRMWARE, BOARD_DATA).await;
    spawner.spawn(serve(runner)?);
    control.init(REGULATORY).await;
    // A vehicle is called at any time: saving power costs up to a tenth of a second per call.
    control.set_power_management(PowerManagementMode::None).await;
    Ok((device, control))
}

impl Network {
    /// The controller, and what keeps it joined.
    pub async fn start(self, _: Spawner) -> Result<(Device, Uplink), SpawnError> {
        Ok((self.device, Uplink(self.control)))
    }
}

/// What joins an access point.
pub struct Uplink(Control<'static>);

impl Uplink {
    /// Starts the task that joins the access point of the settings, again whenever it is lost, and switches the LED.
    pub fn keep(self, spawner: Spawner, stack: Stack<'static>, settings: Option<&Settings>) -> Result<(), SpawnError> {
        let wifi = settings.and_then(|settings| settings.wifi.clone());
        if wifi.is_none() {
            defmt::error!("the settings name no access point: give cara provision --wifi and --wifi-password-file");
        }
        spawner.spawn(keep_joined(self.0, wifi, stack)?);
        Ok(())
    }

    /// Switches the LED of a board that stays without network, for ever.
    pub async fn only_led(mut self) -> ! {
        loop {
            self.0.gpio_set(LED, LIGHT.wait().await).await;
        }
    }
}

#[embassy_executor::task]
async fn serve(runner: Runner<'static, Radio>) -> ! {
    runner.run().await
}

#[embassy_executor::task]
async fn keep_joined(mut control: Control<'static>, wifi: Option<Wifi>, stack: Stack<'static>) -> ! {
    loop {
        if let Some(wifi) = wifi.as_ref().filter(|_| !stack.is_link_up()) {
            join(&mut control, wifi, stack).await;
        }
        if let Ok(on) = with_timeout(LOOKED_AT, LIGHT.wait()).await {
            control.gpio_set(LED, on).await;
        }
    }
}

async fn join(control: &mut Control<'static>, wifi: &Wifi, stack: Stack<'static>) {
    let options = match wifi.password() {
        "" => JoinOptions::new_open(),
        password => JoinOptions::new(password.as_bytes()),
    };
    match with_timeout(JOINS, control.join(wifi.name(), options)).await {
        // The link comes up shortly after; joining again before would lose it.
        Ok(Ok(())) => drop(with_timeout(LOOKED_AT, stack.wait_link_up()).await),
        Ok(Err(error)) => defmt::warn!("{=str} cannot be joined: {}", wifi.name(), error),
        Err(_) => defmt::warn!("{=str} does not answer", wifi.name()),
    }
}

/// The LED, which only the radio's task can switch.
pub struct Led(());

impl Led {
    /// Switches it.
    pub async fn set(&mut self, on: bool) {
        LIGHT.signal(on);
    }
}
