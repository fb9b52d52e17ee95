//! The terminal: taken over as a whole, and given back however the command ends.

use std::io::{self, IsTerminal, Stdout, stdout};
use std::sync::Arc;
use std::sync::atomic::{AtomicI32, Ordering};
use std::sync::mpsc::SyncSender;
use std::thread::{Builder, sleep};
use std::time::Duration;

use cara_tools::exit::{Ended, Exit};
use ratatui::Terminal;
use ratatui::backend::CrosstermBackend;
use ratatui::crossterm::cursor::Show;
use ratatui::crossterm::event::{DisableBracketedPaste, EnableBracketedPaste, read};
use ratatui::crossterm::execute;
use ratatui::crossterm::terminal::{EnterAlternateScreen, LeaveAlternateScreen, disable_raw_mode, enable_raw_mode};
use signal_hook::consts::{SIGHUP, SIGINT, SIGTERM};
use signal_hook::iterator::Signals;

use super::Message;

/// How long the thread that draws has to end by itself after a signal; it may wait for a terminal that takes nothing.
const PATIENCE: Duration = Duration::from_secs(1);
/// What a shell adds to the number of a signal.
const SHELL: i32 = 128;

/// An error where there is no terminal that can be drawn on.
pub(super) fn check() -> anyhow::Result<()> {
    let what = match std::env::var("TERM") {
        _ if !stdout().is_terminal() => "standard output is no terminal",
        _ if !io::stdin().is_terminal() => "standard input is no terminal",
        Ok(term) if term == "dumb" => "this terminal (TERM=dumb) cannot be drawn on",
        Ok(term) if !term.is_empty() => return Ok(()),
        _ => "which terminal this is, is not known (TERM is not set)",
    };
    Err(Ended::usage(format!("{what}: `cara watch` shows what happens line by line, `cara scan` the nodes")))
}

/// The terminal while it is taken over.
pub(super) struct Screen {
    pub(super) terminal: Terminal<CrosstermBackend<Stdout>>,
}

impl Screen {
    pub(super) fn open() -> io::Result<Self> {
        // A panic of any thread ends the command: its text would be lost on the other screen, and nothing is drawn behind it.
        let report = std::panic::take_hook();
        std::panic::set_hook(Box::new(move |panic| {
            restore();
            report(panic);
            std::process::exit(Exit::Failed as i32);
        }));
        enable_raw_mode()?;
        let opened = execute!(stdout(), EnterAlternateScreen, EnableBracketedPaste)
            .and_then(|()| Terminal::new(CrosstermBackend::new(stdout())));
        match opened {
            Ok(terminal) => Ok(Self { terminal }),
            Err(error) => {
                restore();
                Err(error)
            }
        }
    }
}

impl Drop for Screen {
    fn drop(&mut self) {
        restore();
    }
}

/// Each step for itself: a terminal that has gone takes none of them.
fn restore() {
    let _ = execute!(stdout(), DisableBracketedPaste, LeaveAlternateScreen, Show);
    let _ = disable_raw_mode();
}

/// Sends what is typed.
pub(super) fn read_keys(out: SyncSender<Message>) -> io::Result<()> {
    Builder::new().name("keys".into()).spawn(move || {
        loop {
            let message = read().map_or_else(Message::Broken, Message::Terminal);
            let is_over = matches!(message, Message::Broken(_));
            if out.send(message).is_err() || is_over {
                return;
            }
        }
    })?;
    Ok(())
}

/// The number of the signal that asks the command to end; 0 while none has come.
pub(super) fn signals() -> io::Result<Arc<AtomicI32>> {
    let came = Arc::new(AtomicI32::new(0));
    let mut signals = Signals::new([SIGINT, SIGTERM, SIGHUP])?;
    let note = came.clone();
    Builder::new().name("signals".into()).spawn(move || {
        if let Some(signal) = signals.forever().next() {
            note.store(signal, Ordering::SeqCst);
            sleep(PATIENCE);
            // Standard output may be taken by a thread that waits for the terminal.
            let _ = disable_raw_mode();
            std::process::exit(SHELL.saturating_add(signal));
        }
    })?;
    Ok(came)
}

/// How the command ends because of a signal.
pub(super) fn exit_of(signal: i32) -> Exit {
    if signal == SIGINT { Exit::Interrupted } else { Exit::Terminated }
}
