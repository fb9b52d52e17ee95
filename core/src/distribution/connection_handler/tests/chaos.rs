//! Everything that a port and a network can do to a node, in any order, and what must hold after each step.

use proptest::prelude::*;

use super::*;

#[derive(Clone, Debug)]
enum Step {
    Wait(u64),
    /// Wait until the next deadline.
    Next,
    WhoHas {
        who: u8,
        epoch: u64,
        sequence: u32,
        port: u16,
    },
    Announce {
        who: u8,
        epoch: u64,
        sequence: u32,
        port: u16,
        own_question: bool,
        room: u16,
    },
    Admit {
        who: u8,
        epoch: u64,
        link: u16,
    },
    Answered(u16),
    Left(u16, u8),
    Broadcast,
    Maximum(u16),
}

fn step() -> impl Strategy<Value = Step> {
    let heard = || (0u8..6, 1u64..4, 0u32..4, prop::sample::select(std::vec![0u16, 7_000, 7_001]));
    prop_oneof![
        2 => (0u64..5_000).prop_map(Step::Wait),
        4 => Just(Step::Next),
        2 => heard().prop_map(|(who, epoch, sequence, port)| Step::WhoHas { who, epoch, sequence, port }),
        2 => (heard(), any::<bool>(), 0u16..3).prop_map(|((who, epoch, sequence, port), own_question, room)| {
            Step::Announce { who, epoch, sequence, port, own_question, room }
        }),
        4 => (0u8..6, 1u64..4, 0u16..6).prop_map(|(who, epoch, link)| Step::Admit { who, epoch, link }),
        1 => (0u16..6).prop_map(Step::Answered),
        4 => (0u16..6, 0u8..4).prop_map(|(link, reason)| Step::Left(link, reason)),
        1 => Just(Step::Broadcast),
        1 => (1u16..5).prop_map(Step::Maximum),
    ]
}

fn who_is(who: u8, epoch: u64, port: u16) -> NodeConfig<SocketAddr> {
    let config = match who {
        0 => m_unit(MANAGER, MANAGER_ID),
        1 => m_unit("smaller", 1),
        2 => m_unit("larger", 9),
        _ => s_unit("agv", u32::from(who)),
    };
    NodeConfig { epoch: Epoch(epoch), tcp_port: port, ..config }
}

/// A correct port in a hostile network.
struct Port {
    node: Node<InMemory>,
    now: Instant,
    outbox: Outbox,
    /// Open links: admitted, waiting or being dialled.
    open: std::collections::BTreeSet<u16>,
}

impl Port {
    fn poll(&mut self, dial: u64) {
        let mut actions = 0;
        while let Some(command) = self.node.poll(self.now, &mut self.outbox, &Plain) {
            actions += 1;
            assert!(actions < 100, "polling ends");
            self.act(command, dial);
        }
        assert!(self.node.next_deadline() > self.now, "nothing due remains after a poll");
    }

    fn act(&mut self, command: Command<SocketAddr>, dial: u64) {
        match command {
            Command::Dial { identity, .. } => {
                let free = (6..12).find(|link| !self.open.contains(link));
                match (dial % 3, free) {
                    (0, _) | (_, None) => self.node.dial_failed(self.now, identity.as_ref()),
                    (1, Some(link)) => {
                        self.node.dialing(identity.as_ref(), LinkId(link));
                        self.open.insert(link);
                    }
                    // The port does not report anything.
                    (_, Some(_)) => {}
                }
            }
            Command::Notify(link, directive) => {
                assert!(self.open.contains(&link.0), "{link:?} is told {directive:?}");
                match directive {
                    Directive::Challenge | Directive::Yield => {}
                    Directive::Admit => {
                        let known = self.node.node_of(link).expect("who is admitted has joined");
                        assert_eq!(known.link(), Some(link));
                    }
                    Directive::Refuse(refusal) => self.left(link.0, CloseReason::Refused(refusal)),
                    Directive::Close(reason) => self.left(link.0, reason),
                }
            }
        }
    }

    fn left(&mut self, link: u16, reason: CloseReason) {
        self.open.remove(&link);
        self.node.left(self.now, LinkId(link), reason);
    }

