//! Text form of rules: how a file names nodes, verbs and rates, and how they are shown.

use std::fmt;

use cara_core::distribution::identity::{Identity, Role};
use cara_core::services::access::{Functions, Rate, Verb, Verbs, Who};
use cara_core::time::Duration;

use super::OwnedRule;

/// Any name, any id, any function.
pub(super) const ANY: &str = "*";
const OPERATOR: &str = "operator";
const M_UNITS: &str = "m_units";
const S_UNITS: &str = "s_units";
const ROLES: [(&str, Role); 2] = [("@m_unit", Role::MUnit), ("@s_unit", Role::SUnit)];
const VERBS: [(&str, Verb); 4] =
    [("list", Verb::List), ("call", Verb::Call), ("take_over", Verb::TakeOver), ("publish", Verb::Publish)];
const SPANS: [(&str, u64); 3] = [("s", 1), ("min", 60), ("h", 3600)];

/// The text names no principal.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
#[error(
    "'{0}' names no node: write NAME/ID, NAME/* or */ID, \"m_units\", \"s_units\", \"operator\", or \"*\" for every node"
)]
pub struct NotWho(String);

/// The principals that the text names.
pub(super) fn who(words: &str) -> Result<Who<String>, NotWho> {
    match words {
        OPERATOR => return Ok(Who::Operator),
        M_UNITS => return Ok(Who::M_UNITS),
        S_UNITS => return Ok(Who::S_UNITS),
        ANY => return Ok(Who::ANYBODY),
        _ => {}
    }
    let suffix = ROLES.iter().find_map(|&(suffix, role)| Some((words.strip_suffix(suffix)?, role)));
    let (named, role) = suffix.map_or((words, None), |(named, role)| (named, Some(role)));
    let nobody = || NotWho(words.to_owned());
    let (name, id) = named.rsplit_once('/').ok_or_else(nobody)?;
    let id = if id == ANY { None } else { Some(id.parse().map_err(|_| nobody())?) };
    let name = if name == ANY { None } else { Some(name.to_owned()) };
    // What cannot be a node's name would never match.
    if name.as_ref().is_some_and(|name| Identity::m_unit(name, 0).is_err()) {
        return Err(nobody());
    }
    Ok(Who::Node { role, name, id })
}

/// The verb of a word.
#[cfg(feature = "access")]
pub(super) fn verb(word: &str) -> Option<Verb> {
    VERBS.iter().find(|(known, _)| *known == word).map(|&(_, verb)| verb)
}

/// A rate, as `10/s`, `5/min` or `1/h`.
#[cfg(any(feature = "access", test))]
pub(super) fn rate(words: &str) -> Option<Rate> {
    let (calls, span) = words.split_once('/')?;
    let calls: u32 = calls.trim().parse().ok().filter(|calls| *calls > 0)?;
    let (_, seconds) = SPANS.iter().find(|(known, _)| *known == span.trim())?;
    Some(Rate::new(calls, Duration::from_secs(*seconds)))
}

/// A rule as it is written in a file.
pub(super) struct Shown<'r>(pub(super) &'r OwnedRule);

impl fmt::Display for Shown<'_> {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let rule = self.0;
        write!(f, "{} may {} ", Named(&rule.who), Words(rule.verbs))?;
        match &rule.functions {
            Functions::All => f.write_str("every function")?,
            Functions::Named(names) if names.is_empty() => f.write_str("no function")?,
            Functions::Named(names) => f.write_str(&names.join(", "))?,
        }
        match rule.rate {
            None => Ok(()),
            Some(rate) => write!(f, ", {}", Often(rate)),
        }
    }
}

struct Named<'w>(&'w Who<String>);

impl fmt::Display for Named<'_> {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let Who::Node { role, name, id } = self.0 else { return f.write_str(OPERATOR) };
        match (role, name, id) {
            (None, None, None) => return f.write_str("every node"),
            (Some(Role::MUnit), None, None) => return f.write_str("every m_unit"),
            (Some(Role::SUnit), None, None) => return f.write_str("every s_unit"),
            _ => {}
        }
        write!(f, "{}/", name.as_deref().unwrap_or(ANY))?;
        match id {
            Some(id) => write!(f, "{id}")?,
            None => f.write_str(ANY)?,
        }
        let suffix = ROLES.iter().find(|(_, known)| Some(*known) == *role);
        suffix.map_or(Ok(()), |(suffix, _)| f.write_str(suffix))
    }
}

struct Words(Verbs);

impl fmt::Display for Words {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let words: Vec<&str> = VERBS.iter().filter(|(_, verb)| self.0.contains(*verb)).map(|(word, _)| *word).collect();
        f.write_str(if words.is_empty() { "do nothing with" } else { "" })?;
        f.write_str(&words.join(" and "))
    }
}

struct Often(Rate);

impl fmt::Display for Often {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let (calls, every) = self.0.parts();
        match SPANS.iter().find(|(_, seconds)| Duration::from_secs(*seconds) == every) {
            Some((word, _)) => write!(f, "{calls}/{word}"),
            None => write!(f, "{calls} in {} us", every.as_micros()),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn node(role: Option<Role>, name: Option<&str>, id: Option<u32>) -> Who<String> {
        Who::Node { role, name: name.map(str::to_owned), id }
    }

    #[test]
    fn everybody_can_be_named() {
        let known = [
            ("operator", Who::Operator),
            ("*", Who::ANYBODY),
            ("m_units", Who::M_UNITS),
            ("AGV_manager/1", node(None, Some("AGV_manager"), Some(1))),
            ("agv/*", node(None, Some("agv"), None)),
            ("*/7", node(None, None, Some(7))),
            ("*/*", Who::ANYBODY),
            ("a/b@c/7@s_unit", node(Some(Role::SUnit), Some("a/b@c"), Some(7))),
            ("operator/0", node(None, Some("operator"), Some(0))),
        ];
        for (words, meant) in known {
            assert_eq!(who(words), Ok(meant), "{words}");
        }
    }

    #[test]
    fn what_means_nobody_is_told() {
        let long = format!("{}/1", "x".repeat(33));
        for wrong in ["", "agv", "/1", "agv/x", "agv/-1", "agv/4294967296", "Operator", "m_unit", "a\nb/1", &long] {
            assert!(who(wrong).is_err_and(|error| error.to_string().contains("NAME/ID")), "{wrong}");
        }
    }

    #[test]
    fn rates_are_calls_in_a_span() {
        assert_eq!(rate("10/s"), Some(Rate::per_second(10)));
        assert_eq!(rate("1 / min"), Some(Rate::new(1, Duration::from_secs(60))));
        for wrong in ["", "10", "0/s", "-1/s", "1.5/s", "10/ms", "10/S", "/s", "4294967296/s"] {
            assert_eq!(rate(wrong), None, "{wrong}");
        }
    }

    #[test]
    fn a_rule_is_shown_in_the_words_of_the_file() {
        let rule = OwnedRule {
            who: node(Some(Role::MUnit), Some("AGV_manager"), None),
            functions: Functions::Named(vec!["go_to".into(), "stop".into()]),
            verbs: Verbs::LIST.and(Verbs::CALL),
            rate: rate("5/min"),
        };
        assert_eq!(Shown(&rule).to_string(), "AGV_manager/*@m_unit may list and call go_to, stop, 5/min");
        let rule = OwnedRule { who: Who::ANYBODY, functions: Functions::All, verbs: Verbs::PUBLISH, rate: None };
        assert_eq!(Shown(&rule).to_string(), "every node may publish every function");
    }
}
