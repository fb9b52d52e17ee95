//! The members of a fleet, and the generations of keys in use. Nothing in it is secret.
//!
//! ```text
//! cara-fleet 2
//! fleet 7
//! generations 1 2
//! node 1 m_unit 1 depot
//! node 2 s_unit 17 agv-17
//! manager m_unit 1 depot
//! revoked 2 s_unit 18 agv-18
//! sum 8 hexadecimal digits
//! ```
//!
//! `generations` has the one in use, followed by the one beside it during a change of keys. `node` has the first
//! generation in which the node has keys, `manager` a manager of the node above, and `revoked` the first generation
//! without the node.

use std::fmt::Write;

use cara_core::distribution::identity::{Fleet, Identity, Role};

use super::FleetError;
use super::text::{FORM, FormError, Line, Lines, push_identity, push_sum};

/// A node of the fleet.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Member {
    /// Its identity.
    pub identity: Identity,
    /// The first generation in which it has keys.
    pub since: u32,
    /// Of an s_unit: the m_units that it belongs to. None after the last of them was revoked.
    pub managers: Vec<Identity>,
}

/// A node that was taken out.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Revoked {
    /// Its identity.
    pub identity: Identity,
    /// The first generation without it.
    pub from: u32,
}

/// The nodes of a fleet, in the order of their identities.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Members {
    fleet: Fleet,
    /// The generation with which nodes speak.
    used: u32,
    /// The one that they take as well: the next one while a change of keys has begun, then the one before.
    beside: Option<u32>,
    nodes: Vec<Member>,
    revoked: Vec<Revoked>,
}

impl Members {
    /// A fleet without nodes, in its first generation.
    pub(super) fn new(fleet: Fleet) -> Self {
        Self { fleet, used: 1, beside: None, nodes: Vec::new(), revoked: Vec::new() }
    }

    /// The fleet.
    pub fn fleet(&self) -> Fleet {
        self.fleet
    }

    /// The generation with which nodes speak.
    pub fn generation(&self) -> u32 {
        self.used
    }

    /// The generation that nodes take beside the one in use: a newer one while a change of keys has begun, the older one
    /// between the switch and its end.
    pub fn beside(&self) -> Option<u32> {
        self.beside
    }

    /// Both, the one in use first.
    pub fn generations(&self) -> impl Iterator<Item = u32> + use<> {
        std::iter::once(self.used).chain(self.beside)
    }

    fn newest(&self) -> u32 {
        self.beside.map_or(self.used, |beside| beside.max(self.used))
    }

    fn oldest(&self) -> u32 {
        self.beside.map_or(self.used, |beside| beside.min(self.used))
    }

    /// Those that have keys.
    pub fn nodes(&self) -> &[Member] {
        &self.nodes
    }

    /// Those that were taken out, and have not come back.
    pub fn revoked(&self) -> &[Revoked] {
        &self.revoked
    }

    /// Whether a node was taken out, and has not come back.
    pub fn is_revoked(&self, identity: &Identity) -> bool {
        self.revoked.iter().any(|revoked| revoked.identity == *identity)
    }

    /// A node.
    pub fn node(&self, identity: &Identity) -> Result<&Member, FleetError> {
        self.nodes.iter().find(|node| node.identity == *identity).ok_or_else(|| match self.is_revoked(identity) {
            true => FleetError::Revoked(self.fleet, identity.clone()),
            false => FleetError::Unknown(self.fleet, identity.clone()),
        })
    }

    /// Those that a node talks to: m_units to each other, and an s_unit to those that it belongs to.
    pub fn peers<'m>(&'m self, of: &'m Member) -> impl Iterator<Item = &'m Member> {
        self.nodes.iter().filter(|node| node.identity != of.identity && are_peers(node, of))
    }

