//! The paper's names lead to the Rust names: by the same word, or by a `#[doc(alias)]`.

use std::path::Path;

use anyhow::{Result, bail};

use crate::workspace;

/// The paper's names and the project's.
const NAMES: [(&str, &str); 22] = [
    ("Communication_System", "CommunicationSystem"),
    ("Unit", "Unit"),
    ("Parameters", "Parameters"),
    ("Function", "Function"),
    ("Function_list", "FunctionList"),
    ("Connection_handler", "Node"),
    ("Connections", "Link"),
    ("Mailman", "Mailman"),
    ("start_thread", "start"),
    ("get_number_s_units", "number_of_s_units"),
    ("s_units", "s_units"),
    ("broadcast", "broadcast"),
    ("their_function_list", "their_function_list"),
    ("show_functions", "show_functions"),
    ("block_request_their_function", "block_request"),
    ("request_their_function", "request"),
    ("add_int", "add_int"),
    ("set_value", "set_value"),
    ("get_variable", "variable"),
    ("my_function_list", "my_function_list"),
    ("add_function", "add_function"),
    ("publish_my_function_list", "publish_my_function_list"),
];

/// Looks for every name in the core and in the Linux port.
pub(crate) fn check() -> Result<()> {
    let mut sources = String::new();
    for file in workspace::files_with("rs")? {
        if file.starts_with("core/src") || file.starts_with(Path::new("std-port/src")) {
            sources.push_str(&workspace::read(&file)?);
        }
    }
    let wrong = missing(&sources);
    if wrong.is_empty() {
        println!("{} names of the paper are found", NAMES.len());
        return Ok(());
    }
    wrong.iter().for_each(|line| eprintln!("{line}"));
    bail!("{} names of the paper are not found", wrong.len())
}

fn missing(sources: &str) -> Vec<String> {
    NAMES
        .iter()
        .filter_map(|(paper, code)| {
            if paper != code && !has_alias(sources, paper) {
                return Some(format!("`{code}` lacks #[doc(alias = \"{paper}\")]"));
            }
            (!is_defined(sources, code)).then(|| format!("`{code}` is no public item"))
        })
        .collect()
}

/// Aliases stand alone or in a list: `alias = "a"`, `alias("a", "b")`.
fn has_alias(sources: &str, name: &str) -> bool {
    let quoted = format!("\"{name}\"");
    sources.lines().any(|line| line.trim_start().starts_with("#[doc(alias") && line.contains(&quoted))
}

fn is_defined(sources: &str, name: &str) -> bool {
    let kinds = ["fn", "struct", "trait", "enum", "type", "mod"];
    sources.lines().any(|line| {
        let words: Vec<&str> = line.split(|c: char| !c.is_alphanumeric() && c != '_').collect();
        line.contains("pub ") && words.windows(2).any(|pair| kinds.contains(&pair[0]) && pair[1] == name)
    })
}

#[cfg(test)]
mod tests {
    use super::{NAMES, missing};

    /// Sources with every name; `change` takes one thing out.
    fn sources(change: impl Fn(&str) -> String) -> String {
        let item = |(paper, code): &(&str, &str)| {
            let alias = if paper == code { String::new() } else { format!("#[doc(alias = \"{paper}\")]\n") };
            change(&format!("{alias}pub fn {code}() {{}}\n"))
        };
        NAMES.iter().map(item).collect()
    }

    #[test]
    fn all_names_are_found() {
        assert!(missing(&sources(str::to_owned)).is_empty());
    }

    #[test]
    fn a_name_without_alias_or_item_is_told() {
        assert_eq!(missing(&sources(|item| item.replace("\"start_thread\"", "\"started\""))).len(), 1);
        assert_eq!(missing(&sources(|item| item.replace("pub fn add_int", "fn add_int"))).len(), 1);
    }
}
