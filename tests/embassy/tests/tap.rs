//! An s_unit on embassy-net and the Linux manager over kernel sockets, through a TAP device in a network namespace that
//! the test makes for itself.

use std::pin::{Pin, pin};
use std::sync::Mutex;
use std::sync::atomic::{AtomicBool, AtomicU32, Ordering};
use std::task::{Context, Wake, Waker};
use std::time::{Duration, Instant};

use cara_apps::agv::{Agv, BATTERY, GO_TO, GO_TO_LEASE, POS_INFO, Progress, TICK};
use cara_core::services::lease::Lease;
use cara_embassy::{Config, Handle, Handler, Limits, Resources, Security, ServiceOptions, resources};
use cara_processes::network::{self, ip};
use cara_secure::random::Random;
use cara_std::keys::{FleetKeys, KeyRing};
use cara_std::{
    CallError, CommunicationSystem, Error, Fleet, Identity, Interfaces, Parameters, Renew, RequestOptions, ServiceError,
};
use embassy_net::{Ipv4Address, Ipv4Cidr, StackResources, StaticConfigV4};
use embassy_net_driver::{Capabilities, Driver, HardwareAddress, LinkState, RxToken, TxToken};
use smoltcp::phy::{Device, Medium, RxToken as _, TunTapInterface, TxToken as _};

/// Long enough for the slowest machine; nothing here is timed.
const LONG: Duration = Duration::from_secs(60);
/// How often the board's tasks are polled: a TAP device has no waker.
const PAUSE: Duration = Duration::from_micros(300);
/// Two addresses, a type and 1,500 bytes.
const FRAME: usize = 1_514;

/// Real time for embassy-time. Every task is polled all the time, so that no timer need wake any.
struct RealTime;

impl embassy_time_driver::Driver for RealTime {
    fn now(&self) -> u64 {
        static START: std::sync::OnceLock<Instant> = std::sync::OnceLock::new();
        START.get_or_init(Instant::now).elapsed().as_micros() as u64
    }

    fn schedule_wake(&self, _: u64, _: &Waker) {}
}

#[allow(unsafe_code)]
mod symbols {
    use super::RealTime;

    embassy_time_driver::time_driver_impl!(static CLOCK: RealTime = RealTime);
}

/// The far end of the cable of the interface `tap0`.
struct Tap(TunTapInterface);

struct Received(Vec<u8>);

struct Sending<'t>(&'t mut TunTapInterface);

impl RxToken for Received {
    fn consume<R, F: FnOnce(&mut [u8]) -> R>(mut self, read: F) -> R {
        read(&mut self.0)
    }
}

impl TxToken for Sending<'_> {
    fn consume<R, F: FnOnce(&mut [u8]) -> R>(self, length: usize, write: F) -> R {
        // Held while it is written, since the device takes none whose interface is down.
        let plugged_in = PLUGGED_IN.lock().unwrap();
        if !*plugged_in {
            return write(&mut vec![0; length]);
        }
        let token = self.0.transmit(now()).expect("there is always room");
        token.consume(length, write)
    }
}

impl Driver for Tap {
    type RxToken<'a> = Received;
    type TxToken<'a> = Sending<'a>;

    fn receive(&mut self, _: &mut Context<'_>) -> Option<(Received, Sending<'_>)> {
        let frame = self.0.receive(now()).map(|(token, _)| token.consume(<[u8]>::to_vec))?;
        Some((Received(frame), Sending(&mut self.0)))
    }

