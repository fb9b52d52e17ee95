//! For test images only: a leased service whose calls two tasks take. Each looks once a second whether its own call's lease is
//! live, moves if so, and answers when it is told to. What moves the motors in between is the lease that it has left for
//! their interrupt.

use core::cell::Cell;

use cara_apps::agv::GO_TO_LEASE;
use cara_core::distribution::parameters::{Parameters, ParametersView};
use cara_core::error::Error;
use cara_core::services::lease::Lease;
use cara_embassy::{Handler, LeaseWatch, ServiceOptions, TakenCall};
use cara_vehicle::{Agv, Vehicle};
use critical_section::Mutex;
use embassy_time::{Duration, Instant, Timer};

use crate::faults;

/// Moves if the speed is not 0, and answers after so many milliseconds.
const CREEP: &str = "creep(speed: int, answers: int)";
/// How often a task looks at its lease.
const LOOKS: Duration = Duration::from_secs(1);

/// Whether a caller wants one of its calls.
pub(crate) static CREEPING: Lease = Lease::new();
/// The lease of the call that moves.
static MOTION: Mutex<Cell<Option<LeaseWatch>>> = Mutex::new(Cell::new(None));

/// Offers the service.
pub(crate) fn offer(vehicle: Vehicle) -> Result<(), Error> {
    vehicle.my_function_list().add_service(
        CREEP,
        ServiceOptions::new().lease(GO_TO_LEASE, &CREEPING, &|| set_motion(None)),
        Handler::task(),
    )
}

/// Whether the motors may run for it now.
pub(crate) fn may_move() -> bool {
    critical_section::with(|section| MOTION.borrow(section).get()).is_some_and(|lease| lease.is_live())
}

/// Whether a call of it has moved the vehicle, and is wanted.
pub(crate) fn moves() -> bool {
    critical_section::with(|section| MOTION.borrow(section).get()).is_some()
}

fn set_motion(lease: Option<LeaseWatch>) {
    critical_section::with(|section| MOTION.borrow(section).set(lease));
}

/// A task that takes calls, one after the other.
#[embassy_executor::task(pool_size = 2)]
pub async fn take(vehicle: Vehicle) -> ! {
    let mut parameters = Parameters::<128>::sized();
    loop {
        if let Ok(call) = vehicle.next_call("creep", &mut parameters).await {
            creep(call, &parameters).await;
        }
    }
}

async fn creep(call: TakenCall<Agv>, parameters: &ParametersView) {
    let number = faults::order_begins();
    let [speed, answers] = ["speed", "answers"].map(|name| parameters.variable::<i64>(name).unwrap_or(0));
    let answered_at = Instant::now() + Duration::from_millis(answers.unsigned_abs());
    let lease = call.lease;
    let mut call = Some(call);
    while let Some(live) = lease.filter(LeaseWatch::is_live) {
        if speed != 0 {
            set_motion(Some(live));
            defmt::info!("order {=u32} moves", number);
        }
        if let Some(call) = call.take_if(|_| Instant::now() >= answered_at) {
            call.reply(Ok(parameters)).await;
        }
        Timer::after(LOOKS).await;
    }
    defmt::info!("order {=u32} has ended", number);
}
