//! A recording of what goes over MQTT: a message waits in the recorder's bounded queue, and a thread of its own writes it. A disk that
//! is full, hangs or cannot be opened costs the recording alone.

use std::collections::BTreeMap;
use std::path::PathBuf;
use std::sync::atomic::{AtomicU64, Ordering};
use std::sync::{Arc, Mutex, OnceLock, PoisonError};
use std::time::{Duration, Instant};

use anyhow::{Context, Result};
use cara_recording::{Limits, Recorder, StartError};

use crate::config::Config;
use crate::log;
use crate::message;

/// What is recorded can be read after this time.
const CHUNK: Duration = Duration::from_secs(1);
/// Between two warnings about losses.
const WARN: Duration = Duration::from_secs(10);
/// Before a file that cannot be opened is tried again.
const RETRY: Duration = Duration::from_secs(10);
/// A disk that takes nothing is waited for so long at the end, once or twice.
const LAST: Duration = Duration::from_secs(2);
/// Topic of the messages that tell whether the broker is there: they are not recorded.
const PROBE: &str = "/cara-probe";

/// Its clones write into the same one. Without a setting it takes nothing.
#[derive(Clone, Default)]
pub struct Recording(Option<Arc<Shared>>);

struct Shared {
    file: PathBuf,
    /// Once its file is open.
    recorder: OnceLock<Recorder>,
    /// Messages before that.
    missed: AtomicU64,
    /// When its chunk ended last; how many messages were lost at the last warning, and when that was.
    turned: Mutex<(Instant, u64, Option<Instant>)>,
}

impl Recording {
    /// Opens the file in a thread of its own, as its disk may hang, and tries again while it cannot be opened. Fails if there is no
    /// such thread.
    pub fn start(config: &Config) -> Result<Self> {
        let Some(settings) = config.recording.clone() else { return Ok(Self::default()) };
        let turned = Mutex::new((Instant::now(), 0, None));
        let shared = Arc::new(Shared {
            file: settings.file.clone(),
            recorder: OnceLock::new(),
            missed: AtomicU64::new(0),
            turned,
        });
        let limits = Limits { size: settings.max_size, keep: settings.keep.into() };
        let about = [
            ("unit", format!("{}/{}", config.manager.name, config.manager.id)),
            ("fleet", config.manager.fleet.to_string()),
            ("vda5050", config.vda5050.version.clone()),
            ("recorded_by", format!("cara-vda5050 {}", env!("CARGO_PKG_VERSION"))),
        ];
        let about: BTreeMap<_, _> = about.into_iter().map(|(key, value)| (key.to_owned(), value)).collect();
        let own = Arc::downgrade(&shared);
        let open = move || {
            let open = || Recorder::start(&settings.file, limits, about.clone());
            let recorder = open_at_last(open, RETRY, || own.strong_count() > 0);
            if let (Some(own), Some(recorder)) = (own.upgrade(), recorder) {
                let _ = own.recorder.set(recorder);
            }
        };
        let thread = std::thread::Builder::new().name("recording".into());
        thread.spawn(open).context("cannot start the thread of the recording")?;
        Ok(Self(Some(shared)))
    }

    /// Records a message. Never waits: what finds no place is counted.
    pub fn take(&self, is_sent: bool, topic: &str, is_retained: bool, payload: &[u8]) {
        let is_probe = topic.ends_with(PROBE) || payload.starts_with(message::PROBE);
        let Some(shared) = self.0.as_ref().filter(|_| !is_probe) else { return };
        match shared.recorder.get() {
            Some(recorder) => recorder.take_mqtt(is_sent, topic, is_retained, payload),
            None => drop(shared.missed.fetch_add(1, Ordering::Relaxed)),
        }
    }

    /// Ends a chunk if that is due, and warns of losses. To be called several times a second.
    pub fn turn(&self) {
        let Some(shared) = self.0.as_deref() else { return };
        if let Some(losses) = shared.turn() {
            log::line(format_args!("{}: {losses}", shared.file.display()));
        }
    }