    /// Adds a node; one that is there already gets other managers, if any are named.
    pub(super) fn add(&mut self, identity: &Identity, managers: &[Identity]) -> Result<(), FleetError> {
        let named = self.checked(identity, managers)?;
        if let Some(node) = self.nodes.iter_mut().find(|node| node.identity == *identity) {
            if !named.is_empty() {
                node.managers = named;
            }
            // One that lost its last manager belongs to the only one that is left, if there is one.
            return self.settle(identity);
        }
        let before = self.revoked.iter().find(|revoked| revoked.identity == *identity);
        let since = before.map_or(self.oldest(), |revoked| revoked.from);
        let at = self.nodes.partition_point(|node| node.identity < *identity);
        self.nodes.insert(at, Member { identity: identity.clone(), since, managers: named });
        self.settle(identity).inspect_err(|_| drop(self.nodes.remove(at)))?;
        self.revoked.retain(|revoked| revoked.identity != *identity);
        Ok(())
    }

    /// Without repetitions, each of them an m_unit of the fleet.
    fn checked(&self, identity: &Identity, managers: &[Identity]) -> Result<Vec<Identity>, FleetError> {
        if identity.role() == Role::MUnit && !managers.is_empty() {
            return Err(FleetError::MUnit(identity.clone()));
        }
        let is_m_unit = |manager: &&Identity| manager.role() == Role::MUnit && self.node(manager).is_ok();
        if let Some(wrong) = managers.iter().find(|manager| !is_m_unit(manager)) {
            return Err(FleetError::NotAManager(wrong.clone()));
        }
        let mut managers = managers.to_vec();
        managers.sort();
        managers.dedup();
        Ok(managers)
    }

    /// An s_unit for which nothing was said belongs to the fleet's only m_unit.
    fn settle(&mut self, identity: &Identity) -> Result<(), FleetError> {
        let m_units: Vec<_> = self.m_units().cloned().collect();
        let Some(node) = self.nodes.iter_mut().find(|node| node.identity == *identity) else { return Ok(()) };
        if identity.role() == Role::MUnit || !node.managers.is_empty() {
            return Ok(());
        }
        match m_units.as_slice() {
            [] => Err(FleetError::NoManager(self.fleet, identity.clone())),
            [only] => {
                node.managers = vec![only.clone()];
                Ok(())
            }
            _ => Err(FleetError::WhichManager { node: identity.clone(), managers: m_units }),
        }
    }

    /// The m_units.
    pub fn m_units(&self) -> impl Iterator<Item = &Identity> {
        self.nodes.iter().map(|node| &node.identity).filter(|identity| identity.role() == Role::MUnit)
    }

    /// Takes nodes out, and begins a generation that they have nothing of. It stands beside the one in use in the place of
    /// any other: a node must never stay in because a change of keys is under way. Those that were revoked already stay so,
    /// and where there are no others nothing changes.
    pub(super) fn revoke(&mut self, identities: &[Identity]) -> Result<(), FleetError> {
        let mut revoked: Vec<_> = identities.iter().filter(|identity| !self.is_revoked(identity)).cloned().collect();
        revoked.sort();
        revoked.dedup();
        revoked.iter().try_for_each(|identity| self.node(identity).map(drop))?;
        if revoked.is_empty() {
            return Ok(());
        }
        let newest = self.newest().checked_add(1).ok_or(FleetError::Exhausted(self.fleet))?;
        self.nodes.retain(|node| !revoked.contains(&node.identity));
        self.nodes.iter_mut().for_each(|node| node.managers.retain(|manager| !revoked.contains(manager)));
        self.revoked.extend(revoked.into_iter().map(|identity| Revoked { identity, from: newest }));
        self.beside = Some(newest);
        Ok(())
    }

    /// Begins a generation beside the one in use.
    pub(super) fn rotate(&mut self) -> Result<(), FleetError> {
        if self.beside.is_some() {
            return Err(FleetError::UnderWay(self.fleet, self.newest()));
        }
        self.beside = Some(self.used.checked_add(1).ok_or(FleetError::Exhausted(self.fleet))?);
        Ok(())
    }

