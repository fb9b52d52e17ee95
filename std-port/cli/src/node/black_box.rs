//! The black box: the last minutes of events, commands, calls and log lines in memory. When something goes wrong, a thread of its
//! own writes them into the folder of state; nothing else waits for that disk.

use std::collections::BTreeMap;
use std::fs;
use std::io;
use std::path::{Path, PathBuf};
use std::sync::{Arc, Condvar, Mutex, MutexGuard, PoisonError};
use std::time::{Duration, Instant, SystemTime, UNIX_EPOCH};

use cara_std::control::protocol::Answer;
use cara_std::control::{described, state_folder};
use cara_std::{Identity, LeaseEnd, UnitEvent};

use super::settings::Settings;
use cara_recording::{self as recording, Line, Ring};

/// The folder in the folder of state.
pub(crate) const FOLDER: &str = "black-box";
/// How long something is remembered.
const SPAN: Duration = Duration::from_secs(600);
/// What comes so long after the cause is in its box.
const AFTER: Duration = Duration::from_secs(5);
/// Between two boxes: a cause that comes again and again fills no disk. The next box has all that came meanwhile.
const BETWEEN: Duration = Duration::from_secs(60);
/// How long the end of the node waits for a box.
const LAST: Duration = Duration::from_secs(2);

/// What may be shorter in tests.
#[derive(Clone, Copy, Debug)]
struct Times {
    after: Duration,
    between: Duration,
    last: Duration,
}

const TIMES: Times = Times { after: AFTER, between: BETWEEN, last: LAST };

/// How much is kept.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) struct Budget {
    /// Files; 0 switches the black box off.
    pub(super) keep: usize,
    /// Bytes in memory, and about as many in each file.
    pub(super) size: u64,
}

impl Default for Budget {
    fn default() -> Self {
        Self { keep: 8, size: 4 << 20 }
    }
}

/// Why a box is written.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Cause {
    Stop,
    Lease,
    Error,
    Reset,
}

impl Cause {
    const fn word(self) -> &'static str {
        match self {
            Self::Stop => "stop",
            Self::Lease => "lease",
            Self::Error => "error",
            Self::Reset => "reset",
        }
    }

    fn of(event: &UnitEvent) -> Option<Self> {
        match event {
            UnitEvent::Inhibited { latch: Some(_), .. } => Some(Self::Stop),
            UnitEvent::Inhibited { latch: None, .. } => Some(Self::Reset),
            UnitEvent::LeaseEnded { why: LeaseEnd::Finished | LeaseEnd::Replaced | LeaseEnd::Released, .. } => None,
            UnitEvent::LeaseEnded { .. } | UnitEvent::LeaseExpired { .. } => Some(Self::Lease),
            UnitEvent::RequestFailed { .. } | UnitEvent::Fenced { .. } | UnitEvent::ClaimNotKept { .. } => {
                Some(Self::Error)
            }
            _ => None,
        }
    }
}

/// Reports what is so at a moment.
pub(super) type Look = Box<dyn Fn(&mut dyn FnMut(Answer)) + Send>;

/// Its clones fill the same box. Without a folder of state it takes nothing.
#[derive(Clone)]
pub(super) struct BlackBox(Option<Arc<Shared>>);

struct Shared {
    started: Instant,
    times: Times,
    ring: Mutex<Ring>,
    state: Mutex<State>,
    changed: Condvar,
}

#[derive(Default)]
struct State {
    /// The first one that is not written yet.
    cause: Option<(Cause, Instant)>,
    is_ending: bool,
    has_ended: bool,
}

impl BlackBox {
    pub(super) fn new(settings: &Settings) -> Self {
        let Budget { keep, size } = settings.black_box;
        let has_place = keep > 0 && settings.state.clone().or_else(state_folder).is_some();
        Self(has_place.then(|| Arc::new(Shared::new(size, TIMES))))
    }

