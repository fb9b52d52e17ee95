//! The node's log: lines on standard error, at a level that can change while it runs.

use std::io::IsTerminal;

use tracing_subscriber::EnvFilter;
use tracing_subscriber::filter::ParseError;

/// What is logged unless somebody says something else.
const LEVEL: &str = "info";

/// Changes what is logged.
pub(super) struct Logging {
    change: Box<dyn Fn(EnvFilter)>,
    /// The environment's `RUST_LOG` stands above the file's level.
    fixed: bool,
}

/// What a level's text asks for, as `info` or `warn,cara_std=debug`.
pub(super) fn filter(text: &str) -> Result<EnvFilter, ParseError> {
    EnvFilter::try_new(text)
}

impl Logging {
    /// Begins to log. The command line's level stands above `RUST_LOG`, and that above the file's.
    pub(super) fn start(command_line: Option<&str>, file: Option<&str>) -> anyhow::Result<Self> {
        let environment = std::env::var(EnvFilter::DEFAULT_ENV).ok().filter(|text| !text.is_empty());
        let above = command_line.or(environment.as_deref());
        let filter = filter(above.or(file).unwrap_or(LEVEL))?;
        let builder = tracing_subscriber::fmt()
            .with_writer(std::io::stderr)
            .with_ansi(std::io::stderr().is_terminal())
            .with_env_filter(filter);
        let builder = builder.with_filter_reloading();
        let handle = builder.reload_handle();
        // Another one is there only if a test has set it; that one may stay.
        let _ = builder.try_init();
        let change = Box::new(move |filter| {
            // Fails only once nobody logs any more.
            let _ = handle.reload(filter);
        });
        Ok(Self { change, fixed: above.is_some() })
    }

    /// Takes the level of a file that has changed.
    pub(super) fn change(&self, file: Option<&str>) {
        if let Ok(filter) = filter(file.unwrap_or(LEVEL))
            && !self.fixed
        {
            (self.change)(filter);
        }
    }
}
