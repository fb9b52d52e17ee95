//! What happens at a chip's pins and cable, by its own clock, as its emulator tells.

use std::io::{BufRead, BufReader, Read};
use std::sync::{Arc, Condvar, Mutex, MutexGuard, PoisonError};
use std::time::Instant;

use anyhow::{Context, Result, bail};

use crate::board::LONG;

/// Something that happened.
#[derive(Clone, Debug)]
pub(crate) struct Event {
    /// The number of the line behind it.
    pub(super) line: usize,
    /// In µs since the chip started.
    pub(super) at: u64,
    pub(super) what: String,
}

impl Event {
    /// µs from another event to this one.
    pub(super) fn since(&self, earlier: &Self) -> u64 {
        self.at.saturating_sub(earlier.at)
    }

    /// Whether it is a frame to the board with something for its unit in it.
    pub(super) fn has_payload(&self) -> bool {
        self.what.starts_with("to ") && !self.what.ends_with(" 0")
    }

    /// Whether it is a segment of a connection, to the board.
    pub(super) fn is_segment(&self) -> bool {
        self.what.starts_with("to tcp")
    }
}

/// All that happened so far.
#[derive(Clone, Default)]
pub(crate) struct Events {
    shared: Arc<(Mutex<Vec<Event>>, Condvar)>,
}

impl Events {
    /// Keeps what is read until it ends; what is no event is an error of the emulator, and shown.
    pub(crate) fn read(from: impl Read + Send + 'static) -> Self {
        let events = Self::default();
        let kept = events.clone();
        std::thread::spawn(move || {
            for text in BufReader::new(from).lines().map_while(Result::ok) {
                let event = text.split_once(' ').and_then(|(at, what)| Some((at.parse().ok()?, what.to_owned())));
                let Some((at, what)) = event else {
                    eprintln!("rp2040js: {text}");
                    continue;
                };
                let mut events = kept.lock();
                let line = events.len() + 1;
                events.push(Event { line, at, what });
                kept.shared.1.notify_all();
            }
        });
        events
    }

    /// Waits for the motors' enable to go on or off, at or behind line `from`.
    pub(super) fn motors(&self, from: usize, on: bool) -> Result<Event> {
        let what = format!("{MOTORS} {}", u8::from(on));
        let deadline = Instant::now() + LONG;
        let mut events = self.lock();
        loop {
            if let Some(event) = events.iter().skip(from).find(|event| event.what == what) {
                return Ok(event.clone());
            }
            let left = deadline.saturating_duration_since(Instant::now());
            if left.is_zero() {
                bail!("no `{what}` behind line {from} of {:?}", events.iter().map(|event| &event.what));
            }
            events = self.shared.1.wait_timeout(events, left).unwrap_or_else(PoisonError::into_inner).0;
        }
    }

    /// How often the motors' enable went on or off.
    pub(super) fn count_of_motors(&self) -> usize {
        self.lock().iter().filter(|event| event.what.starts_with(MOTORS)).count()
    }

    /// The last event ahead of another one that `wanted` accepts.
    pub(super) fn last_before(&self, event: &Event, wanted: impl Fn(&Event) -> bool) -> Result<Event> {
        let events = self.lock();
        let before = events.iter().take(event.line - 1).rev().find(|event| wanted(event));
        before.cloned().with_context(|| format!("nothing before {event:?}"))
    }

    fn lock(&self) -> MutexGuard<'_, Vec<Event>> {
        self.shared.0.lock().unwrap_or_else(PoisonError::into_inner)
    }
}

/// The pin that enables the motors (`examples/firmware/rp/src/motor.rs`).
const MOTORS: &str = "pin 15";
