//! A vehicle: the port under test, and a program that notes what it is asked to do.

use std::net::SocketAddrV4;

use cara_core::distribution::connection_handler::Target;
use cara_core::distribution::function::{Attributes, Definition};
use cara_core::distribution::function_list::Slot;
use cara_core::distribution::hello::Manager;
use cara_core::distribution::parameters::ParametersView;
use cara_core::error::{Error, ServiceError};
use cara_core::services::Ticket;
use cara_core::services::lease::{Lease, Order};
use cara_core::services::requests::CallId;
use cara_core::services::session::{Event, Incoming, ReplyBlock};
use cara_core::time::{Duration, Instant};
use cara_smoltcp::{Outcome, Program, Resources, SUnit, Settings};

use super::{Cable, SharedSwitch, manager};

/// The lease of `go_to`.
pub(crate) const LEASE: Duration = Duration::from_millis(400);

pub(crate) struct Vehicle {
    pub(crate) unit: SUnit,
    pub(crate) cable: Cable,
    pub(crate) program: Notes,
    pub(crate) lease: &'static Lease,
    /// The program does something else, and polls nothing.
    pub(crate) asleep: bool,
    due: Instant,
}

/// What the program was asked and told, with its time.
#[derive(Default)]
pub(crate) struct Notes {
    pub(crate) now: Instant,
    pub(crate) slow: Option<Slot>,
    pub(crate) report: Option<Slot>,
    /// How often `report` was called.
    pub(crate) reports: usize,
    pub(crate) go_to: Option<Slot>,
    /// Numbers that `echo` was called with.
    pub(crate) echoed: Vec<i64>,
    pub(crate) driving: bool,
    /// The order of the last call of `go_to`.
    pub(crate) drives_for: Option<Order>,
    pub(crate) made_safe: Vec<Instant>,
    /// What came first.
    pub(crate) order: Vec<&'static str>,
    pub(crate) news: Vec<(Instant, Event)>,
    pub(crate) replies: Vec<(CallId, Result<i64, Error>)>,
    pub(crate) waiting: Option<Ticket>,
}

impl Program for Notes {
    fn serve(&mut self, call: &Incoming, parameters: &mut ParametersView) -> Outcome {
        if Some(call.slot) == self.slow {
            self.waiting = Some(call.ticket);
            return Outcome::Later;
        }
        if Some(call.slot) == self.report {
            self.reports += 1;
            let text = "r".repeat(900);
            return Outcome::Now(parameters.set_value("report", &text[..]).map_err(|_| ServiceError::BadResults));
        }
        let [number] = match parameters.variable::<[i64; 1]>("number") {
            Ok(number) => number,
            Err(_) => return Outcome::Now(Err(ServiceError::Failed(1))),
        };
        if Some(call.slot) == self.go_to {
            (self.driving, self.drives_for) = (true, call.order);
        } else {
            self.echoed.push(number);
            self.order.push("echo");
        }
        Outcome::Now(if number < 0 { Err(ServiceError::Failed(2)) } else { Ok(()) })
    }

    fn make_safe(&mut self, function: Slot) {
        assert_eq!(Some(function), self.go_to);
        self.driving = false;
        self.made_safe.push(self.now);
        self.order.push("made safe");
    }

    fn replied(&mut self, call: CallId, outcome: Result<ReplyBlock<'_>, Error>) {
        let outcome = outcome.and_then(|block| {
            let mut parameters = manager::number(0);
            block.read_into(&mut parameters)?;
            parameters.variable::<[i64; 1]>("number").map(|[number]| number)
        });
        self.replies.push((call, outcome));
    }

    fn hear(&mut self, event: Event) {
        self.news.push((self.now, event));
    }
}

impl Vehicle {
    pub(crate) fn new(
        now: Instant,
        switch: &SharedSwitch,
        number: u8,
        seed: u64,
        target: Target<SocketAddrV4>,
    ) -> Self {
        let mac = [2, 0, 0, 0, 1, number];
        let mut cable = Cable::new(switch, mac);
        let epoch = (seed << 8) | u64::from(number);
        let settings =
            Settings::new(&format!("agv-{number:02}"), number.into(), target, [10, 0, 0, number], 24, epoch).unwrap();
        let resources: &'static mut Resources = Box::leak(Box::default());
        let mut unit = SUnit::new(now, settings, mac, &mut cable, resources);
        let lease: &'static Lease = Box::leak(Box::default());
        let define = |text| Definition::parse(text).unwrap();
        let plain = Attributes::default();
        let echo = define("echo(number: int, text: string[400]) -> (number: int)");
        unit.offer(now, &echo, plain, None).unwrap();
        let slow = unit.offer(now, &define("slow(number: int) -> (number: int)"), plain, None);
        let report = define("report(number: int) -> (number: int, report: string[900])");
        let report = unit.offer(now, &report, plain, None);
        let leased = Attributes { lease: Some(LEASE), ..plain };
        let go_to = unit.offer(now, &define("go_to(number: int)"), leased, Some(lease));
        let program = Notes { slow: slow.ok(), report: report.ok(), go_to: go_to.ok(), ..Notes::default() };
        Self { unit, cable, program, lease, asleep: false, due: now }
    }

    pub(crate) fn poll(&mut self, now: Instant) {
        self.program.now = now;
        self.due = self.unit.poll(now, &mut self.cable, &mut self.program);
    }

    /// When it is to be polled: at its deadline, or when a frame arrives.
    pub(crate) fn next(&self) -> Instant {
        if self.asleep {
            return Instant::FAR_FUTURE;
        }
        let arrival = self.cable.switch.borrow().next_arrival(self.cable.port);
        self.due.min(arrival.unwrap_or(Instant::FAR_FUTURE))
    }

    /// Something was asked of the unit from outside, so it wants to be polled.
    pub(crate) fn wake(&mut self) {
        self.due = Instant::START;
    }

    /// How often it was told that its link had ended.
    pub(crate) fn left(&self) -> usize {
        self.program.news.iter().filter(|(_, news)| matches!(news, Event::Closed(_))).count()
    }
}

pub(crate) fn manager_name() -> Manager {
    Manager::new("manager", 1).unwrap()
}

pub(crate) fn by_broadcast() -> Target<SocketAddrV4> {
    Target::Manager(manager_name())
}

pub(crate) fn by_address() -> Target<SocketAddrV4> {
    Target::Fixed(manager_name(), manager::address())
}
