//! Scenarios on boards, in virtual time: the embassy port over embassy-net on a switch in memory, and on a serial line between
//! two boards.

mod memory;
mod node;
mod services;
mod visitor;

use std::rc::Rc;

use cara_core::config::Mode;
use cara_core::random::Random;
use cara_core::time::{Duration, Instant};
use cara_embassy_host::{Bench, Faults, Wire};

use self::node::BoardNode;
use self::visitor::Visitor;
use crate::run::Report;
use crate::{Fault, FaultProfile, Need, Port, Spec, Unit, UnknownClient, Unsupported, World};

/// Of the line.
const BAUD: u32 = 1_000_000;
/// Of so many bytes on a line one is changed and one is lost, under the rough profile.
const DAMAGED: u64 = 2_000;

pub(super) struct EmbassyWorld {
    bench: Bench,
    mode: Mode,
    /// In place of the switch.
    wire: Option<Wire>,
    units: Vec<Rc<BoardNode>>,
    random: Random,
    report: Report,
}

impl EmbassyWorld {
    pub(super) fn new(seed: u64, profile: FaultProfile, mode: Mode) -> Self {
        let bench = Bench::new(seed);
        let mut random = Random::new(seed ^ 0x00E3_BA55);
        bench.set_faults(faults(&mut random, profile));
        Self { bench, mode, wire: None, units: Vec::new(), random, report: Report::default() }
    }

    /// Two boards with keys on a serial line.
    pub(super) fn on_line(seed: u64, profile: FaultProfile) -> Self {
        let wire = Wire::new(BAUD, seed);
        wire.set_damage(if profile == FaultProfile::Rough { DAMAGED } else { 0 });
        Self { wire: Some(wire), ..Self::new(seed, profile, Mode::Secured) }
    }

    fn node(&self, unit: &Unit) -> &Rc<BoardNode> {
        &self.units[unit.number()]
    }
}

fn faults(random: &mut Random, profile: FaultProfile) -> Faults {
    let mut percent = |limit: u64| random.below(limit * 100) as f64 / 10_000.0;
    match profile {
        FaultProfile::Own => Faults::NONE,
        _ => Faults {
            loss: if profile == FaultProfile::Rough { percent(2) } else { 0.0 },
            duplication: percent(5),
            // A segment that overtakes another costs smoltcp a retransmission, thus a second, as a lost one does.
            reordering: if profile == FaultProfile::Rough { percent(5) } else { 0.0 },
            delay: Duration::from_micros(250) + random.jitter(Duration::from_millis(2)),
            jitter: random.jitter(Duration::from_millis(2)),
            ..Faults::NONE
        },
    }
}

impl EmbassyWorld {
    fn unknown_client(&mut self, unit: &Unit, client: UnknownClient) {
        let visitor = Visitor::new(&self.bench, self.node(unit).board().address());
        visitor.sends(client.datagrams(0));
        let mut heard = Vec::new();
        for visit in client.visits(&unit.identity(), 0) {
            heard.extend(visitor.pays(&self.bench, visit));
        }
        if client.is_reported().is_some_and(|reported| reported == heard) {
            self.reached("client was told");
        }
        if let UnknownClient::Silent(count) = client {
            visitor.stays(count);
        }
    }
}

impl EmbassyWorld {
    fn inject_into_line(&mut self, wire: &Wire, fault: Fault<'_>) -> Result<(), Unsupported> {
        let pull = |to: &Unit| wire.pull(to.number(), true);
        match fault {
            Fault::PowerCut(unit) | Fault::Kill(unit) => self.node(unit).cut_power(),
            Fault::Restart(unit) => self.node(unit).boot(),
            Fault::Cut(one, other) => [one, other].into_iter().for_each(pull),
            Fault::CutOneWay(_, to) => pull(to),
            Fault::Heal => [0, 1].into_iter().for_each(|end| wire.pull(end, false)),
            Fault::Suspend(unit, span) => self.node(unit).board().suspend(span),
            Fault::FreezeStreams(..) => return Err(Unsupported(Need::Freeze)),
            Fault::FreezeLink(..) => return Err(Unsupported(Need::FreezeLink)),
            Fault::ChangeAddress(_) => return Err(Unsupported(Need::AddressChange)),
            Fault::Reset(_) => return Err(Unsupported(Need::Reset)),
            Fault::Path(..) => return Err(Unsupported(Need::Path)),
            Fault::SlowReader(..) => return Err(Unsupported(Need::SlowReader)),
            Fault::UnknownClient(..) => return Err(Unsupported(Need::UnknownClients)),
            Fault::Unplug(_) | Fault::Plug(_) => return Err(Unsupported(Need::Interface)),
        }
        Ok(())
    }
}

