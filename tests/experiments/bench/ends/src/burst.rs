//! One-way messages at a fixed period, as the sender sees them.

use std::collections::BTreeMap;
use std::thread;
use std::time::{Duration, Instant};

use serde::{Deserialize, Serialize};

use crate::block::text;
use crate::clock;
use crate::peer::{Caller, Delivery};

/// What a client process is told to offer.
#[derive(Debug, Clone, Serialize, Deserialize)]
pub struct Burst {
    /// Length of the text.
    pub chars: u32,
    /// How many messages.
    pub count: u32,
    /// From one offer to the next.
    pub period_ms: u64,
    /// How they travel.
    pub delivery: Delivery,
    /// A message that is refused is offered again until it is taken.
    pub insist: bool,
}

/// What became of it on the sender's side.
#[derive(Debug, Clone, Default, Serialize, Deserialize)]
pub struct Offered {
    /// Taken by the middleware.
    pub taken: u64,
    /// Not taken, and told so.
    pub refused: u64,
    /// How often each refusal was given.
    pub reasons: BTreeMap<String, u64>,
    /// When the first was offered, on the clock of [`clock::now`].
    pub start: u64,
}

/// Offers the messages of a burst, each at its time; one that is late does not delay those after it.
pub(crate) fn offer(caller: &mut dyn Caller, burst: &Burst) -> Offered {
    let text = text(burst.chars);
    let mut offered = Offered { start: clock::now(), ..Offered::default() };
    let start = Instant::now();
    for index in 0..burst.count {
        let due = start + Duration::from_millis(burst.period_ms) * index;
        thread::sleep(due.saturating_duration_since(Instant::now()));
        while let Err(reason) = caller.send(&text, burst.delivery) {
            offered.refused += 1;
            *offered.reasons.entry(without_numbers(&reason)).or_default() += 1;
            if !burst.insist {
                break;
            }
            thread::yield_now();
        }
    }
    caller.flush();
    let count = u64::from(burst.count);
    offered.taken = if burst.insist { count } else { count - offered.refused };
    offered
}

/// The kind of a refusal: its text with an N for each number, which differs from one to the next.
fn without_numbers(reason: &str) -> String {
    let mut kind = String::new();
    for c in reason.chars() {
        match c.is_ascii_digit() {
            true if kind.ends_with('N') => {}
            true => kind.push('N'),
            false => kind.push(c),
        }
    }
    kind
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn refusals_are_grouped_by_kind() {
        assert_eq!(without_numbers("wait 1203 µs of 2 ms"), "wait N µs of N ms");
    }

    /// Refuses every second message.
    struct Moody(u32);

    impl Caller for Moody {
        fn echo(&mut self, text: &str) -> anyhow::Result<usize> {
            Ok(text.len())
        }

        fn send(&mut self, _: &str, _: Delivery) -> Result<(), String> {
            self.0 += 1;
            if self.0.is_multiple_of(2) { Err("full".into()) } else { Ok(()) }
        }
    }

    fn burst(insist: bool) -> Burst {
        Burst { chars: 1, count: 10, period_ms: 0, delivery: Delivery::Reliable, insist }
    }

    #[test]
    fn what_is_refused_is_told_apart() {
        let offered = offer(&mut Moody(0), &burst(false));
        assert_eq!((offered.taken, offered.refused), (5, 5));
        assert_eq!(offered.reasons["full"], 5);
    }

    #[test]
    fn who_insists_offers_again() {
        let offered = offer(&mut Moody(0), &burst(true));
        assert_eq!((offered.taken, offered.refused), (10, 9));
    }
}
