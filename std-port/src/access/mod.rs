//! Access tables, set by the program or read from a file that may change while the unit runs. Their semantics are in
//! [`cara_core::services::access`]; `docs/access.md` has the file's form.

mod error;
#[cfg(feature = "access")]
mod file;
#[cfg(feature = "access")]
pub(crate) mod watch;
mod words;

use std::fmt;

pub use cara_core::services::access::{Access, Decision, Functions, Principal, Rate, Rule, Verb, Verbs, Who, decide};
pub use error::{AccessError, AccessMistake};
#[cfg(feature = "access")]
pub use file::LONGEST_FILE;
pub use words::NotWho;

/// A rule that owns its words.
pub type OwnedRule = Rule<String, Vec<String>>;

/// A table of rules. Without a rule it allows nothing.
///
/// ```
/// use cara_std::access::{AccessTable, Principal, Verb};
/// use cara_std::Identity;
///
/// let table = AccessTable::parse("access.toml", r#"
///     [[allow]]
///     who = "AGV_manager/1"
///     functions = ["go_to", "stop"]
///     verbs = ["call"]
/// "#)?;
/// let manager = Identity::m_unit("AGV_manager", 1).unwrap();
/// assert!(table.decide(Principal::Node(&manager), "go_to", Verb::Call).is_allowed());
/// assert!(!table.decide(Principal::Operator, "go_to", Verb::Call).is_allowed());
/// # Ok::<(), cara_std::access::AccessError>(())
/// ```
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub struct AccessTable {
    rules: Vec<OwnedRule>,
    /// The line of each rule, if they come from a file.
    lines: Vec<usize>,
    source: String,
}

impl AccessTable {
    /// The rules in their order.
    pub fn rules(&self) -> &[OwnedRule] {
        &self.rules
    }

    /// What the table was read from; empty if it was not.
    pub fn source(&self) -> &str {
        &self.source
    }

    /// The line of the file in which a rule begins, from 1.
    pub fn line(&self, rule: usize) -> Option<usize> {
        self.lines.get(rule).copied()
    }

    /// What the table says.
    pub fn decide(&self, who: Principal<'_>, function: &str, verb: Verb) -> Decision {
        decide(&self.rules, who, function, verb)
    }
}

impl Access for AccessTable {
    fn decide(&self, who: Principal<'_>, function: &str, verb: Verb) -> Decision {
        self.decide(who, function, verb)
    }
}

impl From<Vec<OwnedRule>> for AccessTable {
    fn from(rules: Vec<OwnedRule>) -> Self {
        Self { rules, ..Self::default() }
    }
}

/// The rules of a board.
impl From<&[Rule]> for AccessTable {
    fn from(rules: &[Rule]) -> Self {
        let owned = |rule: &Rule| OwnedRule {
            who: match rule.who {
                Who::Operator => Who::Operator,
                Who::Node { role, name, id } => Who::Node { role, name: name.map(str::to_owned), id },
            },
            functions: match rule.functions {
                Functions::All => Functions::All,
                Functions::Named(names) => Functions::Named(names.iter().map(|&name| name.to_owned()).collect()),
            },
            verbs: rule.verbs,
            rate: rule.rate,
        };
        rules.iter().map(owned).collect::<Vec<_>>().into()
    }
}

/// Each rule on a line, in the words of the file.
impl fmt::Display for AccessTable {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        self.rules.iter().try_for_each(|rule| writeln!(f, "{}", words::Shown(rule)))
    }
}

/// A rule in the words of the file.
pub fn shown(rule: &OwnedRule) -> impl fmt::Display + '_ {
    words::Shown(rule)
}

/// The principals that a file's text names: `*`, `m_units`, `s_units`, `operator`, `NAME/ID`, `NAME/*` or `*/ID`, with
/// `@m_unit` or `@s_unit` behind it where the role matters.
pub fn who(words: &str) -> Result<Who<String>, NotWho> {
    words::who(words)
}