impl World for EmbassyWorld {
    fn port(&self) -> Port {
        if self.wire.is_some() { Port::Line } else { Port::Embassy }
    }

    fn now(&self) -> Instant {
        self.bench.now()
    }

    fn add(&mut self, spec: Spec) -> Unit {
        assert!(self.wire.is_none() || self.units.len() < 2, "a line has two ends");
        let node = BoardNode::new(self.units.len(), &self.bench, self.mode, self.wire.clone(), spec);
        self.units.push(Rc::clone(&node));
        Rc::new(node)
    }

    fn run_until(&mut self, condition: &dyn Fn() -> bool, limit: Duration) -> bool {
        self.bench.run_until(condition, limit)
    }

    fn inject(&mut self, fault: Fault<'_>) -> Result<(), Unsupported> {
        if let Some(wire) = self.wire.clone() {
            return self.inject_into_line(&wire, fault);
        }
        match fault {
            Fault::PowerCut(unit) | Fault::Kill(unit) => self.node(unit).cut_power(),
            Fault::Restart(unit) => self.node(unit).boot(),
            Fault::Cut(one, other) => {
                let (one, other) = (self.node(one).board(), self.node(other).board());
                one.lose_frames_of(&other);
                other.lose_frames_of(&one);
            }
            Fault::CutOneWay(from, to) => self.node(to).board().lose_frames_of(&self.node(from).board()),
            Fault::Heal => self.units.iter().for_each(|unit| unit.board().heal()),
            Fault::FreezeStreams(from, to, span) => {
                self.node(to).board().hold_frames_of(&self.node(from).board(), span, true);
            }
            Fault::FreezeLink(from, to, span) => {
                self.node(to).board().hold_frames_of(&self.node(from).board(), span, false);
            }
            Fault::ChangeAddress(unit) => self.node(unit).board().move_to(std::net::Ipv4Addr::new(10, 77, 0, 207)),
            Fault::Suspend(unit, span) => self.node(unit).board().suspend(span),
            Fault::Reset(unit) => self.node(unit).board().reset_streams(),
            Fault::Path(one, other, path) => {
                let (one, other) = (self.node(one).board(), self.node(other).board());
                one.set_path_from(&other, path);
                other.set_path_from(&one, path);
            }
            Fault::SlowReader(..) => return Err(Unsupported(Need::SlowReader)),
            Fault::UnknownClient(unit, client) => self.unknown_client(unit, client),
            Fault::Unplug(unit) => self.node(unit).board().set_cable(false),
            Fault::Plug(unit) => self.node(unit).board().set_cable(true),
        }
        Ok(())
    }

    fn random(&mut self, bound: u64) -> u64 {
        self.random.below(bound)
    }

    fn reached(&mut self, state: &'static str) {
        *self.report.states.entry(state.to_owned()).or_default() += 1;
    }

    fn measured(&mut self, what: &'static str, span: Duration) {
        self.report.measured.entry(what).or_default().push(span);
    }

    fn report(&self) -> Report {
        let mut report = self.report.clone();
        for (name, count) in self.bench.counts().iter().filter(|(_, count)| *count > 0) {
            *report.faults.entry(name).or_default() += count;
        }
        let wire = self.wire.as_ref().map(Wire::counts).unwrap_or_default();
        for (name, count) in [("changed-byte", wire.changed), ("lost-byte", wire.lost)] {
            *report.faults.entry(name).or_default() += count;
        }
        report
    }

    fn units(&self) -> Vec<Unit> {
        self.units.iter().map(|unit| Rc::new(Rc::clone(unit)) as Unit).collect()
    }
}
