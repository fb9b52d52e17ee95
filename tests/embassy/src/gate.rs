//! What a board is kept from hearing of single other boards; the faults of the switch are those of a whole port.

use std::collections::BTreeMap;

use cara_core::time::Instant;
use cara_ethernet::Mac;

/// Where a frame says who sent it.
const SOURCE: std::ops::Range<usize> = 6..12;
/// Where an IPv4 packet in a frame says what it carries, and what TCP is there.
const PROTOCOL: usize = 23;
const TCP: u8 = 6;

/// What happens to frames of one sender.
pub(crate) struct Rule {
    pub(crate) from: Mac,
    /// They are held until then, instead of lost.
    pub(crate) until: Option<Instant>,
    /// Others than those of TCP pass.
    pub(crate) tcp_only: bool,
}

impl Rule {
    fn concerns(&self, frame: &[u8]) -> bool {
        let tcp = frame.get(PROTOCOL) == Some(&TCP);
        frame.get(SOURCE) == Some(&self.from.0[..]) && (tcp || !self.tcp_only)
    }
}

/// The rules of one board, and the frames that are held.
#[derive(Default)]
pub(crate) struct Gate {
    rules: Vec<Rule>,
    held: BTreeMap<(Instant, u64), Vec<u8>>,
    sequence: u64,
}

impl Gate {
    pub(crate) fn add(&mut self, rule: Rule) {
        self.rules.push(rule);
    }

    /// Ends all losses; what is held stays so.
    pub(crate) fn heal(&mut self) {
        self.rules.retain(|rule| rule.until.is_some());
    }

    /// Forgets everything.
    pub(crate) fn clear(&mut self) {
        self.rules.clear();
        self.held.clear();
    }

    /// The frame, unless it is lost or held.
    pub(crate) fn pass(&mut self, now: Instant, frame: Vec<u8>) -> Option<Vec<u8>> {
        self.rules.retain(|rule| rule.until.is_none_or(|until| until > now));
        match self.rules.iter().find(|rule| rule.concerns(&frame)).map(|rule| rule.until) {
            None => Some(frame),
            Some(None) => None,
            Some(Some(until)) => {
                self.sequence += 1;
                self.held.insert((until, self.sequence), frame);
                None
            }
        }
    }

    /// A frame that has been held long enough.
    pub(crate) fn take(&mut self, now: Instant) -> Option<Vec<u8>> {
        let first = self.held.first_entry()?;
        (first.key().0 <= now).then(|| first.remove())
    }

    /// When the next one is.
    pub(crate) fn next(&self) -> Option<Instant> {
        self.held.keys().next().map(|(until, _)| *until)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const SENDER: Mac = Mac([2, 0, 0, 0, 0, 9]);

    fn frame(protocol: u8) -> Vec<u8> {
        let mut frame = vec![0; 60];
        frame[SOURCE].copy_from_slice(&SENDER.0);
        frame[PROTOCOL] = protocol;
        frame
    }

    #[test]
    fn streams_are_held_in_order_while_datagrams_pass() {
        let mut gate = Gate::default();
        let until = Instant::from_micros(10);
        gate.add(Rule { from: SENDER, until: Some(until), tcp_only: true });
        assert_eq!(gate.pass(Instant::START, frame(17)), Some(frame(17)));
        let (mut first, mut second) = (frame(TCP), frame(TCP));
        (first[40], second[40]) = (1, 2);
        assert_eq!(gate.pass(Instant::START, first.clone()), None);
        assert_eq!(gate.pass(Instant::START, second.clone()), None);
        assert_eq!((gate.take(Instant::START), gate.next()), (None, Some(until)));
        assert_eq!((gate.take(until), gate.take(until), gate.take(until)), (Some(first), Some(second), None));
        assert!(gate.pass(until, frame(TCP)).is_some());
    }

    #[test]
    fn a_cut_loses_one_sender_until_it_heals() {
        let mut gate = Gate::default();
        gate.add(Rule { from: SENDER, until: None, tcp_only: false });
        let mut other = frame(17);
        other[SOURCE.start] ^= 1;
        assert_eq!(gate.pass(Instant::START, frame(17)), None);
        assert!(gate.pass(Instant::START, other).is_some());
        gate.heal();
        assert!(gate.pass(Instant::START, frame(17)).is_some());
    }
}
