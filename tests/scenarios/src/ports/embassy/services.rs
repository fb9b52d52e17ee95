//! Services of scenarios on boards: those that end at once run in the runner, the others in a task of each call.

use std::rc::{Rc, Weak};

use cara_core::distribution::parameters::ParametersView;
use cara_core::error::{Error, ServiceError};
use cara_core::services::lease::{Ended, Lease};
use cara_core::services::session::RequestOptions;
use cara_core::time::Duration;
use cara_embassy::{Handle, Handler, ServiceOptions, TakenCall};
use cara_embassy_host::{Board, now};
use cara_sim::boxed_parameters;

use super::node::BoardNode;
use crate::{Asked, Service};

/// Bytes of the parameters that a task takes calls in.
const PARAMETERS: usize = 48 * 1024;

/// Puts a service into a unit's list.
pub(super) fn put(node: &Rc<BoardNode>, service: &Service, replace: bool) -> Result<(), Error> {
    let (unit, board) = (node.unit()?, node.board());
    let lease: &'static Lease = Box::leak(Box::new(Lease::new()));
    let mut options = ServiceOptions::new().priority(service.priority);
    if service.stops_all {
        options = options.stops_all();
    }
    if service.resets_all {
        options = options.resets_all();
    }
    if let Some(length) = service.lease {
        let log = service.log();
        options = options.lease(length, lease, Box::leak(Box::new(move || log.stop(now()))));
    }
    let handler = if service.awaits() { Handler::task() } else { at_once(Rc::downgrade(node), service.clone()) };
    match replace {
        true => unit.my_function_list().replace(&service.signature, options, handler),
        false => unit.my_function_list().add_service(&service.signature, options, handler),
    }?;
    let known = node.keep(service, lease);
    if service.awaits() && !known {
        board.spawn(take_calls(Rc::clone(node), board.clone(), unit, service.name().to_owned()));
    }
    Ok(())
}

fn at_once(node: Weak<BoardNode>, service: Service) -> Handler<()> {
    Handler::free(Box::leak(Box::new(move |call: &cara_embassy::Served<()>, parameters: &mut _| {
        service.log().begin(now());
        node.upgrade().into_iter().for_each(|node| node.begins(service.name(), call.lease));
        let result = (service.body)(&Asked { caller: call.caller.clone(), at: now() }, parameters);
        service.log().end(now());
        result
    })))
}

/// Takes the calls of one name, for as long as there is such a service, and begins a task for each; one after the other where
/// they run in turns.
async fn take_calls(node: Rc<BoardNode>, board: Board, unit: Handle, function: String) {
    let mut parameters = boxed_parameters(PARAMETERS);
    loop {
        match unit.next_call(&function, &mut parameters).await {
            Err(_) => return,
            Ok(call) => {
                let Some(service) = node.service(&function) else { return };
                let mut own = boxed_parameters(PARAMETERS);
                own.copy_from(&parameters).expect("there is as much room");
                node.begins(&function, call.lease);
                match service.in_turns {
                    true => serve(unit, &service, call, &mut own).await,
                    false => board.spawn(async move { serve(unit, &service, call, &mut own).await }),
                }
            }
        }
    }
}

async fn serve(unit: Handle, service: &Service, call: TakenCall<()>, parameters: &mut ParametersView) {
    service.log().begin(now());
    let result = run(unit, service, &call, parameters).await;
    if result.is_ok() {
        service.log().end(now());
    }
    call.reply(result.map(|()| &*parameters)).await;
}

async fn run(
    unit: Handle,
    service: &Service,
    call: &TakenCall<()>,
    parameters: &mut ParametersView,
) -> Result<(), ServiceError> {
    if let Some(function) = &service.calls_back {
        let patient = RequestOptions { timeout: Some(Duration::from_secs(8)), ..RequestOptions::default() };
        let called =
            unit.node(&call.caller).expect("a caller has joined").call(function, parameters).with(patient).await;
        called.map_err(|_| ServiceError::NotReady)?;
    }
    (service.body)(&Asked { caller: call.caller.clone(), at: now() }, parameters)?;
    embassy_time::Timer::after_micros(service.takes.as_micros()).await;
    while let Some(pause) = service.moves_on(call.lease.is_some_and(|lease| lease.is_live()), parameters) {
        embassy_time::Timer::after_micros(pause.as_micros()).await;
    }
    while service.is_held() {
        embassy_time::Timer::after_millis(1).await;
    }
    service.commit(parameters, |change| call.lease.map_or(Err(Ended), |order| order.commit(change)))
}