    /// Uses the generation that has begun, and keeps the one before beside it.
    pub(super) fn switch(&mut self) -> Result<(), FleetError> {
        match self.beside {
            None => Err(FleetError::NotStarted(self.fleet, self.used)),
            Some(beside) if beside < self.used => Err(FleetError::Switched(self.fleet, self.used)),
            Some(beside) => {
                self.beside = Some(std::mem::replace(&mut self.used, beside));
                Ok(())
            }
        }
    }

    /// Ends the generation before the one in use.
    pub(super) fn finish(&mut self) -> Result<(), FleetError> {
        match self.beside {
            None => Err(FleetError::NotStarted(self.fleet, self.used)),
            Some(beside) if beside > self.used => Err(FleetError::NotSwitched(self.fleet, beside)),
            Some(_) => {
                self.beside = None;
                Ok(())
            }
        }
    }

    /// The text of its file.
    pub(super) fn text(&self) -> String {
        let fleet = self.fleet.0;
        let generations: Vec<_> = self.generations().map(|number| number.to_string()).collect();
        let mut text = format!(
            "# The nodes of fleet {fleet}, as `cara keys` keeps them beside the root.\n\
             cara-fleet {FORM}\nfleet {fleet}\ngenerations {}\n",
            generations.join(" ")
        );
        for node in &self.nodes {
            push(&mut text, format_args!("node {} ", node.since), &node.identity);
            node.managers.iter().for_each(|manager| push(&mut text, format_args!("manager "), manager));
        }
        self.revoked.iter().for_each(|one| push(&mut text, format_args!("revoked {} ", one.from), &one.identity));
        push_sum(&mut text);
        text
    }

    pub(super) fn parse(text: &str) -> Result<Self, FormError> {
        let mut lines = Lines::of(text);
        lines.head("cara-fleet", "here `cara-fleet 2` is expected: this is no list of a fleet's nodes")?;
        let fleet = Fleet(lines.expect("fleet", "here `fleet` is expected")?.number()?);
        let line = lines.expect("generations", "here `generations` is expected")?;
        let (used, behind) = line.numbered()?;
        let beside = if behind.is_empty() { None } else { Some(behind.number()?) };
        if used == 0 || beside.is_some_and(|beside| beside == 0 || beside == used) {
            return Err(line.wrong("here the generation in use is expected, and perhaps another one beside it"));
        }
        let mut members = Self { fleet, used, beside, nodes: Vec::new(), revoked: Vec::new() };
        lines.try_for_each(|line| members.read(line))?;
        members.nodes.sort_by(|one, other| one.identity.cmp(&other.identity));
        Ok(members)
    }

    fn read(&mut self, line: Line<'_>) -> Result<(), FormError> {
        match line.word {
            "node" => {
                let (since, behind) = line.numbered()?;
                let identity = behind.identity()?;
                if self.node(&identity).is_ok() {
                    return Err(line.wrong("this node stands above already"));
                }
                self.nodes.push(Member { identity, since, managers: Vec::new() });
            }
            "manager" => {
                let node =
                    self.nodes.last_mut().ok_or_else(|| line.wrong("here the node of this manager is missing"))?;
                node.managers.push(line.identity()?);
            }
            "revoked" => {
                let (from, behind) = line.numbered()?;
                self.revoked.push(Revoked { identity: behind.identity()?, from });
            }
            _ => return Err(line.wrong("here `node`, `manager` or `revoked` is expected")),
        }
        Ok(())
    }
}

fn push(text: &mut String, head: std::fmt::Arguments<'_>, identity: &Identity) {
    // Writing to text does not fail.
    let _ = text.write_fmt(head);
    push_identity(text, identity);
    text.push('\n');
}

fn are_peers(one: &Member, other: &Member) -> bool {
    let manages = |manager: &Member, node: &Member| node.managers.contains(&manager.identity);
    let both_manage = [one, other].iter().all(|member| member.identity.role() == Role::MUnit);
    both_manage || manages(one, other) || manages(other, one)
}

#[cfg(test)]
mod tests {
    use super::*;

    fn m_unit(name: &str) -> Identity {
        Identity::m_unit(name, 1).unwrap()
    }

    fn agv(id: u32) -> Identity {
        Identity::s_unit("agv", id).unwrap()
    }