    /// Writes boxes from here on. `look` reports what is so at the moment that one is written.
    pub(super) fn start(&self, settings: &Settings, look: impl Fn(&mut dyn FnMut(Answer)) + Send + 'static) {
        let Some(state) = settings.state.clone().or_else(state_folder) else { return };
        let writer = Writer::new(state.join(FOLDER), settings);
        self.write_with(look, move |cause, lines| match writer.write(cause, lines) {
            // No error of the log, which would have the next box written.
            Ok(path) => tracing::warn!(path = %path.display(), "black box written: {}", cause.word()),
            Err(error) => tracing::warn!(%error, folder = %writer.folder.display(), "no black box is written"),
        });
    }

    fn write_with(
        &self,
        look: impl Fn(&mut dyn FnMut(Answer)) + Send + 'static,
        write: impl Fn(Cause, &[Line]) + Send + 'static,
    ) {
        let Some(shared) = self.0.clone() else { return };
        let run = move || {
            shared.write_all(&look, &write);
            shared.lock().has_ended = true;
            shared.changed.notify_all();
        };
        if let Err(error) = std::thread::Builder::new().name("cara-black-box".into()).spawn(run) {
            tracing::warn!(%error, "there is no black box");
        }
    }

    pub(super) fn take(&self, answer: &Answer) {
        if let Some(shared) = &self.0
            && let Some(line) = Ring::line(answer)
        {
            shared.ring.lock().unwrap_or_else(PoisonError::into_inner).push(line);
        }
    }

    pub(super) fn event(&self, event: &UnitEvent) {
        let Some(shared) = &self.0 else { return };
        self.take(&described(event, shared.started.elapsed().into()));
        if let Some(cause) = Cause::of(event) {
            self.freeze(cause);
        }
    }

    /// Something that is no event of the unit; `text` is made only if it is wanted.
    pub(super) fn note(&self, event: &str, node: Option<&Identity>, text: impl FnOnce() -> String) {
        let Some(shared) = &self.0 else { return };
        let unix_ms = SystemTime::now().duration_since(UNIX_EPOCH).unwrap_or_default().as_millis() as u64;
        let (at_ms, node) = (shared.started.elapsed().as_millis() as u64, node.map(Identity::to_string));
        self.take(&Answer::Event { at_ms, unix_ms, event: event.to_owned(), node, text: text() });
    }

    /// Has a box written a little later.
    pub(super) fn freeze(&self, cause: Cause) {
        let Some(shared) = &self.0 else { return };
        shared.lock().cause.get_or_insert((cause, Instant::now()));
        shared.changed.notify_all();
    }

    /// Writes what is to be written at once. A disk that does not answer is waited for no longer than 2 s.
    pub(super) fn end(&self) {
        let Some(shared) = &self.0 else { return };
        let mut state = shared.lock();
        state.is_ending = true;
        shared.changed.notify_all();
        let has_not_ended = |state: &mut State| !state.has_ended;
        drop(shared.changed.wait_timeout_while(state, shared.times.last, has_not_ended));
    }
}

impl Shared {
    fn new(size: u64, times: Times) -> Self {
        let ring = Ring::new(size, SPAN).into();
        Self { started: Instant::now(), times, ring, state: Mutex::default(), changed: Condvar::new() }
    }

