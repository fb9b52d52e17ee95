//! What the macros generate, with a function list and a peer side by side.

use core::cell::RefCell;
use core::future::Future;
use core::ops::ControlFlow;
use core::pin::pin;
use core::task::{Context, Poll, Waker};

use cara_core::config::Priority;
use cara_core::distribution::block::{self, SliceWriter};
use cara_core::distribution::failure::Failure;
use cara_core::distribution::function::{Attributes, Definition, Signature};
use cara_core::distribution::identity::Identity;
use cara_core::services::call::{BlockingCaller, CallError, Callee, Caller, Detail, Held, Outgoing};
use cara_core::services::heart::Renew;
use cara_core::services::lease::Ended;
use cara_core::services::requests::CallId;
use cara_core::services::session::RequestOptions;
use cara_core::time::{Duration, Instant};
use cara_core::typed::{BAD_ARGUMENT, Free, Functions, Interface, Method, Mismatch, Reader, ReaderFunctions};
use cara_core::{AnyCall, Error, Parameters, ParametersView, ServiceError, TypedCall, Variables, interface};

#[derive(Variables, Clone, Copy, Debug, PartialEq)]
enum Gear {
    Reverse = -1,
    Neutral,
    Drive = 7,
}

#[derive(Variables, Clone, Debug, PartialEq)]
struct Pose {
    at: [f64; 2],
    #[name = "heading.deg"]
    heading: i16,
    gear: Gear,
    lit: [bool; 3],
    r#type: u8,
    ratio: f32,
    label: heapless::String<8>,
    #[size(200)]
    note: String,
    #[size(16)]
    photo: Vec<u8>,
}

impl Pose {
    fn new(note: &str) -> Self {
        Self {
            at: [1.5, -2.0],
            heading: -90,
            gear: Gear::Drive,
            lit: [true, false, true],
            r#type: 3,
            ratio: 0.25,
            label: heapless::String::try_from("agv").unwrap(),
            note: note.to_owned(),
            photo: vec![1, 2, 3],
        }
    }
}

/// What each kind of argument and result is there for.
#[interface]
trait Agv {
    /// Adds.
    #[returns(sum)]
    #[idempotent]
    fn add(&self, a: i64, b: i64) -> i64;

