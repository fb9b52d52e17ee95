//! Invariants of the node, whatever a port and its peers do, compared with a simple model of its links.

use std::collections::{BTreeMap, BTreeSet};

use proptest::prelude::*;

use super::*;

const LINKS: u16 = 8;
const MAXIMUM: u16 = 3;

#[derive(Clone, Copy, Debug)]
enum Step {
    /// A new link with a hello of this peer and boot.
    Hello { peer: u8, life: u64 },
    /// The n-th open link ends, counted round and round.
    End(usize),
    /// The n-th open link answers a challenge, whether it was challenged or not.
    Answer(usize),
    /// A peer that this unit dials answers.
    Heard(u8),
    /// Time passes.
    Wait(u64),
}

fn step() -> impl Strategy<Value = Step> {
    prop_oneof![
        3 => (0u8..6, 1u64..3).prop_map(|(peer, life)| Step::Hello { peer, life }),
        2 => any::<usize>().prop_map(Step::End),
        1 => any::<usize>().prop_map(Step::Answer),
        1 => (0u8..6).prop_map(Step::Heard),
        2 => (0u64..2_000).prop_map(Step::Wait),
    ]
}

fn peer(number: u8, life: u64) -> NodeConfig<SocketAddr> {
    let id = u32::from(number) + 3;
    let config = if number.is_multiple_of(2) { m_unit("m", id + 10) } else { s_unit("s", id) };
    NodeConfig { epoch: Epoch(life), ..config }
}

#[derive(Clone, Copy, Debug, PartialEq)]
enum Open {
    Dialed,
    Waiting,
    Joined,
}

/// A port: its open links, whose they are, and their states.
struct Port {
    node: Node<InMemory>,
    now: Instant,
    open: BTreeMap<u16, (u8, Open)>,
    /// Links that were asked whether they live, and have not answered yet.
    challenged: BTreeSet<u16>,
}

impl Port {
    fn new(nodes: usize) -> Self {
        let storage =
            NodeStorage { nodes: slice(nodes), order: slice(nodes), links: slice(LINKS.into()), findings: slice(2) };
        let mut node = Node::new(at(0), m_unit(MANAGER, MANAGER_ID), storage);
        node.set_maximum_nodes(MAXIMUM);
        Self { node, now: at(0), open: BTreeMap::new(), challenged: BTreeSet::new() }
    }

    fn free(&self) -> Option<u16> {
        (0..LINKS).find(|link| !self.open.contains_key(link))
    }

    fn step(&mut self, step: Step) {
        match step {
            Step::Hello { peer: number, life } => {
                let dialed = self.open.iter().find(|(_, open)| **open == (number, Open::Dialed)).map(|(link, _)| *link);
                if let Some(link) = dialed.or_else(|| self.free()) {
                    self.hello(link, number, life);
                }
            }
            Step::End(number) => {
                if let Some(link) = self.choose(number) {
                    self.end(link);
                }
            }
            Step::Answer(number) => {
                if let Some(link) = self.choose(number) {
                    self.challenged.remove(&link);
                    self.node.challenge_answered(self.now, LinkId(link));
                }
            }
            Step::Heard(number) => {
                let bytes =
                    announce_bytes(&announce_of(&peer(number, 1), self.now.as_micros() as u32, self.node.search.nonce));
                self.node.hear(self.now, address(u32::from(number), 7_001), &bytes);
            }
            Step::Wait(millis) => self.now = self.now + Duration::from_millis(millis),
        }
        while let Some(command) = self.node.poll(self.now, &mut Outbox::default(), &Plain) {
            self.act(command);
        }
        assert!(self.node.next_deadline() > self.now);
        self.check();
    }

    fn choose(&self, number: usize) -> Option<u16> {
        self.open.keys().copied().nth(number % self.open.len().max(1))
    }