    fn lock(&self) -> MutexGuard<'_, State> {
        self.state.lock().unwrap_or_else(PoisonError::into_inner)
    }

    /// Waits until a box is due; `None` at the end.
    fn due(&self, last: Option<Instant>) -> Option<Cause> {
        let mut state = self.lock();
        loop {
            let wait = state.cause.map(|(_, at)| {
                let due = at + self.times.after;
                let due = last.map_or(due, |last| due.max(last + self.times.between));
                due.saturating_duration_since(Instant::now())
            });
            match wait {
                Some(wait) if wait.is_zero() || state.is_ending => return state.cause.take().map(|(cause, _)| cause),
                None if state.is_ending => return None,
                wait => {
                    let wait = wait.unwrap_or(Duration::MAX);
                    state = self.changed.wait_timeout(state, wait).unwrap_or_else(PoisonError::into_inner).0;
                }
            }
        }
    }

    fn write_all(&self, look: &impl Fn(&mut dyn FnMut(Answer)), write: &impl Fn(Cause, &[Line])) {
        let mut last = None;
        while let Some(cause) = self.due(last) {
            last = Some(Instant::now());
            let mut lines = self.ring.lock().unwrap_or_else(PoisonError::into_inner).lines();
            look(&mut |answer| lines.extend(Ring::line(&answer)));
            write(cause, &lines);
        }
    }
}

/// The files of one unit.
struct Writer {
    folder: PathBuf,
    keep: usize,
    /// Begins each file's name.
    prefix: String,
    about: BTreeMap<String, String>,
}

impl Writer {
    fn new(folder: PathBuf, settings: &Settings) -> Self {
        let Settings { name, id, fleet, .. } = settings;
        let role = if settings.manager.is_some() { "s_unit" } else { "m_unit" };
        let about = [
            ("unit", format!("{name}/{id}")),
            ("role", role.to_owned()),
            ("fleet", fleet.to_string()),
            ("recorded_by", format!("cara {}", env!("CARGO_PKG_VERSION"))),
        ];
        let about = about.into_iter().map(|(key, value)| (key.to_owned(), value)).collect();
        let prefix = format!("{}-{id}-{role}-{fleet}-", cara_std::file_name(name));
        Self { folder, keep: settings.black_box.keep, prefix, about }
    }

    fn write(&self, cause: Cause, lines: &[Line]) -> io::Result<PathBuf> {
        fs::create_dir_all(&self.folder)?;
        let unix_ms = SystemTime::now().duration_since(UNIX_EPOCH).unwrap_or_default().as_millis();
        // Of one width until the year 2286, so that names are in the order of time.
        let path = self.folder.join(format!("{}{unix_ms:013}-{}.mcap", self.prefix, cause.word()));
        let mut about = self.about.clone();
        about.extend([("cause", cause.word().to_owned()), ("unix_ms", unix_ms.to_string())].map(owned));
        self.of_unit("part")?.iter().for_each(|left| drop(fs::remove_file(left)));
        // With its cause: the error itself does not say that the disk is full.
        let told = |error| io::Error::other(format!("{:#}", anyhow::Error::from(error)));
        recording::write(&path, about, lines).map_err(told)?;
        let mut boxes = self.of_unit("mcap")?;
        boxes.sort();
        let too_many = boxes.len().saturating_sub(self.keep);
        boxes.iter().take(too_many).try_for_each(fs::remove_file)?;
        Ok(path)
    }

    fn of_unit(&self, extension: &str) -> io::Result<Vec<PathBuf>> {
        let is_its = |path: &Path| {
            let name = path.file_name().and_then(|name| name.to_str());
            let rest = name.and_then(|name| name.strip_prefix(&self.prefix));
            rest.is_some_and(|rest| rest.starts_with(|first: char| first.is_ascii_digit()))
                && path.extension().is_some_and(|own| own == extension)
        };
        let files = fs::read_dir(&self.folder)?.map(|entry| Ok(entry?.path()));
        let files: io::Result<Vec<_>> = files.collect();
        Ok(files?.into_iter().filter(|path| is_its(path)).collect())
    }
}

fn owned((key, value): (&str, String)) -> (String, String) {
    (key.to_owned(), value)
}

#[cfg(test)]
mod tests {
    use std::sync::mpsc::{channel, sync_channel};

    use super::*;
    use cara_recording::{Reading, event_of};

    const LONG: Duration = Duration::from_secs(20);
    const SHORT: Times = Times { after: Duration::ZERO, between: Duration::ZERO, last: Duration::from_millis(20) };

