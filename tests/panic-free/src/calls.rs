//! Calls as their callers make them.

use core::future::{Future, IntoFuture};
use core::ops::ControlFlow;
use core::pin::Pin;
use core::task::{Context, Poll, Waker};

use cara_core::distribution::parameters::{Parameters, ParametersView};
use cara_core::error::{Error, ServiceError};
use cara_core::services::call::{
    Answer, BlockingCaller, Call, CallError, Callee, Caller, Detail, Dynamic, Frame, Outgoing,
};
use cara_core::services::requests::CallId;
use cara_core::services::session::RequestOptions;
use cara_core::time::Duration;
use cara_core::typed;

use crate::linkage::{keep, show, unknown, unknown_text};

/// A peer of which nothing is known.
struct Peer;

impl Caller for Peer {
    type Pending = u32;
    type Answered = u32;
    type Hold = u32;
    type Details = Option<Detail>;
    type Room = &'static mut ParametersView;
    type Canceller = u32;

    fn room(_: usize) -> Option<Self::Room> {
        Some(parameters())
    }

    fn send(
        &self,
        callee: Callee<'_>,
        _: &ParametersView,
        _: &RequestOptions,
    ) -> Result<CallId, CallError<(), Option<Detail>>> {
        keep(callee.name());
        Ok(*unknown())
    }

    fn poll(&self, _: &mut Option<u32>, outgoing: Outgoing<'_, u32>, _: &mut Context<'_>) -> Poll<Answer<Self>> {
        Poll::Ready(self.wait(outgoing))
    }

    fn hold(&self, answered: u32) -> u32 {
        answered
    }
}

impl BlockingCaller for Peer {
    fn wait(&self, outgoing: Outgoing<'_, u32>) -> Answer<Self> {
        if let Some(hear) = outgoing.progress {
            keep(hear(parameters()));
        }
        match outgoing.callee.check(*unknown()) {
            Ok(()) => Ok(*unknown()),
            Err(found) => Err(CallError::new(*unknown(), Some(Detail::Version(found)))),
        }
    }
}

fn parameters() -> &'static mut ParametersView {
    unknown::<Parameters<64>>()
}

fn call() -> Call<'static, Peer, Dynamic<'static>> {
    typed::Client::at(unknown::<Peer>()).with(*unknown()).call(Dynamic::new(unknown_text(), parameters()))
}

fn known(failed: &CallError<(), Option<Detail>>) {
    show(failed);
    keep((failed.failure().is_some(), failed.mismatch().is_some(), failed.text().len(), failed.values()));
    keep((failed.code(), failed.may_have_run(), ServiceError::from(failed.clone()), Error::from(failed.clone())));
}

entry!(calls_made, {
    let call = call().timeout(*unknown::<Duration>()).priority(*unknown()).renewing(*unknown());
    let call = call
        .take_over()
        .only_while_leading()
        .best_effort()
        .cancelled_by(unknown())
        .answer_within(*unknown::<Duration>());
    if let Err(failed) = call.send() {
        known(&failed);
    }
});

entry!(calls_waited_for, {
    if let Err(failed) = call()
        .watch(|values: &ParametersView| {
            keep(values.len());
            ControlFlow::Break(())
        })
        .hold()
        .wait()
    {
        known(&failed);
    }
});

entry!(calls_awaited, {
    let mut reply = call().hold().into_future();
    keep(Pin::new(&mut reply).poll(&mut Context::from_waker(Waker::noop())).is_pending());
});

entry!(frames_of_calls, {
    let mut frame = Frame::<64, _, u32>::new(*unknown(), *unknown());
    keep(frame.lay_out::<Peer>(*unknown()).is_ok());
    keep(frame.parts().0.name());
    keep(frame.len());
    keep(unknown::<Callee<'static>>().check(*unknown()).is_ok());
});