    fn step(&mut self, step: &Step) {
        match *step {
            Step::Wait(millis) => self.now = self.now + Duration::from_millis(millis),
            Step::Next => {
                let next = self.node.next_deadline();
                if next != Instant::FAR_FUTURE {
                    self.now = self.now.max(next);
                }
            }
            Step::WhoHas { who, epoch, sequence, port } => {
                let search = search_of(&who_is(who, epoch, port), sequence);
                self.node.hear(self.now, address(u32::from(who) + 1, 7_001), &who_has_bytes(&search));
            }
            Step::Announce { who, epoch, sequence, port, own_question, room } => {
                let nonce = if own_question { self.node.search.nonce } else { 0 };
                let announce = Announce { room, ..announce_of(&who_is(who, epoch, port), sequence, nonce) };
                self.node.hear(self.now, address(u32::from(who) + 1, 7_001), &announce_bytes(&announce));
            }
            Step::Admit { who, epoch, link } => self.admit(who, epoch, link),
            Step::Answered(link) => self.node.challenge_answered(self.now, LinkId(link)),
            Step::Left(link, reason) => {
                let link = if reason % 2 == 0 { link } else { link + 6 };
                let reason = match reason {
                    0 => CloseReason::Silent,
                    1 => CloseReason::DialFailed,
                    2 => CloseReason::Refused(Refusal::DuplicateIdentity),
                    _ => CloseReason::Stopped,
                };
                self.left(link, reason);
            }
            Step::Broadcast => self.node.broadcast(self.now),
            Step::Maximum(maximum) => self.node.set_maximum_nodes(maximum),
        }
    }

    /// A hello arrives on a new link, or on one that was dialled.
    fn admit(&mut self, who: u8, epoch: u64, link: u16) {
        let dialled = link + 6;
        let opening = self.node.node_of(LinkId(dialled)).is_some_and(|known| known.state() == NodeState::Dialing);
        let link = if self.open.contains(&dialled) && opening { dialled } else { link };
        if link < 6 && self.open.contains(&link) {
            return;
        }
        self.open.insert(link);
        let hello = hello_of(&who_is(who, epoch, 7_000));
        match self.node.admit(self.now, LinkId(link), address(u32::from(who) + 1, 40_000), &hello) {
            Admission::Accept => {
                let known = self.node.node_of(LinkId(link)).expect("who is accepted has joined");
                assert_eq!(known.identity, hello.identity);
            }
            Admission::Refuse(refusal) => self.left(link, CloseReason::Refused(refusal)),
            Admission::Wait => {}
        }
    }

    fn check(&self) {
        let joined: Vec<_> = self.node.nodes().filter_map(Known::link).collect();
        assert_eq!(joined.len(), self.node.connected());
        let mut different = joined.clone();
        different.sort();
        different.dedup();
        assert_eq!(different.len(), joined.len(), "each link belongs to one node");
        for known in self.node.nodes().filter(|known| known.is_joined()) {
            assert_eq!(self.node.node(&known.identity), Some(known));
            assert_eq!(self.node.node_of(known.link().unwrap()), Some(known));
        }
        if self.node.identity().role() == Role::SUnit && joined.is_empty() {
            assert!(self.node.next_deadline() < Instant::FAR_FUTURE, "a unit without its manager looks for it");
        }
        assert!(self.outbox.broadcasts.len() < 1_000);
    }
}

proptest! {
    #![proptest_config(ProptestConfig::with_cases(1_000))]
    #[test]
    fn a_node_stays_consistent_and_never_spins(
        kind in 0u8..3,
        steps in prop::collection::vec((step(), any::<u64>()), 1..80),
    ) {
        let config = match kind {
            0 => m_unit(MANAGER, MANAGER_ID),
            1 => s_unit("agv", 77),
            _ => NodeConfig { target: Target::Fixed(manager(), address(1, 7_000)), ..s_unit("agv", 77) },
        };
        let node = Node::new(at(0), config, storage(6));
        let mut port = Port { node, now: at(0), outbox: Outbox::default(), open: Default::default() };
        for (step, dial) in &steps {
            port.step(step);
            port.poll(*dial);
            port.check();
        }
    }
}
