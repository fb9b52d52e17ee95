//! What a program writes for a function that adds two numbers, in either form: its service, and a call of it as far as the
//! port and back. Nothing is sent: the peer that is called answers at once.

use core::hint::black_box;
use core::task::{Context, Poll};

use cara_core::config::Priority;
use cara_core::distribution::block;
use cara_core::distribution::function::{Attributes, Signature};
use cara_core::distribution::identity::Identity;
use cara_core::distribution::parameters::{Parameters, ParametersView};
use cara_core::services::call::{BlockingCaller, Call, CallError, Callee, Caller, Dynamic, Outgoing};
use cara_core::services::lease::Ended;
use cara_core::services::requests::CallId;
use cara_core::services::session::RequestOptions;
use cara_core::time::Instant;
use cara_core::typed::{Free, Functions, Interface, Method};
use cara_core::{AnyCall, Error, ServiceError, interface};

use crate::{Of, Operation};

#[interface]
trait Add {
    #[returns(sum)]
    fn add(&mut self, a: i64, b: i64) -> i64;
}

impl Add for () {
    fn add(&mut self, a: i64, b: i64) -> i64 {
        a.wrapping_add(b)
    }
}

fn add(view: &mut ParametersView) -> Result<(), ServiceError> {
    let a: i64 = view.variable("a")?;
    let b: i64 = view.variable("b")?;
    view.set_value("sum", a.wrapping_add(b))?;
    Ok(())
}

/// Tells a service nothing.
struct Silent(Identity);

impl AnyCall for Silent {
    type Order = ();

    fn order(&self) -> Option<()> {
        None
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
        Ok(change())
    }
}

type Listed = (Signature<'static>, &'static Method<(), Silent>);

/// A list of one function.
#[derive(Default)]
struct List(core::cell::Cell<Option<Listed>>);

impl Functions<()> for List {
    type Call = Silent;
    type Actuator = ();

    fn add_method(
        &self,
        signature: Signature<'static>,
        _: Attributes,
        _: Option<&()>,
        run: &'static Method<(), Silent>,
    ) -> Result<(), Error> {
        self.0.set(Some((signature, run)));
        Ok(())
    }

    fn add_free(
        &self,
        _: Signature<'static>,
        _: Attributes,
        _: Option<&()>,
        _: &'static Free<Silent>,
    ) -> Result<(), Error> {
        Err(Error::UnknownFunction)
    }
}

/// A peer that has published the function, and answers 7.
struct Peer(Signature<'static>);

impl Caller for Peer {
    type Pending = ();
    type Answered = ();
    type Hold = ();
    type Details = ();
    type Room = &'static mut ParametersView;
    type Canceller = ();

    fn room(_: usize) -> Option<Self::Room> {
        None
    }

    fn send(&self, _: Callee<'_>, _: &ParametersView, _: &RequestOptions) -> Result<CallId, CallError> {
        Err(Error::UnknownFunction.into())
    }

    fn poll(&self, _: &mut Option<()>, outgoing: Outgoing<'_, ()>, _: &mut Context<'_>) -> Poll<Result<(), CallError>> {
        Poll::Ready(self.wait(outgoing))
    }

    fn hold(&self, (): ()) {}
}

impl BlockingCaller for Peer {
    fn wait(&self, Outgoing { callee, parameters, .. }: Outgoing<'_, ()>) -> Result<(), CallError> {
        black_box(callee.name());
        callee.check(self.0).map_err(|found| Error::Mismatch(found.part))?;
        block::check_results_fit(self.0.results(), parameters)?;
        Ok(parameters.set_value("sum", 7)?)
    }
}

/// Both forms of one program.
pub struct Programs {
    arguments: Parameters<96>,
    reported: Silent,
    typed: &'static Method<(), Silent>,
    peer: Peer,
}

impl Programs {
    /// A service whose arguments have come, and a peer.
    pub fn new() -> Self {
        let list = List::default();
        AddServer.add_to(&list).expect("it is added");
        let (signature, typed) = list.0.get().expect("it was added");
        let mut arguments = Parameters::sized();
        arguments.lay_out(signature).expect("room for three integers");
        arguments.set_value("a", 3).expect("an integer");
        arguments.set_value("b", 4).expect("an integer");
        let reported = Silent(Identity::m_unit("depot", 1).expect("a name"));
        Self { arguments, reported, typed, peer: Peer(signature) }
    }

    fn serve_dynamic(&mut self) {
        add(black_box(self.arguments.as_mut_view())).expect("it adds");
    }

    fn serve_typed(&mut self) {
        (self.typed)(&mut (), &self.reported, black_box(self.arguments.as_mut_view())).expect("it adds");
    }

    fn call_dynamic(&mut self) {
        let call = |peer: &Peer| -> Result<i64, Error> {
            let mut sum = Parameters::<96>::sized();
            sum.add_int("a", 1)?;
            sum.add_int("b", 1)?;
            sum.add_int("sum", 1)?;
            sum.set_value("a", black_box(3))?;
            sum.set_value("b", black_box(4))?;
            Call::new(peer, Dynamic::new("add", &mut sum)).wait()?;
            sum.variable("sum")
        };
        assert_eq!(black_box(call(&self.peer)), Ok(7));
    }

    fn call_typed(&mut self) {
        let client = AddClient::at(&self.peer);
        assert_eq!(black_box(client.add(black_box(3), black_box(4)).wait()), Ok(7));
    }

    /// What can be counted. A typed call also compares the peer's signature with its own.
    pub fn operations() -> [Operation<Self>; 4] {
        let of = Of::Ints(3);
        [
            Operation { name: "service, dynamic", of, run: |both, meter| meter.count(&mut || both.serve_dynamic()) },
            Operation { name: "service, typed", of, run: |both, meter| meter.count(&mut || both.serve_typed()) },
            Operation { name: "call, dynamic", of, run: |both, meter| meter.count(&mut || both.call_dynamic()) },
            Operation { name: "call, typed", of, run: |both, meter| meter.count(&mut || both.call_typed()) },
        ]
    }
}

impl Default for Programs {
    fn default() -> Self {
        Self::new()
    }
}
