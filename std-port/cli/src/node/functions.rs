//! `[[functions]]`: services that a node offers without a line of code.

use std::ops::Range;
use std::os::unix::fs::PermissionsExt;
use std::path::Path;

use cara_std::{Attributes, Definition, Duration};
use toml::Spanned;

use super::file::{self, Answer, Maybe};
use super::mistake::{Mistake, Source};
use super::values::Time;

/// How long a program may run, unless the file says something else.
const TIMEOUT: Duration = Duration::from_secs(5);
/// Parameters of a served call are at most this long, declared sizes included.
const PARAMETERS_BYTES: u32 = 320 * 1024;

/// A service as the file describes it.
#[derive(Clone, Debug)]
pub(super) struct Service {
    pub(super) definition: Definition,
    pub(super) work: Work,
    pub(super) attributes: Attributes,
    /// What makes safe what the service began; none for a service that begins nothing.
    pub(super) at_lease_end: Option<Vec<String>>,
    /// Of its signature in the file.
    pub(super) span: Range<usize>,
}

/// What a call of a service does.
#[derive(Clone, Debug)]
pub(super) enum Work {
    /// Results are the arguments.
    Echo,
    /// Likewise, and each call is a line of the log.
    Log,
    /// A program of its own for each call.
    Program { command: Vec<String>, timeout: Duration },
}

/// The services that a file describes.
pub(super) fn services(
    source: &Source,
    tables: &[Spanned<file::Function>],
    capacity: usize,
    mistakes: &mut Vec<Mistake>,
) -> Vec<Service> {
    let mut services: Vec<Service> = Vec::new();
    for table in tables {
        let Some(service) = service(source, table, mistakes) else { continue };
        let name = service.definition.name();
        if services.iter().any(|known| known.definition.name() == name) {
            let what = format!("there are two functions of the name `{name}`");
            mistakes.push(Mistake::new(service.span.clone(), what, "give each function a name of its own"));
        }
        services.push(service);
    }
    if let Some(first_beyond) = services.get(capacity) {
        let what = format!("the unit has room for {capacity} functions, and the file has {}", services.len());
        let help = format!("write `functions = {}` below `[capacities]`", services.len());
        mistakes.push(Mistake::new(first_beyond.span.clone(), what, help));
    }
    services
}

/// One service; `None` without a signature that can be read.
fn service(source: &Source, table: &Spanned<file::Function>, mistakes: &mut Vec<Mistake>) -> Option<Service> {
    let function = table.get_ref();
    let work = work(table, mistakes);
    let lease = lease(function, mistakes);
    let Some(signature) = &function.signature else {
        let help = "write one, as signature = \"echo(text: string[64]) -> (text: string[64])\"";
        mistakes.push(Mistake::new(table.span(), "this function has no signature", help));
        return None;
    };
    let definition = definition(source, signature, mistakes)?;
    let work = work?;
    if !matches!(work, Work::Program { .. }) {
        check_answerable(signature, &definition, mistakes);
    }
    let attributes = Attributes { lease, ..function.attributes() };
    let at_lease_end = function.at_lease_end.as_ref().map(|command| command.get_ref().clone());
    Some(Service { definition, work, attributes, at_lease_end, span: signature.span() })
}

fn definition(source: &Source, text: &Spanned<String>, mistakes: &mut Vec<Mistake>) -> Option<Definition> {
    match Definition::parse(text.get_ref()) {
        Ok(definition) if definition.signature().parameters_bytes() <= PARAMETERS_BYTES => return Some(definition),
        Ok(_) => {
            let what = format!("arguments and results take more than {PARAMETERS_BYTES} bytes together");
            mistakes.push(Mistake::new(text.span(), what, "declare smaller sizes"));
        }
        Err(error) => {
            let what = format!("the signature cannot be read: expected {} here", error.expected);
            let help = "a signature looks like go_to(position: int[2], speed: float) -> (done: bool)";
            mistakes.push(Mistake::new(inside(source, text, error.position), what, help));
        }
    }
    None
}

/// The place of a byte of a string's value, or the whole string where escapes part the two.
fn inside(source: &Source, text: &Spanned<String>, byte: usize) -> Range<usize> {
    let span = text.span();
    let written = source.text.get(span.clone()).unwrap_or_default();
    let quotes = written.len().saturating_sub(text.get_ref().len());
    match written.find(text.get_ref().as_str()) {
        Some(at) if at == quotes / 2 => {
            let at = span.start + at + byte;
            at..at + 1
        }
        _ => span,
    }
}

