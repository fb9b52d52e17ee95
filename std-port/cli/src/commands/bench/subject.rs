//! Which function is measured.

use cara_std::control::protocol::{Argument, ArgumentValue, CallQuestion, FunctionInfo};
use cara_std::{Definition, Type};

use crate::nodes;
use crate::operator::Operator;
use cara_tools::exit::Ended;

/// A function that takes one string.
#[derive(Clone, Debug, PartialEq)]
pub(crate) struct Subject {
    pub(crate) node: String,
    pub(crate) function: String,
    pub(crate) signature: String,
    argument: String,
    size: u32,
    /// Its calls move something, each for the length of a lease.
    pub(crate) is_leased: bool,
}

impl Subject {
    /// Of a node's function; `None` if it does not take one string and nothing else. `echo`: and return one.
    fn of(node: &str, info: &FunctionInfo, echo: bool) -> Option<Self> {
        let definition = Definition::parse(&info.signature).ok()?;
        let signature = definition.signature();
        let mut arguments = signature.arguments();
        let only = arguments.next().filter(|only| only.kind == Type::String)?;
        let returns = signature.results().any(|result| result.kind == Type::String && result.size >= only.size);
        let fits = arguments.next().is_none() && (returns || !echo);
        fits.then(|| Self {
            node: node.to_owned(),
            function: info.name.clone(),
            signature: info.signature.clone(),
            argument: only.name.to_owned(),
            size: only.size,
            is_leased: info.attributes.lease.is_some(),
        })
    }

    /// The longest string that it takes.
    pub(crate) fn longest(&self) -> usize {
        self.size as usize
    }

    /// A call with a string of so many characters.
    pub(crate) fn call(&self, characters: usize, asynchronous: bool) -> CallQuestion {
        let value = ArgumentValue::String("x".repeat(characters));
        CallQuestion {
            node: Some(self.node.clone()),
            function: self.function.clone(),
            arguments: vec![Argument { name: self.argument.clone(), size: self.size, value }],
            asynchronous,
            timeout_ms: None,
            priority: None,
            best_effort: false,
            take_over: false,
            progress: false,
        }
    }
}

/// The function of that name, or else the first that takes a string and returns one.
pub(crate) fn choose(operator: &mut Operator, node: &str, name: Option<&str>) -> anyhow::Result<Subject> {
    let functions = nodes::functions(operator, node)?;
    let Some(name) = name else {
        let found = functions.iter().find_map(|info| Subject::of(node, info, true));
        return found.ok_or_else(|| {
            let text = format!(
                "{node} has published no function that takes one string and returns it, as \
                 echo(text: string[20000]) -> (text: string[20000]); name one that takes a string with --function"
            );
            Ended::usage(text)
        });
    };
    let Some(info) = functions.iter().find(|info| info.name == name) else {
        return Err(nodes::no_such_function(node, name, &functions));
    };
    Subject::of(node, info, false)
        .ok_or_else(|| Ended::usage(format!("`{name}` does not take one string and nothing else: {}", info.signature)))
}

#[cfg(test)]
mod tests {

    use super::{FunctionInfo, Subject};

    fn longest(signature: &str, echo: bool) -> Option<usize> {
        let info = FunctionInfo { name: "f".into(), signature: signature.into(), ..FunctionInfo::default() };
        Subject::of("agv/1", &info, echo).map(|subject| subject.longest())
    }

    #[test]
    fn what_takes_one_string_is_found() {
        assert_eq!(longest("f(text: string[9]) -> (text: string[9])", true), Some(9));
        assert_eq!(longest("f(text: string[9]) -> (back: string[10])", true), Some(9));
        assert_eq!(longest("f(text: string[9])", true), None);
        assert_eq!(longest("f(text: string[9])", false), Some(9));
        for other in ["f()", "f(x: int)", "f(text: string[9], x: int)"] {
            assert_eq!(longest(other, false), None, "{other}");
        }
    }
}
