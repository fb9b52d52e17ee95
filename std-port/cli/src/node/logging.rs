//! The node's log: lines on standard error, at a level that can change while it runs. A queue stands before it: a terminal or
//! pipe that takes nothing holds up no thread of the unit.

use std::fmt::{self, Write as _};
use std::io::{IsTerminal, Write};
use std::time::Duration;

use cara_std::{LineQueue, Log};
use tracing::field::{Field, Visit};
use tracing::{Event, Level, Subscriber};
use tracing_subscriber::filter::{LevelFilter, ParseError};
use tracing_subscriber::fmt::writer::MakeWriterExt;
use tracing_subscriber::layer::{Context, SubscriberExt};
use tracing_subscriber::util::SubscriberInitExt;
use tracing_subscriber::{EnvFilter, Layer};

use super::black_box::{BlackBox, Cause};
use super::settings::Settings;
use cara_tools::exit::Ended;

/// The default log filter.
const LEVEL: &str = "info";
/// How long the node waits at its end for the last lines to be written.
const LAST_LINES: Duration = Duration::from_secs(1);

/// Changes what is logged.
pub(super) struct Logging {
    change: Box<dyn Fn(EnvFilter)>,
    /// The environment's `RUST_LOG` stands above the file's level.
    fixed: bool,
    lines: LineQueue,
    /// The same lines for the unit's manager, or for an m_unit's operators.
    stream: Option<Log>,
}

impl Drop for Logging {
    fn drop(&mut self) {
        self.lines.flush(LAST_LINES);
    }
}

/// Why a text is no level.
#[derive(Debug, thiserror::Error)]
pub(super) enum LevelError {
    /// A word alone that is none of the levels. `RUST_LOG` would take it for a part of the program of which all is logged.
    #[error("`{0}` is none of the levels")]
    Word(String),
    #[error(transparent)]
    Form(#[from] ParseError),
}

/// What a level's text asks for, as `info` or `warn,cara_std=debug`.
pub(super) fn filter(text: &str) -> Result<EnvFilter, LevelError> {
    // Brackets hold the fields of a span, and commas between those.
    let words = text.split(',').filter(|_| !text.contains('['));
    let mut alone = words.map(str::trim).filter(|word| !word.contains('='));
    match alone.find(|word| word.parse::<LevelFilter>().is_err()) {
        Some(word) => Err(LevelError::Word(word.to_owned())),
        None => Ok(EnvFilter::try_new(text)?),
    }
}

/// Lines of the log on their way into the black box.
struct Boxed(BlackBox);

impl<S: Subscriber> Layer<S> for Boxed {
    fn on_event(&self, event: &Event<'_>, _: Context<'_, S>) {
        let metadata = event.metadata();
        // Those events are in the box in a form of their own.
        if metadata.target() != super::events::TARGET {
            self.0.note("log", None, || {
                let mut text = metadata.level().to_string();
                event.record(&mut Fields(&mut text));
                text
            });
        }
        if *metadata.level() == Level::ERROR {
            self.0.freeze(Cause::Error);
        }
    }
}

/// Writes the fields of an event behind its level.
struct Fields<'t>(&'t mut String);

impl Visit for Fields<'_> {
    fn record_debug(&mut self, field: &Field, value: &dyn fmt::Debug) {
        // A string takes all.
        let _ = match field.name() {
            "message" => write!(self.0, " {value:?}"),
            name => write!(self.0, " {name}={value:?}"),
        };
    }
}

impl Logging {
    /// Begins to log. The command line's level stands above `RUST_LOG`, and that above the file's.
    pub(super) fn start(command_line: Option<&str>, settings: &Settings, black_box: &BlackBox) -> anyhow::Result<Self> {
        let file = settings.file_log.as_deref();
        let environment = std::env::var(EnvFilter::DEFAULT_ENV).ok().filter(|text| !text.is_empty());
        let fixed = command_line.is_some() || environment.is_some();
        let filter = match (command_line, environment) {
            // It is every program's, and may name parts alone.
            (None, Some(text)) => {
                EnvFilter::try_new(text).map_err(|error| Ended::usage(format!("RUST_LOG: {error}")))?
            }
            (level, _) => filter(level.or(file).unwrap_or(LEVEL))?,
        };
        let mut reported = 0;
        let lines = LineQueue::new("cara-stderr", move |line, lost| {
            let mut stderr = std::io::stderr().lock();
            if lost > reported {
                writeln!(
                    stderr,
                    "{} lines of the log were lost: they came faster than they were read",
                    lost - reported
                )?;
                reported = lost;
            }
            stderr.write_all(line)
        })?;
        let queue = lines.clone();
        let builder = tracing_subscriber::fmt()
            .with_writer(move || queue.clone())
            .with_ansi(std::io::stderr().is_terminal())
            .with_env_filter(filter);
        let builder = builder.with_filter_reloading();
        let handle = builder.reload_handle();
        let stream = settings.streams_log.then(Log::default);
        // Sending a piece of it writes lines of the level TRACE.
        let streamed = stream.clone().map(|log| {
            let writer = (move || log.clone()).with_max_level(Level::DEBUG);
            tracing_subscriber::fmt::layer().with_ansi(false).with_writer(writer)
        });
        // Another one is there only if a test has set it; that one may stay.
        let _ = builder.finish().with(Boxed(black_box.clone())).with(streamed).try_init();
        let change = Box::new(move |filter| {
            // Fails only once the subscriber is gone.
            let _ = handle.reload(filter);
        });
        Ok(Self { change, fixed, lines, stream })
    }

    /// The lines for the unit's manager.
    pub(super) fn stream(&self) -> Option<&Log> {
        self.stream.as_ref()
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
