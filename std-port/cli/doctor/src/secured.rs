//! What keeps units apart that are of one fleet: their modes and their keys.

use std::collections::BTreeSet;

use cara_std::survey::{Heard, Standing};
use cara_std::{Identity, Manager, Mode, Role};

use super::causes::text_of;
use super::evidence::Evidence;
use super::finding::{Finding, Id, Severity};
use super::running::Running;
use cara_tools::listening;
use cara_tools::name_and_id::quoted;

/// Findings of one kind that are listed.
const MOST: usize = 8;

/// What the doctor itself lacks to see and to check secured units.
pub(crate) fn of_host(seen: &Evidence) -> Vec<Finding> {
    let refused = seen.keys.refused.iter().take(MOST).map(|text| {
        let found = format!("a file with keys was found and not taken: {text}");
        let advice = "do what it says; no unit takes its keys from it, and one that runs keeps those that it has";
        Finding::warning(Id::KeyFileRefused, found, advice)
    });
    let mut found: Vec<Finding> = refused.collect();
    if found.is_empty() {
        found.extend(missing(seen));
    }
    found
}

/// The same as the likeliest cause of hearing nothing.
pub(crate) fn of_silence(seen: &Evidence) -> Vec<Finding> {
    if seen.keys.has {
        return Vec::new();
    }
    of_host(seen).into_iter().map(|finding| Finding { severity: Severity::Error, ..finding }).collect()
}

/// No keys, where nothing says that the fleet does without.
fn missing(seen: &Evidence) -> Option<Finding> {
    let is_plain = seen.mode == Some(Mode::Plain) || seen.ours().any(|(heard, _)| heard.mode == Mode::Plain);
    if seen.keys.has || is_plain {
        return None;
    }
    let fleet = seen.fleet.0;
    let found = format!(
        "there are no keys of fleet {fleet} here: without them no secured unit starts, secured m_units do not answer, and \
         nothing shows who belongs to the fleet"
    );
    let advice = format!("{}; if the fleet is in plain mode, say --insecure", listening::how_to_get_keys(seen.fleet));
    Some(Finding::warning(Id::KeysMissing, found, advice).about(format!("fleet {fleet}")))
}

/// A unit whose code was made with none of the keys that are here.
pub(crate) fn wrong_keys(seen: &Evidence, about: &str, heard: &Heard) -> Finding {
    let fleet = seen.fleet.0;
    let found = format!(
        "{about} at {} speaks for fleet {fleet} with none of its keys that are here: it has those of another root, or of a \
         generation that is over, or somebody speaks in its name",
        heard.source
    );
    Finding::error(Id::WrongKeys, found, of_one_root(fleet)).about(about)
}

fn of_one_root(fleet: u32) -> String {
    format!(
        "if it was revoked, or does not belong here, do nothing: it stays out. `cara keys show --fleet {fleet}`, where the fleet's \
         root is, tells who belongs to it. Only one that does gets the file that lies beside the root; if there are two roots, one \
         of them has to go"
    )
}

/// As `cara keys` takes a node.
fn named(heard: &Heard, about: &str) -> String {
    heard.identity.as_ref().map_or_else(|| about.to_owned(), cara_std::keys::full_name)
}

/// A node and its manager of two modes, as far as that can be seen.
pub(crate) fn two_modes(seen: &Evidence, node: &str, heard: &Heard) -> Option<Finding> {
    let manager = heard.wanted.as_ref()?;
    let modes: BTreeSet<bool> = modes_of(seen, manager).map(|mode| mode == Mode::Secured).collect();
    let is_secured = heard.mode == Mode::Secured;
    (!modes.is_empty() && !modes.contains(&is_secured)).then(|| mode_mismatch(seen, node, heard, Some(manager)))
}

