//! A panic, which nothing from outside may cause, on a pseudo-terminal: this program starts itself on it.

use std::io::{Read, stdin};
use std::process::Command;
use std::thread::{Builder, sleep};
use std::time::Duration;

use ratatui::text::Text;

use super::terminal::Screen;

#[path = "../../../tests/cara/terminal.rs"]
#[expect(dead_code, reason = "other tests need more of it")]
mod pseudo;

/// Which thread is to panic, in the process that does.
const PANICS: &str = "CARA_TEST_PANICS";
const NAME: &str = "commands::top::terminal_tests::a_panic_gives_the_terminal_back_and_is_told";

#[test]
fn a_panic_gives_the_terminal_back_and_is_told() {
    if let Ok(thread) = std::env::var(PANICS) {
        panic_on_a_screen(&thread);
    }
    for thread in ["drawing", "asking"] {
        let mut command = Command::new(std::env::current_exe().unwrap());
        command.args(["--exact", NAME, "--nocapture"]).env(PANICS, thread).env("TERM", "xterm-256color");
        // A backtrace would push what is looked for off the screen.
        command.env("RUST_BACKTRACE", "0");
        let mut terminal = pseudo::OnTerminal::start(&command);
        terminal.shows("a screen");
        let screen = terminal.screen();
        assert!(screen.alternate_screen() && screen.hide_cursor() && screen.bracketed_paste());
        assert!(terminal.of_keys().is_empty());
        terminal.type_in("x");
        assert_eq!(terminal.ends_restored(), 1);
        // On the screen that is left.
        let reported = terminal.screen().contents();
        assert!(reported.contains(&format!("the {thread} thread is broken")), "{reported}");
    }
}

/// Takes the terminal over, and panics after a key.
fn panic_on_a_screen(thread: &str) -> ! {
    let mut screen = Screen::open().unwrap();
    screen.terminal.draw(|frame| frame.render_widget(Text::raw("a screen"), frame.area())).unwrap();
    stdin().read_exact(&mut [0]).unwrap();
    if thread == "drawing" {
        panic!("the {thread} thread is broken");
    }
    let thread = thread.to_owned();
    Builder::new().spawn(move || panic!("the {thread} thread is broken")).unwrap();
    loop {
        sleep(Duration::from_secs(1));
    }
}
