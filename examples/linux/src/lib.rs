//! What the examples share on Linux: options, output, signals. Their logic is in `cara-apps`.

mod events;
mod options;
mod output;
mod stop;

pub use cara_std::NameAndId;
pub use events::show_events;
pub use options::Network;
pub use stop::{Stop, Stopper};

use std::process::ExitCode;

use cara_std::StartError;

/// Logs to standard error, as the environment's `RUST_LOG` asks; warnings unless it is set.
pub fn log_to_stderr() {
    use tracing_subscriber::EnvFilter;
    let filter = EnvFilter::try_from_default_env().unwrap_or_else(|_| EnvFilter::new("warn"));
    tracing_subscriber::fmt().with_env_filter(filter).with_writer(std::io::stderr).init();
}

/// How a program ends. A second manager of one identity has an exit code of its own, after which no supervisor should start it
/// again.
pub fn ended(outcome: anyhow::Result<()>) -> anyhow::Result<ExitCode> {
    match outcome {
        Err(error) if error.downcast_ref().is_some_and(StartError::is_running_already) => {
            eprintln!("error: {error}");
            Ok(ExitCode::from(StartError::ALREADY_RUNNING_EXIT))
        }
        outcome => outcome.map(|()| ExitCode::SUCCESS),
    }
}

/// The README's listing, so that it is compiled.
#[cfg(doctest)]
#[doc = include_str!("../../../README.md")]
mod readme {}