    #[name = "go-to"]
    #[help = "Drives there."]
    #[priority(high)]
    #[actuator(drive)]
    #[lease(ms = 400)]
    fn go_to(&mut self, call: &impl AnyCall, #[unit = "m"] position: [i64; 2]) -> Result<(), ServiceError>;

    #[priority(emergency)]
    #[actuator(drive)]
    #[stop]
    fn stop();

    #[reset]
    fn reset(&mut self) -> Result<(), ServiceError>;

    fn pose(&mut self) -> Result<Pose, ServiceError>;

    #[returns(#[size(64)] text, "length-1", gear)]
    fn say(
        &mut self,
        #[size(64)] text: &str,
        #[size(8)] raw: &[u8],
        #[name = "n.1"] small: u8,
        gear: Gear,
    ) -> Result<(String, u16, Gear), ServiceError>;

    fn place(&mut self, #[variables] pose: Pose);

    fn dock(&mut self, call: &impl TypedCall<Left, Blocked>, gate: u8) -> Result<(), ServiceError>;

    fn undock(&mut self, call: &impl TypedCall<Left>);
}

#[derive(Variables, Clone, Copy, Debug, PartialEq)]
struct Left {
    left: f32,
}

#[derive(Variables, Clone, Debug, PartialEq)]
struct Blocked {
    at: [i32; 2],
    #[size(8)]
    by: String,
}

#[derive(Default)]
struct Vehicle {
    target: Option<[i64; 2]>,
    placed: Option<Pose>,
    resets: u32,
    stands_by: bool,
}

impl Agv for Vehicle {
    fn add(&self, a: i64, b: i64) -> i64 {
        a.wrapping_add(b)
    }

    fn go_to(&mut self, call: &impl AnyCall, position: [i64; 2]) -> Result<(), ServiceError> {
        assert_eq!(call.caller().name(), "manager");
        call.commit(|| self.target = Some(position))?;
        Ok(())
    }

    fn stop() {}

    fn reset(&mut self) -> Result<(), ServiceError> {
        self.resets += 1;
        if self.stands_by { Err(ServiceError::Failed(2)) } else { Ok(()) }
    }

    fn pose(&mut self) -> Result<Pose, ServiceError> {
        self.placed.clone().ok_or(ServiceError::NotReady)
    }

    fn say(&mut self, text: &str, raw: &[u8], small: u8, gear: Gear) -> Result<(String, u16, Gear), ServiceError> {
        assert_eq!(gear, Gear::Reverse);
        Ok((text.to_uppercase(), raw.len() as u16 + u16::from(small), Gear::Neutral))
    }

    fn place(&mut self, pose: Pose) {
        self.placed = Some(pose);
    }

    fn dock(&mut self, call: &impl TypedCall<Left, Blocked>, gate: u8) -> Result<(), ServiceError> {
        call.progress(&Left { left: 2.5 })?;
        let by = if gate > 8 { "a pallet of bricks" } else { "a pallet" }.to_owned();
        Err(call.fail_with(7, "the way is blocked", &Blocked { at: [3, 4], by }))
    }

    fn undock(&mut self, call: &impl TypedCall<Left>) {
        let _ = call.progress(&Left { left: 0.0 });
    }
}

/// For any port: the type of orders differs between ports.
#[interface]
trait Winch {
    type Order;

    #[returns(wound)]
    fn wind(&mut self, call: &impl TypedCall<Left, Order = Self::Order>) -> bool;
}

impl Winch for Vehicle {
    type Order = u32;

    fn wind(&mut self, call: &impl TypedCall<Left, Order = u32>) -> bool {
        call.order() == Some(7)
    }
}

/// The call as a service sees it, and what the service reports.
struct Report(Identity, Option<Ended>, RefCell<Parameters>, RefCell<Option<Failure>>);

impl AnyCall for Report {
    type Order = u32;

    fn order(&self) -> Option<u32> {
        Some(7)
    }
    fn caller(&self) -> &Identity {
        &self.0
    }
    fn priority(&self) -> Priority {
        Priority::Normal
    }
    fn deadline(&self) -> Instant {
        Instant::START
    }
    fn wants_reply(&self) -> bool {
        true
    }
    fn commit<R>(&self, change: impl FnOnce() -> R) -> Result<R, Ended> {
        self.1.map_or_else(|| Ok(change()), Err)
    }
    fn fail(&self, failure: Failure) -> ServiceError {
        let error = failure.error();
        *self.3.borrow_mut() = Some(failure);
        error
    }
    fn notify(&self, progress: &ParametersView) -> Result<(), Error> {
        self.2.borrow_mut().copy_from(progress)
    }
}

enum Run {
    Method(&'static Method<Vehicle, Report>),
    Reader(&'static Reader<Vehicle, Report>),
    Free(&'static Free<Report>),
}

struct Listed {
    signature: Signature<'static>,
    attributes: Attributes,
    actuator: Option<&'static str>,
    run: Run,
}

/// A unit and its list; it is its own peer.
#[derive(Default)]
struct Unit {
    listed: RefCell<Vec<Listed>>,
    /// Published instead of the list's own signature.
    other: Option<Definition>,
    vehicle: RefCell<Vehicle>,
    ended: Option<Ended>,
    sent: RefCell<Vec<RequestOptions>>,
    /// The progress of the newest call, and why it failed.
    reported: RefCell<Parameters>,
    failure: RefCell<Option<Failure>>,
}

impl Functions<Vehicle> for Unit {
    type Call = Report;
    type Actuator = &'static str;

    fn add_method(
        &self,
        signature: Signature<'static>,
        attributes: Attributes,
        actuator: Option<&&'static str>,
        run: &'static Method<Vehicle, Report>,
    ) -> Result<(), Error> {
        let (actuator, run) = (actuator.copied(), Run::Method(run));
        self.listed.borrow_mut().push(Listed { signature, attributes, actuator, run });
        Ok(())
    }

    fn add_free(
        &self,
        signature: Signature<'static>,
        attributes: Attributes,
        actuator: Option<&&'static str>,
        run: &'static Free<Report>,
    ) -> Result<(), Error> {
        let (actuator, run) = (actuator.copied(), Run::Free(run));
        self.listed.borrow_mut().push(Listed { signature, attributes, actuator, run });
        Ok(())
    }
}

impl ReaderFunctions<Vehicle> for Unit {
    fn add_reader(
        &self,
        signature: Signature<'static>,
        attributes: Attributes,
        actuator: Option<&&'static str>,
        read: &'static Reader<Vehicle, Report>,
        _: &'static Method<Vehicle, Report>,
    ) -> Result<(), Error> {
        let (actuator, run) = (actuator.copied(), Run::Reader(read));
        self.listed.borrow_mut().push(Listed { signature, attributes, actuator, run });
        Ok(())
    }
}

impl Unit {
    /// Compares with what is published, as a port does, and calls.
    #[expect(clippy::result_large_err, reason = "it is the port's error")]
    fn ask(
        &self,
        callee: Callee<'_>,
        parameters: &mut ParametersView,
        options: &RequestOptions,
    ) -> Result<(), CallError<(), Option<Detail>>> {
        let listed = self.listed.borrow();
        let own = listed.iter().find(|listed| listed.signature.name() == callee.name()).map(|listed| listed.signature);
        if let Some(published) = self.other.as_ref().map(|other| other.signature()).or(own) {
            let wrong = |found: Mismatch| CallError::new(Error::Mismatch(found.part), Some(Detail::Version(found)));
            callee.check(published).map_err(wrong)?;
        }
        let outcome = self.block(callee.name(), parameters, options);
        outcome.map_err(|error| CallError::new(error, self.failure.take().map(Detail::Service)))
    }

    /// Calls through encoded blocks, as between two units.
    fn block(&self, function: &str, parameters: &mut ParametersView, options: &RequestOptions) -> Result<(), Error> {
        self.sent.borrow_mut().push(*options);
        let listed = self.listed.borrow();
        let listed = listed.iter().find(|listed| listed.signature.name() == function).ok_or(Error::UnknownFunction)?;
        let (arguments, results) = (listed.signature.arguments(), listed.signature.results());
        block::check_results_fit(results, parameters)?;
        let mut bytes = vec![0; block::measure(arguments, parameters)?];
        block::write(arguments, parameters, &mut SliceWriter::new(&mut bytes));
        let mut served = Parameters::<1024>::sized();
        block::read_arguments(arguments, &bytes, &mut served)?;
        block::prepare_results(results, &mut served)?;
        let call = Report(Identity::m_unit("manager", 1)?, self.ended, RefCell::default(), RefCell::default());
        let outcome = match listed.run {
            Run::Method(run) => run(&mut self.vehicle.borrow_mut(), &call, &mut served),
            Run::Reader(run) => run(&self.vehicle.borrow(), &call, &mut served),
            Run::Free(run) => run(&call, &mut served),
        };
        *self.reported.borrow_mut() = call.2.take();
        *self.failure.borrow_mut() = call.3.take();
        outcome?;
        let mut bytes = vec![0; block::measure(results, &served)?];
        block::write(results, &served, &mut SliceWriter::new(&mut bytes));
        block::read(results, &bytes, parameters)
    }
}

impl Caller for Unit {
    type Pending = ();
    type Answered = ();
    type Hold = &'static str;
    type Details = Option<Detail>;
    type Room = &'static mut ParametersView;
    type Canceller = ();

    fn room(_: usize) -> Option<Self::Room> {
        None
    }

    fn send(
        &self,
        callee: Callee<'_>,
        parameters: &ParametersView,
        options: &RequestOptions,
    ) -> Result<CallId, CallError<(), Option<Detail>>> {
        let mut copy = Parameters::<1024>::sized();
        copy.copy_from(parameters)?;
        self.ask(callee, &mut copy, options).map(|()| CallId(1))
    }

    fn poll(
        &self,
        _: &mut Option<()>,
        outgoing: Outgoing<'_, ()>,
        _: &mut Context<'_>,
    ) -> Poll<Result<(), CallError<(), Option<Detail>>>> {
        Poll::Ready(self.wait(outgoing))
    }

    fn hold(&self, (): ()) -> &'static str {
        "held"
    }
}

impl BlockingCaller for Unit {
    fn wait(&self, outgoing: Outgoing<'_, ()>) -> Result<(), CallError<(), Option<Detail>>> {
        let outcome = self.ask(outgoing.callee, outgoing.parameters, outgoing.options);
        match outgoing.progress.map(|hear| hear(&self.reported.borrow())) {
            Some(ControlFlow::Break(())) => Err(Error::Cancelled.into()),
            _ => outcome,
        }
    }
}

fn unit() -> Unit {
    let unit = Unit::default();
    AgvServer { drive: "motor" }.add_to(&unit).unwrap();
    unit
}

#[test]
fn signatures_are_those_of_the_text_form() {
    let unit = unit();
    let shown: Vec<String> = unit.listed.borrow().iter().map(|listed| listed.signature.to_string()).collect();
    let pose = "at: float[2], heading.deg: int, gear: int, lit: bool[3], type: int, ratio: float, label: string[8], \
                note: string[200], photo: bytes[16]";
    assert_eq!(
        shown,
        [
            "add(a: int, b: int) -> (sum: int)".to_owned(),
            "go-to(position: int[2])".to_owned(),
            "stop()".to_owned(),
            "reset()".to_owned(),
            format!("pose() -> ({pose})"),
            "say(text: string[64], raw: bytes[8], n.1: int, gear: int) -> (text: string[64], length-1: int, gear: int)"
                .to_owned(),
            format!("place({pose})"),
            "dock(gate: int) progress (left: float) fails (at: int[2], by: string[8])".to_owned(),
            "undock() progress (left: float)".to_owned(),
        ]
    );
    for (text, listed) in shown.iter().zip(unit.listed.borrow().iter()) {
        let plain = Definition::parse(text).unwrap();
        let said = (listed.signature.help(), listed.signature.units());
        let said =
            said.1.fold(if said.0.is_empty() { plain } else { plain.help(said.0).unwrap() }, |all, (name, unit)| {
                all.unit(name, unit).unwrap()
            });
        assert_eq!(said.as_bytes(), listed.signature.as_bytes());
    }
}

#[test]
fn attributes_and_actuators_are_passed_on() {
    let unit = unit();
    let listed = unit.listed.borrow();
    let of = |name: &str| listed.iter().find(|listed| listed.signature.name() == name).unwrap();
    let usual = Attributes::default();
    assert_eq!((of("add").attributes, of("add").actuator), (Attributes { idempotent: true, ..usual }, None));
    let moves = Attributes { priority: Priority::High, lease: Some(Duration::from_millis(400)), ..usual };
    assert_eq!((of("go-to").attributes, of("go-to").actuator), (moves, Some("motor")));
    let stops = Attributes { priority: Priority::Emergency, stop: true, ..usual };
    assert_eq!((of("stop").attributes, of("stop").actuator), (stops, Some("motor")));
    assert!(matches!(of("stop").run, Run::Free(_)));
    assert_eq!((of("reset").attributes, of("reset").actuator), (Attributes { reset: true, ..usual }, None));
}

#[test]
fn a_client_gets_what_the_service_gives() {
    let unit = unit();
    let agv = AgvClient::at(&unit);
    assert_eq!(agv.add(40, 2).wait(), Ok(42));
    assert_eq!(agv.go_to([3, 4]).wait(), Ok(()));
    assert_eq!(unit.vehicle.borrow().target, Some([3, 4]));
    assert_eq!(agv.stop().wait(), Ok(()));
    assert_eq!(agv.say("stand by", &[1, 2], 5, Gear::Reverse).wait(), Ok(("STAND BY".to_owned(), 7, Gear::Neutral)));
    assert_eq!(agv.pose().wait(), Err(Error::Service(ServiceError::NotReady).into()));
    assert_eq!(agv.place(Pose::new("hall 7")).wait(), Ok(()));
    assert_eq!(agv.pose().wait(), Ok(Pose::new("hall 7")));
    unit.vehicle.borrow_mut().stands_by = true;
    assert_eq!(agv.reset().wait(), Err(Error::Service(ServiceError::Failed(2)).into()));
    assert_eq!(unit.vehicle.borrow().resets, 1);
}

#[test]
fn progress_and_failures_are_typed() {
    let unit = unit();
    let agv = AgvClient::at(&unit);
    let mut reported = Vec::new();
    let mut dock = |gate| {
        let on_progress = |left| {
            reported.push(left);
            ControlFlow::Continue(())
        };
        agv.dock(gate).watch(on_progress).wait().unwrap_err()
    };
    let error = Error::Service(ServiceError::Failed(7));
    let failed = dock(1);
    assert_eq!((&failed.error, failed.text()), (&error, "the way is blocked"));
    assert_eq!(failed.values(), Some(Blocked { at: [3, 4], by: "a pallet".to_owned() }));
    assert_eq!(failed.to_string(), "the way is blocked (code 7)");
    // The value is longer than declared: the rest is sent without it.
    let failed = dock(9);
    assert_eq!((failed.values(), failed.text()), (None, "the way is blocked"));
    assert_eq!(reported, [Left { left: 2.5 }; 2]);
    assert_eq!(agv.dock(1).wait(), Err(error.into()), "without what it tells");
    let cancelled = agv
        .undock()
        .watch(|left| if left.left == 0.0 { ControlFlow::Break(()) } else { ControlFlow::Continue(()) })
        .wait();
    assert_eq!(cancelled.map_err(|failed| failed.error), Err(Error::Cancelled));
}

#[test]
fn a_service_of_any_port_gets_its_order() {
    let unit = Unit::default();
    WinchServer.add_to(&unit).unwrap();
    assert_eq!(WinchClient::at(&unit).wind().wait(), Ok(true));
}

#[test]
fn options_holds_and_requests_go_through() {
    let mut unit = unit();
    let wanted = RequestOptions { timeout: Some(Duration::from_secs(9)), ..RequestOptions::new() };
    let agv = AgvClient::at(&unit).with(wanted).renewing(Renew::Process);
    assert_eq!(agv.go_to([1, 2]).hold().wait(), Ok(Held { results: (), hold: "held" }));
    assert_eq!(agv.add(1, 2).send(), Ok(CallId(1)));
    assert_eq!(*unit.sent.borrow(), [RequestOptions { renew: Renew::Process, ..wanted }; 2]);
    unit.ended = Some(Ended);
    assert!(AgvClient::at(&unit).go_to([9, 9]).wait().is_err(), "its order has ended");
    assert_eq!(unit.vehicle.borrow().target, Some([1, 2]));
}

#[test]
fn a_task_awaits_the_same() {
    let unit = unit();
    let agv = AgvClient::at(&unit);
    let both = async { (agv.add(1, 2).await, agv.go_to([5, 6]).send(), agv.pose().await) };
    let Poll::Ready((sum, sent, pose)) = pin!(both).poll(&mut Context::from_waker(Waker::noop())) else {
        panic!("it is ready at once");
    };
    assert_eq!((sum, sent), (Ok(3), Ok(CallId(1))));
    assert_eq!(pose, Err(Error::Service(ServiceError::NotReady).into()));
}

#[test]
fn another_version_at_the_peer_is_told_before_anything_is_sent() {
    let mut unit = unit();
    for (theirs, reported) in [
        ("add(a: int, b: float) -> (sum: int)", Some("argument b is float there and int here")),
        ("add(a: int, c: int) -> (sum: int)", Some("argument c is int there and missing here")),
        ("add(a: int, b: int) -> (sum: float)", Some("result sum is float there and int here")),
        ("add(a: int, b: int)", Some("result sum is missing there and int here")),
        ("add(a: int) -> (sum: int, carry: bool)", None),
    ] {
        unit.other = Some(Definition::parse(theirs).unwrap());
        unit.sent.borrow_mut().clear();
        match (AgvClient::at(&unit).add(1, 2).wait(), reported) {
            (Err(failed), Some(reported)) => {
                let mismatch = failed.mismatch().expect("it is of another version");
                assert!(mismatch.to_string().contains(reported), "{mismatch}");
                assert_eq!(mismatch.function, "add");
                assert_eq!(unit.sent.borrow().len(), 0);
            }
            (Ok(3), None) => {}
            other => panic!("{theirs}: {other:?}"),
        }
    }
}

#[test]
fn what_does_not_fit_the_rust_type_is_refused() {
    let unit = unit();
    let mut call = Parameters::new();
    call.add_string("text", 64).unwrap();
    call.add_bytes("raw", 8).unwrap();
    call.add_int("n.1", 1).unwrap();
    call.add_int("gear", 1).unwrap();
    call.add_int("length-1", 1).unwrap();
    let usual = RequestOptions::new();
    for (number, gear) in [(256, -1), (-1, -1), (0, 1), (0, 8)] {
        call.set_value("n.1", number).unwrap();
        call.set_value("gear", gear).unwrap();
        let refused = Err(Error::Service(ServiceError::Failed(BAD_ARGUMENT)));
        assert_eq!(unit.block("say", &mut call, &usual), refused, "{number} {gear}");
    }
    call.set_value("gear", -1).unwrap();
    assert_eq!(unit.block("say", &mut call, &usual), Ok(()));
    assert_eq!(call.variable("gear"), Ok(0));
    // Longer than declared: nothing is sent.
    let long = AgvClient::at(&unit).say(&"x".repeat(65), &[], 0, Gear::Reverse).wait();
    assert_eq!(long, Err(Error::WrongSize { index: 0, expected: 64, found: 65 }.into()));
}

#[test]
fn a_struct_goes_into_dynamic_parameters_and_back() {
    let mut parameters = Parameters::<1024>::sized();
    Pose::new("here").to_parameters(&mut parameters).unwrap();
    assert_eq!(parameters.variable("heading.deg"), Ok(-90));
    assert_eq!(parameters.variable("note"), Ok("here"));
    assert_eq!(Pose::from_parameters(&parameters), Ok(Pose::new("here")));
    parameters.set_value("heading.deg", 40_000).unwrap();
    assert_eq!(Pose::from_parameters(&parameters), Err(Error::OutOfRange));
}