/// An answer without a program has no results but the arguments.
fn check_answerable(text: &Spanned<String>, definition: &Definition, mistakes: &mut Vec<Mistake>) {
    let signature = definition.signature();
    let Some(missing) = signature.results().find(|result| signature.arguments().named(result.name).is_none()) else {
        return;
    };
    let what = format!("nothing gives the result `{}`: `answer` returns arguments", missing.name);
    let help = "make it an argument too, or let a program answer: run = [\"program\"]";
    mistakes.push(Mistake::new(text.span(), what, help));
}

fn work(table: &Spanned<file::Function>, mistakes: &mut Vec<Mistake>) -> Option<Work> {
    let function = table.get_ref();
    match (&function.run, &function.answer) {
        (Some(command), None) => {
            check_command(command, mistakes);
            let timeout = nonzero(&function.timeout, TIMEOUT, mistakes);
            Some(Work::Program { command: command.get_ref().clone(), timeout })
        }
        (None, Some(answer)) => {
            if let Some(timeout) = &function.timeout {
                let help = "take the line out, or let a program answer: run = [\"program\"]";
                mistakes.push(Mistake::new(timeout.span(), "a time-out is for a program that is run", help));
            }
            Some(if *answer.get_ref() == Answer::Echo { Work::Echo } else { Work::Log })
        }
        (Some(_), Some(answer)) => {
            let help = "keep one of the two lines";
            mistakes.push(Mistake::new(answer.span(), "a function either runs a program or answers itself", help));
            None
        }
        (None, None) => {
            let place = function.signature.as_ref().map_or(table.span(), Spanned::span);
            let help = "write run = [\"program\", \"argument\"], answer = \"echo\" or answer = \"log\"";
            mistakes.push(Mistake::new(place, "this function does nothing", help));
            None
        }
    }
}

fn lease(function: &file::Function, mistakes: &mut Vec<Mistake>) -> Option<Duration> {
    function.at_lease_end.iter().for_each(|command| check_command(command, mistakes));
    match (&function.lease, &function.at_lease_end) {
        (None, Some(command)) => {
            let help = "write how long, as lease = \"500ms\"";
            mistakes.push(Mistake::new(command.span(), "there is no lease that could end", help));
            None
        }
        (Some(lease), None) if function.run.is_some() => {
            let help = "write what stops it: at_lease_end = [\"program\", \"argument\"]";
            mistakes.push(Mistake::new(lease.span(), "nothing stops what the program began when its lease ends", help));
            None
        }
        (lease, _) => lease.as_ref().map(|_| nonzero(lease, Duration::ZERO, mistakes)),
    }
}

fn nonzero(time: &Maybe<Time>, default: Duration, mistakes: &mut Vec<Mistake>) -> Duration {
    let Some(time) = time else { return default };
    if time.get_ref().0 == Duration::ZERO {
        mistakes.push(Mistake::new(time.span(), "this time is too short", "write a time, as \"500ms\" or \"2s\""));
    }
    time.get_ref().0
}

fn check_command(command: &Spanned<Vec<String>>, mistakes: &mut Vec<Mistake>) {
    let what = match command.get_ref().first() {
        None => "the program is missing".to_owned(),
        Some(program) if command.get_ref().iter().any(|word| word.contains('\0')) => {
            format!("a word of the command of `{}` has a null character", program.escape_debug())
        }
        Some(program) if !can_be_run(program) => format!("there is no program `{program}` that can be run"),
        Some(_) => return,
    };
    let help = "write its path and its arguments, as [\"/usr/bin/logger\", \"-t\", \"agv\"]; there is no shell";
    mistakes.push(Mistake::new(command.span(), what, help));
}

/// Whether a program is where it is looked for: at its path, or in one of the folders of `PATH`.
fn can_be_run(program: &str) -> bool {
    if program.contains('/') {
        return is_executable(Path::new(program));
    }
    let folders = std::env::var_os("PATH").unwrap_or_default();
    !program.is_empty() && std::env::split_paths(&folders).any(|folder| is_executable(&folder.join(program)))
}

fn is_executable(path: &Path) -> bool {
    path.metadata().is_ok_and(|found| found.is_file() && found.permissions().mode() & 0o111 != 0)
}
