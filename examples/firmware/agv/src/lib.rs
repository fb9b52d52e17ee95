//! The AGV of the examples as firmware, whatever the board. What it does is `cara_apps::agv`, the same as on Linux; a
//! board adds its network, its clock, its settings and its button.
//!
//! [`provision`] has a board's settings, and the keys that prove its identity. [`vehicle`] makes the unit and its
//! services. A board then runs three tasks beside that of its network: the unit's [`Runner`], [`drive`] and
//! [`call_mechanic`]. [`led`] is the status LED; `slip` is a network over a serial line; [`echo`] is a program without
//! CARA to compare with.

#![no_std]

#[cfg(test)]
extern crate std;

#[cfg(feature = "secure")]
mod claims;
#[cfg(feature = "net")]
pub mod echo;
pub mod least;
pub mod led;
mod log;
#[cfg(feature = "agv")]
mod mechanic;
pub mod provision;
#[cfg(any(test, feature = "slip"))]
pub mod slip;
#[cfg(feature = "streams")]
mod streams;
#[cfg(feature = "tasks")]
pub mod tasks;
#[cfg(feature = "warehouse")]
pub mod warehouse;

#[cfg(feature = "agv")]
pub use mechanic::call_mechanic;

use core::sync::atomic::{AtomicBool, Ordering};

use cara_apps::agv::{BATTERY, BUMPER, GO_TO, GO_TO_LEASE, POS_INFO, Place, Progress, RESET, STOP, TICK};
use cara_core::config::Priority;
use cara_core::error::Error;
use cara_core::services::access::{Functions, Rule, Verbs, Who};
use cara_core::services::lease::{Latch, Lease, Stage};
use cara_embassy::{
    Config, Handle, Handler, Hook, LeaseWatch, Limits, Runner, Security, ServiceOptions, Transport, now, resources,
};
use cara_settings::Settings;
use embassy_time::{Duration, Ticker};

/// The vehicle, which keeps the lease of the call that it drives for.
pub type Agv = cara_apps::agv::Agv<LeaseWatch>;
/// An AGV.
pub type Vehicle = Handle<Agv>;
/// Its limits: one manager, messages of 1 KiB.
pub const LIMITS: Limits =
    Limits { functions: Limits::S_UNIT.functions + cfg!(feature = "logs") as usize, ..Limits::S_UNIT };
/// Its memory.
pub type VehicleResources = resources!(Agv, LIMITS);

/// Returns its argument, for measurements of the round trip.
const ECHO: &str = "echo(text: string[400]) -> (text: string[400])";

/// Permissions: m_units see and call all functions of the vehicle, and may publish theirs to it. Only the manager of
/// the settings can join, and its name is not known when the image is built. S_units have no business here and may do
/// nothing.
const RULES: [Rule; 1] = [Rule::new(Who::M_UNITS, Functions::All, Verbs::ALL)];

/// The lease of the vehicle's driving. An interrupt of the motors can read it: `DRIVING.is_live(now())` becomes false
/// in time even if no task runs any more.
pub static DRIVING: Lease = Lease::new();
/// Whether the vehicle has somewhere to go.
static HAS_TARGET: AtomicBool = AtomicBool::new(false);
static BUMPER_PRESSED: AtomicBool = AtomicBool::new(false);

/// The vehicle's bumper, from its interrupt if the board has one: the motors are off with their next tick, and stay so until a
/// reset, which is refused while the bumper is pressed.
pub fn bumper(pressed: bool) {
    BUMPER_PRESSED.store(pressed, Ordering::Release);
    if pressed {
        DRIVING.inhibit(now(), Latch { by: 0, reason: BUMPER });
    }
}

/// Whether the motors may run now: the vehicle has a target, and its lease is live or, where it has a ramp to brake on, has
/// ended a moment ago. The interrupt of a board's motors asks this each time and cuts them off otherwise, so that they stop in
/// time even if no task runs any more.
pub fn may_move() -> bool {
    HAS_TARGET.load(Ordering::Acquire) && DRIVING.stage(now()) != Stage::Dead
}

