//! Constraints by name, as an operator sets them.

use cara_core::config::{CHUNK_BYTES, Constraints, MINIMUM_CHUNK_BYTES, Scheduling};
use cara_core::error::Error;
use cara_core::time::Duration;

use super::protocol::Failure;
use crate::config::{LONGEST_MESSAGE, SHORTEST_MESSAGE};

const NAMES: &str = "request_timeout, minimum_interval, maximum_nodes, message_size, chunk_size, keep_alive, calls_per_peer, scheduling";
/// What may differ from node to node.
const FOR_ONE: [&str; 3] = ["request_timeout", "minimum_interval", "calls_per_peer"];

/// The constraints with one of them changed.
pub(super) fn changed(before: Constraints, name: &str, value: u64) -> Result<Constraints, Failure> {
    let mut after = before;
    match plain(name) {
        "request_timeout" => after.request_timeout = Duration::from_micros(value),
        "minimum_interval" => after.minimum_interval = Duration::from_micros(value),
        "maximum_nodes" => after.maximum_nodes = narrow(name, value)?,
        "message_size" => after.message_size = narrow(name, value)?,
        "chunk_size" => after.chunk_size = narrow(name, value)?,
        "keep_alive" => after.keep_alive = Duration::from_micros(value),
        "calls_per_peer" => after.calls_per_peer = narrow(name, value)?,
        "scheduling" => after.scheduling = scheduling(value).ok_or_else(|| bad(name, value))?,
        _ => {
            let text = format!("there is no constraint '{name}'; there are {NAMES}");
            return Err(Failure::configuration("UnknownConstraint", text));
        }
    }
    Ok(after)
}

/// Whether a constraint may be set towards one node.
pub(super) fn check_for_one(name: &str) -> Result<(), Failure> {
    if FOR_ONE.contains(&plain(name)) || !NAMES.split(", ").any(|known| known == plain(name)) {
        return Ok(());
    }
    let text = format!("'{name}' is one for all nodes; towards one node there are {}", FOR_ONE.join(", "));
    Err(Failure::configuration("BadConstraint", text))
}

/// Why the unit does not take the value.
pub(super) fn refused(error: Error, name: &str, value: u64) -> Failure {
    match error {
        Error::BadConstraint => bad(name, value),
        error => error.into(),
    }
}

/// The name in the answer has its unit behind it.
fn plain(name: &str) -> &str {
    name.strip_suffix("_us").unwrap_or(name)
}

/// By its place in the table of all.
fn scheduling(value: u64) -> Option<Scheduling> {
    Scheduling::ALL.get(usize::try_from(value).ok()?).copied()
}

fn narrow<N: TryFrom<u64>>(name: &str, value: u64) -> Result<N, Failure> {
    N::try_from(value).map_err(|_| bad(name, value))
}

fn bad(name: &str, value: u64) -> Failure {
    let bounds = match plain(name) {
        "maximum_nodes" => format!(
            "it is 1 to {}, and its process may have {} links open at most (ulimit -Hn)",
            u16::MAX,
            crate::sys::limits::most_links()
        ),
        "message_size" => format!("it is {SHORTEST_MESSAGE} to {LONGEST_MESSAGE} bytes"),
        "chunk_size" => format!("it is {MINIMUM_CHUNK_BYTES} to {CHUNK_BYTES} bytes"),
        "request_timeout" => "it is at least 1000 microseconds".to_owned(),
        "keep_alive" => format!(
            "it is {} to {} microseconds",
            cara_core::config::SHORTEST_KEEP_ALIVE.as_micros(),
            cara_core::config::LONGEST_KEEP_ALIVE.as_micros()
        ),
        "calls_per_peer" => format!("it is 1 to {}", u16::MAX),
        "scheduling" => "it is 0 for deadline, 1 for fifo or 2 for admission".to_owned(),
        _ => "this unit cannot hold it".to_owned(),
    };
    Failure::configuration("BadConstraint", format!("{name} cannot be {value}: {bounds}"))
}
