//! The end of an example: Ctrl-C, SIGTERM, or its work is done.

use std::io::BufRead;
use std::sync::mpsc::{Receiver, RecvTimeoutError, Sender, channel};
use std::time::Duration;

use anyhow::Result;

/// Waits for the end.
pub struct Stop {
    ended: Receiver<Result<()>>,
    stopper: Stopper,
}

/// Brings the end about, from any thread.
#[derive(Clone)]
pub struct Stopper(Sender<Result<()>>);

impl Stopper {
    /// The example ends with this outcome.
    pub fn stop(&self, outcome: Result<()>) {
        // Without a receiver the program is ending already.
        let _ = self.0.send(outcome);
    }
}

impl Stop {
    /// Ends at Ctrl-C and SIGTERM; also when standard input is closed, if `attended`.
    pub fn new(attended: bool) -> Result<Self> {
        Self::hearing(attended, |_| ())
    }

    /// As [`new`](Self::new), and `hear` gets each line of standard input before its end.
    pub fn hearing(attended: bool, mut hear: impl FnMut(&str) + Send + 'static) -> Result<Self> {
        let (sender, ended) = channel();
        let stopper = Stopper(sender);
        let at_signal = stopper.clone();
        ctrlc::set_handler(move || at_signal.stop(Ok(())))?;
        if attended {
            let at_end = stopper.clone();
            std::thread::spawn(move || {
                // What is no text is no line to be heard.
                let lines = std::io::stdin().lock().split(b'\n').map_while(std::result::Result::ok);
                lines.for_each(|line| hear(String::from_utf8_lossy(&line).trim()));
                at_end.stop(Ok(()));
            });
        }
        Ok(Self { ended, stopper })
    }

    /// Another way to end.
    pub fn stopper(&self) -> Stopper {
        self.stopper.clone()
    }

    /// Waits for the end.
    pub fn wait(&self) -> Result<()> {
        // This holds a sender itself, so the channel never closes.
        self.ended.recv().unwrap_or(Ok(()))
    }

    /// Waits for the end or for `time`; `None` when the example goes on.
    pub fn wait_for(&self, time: Duration) -> Option<Result<()>> {
        match self.ended.recv_timeout(time) {
            Ok(outcome) => Some(outcome),
            Err(RecvTimeoutError::Timeout) => None,
            Err(RecvTimeoutError::Disconnected) => Some(Ok(())),
        }
    }
}
