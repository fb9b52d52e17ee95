//! Errors as text: their name, where the remedy lies, and what to do.

use std::fmt::Display;

use cara_core::error::{Cause, CloseReason, Error, ServiceError};
use cara_core::services::access::Verb;

use super::protocol::Failure;
use super::role::Role;

impl Failure {
    /// A failure of the question itself: it must be asked otherwise.
    pub fn configuration(error: &str, text: impl Display) -> Self {
        Self::new(Cause::Configuration, error, text)
    }

    /// A failure of the node that was asked.
    pub(super) fn peer(error: &str, text: impl Display) -> Self {
        Self::new(Cause::Peer, error, text)
    }

    /// A failure for which the unit lacks something.
    pub(crate) fn resource(error: &str, text: impl Display) -> Self {
        Self::new(Cause::Resource, error, text)
    }

    /// A call of all skipped a node that is connected and `lacks` the function, or is not connected.
    pub fn not_called(lacks: Option<&str>) -> Self {
        let (error, text) = match lacks {
            Some(function) => {
                ("UnknownFunction", format!("it does not offer '{function}' to this unit, and was not called"))
            }
            None => {
                let text = "it was not connected, and was not called: ask again when it is back";
                ("NotConnected", text.to_owned())
            }
        };
        Self::new(Error::NotConnected.cause(), error, text)
    }

    /// The unit's access table does not let the operator do this.
    pub(super) fn not_allowed(function: &str, verb: Verb) -> Self {
        let verb = match verb {
            Verb::List => "list",
            Verb::Call => "call",
            Verb::Publish => "publish",
            Verb::TakeOver => "take over",
        };
        let text = format!(
            "the unit's access table does not let the operator {verb} '{function}': \
             add a rule with who = \"operator\" to it"
        );
        Self::new(Error::NotAllowed.cause(), &name_of(&Error::NotAllowed), text)
    }

    /// The operator's role does not include it.
    pub fn role(has: Role, needed: Role) -> Self {
        let text = format!(
            "this needs the role `{needed}`, and you have `{has}`; every role may stop. Roles are given by the unit's \
             `operators` and by the page's token file"
        );
        Self::new(Error::NotAllowed.cause(), &name_of(&Error::NotAllowed), text)
    }

    fn new(cause: Cause, error: &str, text: impl Display) -> Self {
        let (cause, error) = (cause_word(cause).to_owned(), error.to_owned());
        Self { cause, error, kind: None, code: None, said: None, text: text.to_string() }
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
        let code = if let Error::Service(ServiceError::Failed(code)) = error { Some(code) } else { None };
        Self { kind: kind_of(&error), code, ..Self::new(error.cause(), &name_of(&error), error) }
    }
}

/// What an error says beyond its own name.
fn kind_of(error: &Error) -> Option<String> {
    match error {
        Error::Service(error) => Some(name_of(error)),
        Error::Refused(refusal) | Error::Closed(CloseReason::Refused(refusal)) => Some(name_of(refusal)),
        Error::Closed(reason) => Some(name_of(reason)),
        Error::Full(limit) => Some(name_of(limit)),
        _ => None,
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
        let failed = Failure::from(Error::Service(ServiceError::Failed(7)));
        assert_eq!((failed.error.as_str(), failed.kind.as_deref(), failed.code), ("Service", Some("Failed"), Some(7)));
        assert_eq!(Failure::from(Error::TimedOut).cause, "peer");
    }
}
