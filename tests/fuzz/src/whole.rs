//! A whole unit by a script: links are accepted, dialled and cut, datagrams come, calls are made, motors move, time passes.

use cara_core::config::Mode;

use crate::discovery::{self, Heard};
use crate::play::Play;
use crate::script::Script;
use crate::unit::{LINKS, ROOTS};

pub(crate) fn run(data: &[u8]) {
    let mut script = Script::new(data);
    let mode = if script.byte() > 0xE0 { Mode::Secured } else { Mode::Plain };
    let mut play = Play::new(&mut script, mode);
    let mut heard = Heard::default();
    while !script.is_over() {
        let index = usize::from(script.below(LINKS as u8));
        match script.below(24) {
            0..16 => play.step(&mut script, index),
            16 | 17 => discovery::step(&mut script, &mut play, &mut heard),
            18 => {
                for index in 0..LINKS {
                    play.carry(index);
                }
            }
            19 => {
                if let Some(link) = &mut play.unit.links[index] {
                    link.is_loose = true;
                }
                play.arrive(index, script.bytes());
            }
            _ if play.unit.links[index].is_some() => {}
            20..23 => {
                let who = script.below(6);
                let hello = play.hello(if who == 5 { 0 } else { who });
                let dialed = !play.is_manager() && script.flag();
                play.join(index, dialed, hello);
            }
            _ => {
                let (who, root) = (script.below(6), ROOTS[usize::from(script.flag())]);
                let hello = play.hello(who);
                play.open(index, script.flag(), hello, root);
            }
        }
        play.unit.settle();
        play.forget();
    }
    play.end();
}