/// In which modes a manager runs here, or was heard.
fn modes_of<'e>(seen: &'e Evidence, manager: &'e Manager) -> impl Iterator<Item = Mode> + 'e {
    let is_it = |unit: &&Running| unit.name() == text_of(manager) && unit.unit.fleet == seen.fleet.0;
    let here = seen.running.iter().filter(is_it).filter_map(Running::mode);
    let of_fleet = |(heard, identity): &(&Heard, &Identity)| {
        heard.same_version() && heard.fleet == seen.fleet && manager.is(identity) && identity.role() == Role::MUnit
    };
    here.chain(seen.units().filter(of_fleet).map(|(heard, _)| heard.mode))
}

/// A unit of the other mode than its fleet's, or than that of its manager where this one is known.
pub(crate) fn mode_mismatch(seen: &Evidence, about: &str, heard: &Heard, manager: Option<&Manager>) -> Finding {
    let other = manager.map_or_else(|| format!("fleet {} here", seen.fleet.0), text_of);
    let keyless = manager
        .map_or_else(|| "MANAGER/ID@m_unit".to_owned(), |manager| quoted(&format!("{}@m_unit", text_of(manager))));
    let (fleet, node) = (seen.fleet.0, quoted(&named(heard, about)));
    let derive = |node: &str| format!("`cara keys derive --fleet {fleet} {node}`");
    let (mode, others, advice) = match heard.mode {
        Mode::Plain => (
            "in plain mode",
            "secured",
            format!(
                "if {about} belongs here and was not revoked, give it its keys ({}) and start it without `insecure`",
                derive(&node)
            ),
        ),
        Mode::Secured => (
            "secured",
            "in plain mode",
            format!("give {other} its keys ({}) and start it without `--insecure`", derive(&keyless)),
        ),
    };
    let found = format!("{about} at {} is {mode}, and {other} is {others}: the two modes do not meet", heard.source);
    Finding::error(Id::ModeMismatch, found, format!("{advice}; plain mode is for private networks")).about(about)
}

/// A node that speaks with a key that its manager does not take: of a generation that is over, or of another root.
pub(crate) fn generations(seen: &Evidence, node: &str, heard: &Heard) -> Option<Finding> {
    let Standing::Proven { generation: theirs, root } = heard.standing else { return None };
    let manager = heard.wanted.as_ref()?;
    let here = seen.running.iter().find(|unit| unit.name() == text_of(manager) && unit.unit.fleet == seen.fleet.0);
    let spoken = generation_of(seen, manager);
    let taken = match here {
        Some(unit) => unit.unit.keys.as_ref()?.generations.clone(),
        None => vec![spoken?.0],
    };
    let is_taken = taken.contains(&theirs);
    if spoken.is_some_and(|(_, other)| other != root) {
        // One root has one key of each generation. Two generations may be of one root, with no file here that shows it.
        return Some(two_roots(seen, node, heard, manager).certain(is_taken || here.is_some()));
    }
    if is_taken {
        return None;
    }
    let numbers: Vec<String> = taken.iter().map(u32::to_string).collect();
    let (manager, fleet) = (text_of(manager), seen.fleet.0);
    let found = format!(
        "{node} at {} speaks with generation {theirs} of the fleet's keys, and {manager} with generation {}: a change of keys \
         has left one of them behind",
        heard.source,
        numbers.join(" and takes ")
    );
    let advice = format!(
        "bring both the files that are beside the fleet's root (`cara keys show --fleet {fleet}` tells the generation in use, \
         `cara keys show FILE` that of a file); the next time finish a change when all units have theirs"
    );
    Some(Finding::error(Id::KeyGenerations, found, advice).about(node).certain(here.is_some()))
}

/// The generation with which a manager was heard to speak, and its root.
fn generation_of(seen: &Evidence, manager: &Manager) -> Option<(u32, u32)> {
    match seen.manager(manager)?.standing {
        Standing::Proven { generation, root } => Some((generation, root)),
        _ => None,
    }
}

/// Both have keys of the fleet that are here as well, and no root or file here has those of both.
fn two_roots(seen: &Evidence, node: &str, heard: &Heard, manager: &Manager) -> Finding {
    let (manager, fleet) = (text_of(manager), seen.fleet.0);
    let found = format!(
        "{node} at {} and {manager} speak with different keys of fleet {fleet}, and no file here has both: they are of two roots, or \
         one of them is of a generation that is over",
        heard.source
    );
    Finding::error(Id::WrongKeys, found, of_one_root(fleet)).about(node)
}