    fn black_box(size: u64, times: Times) -> BlackBox {
        BlackBox(Some(Arc::new(Shared::new(size, times))))
    }

    fn writer(folder: &Path, keep: usize) -> Writer {
        Writer { folder: folder.to_owned(), keep, prefix: "agv-7-s_unit-0-".to_owned(), about: BTreeMap::new() }
    }

    fn texts(file: &Path) -> Vec<String> {
        let events = Reading::open(file).unwrap().filter_map(|message| event_of(&message));
        let text = |event| if let Answer::Event { text, .. } = event { text } else { String::new() };
        events.map(text).collect()
    }

    #[test]
    fn the_newest_that_fit_are_written_and_as_many_files_are_kept_as_are_wanted() {
        let folder = tempfile::tempdir().unwrap();
        let (box_, writer) = (black_box(2_000, TIMES), writer(folder.path(), 2));
        (0..100).for_each(|number| box_.note("log", None, || number.to_string()));
        let lines = box_.0.as_ref().unwrap().ring.lock().unwrap().lines();
        let foreign = folder.path().join("agv-71-s_unit-0-0000000000000-stop.mcap");
        fs::write(&foreign, "").unwrap();
        fs::write(folder.path().join("agv-7-s_unit-0-1.part"), "").unwrap();
        let written = [Cause::Stop, Cause::Lease, Cause::Reset].map(|cause| {
            std::thread::sleep(Duration::from_millis(2));
            writer.write(cause, &lines).unwrap()
        });
        let texts = texts(&written[2]);
        assert!((5..20).contains(&texts.len()) && texts.last().unwrap() == "99", "{texts:?}");
        let mut left: Vec<_> = fs::read_dir(folder.path()).unwrap().map(|entry| entry.unwrap().path()).collect();
        left.sort();
        assert_eq!(left, [written[1].clone(), written[2].clone(), foreign]);
        fs::write(folder.path().join("file"), "").unwrap();
        let nowhere = Writer { folder: folder.path().join("file"), ..writer };
        assert!(nowhere.write(Cause::Stop, &lines).is_err());
        let too_long = Writer { folder: folder.path().to_owned(), prefix: "x".repeat(300), ..nowhere };
        let error = too_long.write(Cause::Stop, &lines).unwrap_err().to_string();
        assert!(error.contains("File name too long"), "{error}");
    }

    #[test]
    fn a_disk_that_hangs_holds_up_nothing_and_causes_meanwhile_make_one_box() {
        let black_box = black_box(1 << 20, SHORT);
        let ((began, begins), (go_on, hangs)) = (channel(), sync_channel::<()>(0));
        black_box.write_with(
            |_| {},
            move |cause, lines| {
                began.send((cause, lines.len())).unwrap();
                let _ = hangs.recv();
            },
        );
        black_box.note("log", None, || "before".to_owned());
        black_box.freeze(Cause::Stop);
        assert_eq!(begins.recv_timeout(LONG), Ok((Cause::Stop, 1)));
        for cause in [Cause::Error, Cause::Reset] {
            black_box.note("log", None, || "meanwhile".to_owned());
            black_box.freeze(cause);
        }
        black_box.end();
        assert!(begins.try_recv().is_err(), "it hangs");
        drop(go_on);
        assert_eq!(begins.recv_timeout(LONG), Ok((Cause::Error, 3)));
        assert!(begins.recv_timeout(LONG).is_err(), "it has ended");
    }

    /// By command: what an event costs.
    #[test]
    #[ignore = "measures"]
    fn cost_of_an_event() {
        let black_box = black_box(4 << 20, TIMES);
        let started = Instant::now();
        for number in 0..200_000 {
            black_box.note("called", None, || format!("go_to {{\"position\":[{number},2]}}"));
        }
        println!("{} ns an event", started.elapsed().as_nanos() / 200_000);
    }
}
