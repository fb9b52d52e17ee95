//! `cara forget-claim`: a vehicle obeys any manager of an identity again.

use std::path::PathBuf;
use std::process::ExitCode;

use cara_std::control::{ForgetError, Forgotten, forget_claims, state_folder};
use serde_json::json;

use cara_tools::exit::{Ended, Exit};
use cara_tools::global::Global;
use cara_tools::name_and_id::NameAndId;
use cara_tools::output;

/// Has a unit of this host forget which claims of its managers it has obeyed, while its program does not run.
///
/// For a vehicle that refuses every manager (`Fenced`) because of a claim that none of them made. A manager that is alive and has
/// the higher claim gets the vehicle again: stop that one first. Each claim is written to the audit log before it is
/// forgotten.
#[derive(clap::Args)]
pub(crate) struct Arguments {
    /// The unit: NAME/ID.
    node: NameAndId,
    /// Its folder of state; CARA_STATE or STATE_DIRECTORY unless told.
    #[arg(long, value_name = "FOLDER")]
    state: Option<PathBuf>,
    /// The audit log; `audit.log` in the folder of state unless told.
    #[arg(long, value_name = "FILE")]
    audit: Option<PathBuf>,
}

pub(crate) fn run(Arguments { node, state, audit }: Arguments, global: &Global) -> anyhow::Result<ExitCode> {
    let state = state.or_else(state_folder);
    let state = state.ok_or_else(|| Ended::usage("say which folder of state the unit has: --state FOLDER"))?;
    let audit = audit.unwrap_or_else(|| state.join("audit.log"));
    let forgotten = forget_claims(&state, &node, global.fleet, &audit).map_err(|error| match error {
        ForgetError::Runs(_) => Ended::failed("Runs", error.to_string()),
        error => Ended::failed("NotForgotten", error.to_string()),
    })?;
    if forgotten.is_empty() {
        return Err(Ended::failed("NoClaim", format!("{} has no claim that {node} has obeyed", state.display())));
    }
    if global.json {
        let reported = |Forgotten { fleet, manager, claim }: &Forgotten| json!({ "fleet": fleet, "manager": manager.to_string(), "claim": [claim.term, claim.claimant] });
        output::object(
            &json!({ "node": node.to_string(), "forgotten": forgotten.iter().map(reported).collect::<Vec<_>>() }),
        )?;
    } else {
        for Forgotten { fleet, manager, claim } in forgotten {
            output::line(format_args!("{node} (fleet {fleet}) has forgotten claim {claim} of {manager}"))?;
        }
    }
    Ok(Exit::Done.into())
}
