//! Links that have joined, whose peers say anything.

use cara_core::config::Mode;

use crate::play::Play;
use crate::script::Script;

pub(crate) fn plain(data: &[u8]) {
    run(data, Mode::Plain);
}

pub(crate) fn sealed(data: &[u8]) {
    run(data, Mode::Secured);
}

fn run(data: &[u8], mode: Mode) {
    let mut script = Script::new(data);
    let mut play = Play::new(&mut script, mode);
    join(&mut play);
    while !script.is_over() {
        play.step(&mut script, 0);
        if play.peers[0].is_none() {
            join(&mut play);
        }
    }
    play.end();
}

/// The vehicle dials.
fn join(play: &mut Play) {
    let dialed = !play.is_manager();
    let hello = play.hello(0);
    play.join(0, dialed, hello);
}