/// All of this kind that is strange on the network.
pub(crate) fn all(seen: &Evidence) -> Vec<Finding> {
    let mut found: Vec<Finding> = Vec::new();
    let of_fleet = seen.units().filter(|(heard, _)| heard.same_version() && heard.fleet == seen.fleet);
    for (heard, identity) in of_fleet {
        let name = identity.to_string();
        let finding = match heard.standing {
            Standing::OtherKeys => Some(wrong_keys(seen, &name, heard)),
            _ => {
                two_modes(seen, &name, heard).or_else(|| generations(seen, &name, heard).filter(|found| found.certain))
            }
        };
        let news = finding
            .filter(|finding| found.iter().all(|known| (known.id, &known.about) != (finding.id, &finding.about)));
        found.extend(news.map(|finding| Finding { severity: Severity::Warning, ..finding }));
    }
    found.truncate(MOST);
    found
}

/// Links of a unit whose other end had the name of a node, and not its key.
pub(crate) fn failed_proofs(unit: &Running) -> Option<Finding> {
    let failed = unit.own_counter("ProofsFailed").filter(|failed| *failed > 0)?;
    let found = format!(
        "{failed} links of {} ended because the other end did not prove that it has the pair's key",
        unit.name()
    );
    let advice = "the log tells with whom; bring both ends the files of one root and generation. If all nodes have joined, somebody \
                  may have tried other keys";
    Some(Finding::warning(Id::WrongKeys, found, advice).about(unit.name()))
}

#[cfg(test)]
mod tests {
    use super::super::evidence::KeysSeen;
    use super::super::evidence::samples::{answering, evidence, running, searching};
    use super::super::node;
    use super::super::which::Which;
    use super::*;
    use cara_std::control::protocol::KeysInfo;

    fn ids(seen: &Evidence) -> Vec<Id> {
        node::check(seen, &Which("agv".into())).iter().map(|finding| finding.id).collect()
    }

    fn all_ids(seen: &Evidence) -> Vec<Id> {
        of_host(seen).iter().chain(&all(seen)).map(|finding| finding.id).collect()
    }

    fn plain(heard: Heard) -> Heard {
        Heard { mode: Mode::Plain, standing: Standing::Plain, ..heard }
    }

    fn proven(generation: u32, root: u32) -> Standing {
        Standing::Proven { generation, root }
    }

    fn of(standing: Standing) -> Heard {
        Heard { standing, ..searching("agv", 7, "boss") }
    }

    #[test]
    fn two_modes_are_told_from_either_side_and_from_outside() {
        let mut seen = evidence();
        seen.heard = vec![plain(searching("agv", 7, "boss")), answering("boss", 3)];
        assert_eq!((ids(&seen), all_ids(&seen)), (vec![Id::ModeMismatch], vec![Id::ModeMismatch]));
        seen.heard = vec![searching("agv", 7, "boss"), plain(answering("boss", 3))];
        assert_eq!(ids(&seen), [Id::ModeMismatch]);
        seen.heard.truncate(1);
        let mut unit = running("boss", 1);
        (unit.unit.mode, unit.unit.keys) = (Some("plain".into()), None);
        (seen.running, seen.mode) = (vec![unit], Some(Mode::Plain));
        let reported = node::check(&seen, &Which("agv".into()));
        assert_eq!((reported.len(), reported[0].id), (1, Id::ModeMismatch));
        assert!(reported[0].advice.contains("`cara keys derive --fleet 7 'boss/1@m_unit'`"), "{reported:?}");
        // A fleet of which one half is plain and meets is none of ours.
        seen.heard = vec![plain(searching("agv", 7, "boss"))];
        assert!(all_ids(&seen).is_empty());
    }

