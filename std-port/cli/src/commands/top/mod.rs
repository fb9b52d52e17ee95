//! `cara top`: what a manager sees, on a screen that follows it.
//!
//! [`App`] is what is known and chosen, and takes news and keys; [`draw`] puts it on the screen; [`feed`] asks the manager;
//! [`terminal`] takes the terminal over and gives it back. One thread draws and reads the channel that all others send to.

mod app;
mod draw;
mod feed;
mod rows;
mod terminal;
#[cfg(test)]
mod terminal_tests;
#[cfg(test)]
mod tests;

use std::io;
use std::process::ExitCode;
use std::sync::atomic::{AtomicI32, Ordering};
use std::sync::mpsc::{Receiver, RecvTimeoutError, sync_channel};
use std::time::{Duration, Instant, SystemTime, UNIX_EPOCH};

use ratatui::crossterm::event::{Event, KeyEventKind};

use self::app::{Act, App, News};
use self::draw::Theme;
use self::feed::Feed;
use self::terminal::Screen;
use crate::operator::{Need, Operator};
use cara_tools::exit::{Ended, Exit};
use cara_tools::global::Global;

/// Messages that wait to be looked at; who sends more waits.
const MESSAGES: usize = 1024;
/// Least time between two screens, while much is told.
const SOONEST: Duration = Duration::from_millis(40);
/// Longest time between two screens: ages and times left go on.
const LATEST: Duration = Duration::from_millis(200);

/// Shows nodes, links, orders, streams, counters and events on the whole terminal, as they change, and takes keys to call,
/// stop and reset. `?` shows the keys.
#[derive(clap::Args)]
pub(crate) struct Arguments {}

/// What wakes the thread that draws.
enum Message {
    News(News),
    Terminal(Event),
    /// The terminal can be read no longer.
    Broken(io::Error),
}

pub(crate) fn run(Arguments {}: Arguments, global: &Global) -> anyhow::Result<ExitCode> {
    if global.json {
        return Err(Ended::usage("a screen has no form in JSON: `cara watch --json` tells what happens"));
    }
    terminal::check()?;
    let mut operator = Operator::open(global, &Need::Nothing)?;
    let unit = operator.unit()?;
    let app = App::new(format!("{}/{}", unit.name, unit.id));
    let (out, messages) = sync_channel(MESSAGES);
    let signal = terminal::signals()?;
    // `NO_COLOR` counts where it is not empty.
    let theme = Theme { colours: std::env::var_os("NO_COLOR").is_none_or(|value| value.is_empty()) };
    let mut screen = Screen::open()?;
    let outcome = Feed::start(operator, out.clone()).and_then(|feed| {
        terminal::read_keys(out)?;
        let outcome = show(app, &feed, &messages, &mut screen, theme, &signal);
        feed.end();
        outcome
    });
    // Before an error is told.
    drop(screen);
    Ok(outcome?.into())
}

/// When the next screen is drawn.
struct Pace {
    drawn: Instant,
    due: Instant,
}

impl Pace {
    fn draw(&mut self, clock: impl Fn() -> Instant, draw: impl FnOnce() -> io::Result<()>) -> io::Result<()> {
        if clock() >= self.due {
            draw()?;
            // Its end counts: a screen may take longer than `SOONEST`, and keys would wait for one screen a message.
            self.drawn = clock();
            self.due = self.drawn + LATEST;
        }
        Ok(())
    }

    fn heard(&mut self) {
        self.due = self.drawn + SOONEST;
    }
}

/// Until it is to end.
fn show(
    mut app: App,
    feed: &Feed,
    messages: &Receiver<Message>,
    screen: &mut Screen,
    theme: Theme,
    signal: &AtomicI32,
) -> io::Result<Exit> {
    let start = Instant::now();
    app.started_ms = SystemTime::now().duration_since(UNIX_EPOCH).unwrap_or_default().as_millis() as u64;
    let mut pace = Pace { drawn: start, due: start };
    loop {
        pace.draw(Instant::now, || {
            screen.terminal.draw(|frame| draw::draw(frame, &app, start.elapsed(), theme)).map(drop)
        })?;
        match messages.recv_timeout(pace.due.saturating_duration_since(Instant::now())) {
            Ok(message) => {
                pace.heard();
                match take(&mut app, message, start.elapsed())? {
                    Some(Act::Quit) => return Ok(Exit::Done),
                    Some(Act::Ask(task, ask)) => feed.act(task, ask),
                    None => {}
                }
                feed.watch(app.watched.as_ref().map(|(node, _)| node.as_str()));
            }
            Err(RecvTimeoutError::Timeout) => {}
            Err(RecvTimeoutError::Disconnected) => return Err(io::Error::other("all threads have ended")),
        }
        match signal.load(Ordering::SeqCst) {
            0 => {}
            signal => return Ok(terminal::exit_of(signal)),
        }
    }
}

fn take(app: &mut App, message: Message, now: Duration) -> io::Result<Option<Act>> {
    match message {
        Message::News(news) => app.reported(news, now),
        Message::Terminal(Event::Key(key)) if key.kind != KeyEventKind::Release => return Ok(app.key(key, now)),
        Message::Terminal(Event::Paste(text)) => app.paste(&text),
        // A new size is seen when the next screen is drawn.
        Message::Terminal(_) => {}
        Message::Broken(error) => return Err(error),
    }
    Ok(None)
}