    /// Two m_units, an AGV of the first and one of both.
    fn fleet() -> Members {
        let mut members = Members::new(Fleet(7));
        members.add(&m_unit("depot"), &[]).unwrap();
        members.add(&agv(1), &[]).unwrap();
        members.add(&m_unit("hall"), &[]).unwrap();
        members.add(&agv(2), &[m_unit("hall"), m_unit("depot"), m_unit("hall")]).unwrap();
        members
    }

    fn peers(members: &Members, of: &Identity) -> Vec<String> {
        members.peers(members.node(of).unwrap()).map(|peer| peer.identity.to_string()).collect()
    }

    #[test]
    fn an_s_unit_talks_to_its_m_units_and_those_to_each_other() {
        let members = fleet();
        assert_eq!(peers(&members, &m_unit("depot")), ["agv/1", "hall/1", "agv/2"]);
        assert_eq!(peers(&members, &m_unit("hall")), ["depot/1", "agv/2"]);
        assert_eq!(peers(&members, &agv(1)), ["depot/1"]);
        assert_eq!(peers(&members, &agv(2)), ["depot/1", "hall/1"]);
    }

    #[test]
    fn what_cannot_be_added_is_told_and_changes_nothing() {
        let mut members = Members::new(Fleet(7));
        assert_eq!(members.add(&agv(1), &[]), Err(FleetError::NoManager(Fleet(7), agv(1))));
        assert_eq!(members, Members::new(Fleet(7)));
        let mut members = fleet();
        let before = members.clone();
        let managers = vec![m_unit("depot"), m_unit("hall")];
        let error = members.add(&agv(3), &[]).unwrap_err();
        assert_eq!(error, FleetError::WhichManager { node: agv(3), managers });
        assert!(error.to_string().ends_with("Say `--manager depot/1` or `--manager hall/1`"), "{error}");
        assert_eq!(members.add(&agv(3), &[m_unit("yard")]), Err(FleetError::NotAManager(m_unit("yard"))));
        assert_eq!(members.add(&agv(3), &[agv(1)]), Err(FleetError::NotAManager(agv(1))));
        assert_eq!(members.add(&m_unit("yard"), &[m_unit("hall")]), Err(FleetError::MUnit(m_unit("yard"))));
        assert_eq!(members, before);
        members.add(&agv(1), &[]).unwrap();
        assert_eq!(members, before, "what is there stays as it is");
        members.add(&agv(1), &[m_unit("hall")]).unwrap();
        assert_eq!(peers(&members, &agv(1)), ["hall/1"]);
    }

    #[test]
    fn who_is_revoked_comes_back_with_keys_that_it_never_had() {
        let mut members = fleet();
        members.revoke(&[agv(1)]).unwrap();
        assert_eq!(members.generations().collect::<Vec<_>>(), [1, 2]);
        assert_eq!(members.revoked(), [Revoked { identity: agv(1), from: 2 }]);
        let before = members.clone();
        members.revoke(&[agv(1), agv(1)]).unwrap();
        assert_eq!(members, before, "once is enough");
        assert_eq!(members.revoke(&[agv(2), agv(9)]), Err(FleetError::Unknown(Fleet(7), agv(9))));
        assert!(members.node(&agv(2)).is_ok(), "all of them or none");
        assert!(members.add(&agv(1), &[]).is_err(), "there are two m_units");
        members.add(&agv(1), &[m_unit("depot")]).unwrap();
        assert_eq!((members.node(&agv(1)).unwrap().since, members.revoked().len()), (2, 0));
        members.add(&agv(3), &[m_unit("depot")]).unwrap();
        assert_eq!(members.node(&agv(3)).unwrap().since, 1, "a new node speaks as all do");
    }

    #[test]
    fn who_is_revoked_already_is_taken_out_once() {
        let mut members = fleet();
        members.revoke(&[agv(1)]).unwrap();
        members.revoke(&[agv(2), agv(1), agv(2)]).unwrap();
        let expected = [Revoked { identity: agv(1), from: 2 }, Revoked { identity: agv(2), from: 3 }];
        assert_eq!((members.revoked(), members.beside()), (&expected[..], Some(3)));
        assert!(members.is_revoked(&agv(2)) && !members.is_revoked(&agv(3)));
    }

