//! Errors as text: their name, who must act, and what to do.

use std::fmt::Display;

use cara_core::error::{Cause, Error};
use cara_core::services::access::Verb;

use super::protocol::Failure;

impl Failure {
    /// A failure of the question itself: whoever asks must ask otherwise.
    pub fn configuration(error: &str, text: impl Display) -> Self {
        Self::new(Cause::Configuration, error, text)
    }

    /// A failure for which the unit lacks something.
    pub fn resource(error: &str, text: impl Display) -> Self {
        Self::new(Cause::Resource, error, text)
    }

    /// The unit's access table does not let the operator do this.
    pub(super) fn not_allowed(function: &str, verb: Verb) -> Self {
        let verb = match verb {
            Verb::List => "list",
            Verb::Call => "call",
            Verb::Publish => "publish",
        };
        let text = format!(
            "the unit's access table does not let the operator {verb} '{function}': \
             add a rule with who = \"operator\" to it"
        );
        Self::new(Error::NotAllowed.cause(), &name_of(&Error::NotAllowed), text)
    }

    fn new(cause: Cause, error: &str, text: impl Display) -> Self {
        Self { cause: cause_word(cause).to_owned(), error: error.to_owned(), text: text.to_string() }
    }

    /// The same with more to its text.
    pub(super) fn and(mut self, more: impl Display) -> Self {
        self.text = format!("{}; {more}", self.text);
        self
    }
}

impl Display for Failure {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.write_str(&self.text)
    }
}

impl From<Error> for Failure {
    fn from(error: Error) -> Self {
        Self::new(error.cause(), &name_of(&error), error)
    }
}

/// The name of a variant: the debug form up to its fields.
pub(super) fn name_of(error: &impl std::fmt::Debug) -> String {
    let text = format!("{error:?}");
    let end = text.find(|character: char| !character.is_alphanumeric()).unwrap_or(text.len());
    text[..end].to_owned()
}

fn cause_word(cause: Cause) -> &'static str {
    match cause {
        Cause::Configuration => "configuration",
        Cause::Peer => "peer",
        Cause::Resource => "resource",
        Cause::Transport => "transport",
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn an_error_keeps_its_name_and_says_who_must_act() {
        let failure = Failure::from(Error::WrongSize { index: 0, expected: 2, found: 3 });
        assert_eq!((failure.cause.as_str(), failure.error.as_str()), ("configuration", "WrongSize"));
        assert!(failure.text.contains('2') && failure.text.contains('3'), "{failure}");
        assert_eq!(Failure::from(Error::TimedOut).error, "TimedOut");
        assert_eq!(Failure::from(Error::TimedOut).cause, "peer");
    }
}
