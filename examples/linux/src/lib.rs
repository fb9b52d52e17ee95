//! What the examples share on Linux: options, output, signals. Their logic is in `cara-apps`.

mod events;
pub mod messages;
mod options;
mod output;
mod stop;

pub use cara_std::NameAndId;
pub use events::show_events;
pub use options::Network;
pub use stop::{Stop, Stopper};

use std::process::ExitCode;

use cara_std::StartError;

/// Logs to standard error, as the environment's `RUST_LOG` asks; warnings unless it is set. A terminal that takes nothing holds up no
/// thread that moves or stops something.
pub fn log_to_stderr() {
    use std::io::Write;
    use tracing_subscriber::EnvFilter;
    let lines = cara_std::LineQueue::new("log", |line, _| std::io::stderr().write_all(line));
    let Ok(lines) = lines.inspect_err(|error| eprintln!("there is no log: {error}")) else { return };
    let filter = EnvFilter::try_from_default_env().unwrap_or_else(|_| EnvFilter::new("warn"));
    tracing_subscriber::fmt().with_env_filter(filter).with_writer(move || lines.clone()).init();
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
