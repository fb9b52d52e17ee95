//! Shows what each line of the listing brought, and lets a person or a program go through it line by line.

use std::fmt::Display;
use std::sync::{Arc, Mutex, PoisonError};

use anyhow::{Result, bail};
use cara_examples::{say, show_events};
use cara_std::CommunicationSystem;

/// What the listing has come to.
#[derive(Clone)]
pub(crate) struct Transcript {
    step: bool,
    unit: Arc<Mutex<Option<CommunicationSystem>>>,
}

impl Transcript {
    /// With `step`, each line waits for a line on standard input.
    pub(crate) fn new(step: bool) -> Self {
        Self { step, unit: Arc::default() }
    }

    /// The unit exists: shows what happens to it.
    pub(crate) fn begin(&self, unit: &CommunicationSystem) {
        show_events(unit.events());
        *self.unit.lock().unwrap_or_else(PoisonError::into_inner) = Some(unit.clone());
    }

    /// Says what came of a line of the paper's listing.
    pub(crate) fn show(&self, line: u32, what: impl Display) {
        say!("line {line}: {what}");
    }

    /// As [`show`](Self::show), then waits if each line is to wait.
    pub(crate) fn after(&self, line: u32, what: impl Display) -> Result<()> {
        self.show(line, what);
        if self.step && std::io::stdin().read_line(&mut String::new())? == 0 {
            bail!("standard input ended behind line {line}");
        }
        Ok(())
    }

    /// Stops the unit, if the listing has come that far.
    pub(crate) fn stop_unit(&self) {
        let unit = self.unit.lock().unwrap_or_else(PoisonError::into_inner).take();
        unit.into_iter().for_each(|unit| unit.stop());
    }
}
