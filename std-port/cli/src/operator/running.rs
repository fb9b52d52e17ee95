//! A unit that runs on this host, through its control socket.

use std::ops::ControlFlow;
use std::path::Path;

use cara_std::control::protocol::{Answer, Question};
use cara_std::control::{
    Client, ControlError, Elsewhere, RunningUnit, UnitState, directories, elsewhere, first_of, running, running_called,
    running_in,
};

use super::error_of;
use cara_tools::exit::{Ended, Exit};
use cara_tools::global::Global;
use cara_tools::name_and_id::NameAndId;

/// How a unit is connected to.
pub(super) type Connect = fn(&Path) -> Result<Client, ControlError>;

/// The unit that the options choose; `None` if they choose none and none runs.
pub(super) fn choose(global: &Global, connect: Connect) -> anyhow::Result<Option<Client>> {
    if let Some(path) = &global.socket {
        return connect(path).map(Some).map_err(error);
    }
    let wanted = global.unit.clone();
    let is_meant = |unit: &RunningUnit| {
        global.fleet.is_none_or(|fleet| fleet == unit.fleet) && wanted.as_ref().is_none_or(|wanted| unit.is(wanted))
    };
    let all = first_of(&directories(), |directory| {
        let mut all = match &wanted {
            Some(wanted) => running_called(directory, wanted)?,
            None => running_in(directory)?,
        };
        all.retain(is_meant);
        Ok(all)
    });
    let all = all.map_err(error)?;
    let mut meant: Vec<_> = all.iter().collect();
    // Another unit that lets this user in is meant before one that does not.
    if meant.iter().any(|unit| !matches!(unit.state, UnitState::Refuses(_))) {
        meant.retain(|unit| !matches!(unit.state, UnitState::Refuses(_)));
    }
    match (meant.as_slice(), wanted) {
        ([], None) => Ok(None),
        ([], Some(wanted)) => Err(Ended::no_unit(match of_others(Some(&wanted), global.fleet).as_str() {
            "" => format!("{wanted} does not run on this host{} (looked in {})", not_meant(), looked_in()),
            others => others.to_owned(),
        })),
        ([only], _) => match (&only.state, only.refusal()) {
            // Whether there is a connection for what is wanted, it says itself.
            (UnitState::Full(_), _) | (_, None) => connect(&only.path).map(Some).map_err(error),
            (_, Some(refusal)) => Err(error(refusal)),
        },
        (several, _) => Err(Ended::usage(format!(
            "several units run on this host: {}; choose one with --unit, --fleet or --socket",
            list(several.iter().copied())
        ))),
    }
}

/// Units of this host, or those of the unit and the fleet that are wanted, whose sockets are in other folders, such as another
/// user's, and how they are asked; empty if there are none.
pub(crate) fn of_others(wanted: Option<&str>, fleet: Option<u32>) -> String {
    let is_wanted = |unit: &Elsewhere| {
        wanted.is_none_or(|wanted| wanted == unit.unit) && fleet.is_none_or(|fleet| fleet == unit.fleet)
    };
    let all = elsewhere().into_iter().filter(is_wanted);
    let reported = all.take(SHOWN).map(|Elsewhere { unit, fleet, path, owner }| {
        let folder = path.parent().unwrap_or(&path).display().to_string();
        let (user, sudo) = match owner {
            Some(owner) if owner == rustix::process::getuid().as_raw() => ("this user".to_owned(), String::new()),
            Some(owner) => (format!("user {owner}"), format!("sudo -u '#{owner}' ")),
            None => ("another user".to_owned(), String::new()),
        };
        format!(
            "{unit} (fleet {fleet}) runs on this host as {user}, and its control socket is in {folder}: \
             `{sudo}env CARA_CONTROL_DIR={folder} cara …` asks it"
        )
    });
    reported.collect::<Vec<_>>().join("; ")
}

/// Every place where a running unit was looked for.
pub(super) fn looked_in() -> String {
    directories().iter().map(|directory| directory.display().to_string()).collect::<Vec<_>>().join(", ")
}

/// Units of others that an error lists.
const SHOWN: usize = 4;

/// Which units run although none of them is meant.
pub(super) fn not_meant() -> String {
    running().map(|all| others(&all)).unwrap_or_default()
}

fn others(all: &[RunningUnit]) -> String {
    if all.is_empty() { String::new() } else { format!(" (there is {})", list(all.iter())) }
}

fn list<'u>(units: impl Iterator<Item = &'u RunningUnit>) -> String {
    units.map(RunningUnit::to_string).collect::<Vec<_>>().join(", ")
}

/// Whether a unit of that identity runs on this host.
pub(super) fn runs(identity: &NameAndId, fleet: u32) -> anyhow::Result<bool> {
    let all = running().map_err(error)?;
    Ok(all.iter().any(|unit| unit.unit == identity.to_string() && unit.fleet == fleet))
}

/// The unit of a socket.
pub(super) fn at(path: &Path, connect: Connect) -> anyhow::Result<Client> {
    connect(path).map_err(error)
}

/// Asks, and has each answer looked at until it says `Break`.
pub(super) fn ask(
    client: &mut Client,
    question: &Question,
    each: &mut dyn FnMut(Answer) -> ControlFlow<()>,
) -> anyhow::Result<()> {
    for answer in client.ask(question).map_err(error)? {
        if each(answer.map_err(error)?).is_break() {
            break;
        }
    }
    Ok(())
}

/// As [`ask`], with the end as an answer: what the unit failed is none of this function's errors.
pub(super) fn pass_on(
    client: &mut Client,
    question: &Question,
    each: &mut dyn FnMut(Answer) -> ControlFlow<()>,
) -> anyhow::Result<()> {
    let mut end = Answer::Done;
    for answer in client.ask(question).map_err(error)? {
        match answer {
            Ok(answer) => {
                if each(answer).is_break() {
                    return Ok(());
                }
            }
            Err(ControlError::Failed(failure)) => end = Answer::Failed(failure),
            Err(broken) => return Err(error(broken)),
        }
    }
    let _ = each(end);
    Ok(())
}

/// With the exit code that fits.
fn error(error: ControlError) -> anyhow::Error {
    let (exit, name) = match error {
        ControlError::Failed(failure) => return error_of(failure),
        ControlError::NoneRunning(paths) => {
            let paths = paths.iter().map(|path| path.display().to_string()).collect::<Vec<_>>().join(", ");
            return Ended::no_unit(format!(
                "no unit answers at {paths}: start it, or be the manager with --as NAME/ID"
            ));
        }
        ControlError::NotRunning { .. } => (Exit::NoUnit, "NoUnit"),
        ControlError::NotAllowed { .. } => (Exit::NoUnit, "NotAllowed"),
        ControlError::Version { .. } => (Exit::NoUnit, "Version"),
        ControlError::Broken(io) if io.kind() == std::io::ErrorKind::UnexpectedEof => {
            return Ended::failed("Broken", "the unit has ended, or closed the connection");
        }
        ControlError::Several(_) => (Exit::Usage, "Usage"),
        ControlError::Full { .. } => (Exit::Failed, "Full"),
        ControlError::Silent { .. } => (Exit::Failed, "Silent"),
        _ => (Exit::Failed, "Broken"),
    };
    Ended { exit, text: error.to_string(), name: name.into() }.into()
}