    #[test]
    fn other_keys_are_told_of_node_and_manager() {
        let mut seen = evidence();
        seen.heard = vec![of(Standing::OtherKeys)];
        assert_eq!((ids(&seen), all_ids(&seen)), (vec![Id::WrongKeys], vec![Id::WrongKeys]));
        seen.heard = vec![of(proven(1, 1)), Heard { standing: Standing::OtherKeys, ..answering("boss", 3) }];
        let reported = node::check(&seen, &Which("agv".into()));
        assert_eq!((reported.len(), reported[0].id, reported[0].about.as_deref()), (1, Id::WrongKeys, Some("boss/1")));
    }

    #[test]
    fn generations_are_compared_with_those_that_the_manager_takes() {
        let mut seen = evidence();
        seen.heard = vec![of(proven(1, 1)), Heard { standing: proven(2, 1), ..answering("boss", 3) }];
        assert_eq!(ids(&seen), [Id::KeyGenerations]);
        assert!(all_ids(&seen).is_empty(), "it may take both");
        let mut unit = running("boss", 1);
        unit.unit.keys = Some(KeysInfo { file: None, generations: vec![2, 1] });
        seen.running = vec![unit];
        assert_eq!(ids(&seen), [Id::NotJoining]);
        seen.running[0].unit.keys = Some(KeysInfo { file: None, generations: vec![2, 3] });
        assert_eq!((ids(&seen), all_ids(&seen)), (vec![Id::KeyGenerations], vec![Id::KeyGenerations]));
    }

    #[test]
    fn keys_of_another_root_are_none_of_another_generation() {
        let mut seen = evidence();
        let first = |seen: &Evidence| node::check(seen, &Which("agv".into())).remove(0);
        for generation in [1, 2] {
            seen.heard = vec![of(proven(1, 1)), Heard { standing: proven(generation, 2), ..answering("boss", 3) }];
            let found = first(&seen);
            // Of one generation there are two keys: two roots. Else a file with both may be elsewhere.
            assert_eq!((found.id, found.certain), (Id::WrongKeys, generation == 1), "{found:?}");
            assert!(found.advice.contains("do nothing"), "{found:?}");
            assert_eq!(all_ids(&seen).contains(&Id::WrongKeys), generation == 1);
        }
        let mut unit = running("boss", 1);
        unit.unit.keys = Some(KeysInfo { file: None, generations: vec![2, 1] });
        seen.running = vec![unit];
        assert_eq!((ids(&seen), all_ids(&seen)), (vec![Id::WrongKeys], vec![Id::WrongKeys]));
        // Not heard, it says which generations it takes, and no more.
        seen.heard.truncate(1);
        assert_eq!(ids(&seen), [Id::NotJoining]);
    }

    #[test]
    fn without_keys_that_comes_before_the_silence_unless_the_fleet_is_plain() {
        let mut seen = evidence();
        seen.keys = KeysSeen { has: false, refused: Vec::new() };
        assert_eq!((ids(&seen), all_ids(&seen)), (vec![Id::KeysMissing, Id::NotHeard], vec![Id::KeysMissing]));
        seen.keys.refused = vec!["others can read it".into()];
        assert_eq!(ids(&seen), [Id::KeyFileRefused, Id::NotHeard]);
        seen.keys = KeysSeen { has: false, refused: Vec::new() };
        seen.heard = vec![of(Standing::Unchecked)];
        assert_eq!(ids(&seen), [Id::NoManager, Id::KeysMissing], "names travel in clear");
        seen.heard = vec![plain(searching("other", 8, "boss"))];
        assert_eq!(ids(&seen), [Id::NoManager]);
        seen.heard.clear();
        seen.mode = Some(Mode::Plain);
        assert_eq!(ids(&seen), [Id::NotHeard]);
    }

    #[test]
    fn links_that_were_not_proven_are_counted() {
        let mut unit = running("boss", 1);
        assert_eq!(failed_proofs(&unit), None);
        unit.counters = vec![super::super::running::Counted { node: None, counters: vec![("ProofsFailed".into(), 2)] }];
        assert_eq!(failed_proofs(&unit).unwrap().id, Id::WrongKeys);
    }
}