/// Why there is no vehicle.
#[derive(Clone, Copy, Debug, PartialEq, Eq, thiserror::Error)]
pub enum VehicleError {
    /// The settings are those of an m_unit.
    #[error("a vehicle belongs to a manager, and the settings name none")]
    NoManager,
    /// The unit could not be made.
    #[error("{0}")]
    Unit(#[from] Error),
}

/// Makes the network stack of the settings.
#[cfg(feature = "net")]
pub fn network<D: embassy_net::driver::Driver, const SOCKETS: usize>(
    device: D,
    settings: &Settings,
    sockets: &'static mut embassy_net::StackResources<SOCKETS>,
    seed: u64,
) -> (cara_embassy::Network<SOCKETS>, embassy_net::Runner<'static, D>) {
    cara_embassy::network(device, network_config(settings), sockets, seed)
}

/// How the network stack gets its address.
#[cfg(feature = "net")]
pub fn network_config(settings: &Settings) -> embassy_net::Config {
    use cara_settings::Network;
    use embassy_net::{Ipv4Cidr, StaticConfigV4};
    match settings.network {
        Network::Dhcp => embassy_net::Config::dhcpv4(Default::default()),
        Network::Static { address, prefix, gateway } => embassy_net::Config::ipv4_static(StaticConfigV4 {
            address: Ipv4Cidr::new(address, prefix),
            gateway,
            dns_servers: Default::default(),
        }),
    }
}

/// A hardware address from a chip's own number, for chips that are delivered without one: administered locally, the same
/// at each start, and different from chip to chip with a likelihood of 2^-40 per pair.
pub fn hardware_address(chip: &[u8]) -> [u8; 6] {
    // FNV-1a.
    let mix = |sum: u64, byte: &u8| (sum ^ u64::from(*byte)).wrapping_mul(0x0000_0100_0000_01B3);
    let [first, second, third, fourth, fifth, ..] = chip.iter().fold(0xCBF2_9CE4_8422_2325, mix).to_be_bytes();
    [0x02, first, second, third, fourth, fifth]
}

/// Makes the AGV that the settings describe; `security` proves its identity.
pub fn vehicle(
    transport: impl Transport,
    resources: &'static mut VehicleResources,
    settings: &Settings,
    security: Security,
) -> Result<(Vehicle, Runner<Agv>), VehicleError> {
    let config = unit_config(settings, security)?.access(&RULES);
    let (vehicle, runner) = cara_embassy::new(transport, resources, config, Agv::new([0, 0]))?;
    offer(vehicle)?;
    Ok((vehicle, runner))
}

/// The unit's configuration from the settings.
fn unit_config(settings: &Settings, security: Security) -> Result<Config, VehicleError> {
    let manager = settings.manager.as_ref().ok_or(VehicleError::NoManager)?;
    let identity = &settings.identity;
    let config = Config::s_unit(identity.name(), identity.id(), &manager.name, manager.id, security)?;
    let config = config.fleet(settings.fleet.0);
    #[cfg(feature = "secure")]
    let config = match claims::stored() {
        Some(stored) => config.obeyed_claim(stored, claims::store),
        None => config,
    };
    Ok(match settings.manager_address {
        Some(address) => config.manager_address(address),
        None => config,
    })
}

/// Publishes the AGV's services.
fn offer(vehicle: Vehicle) -> Result<(), Error> {
    let plain = ServiceOptions::new;
    let stand: &'static Hook<Agv> = &stand_still;
    let pos_info = Handler::method(&|agv: &mut Agv, _, pos| agv.pos_info(pos));
    let battery = Handler::method(&|agv: &mut Agv, _, charge| agv.battery(charge));
    // The order has ended before this runs, which the motors' interrupt sees at once; the hooks do the rest.
    let stop = Handler::free(&|_, _| Ok(()));
    let reset = Handler::method(&|agv: &mut Agv, _, _| {
        agv.set_bumper(BUMPER_PRESSED.load(Ordering::Acquire));
        agv.reset()
    });
    let go_to = Handler::method(&|agv: &mut Agv, call, pos| {
        call.commit(|| agv.go_to(pos, call.lease).inspect(|()| HAS_TARGET.store(true, Ordering::Release)))??;
        info!("driving");
        Ok(())
    });
    vehicle.my_function_list().add_service(POS_INFO, plain().idempotent(), pos_info)?;
    vehicle.my_function_list().add_service(BATTERY, plain().idempotent(), battery)?;
    let stops = plain().idempotent().priority(Priority::Emergency).stops(&DRIVING);
    vehicle.my_function_list().add_service(STOP, stops, stop)?;
    vehicle.my_function_list().add_service(RESET, plain().idempotent().resets(&DRIVING), reset)?;
    vehicle.my_function_list().add_service(ECHO, plain().idempotent(), Handler::method(&|_, _, _| Ok(())))?;
    vehicle.my_function_list().add_service(GO_TO, plain().lease(GO_TO_LEASE, &DRIVING, &cut).then(stand), go_to)?;
    vehicle.on_manager_lost(stand);
    vehicle.publish_my_function_list()
}

/// Stops the motors, whatever else runs.
fn cut() {
    HAS_TARGET.store(false, Ordering::Release);
}

/// Stops the motors, and forgets the target.
pub fn stand_still(agv: &mut Agv) {
    HAS_TARGET.store(false, Ordering::Release);
    if let Some(place) = agv.stop() {
        notify_stop(place);
    }
}

fn notify_stop(place: Place) {
    let [_x, _y] = place.rounded();
    info!("stopped at {} {}", _x, _y);
}

/// The motors' loop: drives while the lease is live.
pub async fn drive(vehicle: Vehicle) -> ! {
    #[cfg(feature = "streams")]
    let streams = streams::Streams::add(vehicle).inspect_err(|_| error!("no room for the streams")).ok();
    let mut ticker = Ticker::every(Duration::from_micros(TICK.as_micros()));
    loop {
        ticker.next().await;
        // The state is lent to services between awaits only, so it is free here.
        let progress = vehicle.with_state(|agv| {
            let progress = agv.step(TICK, DRIVING.is_live(now()));
            HAS_TARGET.store(agv.target().is_some(), Ordering::Release);
            (progress, agv.finished())
        });
        #[cfg(feature = "streams")]
        streams.as_ref().into_iter().for_each(|streams| streams.publish(vehicle));
        let Ok((progress, finished)) = progress else { continue };
        if let Some(order) = finished {
            vehicle.end_order(&order);
        }
        match progress {
            Some(Progress::Arrived(place)) => {
                let [_x, _y] = place.rounded();
                info!("arrived at {} {}", _x, _y);
            }
            Some(Progress::Stopped(place)) => notify_stop(place),
            _ => {}
        }
    }
}

#[cfg(test)]
mod tests {
    use super::hardware_address;
    use std::collections::HashSet;

    #[test]
    fn chips_have_addresses_of_their_own() {
        let addresses: HashSet<[u8; 6]> = (0..1_000_u32).map(|chip| hardware_address(&chip.to_le_bytes())).collect();
        assert_eq!(addresses.len(), 1_000);
        // Administered locally, and of one station.
        assert!(addresses.iter().all(|[first, ..]| first & 0b11 == 0b10));
    }
}