    fn transmit(&mut self, _: &mut Context<'_>) -> Option<Sending<'_>> {
        Some(Sending(&mut self.0))
    }

    fn link_state(&mut self, _: &mut Context<'_>) -> LinkState {
        if *PLUGGED_IN.lock().unwrap() { LinkState::Up } else { LinkState::Down }
    }

    fn capabilities(&self) -> Capabilities {
        let mut capabilities = Capabilities::default();
        capabilities.max_transmission_unit = FRAME;
        capabilities
    }

    fn hardware_address(&self) -> HardwareAddress {
        HardwareAddress::Ethernet([2, 0, 0, 0, 0, 7])
    }
}

fn now() -> smoltcp::time::Instant {
    smoltcp::time::Instant::from_micros(embassy_time::Instant::now().as_micros() as i64)
}

/// The cable: out before the interface goes down, and in again behind its coming up.
static PLUGGED_IN: Mutex<bool> = Mutex::new(true);
static LOSSES: AtomicU32 = AtomicU32::new(0);
static MECHANIC_CAME: AtomicBool = AtomicBool::new(false);
static DRIVING: Lease = Lease::new();

#[test]
fn a_linux_manager_meets_a_vehicle_on_embassy() {
    if network::test("a_linux_manager_meets_a_vehicle_on_embassy", &[], true) {
        meet();
    }
}

fn meet() {
    ip("link set lo up");
    ip("tuntap add name tap0 mode tap");
    ip("addr add 10.77.0.1/24 broadcast + dev tap0");
    ip("link set tap0 up");
    let fleet = cara_processes::random_fleet();
    let (own, vehicle) = (Identity::m_unit("manager", 1).unwrap(), Identity::s_unit("agv", 7).unwrap());
    let mut keys = FleetKeys::draw(Fleet(fleet)).unwrap();
    keys.add(&own, &[]).unwrap();
    keys.add(&vehicle, std::slice::from_ref(&own)).unwrap();
    let vehicle = keys.ring(&vehicle).unwrap();
    std::thread::spawn(move || board(fleet, vehicle));
    let builder = CommunicationSystem::builder("manager", 1).unwrap();
    let manager = builder.keys(keys.ring(&own).unwrap()).fleet(fleet).interfaces(Interfaces::All).build().unwrap();
    let mut minutes = Parameters::new();
    minutes.add_int("minutes", 1).unwrap();
    let list = manager.my_function_list();
    list.add_function("call_mechanic", &minutes, |mut parameters: Parameters| {
        parameters.set_value("minutes", 15_i64).unwrap();
        parameters
    })
    .unwrap();
    manager.publish_my_function_list().unwrap();
    manager.start().unwrap();
    until("the vehicle joins", || manager.number_of_s_units() == 1);
    talk(&manager, [1, 1]);
    until("the vehicle has called the mechanic", || MECHANIC_CAME.load(Ordering::Relaxed));
    assert_eq!(LOSSES.load(Ordering::Relaxed), 0);
    // The cable is pulled until both ends have noticed, and the vehicle comes back by itself.
    *PLUGGED_IN.lock().unwrap() = false;
    ip("link set tap0 down");
    until("the manager gives the vehicle up", || manager.number_of_s_units() == 0);
    assert_eq!(LOSSES.load(Ordering::Relaxed), 1);
    ip("link set tap0 up");
    *PLUGGED_IN.lock().unwrap() = true;
    until("the vehicle comes back", || manager.number_of_s_units() == 1);
    talk(&manager, [0, 1]);
    assert_eq!(LOSSES.load(Ordering::Relaxed), 1);
    manager.stop();
}

fn until(what: &str, done: impl Fn() -> bool) {
    let deadline = Instant::now() + LONG;
    while !done() {
        assert!(Instant::now() < deadline, "not in {LONG:?}: {what}");
        std::thread::sleep(Duration::from_millis(5));
    }
}

fn position(value: [i64; 2]) -> Parameters {
    let mut position = Parameters::new();
    position.add_int("position", 2).unwrap();
    position.set_value("position", value).unwrap();
    position
}

/// Sends the vehicle somewhere, which answers when it is there.
fn talk(manager: &CommunicationSystem, to: [i64; 2]) {
    let agv = manager.s_unit("agv").expect("it has joined");
    assert!(agv.wait_for_function("go_to", LONG), "it publishes what it offers");
    let options = RequestOptions { timeout: Some(LONG.into()), ..RequestOptions::renewing(Renew::Process) };
    let deadline = Instant::now() + LONG;
    loop {
        match agv.call("go_to", &mut position(to)).with(options).wait() {
            // This machine was too busy to renew the lease, and the vehicle stands.
            Err(CallError { error: Error::Expired | Error::Service(ServiceError::NotReady), .. })
                if Instant::now() < deadline => {}
            ended => break ended.unwrap(),
        }
    }
    let mut there = position([9, 9]);
    agv.block_request("pos_info", &mut there).unwrap();
    assert_eq!(there.variable("position"), Ok(to));
    let mut wrong = Parameters::new();
    wrong.add_float("position", 2).unwrap();
    assert_eq!(agv.block_request("go_to", &mut wrong), Err(Error::WrongType { index: 0 }));
    let mut charge = Parameters::new();
    charge.add_float("charge", 1).unwrap();
    agv.block_request("battery", &mut charge).unwrap();
    let [charge]: [f64; 1] = charge.variable("charge").unwrap();
    assert!((90.0..=100.0).contains(&charge), "{charge}");
}

/// The vehicle's controller.
fn board(fleet: u32, keys: KeyRing) {
    let tap = TunTapInterface::new("tap0", Medium::Ethernet).expect("the device is there");
    let address = Ipv4Cidr::new(Ipv4Address::new(10, 77, 0, 2), 24);
    let config = StaticConfigV4 { address, gateway: None, dns_servers: Default::default() };
    let resources = Box::leak(Box::new(StackResources::<{ Limits::S_UNIT.sockets() }>::new()));
    let config = embassy_net::Config::ipv4_static(config);
    let (network, mut stack_runner) = cara_embassy::network(Tap(tap), config, resources, u64::from(fleet));
    let memory: &'static mut resources!(Agv, Limits::S_UNIT) = Box::leak(Box::new(Resources::new()));
    let mut random = Random::constant();
    random.stir(&fleet.to_le_bytes());
    let security = Security::keys(Box::leak(Box::new(keys)), random);
    let config = Config::s_unit("agv", 7, "manager", 1, security).unwrap().fleet(fleet);
    let (unit, mut runner) = cara_embassy::new(network, memory, config, Agv::new([0, 0])).unwrap();
    services(unit);
    let (network, runner) = (pin!(async { stack_runner.run().await }), pin!(async { runner.run().await }));
    let (driving, asking) = (pin!(drive(unit)), pin!(ask(unit)));
    let mut tasks: [Pin<&mut dyn Future<Output = ()>>; 4] = [network, runner, driving, asking];
    let waker = Waker::from(std::sync::Arc::new(Nobody));
    let mut context = Context::from_waker(&waker);
    loop {
        for task in &mut tasks {
            let _ = task.as_mut().poll(&mut context);
        }
        std::thread::sleep(PAUSE);
    }
}

struct Nobody;

impl Wake for Nobody {
    fn wake(self: std::sync::Arc<Self>) {}
}

fn services(unit: Handle<Agv>) {
    let plain = ServiceOptions::new;
    let pos_info = Handler::method(&|agv: &mut Agv, _, parameters| agv.pos_info(parameters));
    unit.my_function_list().add_service(POS_INFO, plain(), pos_info).unwrap();
    unit.my_function_list()
        .add_service(BATTERY, plain(), Handler::method(&|agv: &mut Agv, _, p| agv.battery(p)))
        .unwrap();
    let forget: &'static cara_embassy::Hook<Agv> = &|agv| {
        agv.stop();
    };
    unit.my_function_list()
        .add_service(GO_TO, plain().lease(GO_TO_LEASE, &DRIVING, &|| {}).then(forget), Handler::task())
        .unwrap();
    unit.on_manager_lost(&|agv| {
        agv.stop();
        LOSSES.fetch_add(1, Ordering::Relaxed);
    });
    unit.publish_my_function_list().unwrap();
}