    #[test]
    fn without_its_manager_a_node_talks_to_nobody() {
        let mut members = fleet();
        members.revoke(&[m_unit("depot")]).unwrap();
        assert_eq!((peers(&members, &agv(1)), peers(&members, &agv(2))), (vec![], vec!["hall/1".to_owned()]));
        members.add(&agv(1), &[]).unwrap();
        assert_eq!(peers(&members, &agv(1)), ["hall/1"]);
    }

    #[test]
    fn a_change_of_keys_has_three_steps_and_revoking_is_never_held_up() {
        let mut members = fleet();
        let generations = |members: &Members| members.generations().collect::<Vec<_>>();
        assert_eq!(
            (members.switch(), members.finish()),
            (Err(FleetError::NotStarted(Fleet(7), 1)), Err(FleetError::NotStarted(Fleet(7), 1)))
        );
        members.rotate().unwrap();
        assert_eq!(generations(&members), [1, 2]);
        assert_eq!(
            (members.rotate(), members.finish()),
            (Err(FleetError::UnderWay(Fleet(7), 2)), Err(FleetError::NotSwitched(Fleet(7), 2)))
        );
        members.revoke(&[agv(1)]).unwrap();
        assert_eq!(generations(&members), [1, 3], "nobody speaks with 2 yet");
        members.switch().unwrap();
        assert_eq!(generations(&members), [3, 1]);
        assert_eq!(
            (members.rotate(), members.switch()),
            (Err(FleetError::UnderWay(Fleet(7), 3)), Err(FleetError::Switched(Fleet(7), 3)))
        );
        members.revoke(&[agv(2)]).unwrap();
        assert_eq!(generations(&members), [3, 4]);
        members.switch().unwrap();
        members.finish().unwrap();
        assert_eq!(generations(&members), [4]);
        members.used = u32::MAX;
        let depot = [m_unit("depot")];
        assert_eq!(
            (members.rotate(), members.revoke(&depot)),
            (Err(FleetError::Exhausted(Fleet(7))), Err(FleetError::Exhausted(Fleet(7))))
        );
        assert!(members.node(&depot[0]).is_ok());
    }

    #[test]
    fn what_is_written_is_read() {
        let mut members = fleet();
        members.add(&Identity::s_unit("a b/c #1", 9).unwrap(), &[m_unit("hall")]).unwrap();
        assert_eq!(Members::parse(&members.text()), Ok(members.clone()));
        members.rotate().unwrap();
        members.switch().unwrap();
        members.revoke(&[agv(1)]).unwrap();
        assert_eq!(Members::parse(&members.text()), Ok(members));
    }

    #[test]
    fn every_line_that_is_wrong_is_told_by_its_number() {
        let mut members = fleet();
        members.revoke(&[agv(1)]).unwrap();
        let text = members.text();
        let (text, sum) = text.split_at(text.find("sum ").unwrap());
        let parse = |text: &str| Members::parse(&format!("{text}{sum}")).map(drop).map_err(|error| error.line);
        for (index, line) in text.lines().enumerate().skip(1) {
            for wrong in ["strange 1", line.split(' ').next().unwrap()] {
                assert_eq!(parse(&text.replace(line, wrong)), Err(index + 1), "{line}");
            }
        }
        for generations in ["0 1", "1 1", "1 0", "1 2 3", "x"] {
            assert_eq!(parse(&text.replace("generations 1 2", &format!("generations {generations}"))), Err(4));
        }
        assert_eq!(parse(""), Err(1));
        assert_eq!(parse("cara-fleet 2\nfleet 7\ngenerations 1\nmanager m_unit 1 depot\n"), Err(4));
        assert_eq!(parse(&format!("{text}node 1 m_unit 1 depot\n")), Err(text.lines().count() + 1));
    }
}
