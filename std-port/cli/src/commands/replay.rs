//! `cara replay`: the events of recordings, and what a unit would have answered meanwhile.

use std::path::PathBuf;
use std::process::ExitCode;
use std::time::Duration;

use cara_recording::{Damage, Reading, ReadingEnd, Stage, event_of};
use cara_tools::exit::{Ended, Exit};
use cara_tools::global::Global;
use cara_tools::output;

/// Prints the events of recordings by `cara record` as `cara watch` printed them, and messages of MQTT that a gateway recorded.
#[derive(clap::Args)]
pub(crate) struct Arguments {
    /// The recordings, the oldest first: FILE.1 before FILE.
    #[arg(required = true)]
    file: Vec<PathBuf>,
    /// Take the time between two events that it took then, divided by this number; all at once if absent.
    #[arg(long, value_name = "NUMBER", value_parser = speed)]
    speed: Option<f64>,
    /// Make a control socket for `cara top --socket PATH` and `cara web --socket PATH`, which show what was recorded at the moment
    /// that is replayed; as fast as it was unless --speed says otherwise. Its end stays until Ctrl-C.
    #[arg(long, value_name = "PATH")]
    serve: Option<PathBuf>,
}

fn speed(text: &str) -> Result<f64, String> {
    let speed = text.parse().ok().filter(|speed: &f64| speed.is_finite() && *speed > 0.0);
    speed.ok_or_else(|| "a number above 0: 1 for as fast as it was".to_owned())
}

pub(crate) fn run(Arguments { file, speed, serve }: Arguments, global: &Global) -> anyhow::Result<ExitCode> {
    let stage = serve.as_ref().map(|_| Stage::default());
    let speed = if stage.is_some() { speed.or(Some(1.0)) } else { speed };
    let (mut last, mut is_open, mut damaged) = (None, false, Vec::new());
    for path in &file {
        let failed = |text: String| Ended::failed("Failed", format!("{}: {text}", path.display()));
        let mut reading = Reading::open(path).map_err(|error| failed(error.to_string()))?;
        for message in &mut reading {
            let event = event_of(&message);
            if event.is_none() && stage.is_none() {
                continue;
            }
            if let Some((speed, last)) = speed.zip(last.replace(message.came)) {
                std::thread::sleep(pause(message.came.saturating_sub(last), speed));
            }
            if let Some((stage, path)) = stage.as_ref().zip(serve.as_ref()) {
                stage.show(&message);
                if !is_open && stage.has_unit() {
                    is_open = true;
                    let failed = |error| Ended::failed("Failed", format!("{}: {error}", path.display()));
                    stage.open(path).map_err(failed)?;
                    output::warning(format_args!("a recording answers at {}", path.display()));
                }
            }
            let Some(event) = event else { continue };
            super::watch::print(event, global)?;
        }
        let Damage { parts, messages } = reading.damage();
        if parts + messages > 0 {
            let without = if messages > 0 {
                format!(", and {messages} messages whose channel is in them")
            } else {
                String::new()
            };
            let path = path.display();
            output::warning(format_args!("{path} is damaged: parts that are left out: {parts}{without}"));
        }
        match reading.end() {
            Some(ReadingEnd::Damaged(why)) => output::warning(format_args!("{}: {why}", path.display())),
            Some(ReadingEnd::CutOff) => output::warning(format_args!("{} was cut off here", path.display())),
            Some(ReadingEnd::Whole) | None => {}
        }
        if parts + messages > 0 || matches!(reading.end(), Some(ReadingEnd::Damaged(_))) {
            damaged.push(path.display().to_string());
        }
    }
    if is_open {
        // A signal ends the process.
        loop {
            std::thread::park();
        }
    }
    if !damaged.is_empty() {
        return Err(Ended::failed("Failed", format!("not all could be read of {}", damaged.join(", "))));
    }
    Ok(Exit::Done.into())
}

fn pause(nanos: u64, speed: f64) -> Duration {
    Duration::try_from_secs_f64(Duration::from_nanos(nanos).as_secs_f64() / speed).unwrap_or(Duration::MAX)
}