/// Drives, and answers on arrival.
async fn drive(unit: Handle<Agv>) {
    let mut parameters = Parameters::new();
    loop {
        let call = unit.next_call("go_to", &mut parameters).await.expect("it is there");
        let mut driven = unit.with_state(|agv| agv.go_to(&parameters, None)).unwrap();
        while driven.is_ok() {
            embassy_time::Timer::after_micros(TICK.as_micros()).await;
            let is_live = DRIVING.is_live(cara_embassy::now());
            match unit.with_state(|agv| agv.step(TICK, is_live)).unwrap() {
                Some(Progress::Arrived(_)) => break,
                // Where the hook was first, it is not the step that stops the vehicle.
                Some(Progress::Stopped(_)) => driven = Err(ServiceError::NotReady),
                _ if !is_live => driven = Err(ServiceError::NotReady),
                _ => {}
            }
        }
        if let Some(order) = &call.lease {
            unit.end_order(order);
        }
        call.reply(driven.map(|()| &*parameters)).await;
    }
}

/// Calls the mechanic once.
async fn ask(unit: Handle<Agv>) {
    let mut minutes = Parameters::new();
    minutes.add_int("minutes", 1).unwrap();
    unit.wait_until(|unit| unit.nodes_offering("call_mechanic").next().is_some()).await;
    unit.block_request("call_mechanic", &mut minutes).await.unwrap();
    MECHANIC_CAME.store(minutes.variable::<i64>("minutes") == Ok(15), Ordering::Relaxed);
    std::future::pending().await
}
