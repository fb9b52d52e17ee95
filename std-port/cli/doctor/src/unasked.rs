//! Units of this host that hold a control socket and cannot be asked: they hang, too many ask, or they refuse this user.

use cara_std::control::{RunningUnit, UnitState};

use super::evidence::Evidence;
use super::finding::{Finding, Id};
use super::node::ANSWERED;
use super::which::Which;

/// What is to be said of them, and of nothing that follows from it.
pub(crate) fn above(seen: &Evidence, which: Option<&Which>, below: Vec<Finding>) -> Vec<Finding> {
    let mut found: Vec<Finding> = seen.unasked.iter().filter_map(|unit| finding(seen, which, unit)).collect();
    let hangs = found.iter().any(|finding| finding.id == Id::UnitHangs);
    found.extend(below.into_iter().filter(|finding| !hangs || !FOLLOWS.contains(&finding.id)));
    found
}

/// What a unit that hangs looks like from outside.
const FOLLOWS: [Id; 7] =
    [Id::NoManager, Id::NotJoining, Id::NotHeard, Id::AskItsManager, Id::TcpBlocked, Id::BroadcastOneWay, Id::Answers];

fn finding(seen: &Evidence, which: Option<&Which>, unit: &RunningUnit) -> Option<Finding> {
    let (name, path) = (&unit.unit, unit.path.display());
    let meant = which.is_some_and(|which| which.is_text(name));
    match &unit.state {
        UnitState::Answers => None,
        UnitState::Refuses(reason) => {
            let found = format!("{name} runs on this host and does not let this user ask it: {reason}");
            Some(Finding::warning(Id::ControlRefused, found, REFUSES).about(name))
        }
        UnitState::Silent => {
            let found = format!(
                "{name} runs on this host (control socket {path}) and does not answer: its process hangs or is stopped"
            );
            let certain = meant || which.is_some() && seen.listened >= ANSWERED;
            Some(Finding::error(Id::UnitHangs, found, HANGS).about(name).certain(certain))
        }
        UnitState::Full(text) => {
            let found = format!("{name} runs on this host, and its control socket has no connection free: {text}");
            Some(Finding::warning(Id::ControlFull, found, FULL).about(name))
        }
    }
}

const HANGS: &str = "restart it, and start no second one beside it; a process that was stopped (state T in `ps`) goes on \
                     with `kill -CONT`";
const REFUSES: &str = "run the doctor as the user that runs it, or add this user to its `operators`; what the unit knows is missing \
                       from the other findings";
const FULL: &str = "end commands that go on asking it (`cara watch`, scripts that wait), then run the doctor again: what the \
                    unit knows is missing from the other findings";

#[cfg(test)]
mod tests {
    use super::super::evidence::samples::evidence;
    use super::*;

    fn unasked(state: UnitState) -> Evidence {
        let unit = RunningUnit { unit: "boss/1".into(), fleet: 7, path: "/run/boss".into(), state };
        Evidence { unasked: vec![unit], ..evidence() }
    }

    fn ids(seen: &Evidence) -> Vec<Id> {
        let below = vec![Finding::error(Id::NoManager, "", ""), Finding::error(Id::Duplicate, "", "")];
        above(seen, None, below).iter().map(|finding| finding.id).collect()
    }

    #[test]
    fn a_unit_that_hangs_stands_above_what_follows_from_it() {
        assert_eq!(ids(&unasked(UnitState::Silent)), [Id::UnitHangs, Id::Duplicate]);
        let full = unasked(UnitState::Full("too many".into()));
        assert_eq!(ids(&full), [Id::ControlFull, Id::NoManager, Id::Duplicate]);
        let refuses = unasked(UnitState::Refuses("not you".into()));
        assert_eq!(ids(&refuses), [Id::ControlRefused, Id::NoManager, Id::Duplicate]);
        assert_eq!(ids(&unasked(UnitState::Answers)), [Id::NoManager, Id::Duplicate]);
    }
}
