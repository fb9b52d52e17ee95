//! Faults between single boards: a board does not receive the frames of one other board, or receives them late. The
//! faults of the switch apply to a whole port.

use std::collections::BTreeMap;

use cara_core::random::Random;
use cara_core::time::{Duration, Instant};
use cara_ethernet::Mac;
use cara_sim::Path;
use smoltcp::wire::{EthernetFrame, EthernetProtocol, IpAddress, IpProtocol, Ipv4Packet, TcpPacket};

/// The source address in a frame.
const SOURCE: std::ops::Range<usize> = 6..12;
/// Both addresses and ports of a TCP segment in a frame.
const FLOW: std::ops::Range<usize> = 26..38;
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

/// The way from one sender, on top of that through the switch.
struct Way {
    from: Mac,
    path: Path,
    /// What was sent before is on the wire by then.
    sent_at: Instant,
    /// What keeps the order arrives no earlier.
    in_order: Instant,
}

/// The rules of one board, and the frames that are held.
pub(crate) struct Gate {
    random: Random,
    rules: Vec<Rule>,
    ways: Vec<Way>,
    held: BTreeMap<(Instant, u64), Vec<u8>>,
    /// The last segment of each stream that the board has heard.
    last: BTreeMap<Vec<u8>, Vec<u8>>,
    sequence: u64,
}

impl Gate {
    pub(crate) fn new(seed: u64) -> Self {
        Self {
            random: Random::new(seed),
            rules: Vec::new(),
            ways: Vec::new(),
            held: BTreeMap::new(),
            last: BTreeMap::new(),
            sequence: 0,
        }
    }

    /// Frames of a sender come over this path from now on.
    pub(crate) fn set_path(&mut self, from: Mac, path: Path) {
        self.ways.retain(|way| way.from != from);
        self.ways.push(Way { from, path, sent_at: Instant::START, in_order: Instant::START });
    }

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
        self.ways.clear();
        self.held.clear();
        self.last.clear();
    }

    /// The frame, unless it is lost or held.
    pub(crate) fn pass(&mut self, now: Instant, frame: Vec<u8>) -> Option<Vec<u8>> {
        self.rules.retain(|rule| rule.until.is_none_or(|until| until > now));
        match self.rules.iter().find(|rule| rule.concerns(&frame)).map(|rule| rule.until) {
            None => self.travel(now, frame),
            Some(None) => None,
            Some(Some(until)) => {
                self.hold(until, frame);
                None
            }
        }
    }

    fn hold(&mut self, until: Instant, frame: Vec<u8>) {
        self.sequence += 1;
        self.held.insert((until, self.sequence), frame);
    }

    /// The frame at once where its sender has no path of its own.
    fn travel(&mut self, now: Instant, frame: Vec<u8>) -> Option<Vec<u8>> {
        let random = &mut self.random;
        let Some(way) = self.ways.iter_mut().find(|way| frame.get(SOURCE) == Some(&way.from.0[..])) else {
            return Some(frame);
        };
        let path = way.path;
        let micros = (frame.len() as u64 * 1_000_000).checked_div(path.bytes_per_second).unwrap_or(0);
        way.sent_at = way.sent_at.max(now) + Duration::from_micros(micros);
        if path.loss.hits(random) {
            return None;
        }
        let mut at = way.sent_at + path.delay + random.jitter(path.jitter);
        if !path.reorder.hits(random) {
            at = at.max(way.in_order);
            way.in_order = at;
        }
        if path.duplicate.hits(random) {
            self.hold(at, frame.clone());
        }
        self.hold(at, frame);
        None
    }

    /// The board hears a frame.
    pub(crate) fn hear(&mut self, frame: &[u8]) {
        if let Some(flow) = frame.get(FLOW).filter(|_| frame.get(PROTOCOL) == Some(&TCP)) {
            self.last.insert(flow.to_vec(), frame.to_vec());
        }
    }

    /// The board hears resets of its streams: of all, or of those from one sender.
    pub(crate) fn reset(&mut self, now: Instant, from: Option<Mac>) {
        let of_sender = |frame: &&Vec<u8>| from.is_none_or(|from| frame.get(SOURCE) == Some(&from.0[..]));
        let resets: Vec<Vec<u8>> = self.last.values().filter(of_sender).filter_map(|frame| reset_of(frame)).collect();
        self.last.clear();
        resets.into_iter().for_each(|frame| self.hold(now, frame));
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

/// A reset by the sender of a segment, right behind it.
fn reset_of(frame: &[u8]) -> Option<Vec<u8>> {
    let mut reset = frame.to_vec();
    let mut ethernet = EthernetFrame::new_checked(&mut reset[..]).ok()?;
    if ethernet.ethertype() != EthernetProtocol::Ipv4 {
        return None;
    }
    let mut packet = Ipv4Packet::new_checked(ethernet.payload_mut()).ok()?;
    if packet.next_header() != IpProtocol::Tcp {
        return None;
    }
    let (from, to) = (IpAddress::from(packet.src_addr()), IpAddress::from(packet.dst_addr()));
    let mut segment = TcpPacket::new_checked(packet.payload_mut()).ok()?;
    let next = segment.seq_number() + segment.segment_len();
    segment.set_seq_number(next);
    segment.clear_flags();
    segment.set_rst(true);
    segment.fill_checksum(&from, &to);
    Some(reset)
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
        let mut gate = Gate::new(1);
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
    fn a_path_has_its_own_delay_and_pace() {
        let mut gate = Gate::new(1);
        let path = Path { bytes_per_second: 1_000, ..Path::LAN.delay(Duration::from_millis(5)).jitter(Duration::ZERO) };
        gate.set_path(SENDER, path);
        for _ in 0..2 {
            assert_eq!(gate.pass(Instant::START, frame(17)), None);
        }
        let at = |millis: u64| Instant::from_micros(millis * 1_000);
        assert_eq!((gate.take(at(64)), gate.take(at(65))), (None, Some(frame(17))));
        assert_eq!((gate.take(at(124)), gate.take(at(125))), (None, Some(frame(17))));
        gate.set_path(SENDER, path.loss_percent(100.0));
        assert_eq!((gate.pass(at(200), frame(17)), gate.next()), (None, None));
    }

    #[test]
    fn a_cut_loses_one_sender_until_it_heals() {
        let mut gate = Gate::new(1);
        gate.add(Rule { from: SENDER, until: None, tcp_only: false });
        let mut other = frame(17);
        other[SOURCE.start] ^= 1;
        assert_eq!(gate.pass(Instant::START, frame(17)), None);
        assert!(gate.pass(Instant::START, other).is_some());
        gate.heal();
        assert!(gate.pass(Instant::START, frame(17)).is_some());
    }
}