    fn hello(&mut self, link: u16, number: u8, life: u64) {
        let joined = self.joined(number);
        let hello = hello_of(&peer(number, life));
        match self.node.admit(self.now, LinkId(link), address(u32::from(number), 40_000), &hello) {
            Admission::Accept => {
                assert_eq!(joined, None, "a second link of one identity was taken");
                self.open.insert(link, (number, Open::Joined));
            }
            Admission::Wait => {
                assert!(joined.is_some());
                self.open.insert(link, (number, Open::Waiting));
            }
            Admission::Refuse(_) => {
                self.open.insert(link, (number, Open::Dialed));
                self.end(link);
            }
        }
    }

    fn joined(&self, number: u8) -> Option<u16> {
        self.open.iter().find(|(_, open)| **open == (number, Open::Joined)).map(|(link, _)| *link)
    }

    fn end(&mut self, link: u16) {
        self.open.remove(&link);
        self.challenged.remove(&link);
        self.node.left(self.now, LinkId(link), CloseReason::Reset);
    }

    fn act(&mut self, command: Command<SocketAddr>) {
        match command {
            Command::Dial { identity, .. } => {
                let number = (0..6).find(|number| Some(peer(*number, 1).identity) == identity).unwrap();
                assert_eq!(self.joined(number), None, "a connected node is dialled");
                match self.free() {
                    Some(link) => {
                        self.open.insert(link, (number, Open::Dialed));
                        self.node.dialing(identity.as_ref(), LinkId(link));
                    }
                    None => self.node.dial_failed(self.now, identity.as_ref()),
                }
            }
            Command::Notify(link, directive) => self.reported(link.0, directive),
        }
    }

    fn reported(&mut self, link: u16, directive: Directive) {
        let open = self.open.get_mut(&link).unwrap();
        match directive {
            Directive::Challenge => {
                assert_eq!(open.1, Open::Joined);
                self.challenged.insert(link);
            }
            Directive::Yield => assert_eq!(open.1, Open::Joined),
            Directive::Admit => {
                assert_eq!(open.1, Open::Waiting, "only who waits is taken");
                open.1 = Open::Joined;
            }
            Directive::Refuse(_) => {
                assert_eq!(open.1, Open::Waiting);
                self.end(link);
            }
            Directive::Close(_) => {
                assert_eq!(open.1, Open::Joined);
                assert!(self.challenged.contains(&link), "who answers keeps its place");
                self.end(link);
            }
        }
    }

    fn check(&self) {
        let joined: Vec<_> = self.open.iter().filter(|(_, open)| open.1 == Open::Joined).collect();
        for (link, (number, _)) in &joined {
            let known = self.node.node_of(LinkId(**link)).unwrap();
            assert_eq!((&known.identity, known.link()), (&peer(*number, 1).identity, Some(LinkId(**link))));
        }
        assert_eq!(self.node.connected(), joined.len());
        assert_eq!(self.node.number_of_s_units() + self.node.number_of_m_units(), joined.len());
        assert_eq!(self.node.nodes().filter(|known| known.is_joined()).count(), joined.len());
        assert!(joined.len() <= usize::from(MAXIMUM));
    }
}

proptest! {
    #[test]
    fn the_books_agree_whatever_happens(steps in prop::collection::vec(step(), 1..80), nodes in 4usize..8) {
        let mut port = Port::new(nodes);
        for step in steps {
            port.step(step);
        }
        while let Some(link) = port.open.keys().next().copied() {
            port.end(link);
        }
        prop_assert_eq!(port.node.connected(), 0);
    }
}

/// A unit, and one that runs with its name and id: all that can happen to them, in all orders.
#[test]
fn of_two_twins_the_one_that_answers_stays_whatever_the_order() {
    const STEPS: [Step; 7] = [
        Step::Hello { peer: 1, life: 1 },
        Step::Hello { peer: 1, life: 2 },
        Step::Answer(0),
        Step::Answer(1),
        Step::End(0),
        Step::End(1),
        Step::Wait(350),
    ];
    const LENGTH: u32 = 6;
    for order in 0..STEPS.len().pow(LENGTH) {
        let mut port = Port::new(4);
        (0..LENGTH).for_each(|place| port.step(STEPS[order / STEPS.len().pow(place) % STEPS.len()]));
    }
}
