//! `cara replay`: the events of recordings.

use std::path::PathBuf;
use std::process::ExitCode;
use std::time::Duration;

use crate::recording::{Reading, ReadingEnd, event_of};
use cara_tools::exit::{Ended, Exit};
use cara_tools::global::Global;
use cara_tools::output;

/// Prints the events of recordings by `cara record` as `cara watch` printed them.
#[derive(clap::Args)]
pub(crate) struct Arguments {
    /// The recordings, the oldest first: FILE.1 before FILE.
    #[arg(required = true)]
    file: Vec<PathBuf>,
    /// Take the time between two events that it took then, divided by this number; all at once if absent.
    #[arg(long, value_name = "NUMBER", value_parser = speed)]
    speed: Option<f64>,
}

fn speed(text: &str) -> Result<f64, String> {
    let speed = text.parse().ok().filter(|speed: &f64| speed.is_finite() && *speed > 0.0);
    speed.ok_or_else(|| "a number above 0: 1 for as fast as it was".to_owned())
}

pub(crate) fn run(Arguments { file, speed }: Arguments, global: &Global) -> anyhow::Result<ExitCode> {
    let mut last = None;
    for path in &file {
        let failed = |text: String| Ended::failed("Failed", format!("{}: {text}", path.display()));
        let mut reading = Reading::open(path).map_err(|error| failed(error.to_string()))?;
        for message in &mut reading {
            let Some(event) = event_of(&message.topic, &message.body) else { continue };
            if let Some((speed, last)) = speed.zip(last.replace(message.came)) {
                std::thread::sleep(pause(message.came.saturating_sub(last), speed));
            }
            super::watch::print(event, global)?;
        }
        match reading.end() {
            Some(ReadingEnd::Damaged(why)) => return Err(failed(why.clone())),
            Some(ReadingEnd::CutOff) => output::warning(format_args!("{} was cut off here", path.display())),
            Some(ReadingEnd::Whole) | None => {}
        }
    }
    Ok(Exit::Done.into())
}

fn pause(nanos: u64, speed: f64) -> Duration {
    Duration::try_from_secs_f64(Duration::from_nanos(nanos).as_secs_f64() / speed).unwrap_or(Duration::MAX)
}