    /// Ends the file.
    pub fn end(&self) {
        let Some(shared) = self.0.as_deref() else { return };
        let outcome = shared.recorder.get().map(|recorder| recorder.clone().end(LAST));
        let (messages, lost) = outcome.map_or((0, 0), |outcome| (outcome.messages, outcome.lost));
        let lost = lost + shared.missed.load(Ordering::Relaxed);
        log::line(format_args!("{}: {messages} messages recorded, {lost} lost", shared.file.display()));
    }
}

impl Shared {
    /// Returns what is to be said of losses, those before the file was open included: its disk may hang.
    fn turn(&self) -> Option<String> {
        let recorder = self.recorder.get();
        let mut turned = self.turned.lock().unwrap_or_else(PoisonError::into_inner);
        let (flushed, lost, warned) = &mut *turned;
        if let Some(recorder) = recorder.filter(|_| flushed.elapsed() >= CHUNK) {
            *flushed = Instant::now();
            recorder.flush();
        }
        let now = self.missed.load(Ordering::Relaxed) + recorder.map_or(0, Recorder::lost);
        if now <= *lost || warned.is_some_and(|warned| warned.elapsed() < WARN) {
            return None;
        }
        (*lost, *warned) = (now, Some(Instant::now()));
        let why = recorder.map_or_else(|| Some("the file is not open yet".to_owned()), Recorder::held_up);
        let why = why.map(|why| format!(": {why}")).unwrap_or_default();
        Some(format!("{now} messages are not recorded until now{why}"))
    }
}

/// Tries until the file is open or nobody waits for it. Each reason is logged once.
fn open_at_last(
    open: impl Fn() -> Result<Recorder, StartError>,
    pause: Duration,
    is_awaited: impl Fn() -> bool,
) -> Option<Recorder> {
    let mut why = String::new();
    while is_awaited() {
        match open() {
            Ok(recorder) => {
                if !why.is_empty() {
                    log::line("recording from now on");
                }
                return Some(recorder);
            }
            Err(error) if error.to_string() == why => {}
            Err(error) => {
                why = error.to_string();
                log::line(format_args!("nothing is recorded, next try in {} s: {why}", pause.as_secs()));
            }
        }
        std::thread::sleep(pause);
    }
    None
}

#[cfg(test)]
mod tests {
    use std::cell::Cell;

    use super::*;

    #[test]
    fn what_is_missed_before_the_file_is_open_is_said() {
        let folder = tempfile::tempdir().unwrap();
        let file = folder.path().join("a.mcap");
        let recording = Recording(Some(Arc::new(Shared {
            file: file.clone(),
            recorder: OnceLock::new(),
            missed: AtomicU64::new(0),
            turned: Mutex::new((Instant::now(), 0, None)),
        })));
        let shared = recording.0.as_deref().unwrap();
        assert_eq!(shared.turn(), None);
        (0..3).for_each(|_| recording.take(true, "uagv/state", false, b"{}"));
        assert_eq!(shared.turn().unwrap(), "3 messages are not recorded until now: the file is not open yet");
        recording.take(true, "uagv/state", false, b"{}");
        assert_eq!(shared.turn(), None, "not so soon again");
        shared.turned.lock().unwrap().2 = None;
        let recorder = Recorder::start(&file, Limits { size: 1 << 20, keep: 1 }, BTreeMap::new()).unwrap();
        assert!(shared.recorder.set(recorder).is_ok());
        assert_eq!(shared.turn().unwrap(), "4 messages are not recorded until now");
        recording.end();
    }

    #[test]
    fn a_file_that_cannot_be_opened_is_tried_again_while_somebody_waits() {
        let folder = tempfile::tempdir().unwrap();
        let file = folder.path().join("a.mcap");
        std::fs::write(&file, "no recording").unwrap();
        let tries = Cell::new(0);
        let open = || {
            tries.set(tries.get() + 1);
            if tries.get() == 3 {
                std::fs::remove_file(&file).unwrap();
            }
            Recorder::start(&file, Limits { size: 1 << 20, keep: 1 }, BTreeMap::new())
        };
        assert!(open_at_last(open, Duration::ZERO, || tries.get() < 2).is_none());
        assert_eq!(tries.get(), 2);
        assert!(open_at_last(open, Duration::ZERO, || true).is_some());
        assert_eq!(tries.get(), 3);
        assert!(file.exists());
    }
}
