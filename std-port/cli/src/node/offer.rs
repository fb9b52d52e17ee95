//! The services of the file, put into the unit's list of functions.

use std::sync::Arc;
use std::time::Duration;

use cara_std::{Definition, Error, MyFunctionList, ParametersView, Served, ServiceError, ServiceOptions, Shown};

use super::black_box::{BlackBox, Cause};
use super::functions::{Service, Work};
use super::json;
use super::program::{Programs, Task};

/// How long a program that makes safe may run.
const SAFE_TIMEOUT: Duration = Duration::from_secs(5);
/// Longest text of arguments in a line of the log, and in the black box.
const LOGGED_BYTES: usize = 1024;

/// Adds a service to the list.
pub(super) fn offer(
    list: &MyFunctionList<'_, ()>,
    number: usize,
    service: &Service,
    programs: &Arc<Programs>,
    black_box: &BlackBox,
) -> Result<(), Error> {
    let definition = service.definition.clone();
    let mut options = ServiceOptions::new().attributes(service.attributes);
    if let Some(length) = service.attributes.lease {
        options = options.lease(length, make_safe(number, service, programs));
    }
    match &service.work {
        Work::Echo => list.add_service(&service.definition, options, boxed(service, black_box, echo))?,
        Work::Log => {
            let log = move |call: &Served, view: &mut ParametersView| log(&definition, call, view);
            list.add_service(&service.definition, options, boxed(service, black_box, log))?
        }
        Work::Program { command, timeout } => {
            let (command, timeout, programs) = (command.clone(), (*timeout).into(), programs.clone());
            let run = move |call: &Served, view: &mut ParametersView| {
                let task = Serving { number, definition: &definition, command: &command, timeout };
                task.run(&programs, call, view)
            };
            list.add_service(&service.definition, options, boxed(service, black_box, run))?
        }
    };
    Ok(())
}

/// What a service does, with each call and its outcome put into the black box.
fn boxed(
    service: &Service,
    black_box: &BlackBox,
    work: impl Fn(&Served, &mut ParametersView) -> Result<(), ServiceError> + Send + Sync + 'static,
) -> impl Fn(&Served, &mut ParametersView) -> Result<(), ServiceError> + Send + Sync + 'static {
    let (definition, attributes, black_box) = (service.definition.clone(), service.attributes, black_box.clone());
    move |call, view| {
        black_box.note("called", Some(&call.caller), || shown(&definition, view));
        let outcome = work(call, view);
        black_box.note("answered", Some(&call.caller), || match &outcome {
            Ok(()) => definition.name().to_owned(),
            Err(error) => format!("{}: {error}", definition.name()),
        });
        match outcome {
            Ok(()) if attributes.stop => black_box.freeze(Cause::Stop),
            Ok(()) if attributes.reset => black_box.freeze(Cause::Reset),
            _ => {}
        }
        outcome
    }
}

/// A call as its name and arguments.
fn shown(definition: &Definition, view: &ParametersView) -> String {
    let mut text = format!("{} {}", definition.name(), json::arguments(definition.signature(), view));
    text.truncate(text.floor_char_boundary(LOGGED_BYTES));
    text
}

fn echo(_: &Served, _: &mut ParametersView) -> Result<(), ServiceError> {
    Ok(())
}

fn log(definition: &Definition, call: &Served, view: &ParametersView) -> Result<(), ServiceError> {
    let mut arguments = json::arguments(definition.signature(), view).to_string();
    arguments.truncate(arguments.floor_char_boundary(LOGGED_BYTES));
    tracing::info!(function = definition.name(), caller = %call.caller, arguments = %Shown(&arguments), "called");
    Ok(())
}

/// What the unit runs at the end of a lease, also when it is stopped.
fn make_safe(number: usize, service: &Service, programs: &Arc<Programs>) -> impl Fn() + Send + Sync + 'static {
    let (name, command) = (service.definition.name().to_owned(), service.at_lease_end.clone());
    let programs = programs.clone();
    move || {
        let Some(command) = &command else { return };
        let environment = [("CARA_FUNCTION", name.clone()), ("CARA_CALLER", String::new())];
        programs.make_safe(number, &Task { command, environment, input: b"{}" }, SAFE_TIMEOUT);
    }
}

/// A call that a program serves.
struct Serving<'a> {
    number: usize,
    definition: &'a Definition,
    command: &'a [String],
    timeout: Duration,
}

impl Serving<'_> {
    fn run(&self, programs: &Arc<Programs>, call: &Served, view: &mut ParametersView) -> Result<(), ServiceError> {
        let signature = self.definition.signature();
        let function = signature.name();
        let input = json::arguments(signature, view).to_string();
        let environment = [("CARA_FUNCTION", function.to_owned()), ("CARA_CALLER", call.caller.to_string())];
        let task = Task { command: self.command, environment, input: input.as_bytes() };
        let output = programs.serve(self.number, &task, self.timeout, call.lease.as_ref()).map_err(|failure| {
            tracing::warn!(function, caller = %call.caller, program = self.command.join(" "), "{}", Shown(&failure.to_string()));
            failure.to_service_error()
        })?;
        json::set_results(signature, &output, view).map_err(|bad| {
            tracing::warn!(function, caller = %call.caller, program = self.command.join(" "), "{}", Shown(&bad.to_string()));
            ServiceError::BadResults
        })
    }
}
