//! `cara completions`: a script that lets a shell complete verbs and options, and what it asks for while a line is typed: nodes,
//! functions and streams of the unit that runs on this host, and constraints.

use std::process::ExitCode;
use std::sync::mpsc;
use std::time::Duration;

use cara_std::control::protocol::NodeInfo;
use clap::{Command, Parser};
use clap_complete::{Shell, generate};
use serde_json::json;

use crate::command_line::{self, CommandLine};
use crate::nodes;
use crate::operator::{Need, Operator};
use cara_tools::exit::Exit;
use cara_tools::global::Global;
use cara_tools::name_and_id::quoted;
use cara_tools::output;

/// Prints a script with which a shell completes verbs and options; in bash, zsh and fish also nodes, functions and streams of the
/// unit that runs on this host, and constraints.
#[derive(clap::Args)]
#[command(after_help = "\
bash:  cara completions bash > ~/.local/share/bash-completion/completions/cara
zsh:   cara completions zsh > \"${fpath[1]}/_cara\"
fish:  cara completions fish > ~/.config/fish/completions/cara.fish")]
pub(crate) struct Arguments {
    /// The shell.
    #[arg(required_unless_present = "line")]
    shell: Option<Shell>,
    /// What the scripts ask for: the names that the last of these words can be, a line each.
    #[arg(long, hide = true, conflicts_with = "shell")]
    line: bool,
    #[arg(last = true, hide = true, requires = "line")]
    words: Vec<String>,
}

/// A shell that waits for longer seems to hang. The rest of the 300 ms is for the start of this program.
const LONGEST: Duration = Duration::from_millis(250);

const BASH: &str = r#"
_cara_names() {
    _cara "$@"
    local names
    mapfile -t names < <(cara completions --line -- "${COMP_WORDS[@]:1:COMP_CWORD}" 2>/dev/null)
    if [[ ${#names[@]} -gt 0 ]]; then COMPREPLY=("${names[@]}"); fi
}
complete -F _cara_names -o bashdefault -o default cara
"#;

const ZSH: &str = r#"
(( $+functions[_cara_names] )) ||
_cara_names() {
    local -a names
    names=(${(f)"$(cara completions --line -- "${(@Q)words[1,CURRENT]}" 2>/dev/null)"})
    if (( $#names )); then compadd -a names; else _default; fi
}
"#;

const FISH: &str = r#"
function __cara_names
    set -g __cara_found (cara completions --line -- (commandline -opc)[2..-1] (commandline -ct) 2>/dev/null)
    test (count $__cara_found) -gt 0
end
complete -c cara -n __cara_names -f -a '$__cara_found'
"#;
/// The one option whose value is such a name.
const OFFERING: &str = " -l offering ";
const NAMES_OFFERING: &str = " -l offering -f -a '(__cara_names; and string join \\n $__cara_found)' ";

pub(crate) fn run(Arguments { shell, words, .. }: Arguments, global: &Global) -> anyhow::Result<ExitCode> {
    let Some(shell) = shell else {
        let (to, found) = mpsc::channel();
        std::thread::spawn(move || to.send(names(&words)));
        for name in found.recv_timeout(LONGEST).ok().flatten().unwrap_or_default() {
            output::line(name)?;
        }
        return Ok(Exit::Done.into());
    };
    let script = script(shell);
    match global.json {
        true => output::object(&json!({ "shell": shell.to_string(), "script": script }))?,
        false => output::bytes(script.as_bytes())?,
    }
    Ok(Exit::Done.into())
}

fn script(shell: Shell) -> String {
    let mut script = Vec::new();
    generate(shell, &mut command_line::command(), "cara", &mut script);
    let mut script = String::from_utf8_lossy(&script).into_owned();
    match shell {
        Shell::Bash => script += BASH,
        Shell::Fish => script = script.replace(OFFERING, NAMES_OFFERING) + FISH,
        Shell::Zsh => {
            // Its last lines run what stands before them.
            let end = script.rfind("\nif [ \"$funcstack[1]\"").unwrap_or(script.len());
            script.insert_str(end, ZSH);
            // With two colons an action sees the words from there on, and not the verb.
            script = script.replace(":_default'", ":_cara_names'").replace("'*::", "'*:");
        }
        _ => {}
    }
    script
}

/// What a word names.
#[derive(Debug, PartialEq, Eq)]
enum Wanted {
    Node,
    /// A function that is called; of this node, or of any.
    Function(Option<String>),
    Stream(String),
    Constraint,
}

/// The names that the last word can be; `None` if it is none, or if no unit tells.
fn names(words: &[String]) -> Option<Vec<String>> {
    let (last, before) = words.split_last()?;
    let (wanted, shared) = wanted(&command_line::command(), before)?;
    let mut names = match wanted {
        Wanted::Constraint => super::set::names().map(str::to_owned).collect(),
        wanted => {
            let line = ["cara"].into_iter().chain(shared.iter().map(String::as_str)).chain(["watch"]);
            let global = CommandLine::try_parse_from(line).ok()?.global;
            of_unit(&mut Operator::open_if_any(&global, &Need::Nothing).ok()??, &wanted).ok()?
        }
    };
    // A name that a shell would read as something else is typed by hand.
    names.retain(|name| name.starts_with(last.as_str()) && quoted(name) == *name);
    names.sort();
    names.dedup();
    Some(names)
}

/// What comes behind these words, and those of them that say which unit is asked.
fn wanted(command: &Command, before: &[String]) -> Option<(Wanted, Vec<String>)> {
    let (mut verb, mut names, mut shared, mut for_all) = (None::<&Command>, Vec::new(), Vec::new(), false);
    let mut words = before.iter().skip_while(|word| *word == "cara");
    while let Some(word) = words.next() {
        let level = verb.unwrap_or(command);
        let Some(option) = word.strip_prefix('-').filter(|option| !option.is_empty()) else {
            match verb {
                None => verb = Some(command.find_subcommand(word)?),
                Some(_) => names.push(word.clone()),
            }
            continue;
        };
        let (name, value) = option.trim_start_matches('-').split_once('=').unzip();
        let name = name.unwrap_or(option.trim_start_matches('-'));
        let is_it = |arg: &&clap::Arg| {
            arg.get_long() == Some(name) || arg.get_short().is_some_and(|short| name == short.to_string())
        };
        let known = level.get_arguments().find(is_it);
        for_all |= name == "all";
        let mut value = value.map(str::to_owned);
        if value.is_none() && known.is_some_and(|arg| arg.get_action().takes_values()) {
            // Bash parts a word at its `=`.
            match words.by_ref().find(|word| *word != "=") {
                Some(next) => value = Some(next.clone()),
                // The value is what is typed.
                None if name == "offering" => return Some((Wanted::Function(None), shared)),
                None if name == "to" => return Some((Wanted::Node, shared)),
                None => return None,
            }
        }
        match (name, value) {
            // A unit of the command's own would have to be started.
            ("as", _) => return None,
            ("unit" | "socket" | "fleet", Some(value)) => shared.push(format!("--{name}={value}")),
            _ => {}
        }
    }
    let wanted = match (verb?.get_name(), names.as_slice()) {
        ("call", []) if for_all => Wanted::Function(None),
        ("call", [node]) => Wanted::Function(Some(node.clone())),
        ("stream", [node]) => Wanted::Stream(node.clone()),
        ("set", [_]) => Wanted::Constraint,
        ("hand-over", _) => Wanted::Node,
        (
            "functions" | "orders" | "call" | "publish" | "stop" | "reset" | "retire" | "set" | "stream" | "counters"
            | "ping" | "doctor",
            [],
        ) => Wanted::Node,
        _ => return None,
    };
    Some((wanted, shared))
}

fn of_unit(unit: &mut Operator, wanted: &Wanted) -> anyhow::Result<Vec<String>> {
    let nodes = nodes::all(unit, None)?;
    let mut published = Vec::new();
    match wanted {
        Wanted::Function(None) => {
            for node in nodes.iter().filter(|node| node.connected) {
                published.extend(nodes::functions(unit, &nodes::Chosen::among(&nodes, node).selector)?);
            }
        }
        Wanted::Function(Some(node)) | Wanted::Stream(node) => published = nodes::functions(unit, node)?,
        Wanted::Node | Wanted::Constraint => {
            let is_alone = |name: &str| nodes.iter().filter(|node| node.name == name).count() == 1;
            let name = |node: &NodeInfo| if is_alone(&node.name) { node.name.clone() } else { nodes::full_name(node) };
            return Ok(nodes.iter().map(name).collect());
        }
    }
    let of_streams = matches!(wanted, Wanted::Stream(_));
    published.retain(|function| nodes::is_stream(function) == of_streams);
    Ok(published.into_iter().map(|function| function.name).collect())
}

#[cfg(test)]
mod tests {
    use super::{Wanted, command_line, wanted};

    fn of(line: &str) -> Option<(Wanted, Vec<String>)> {
        wanted(&command_line::command(), &line.split(' ').map(str::to_owned).collect::<Vec<_>>())
    }

    #[test]
    fn what_a_word_names_follows_from_those_before_it() {
        let function = |node: &str| Wanted::Function(Some(node.to_owned()));
        for (line, expected) in [
            ("call", Wanted::Node),
            ("cara call agv-1", function("agv-1")),
            ("call --timeout 2s agv-1 --hold", function("agv-1")),
            ("call --all", Wanted::Function(None)),
            ("scan --offering", Wanted::Function(None)),
            ("stream agv-1", Wanted::Stream("agv-1".into())),
            ("set .", Wanted::Constraint),
            ("stop", Wanted::Node),
            ("hand-over agv-1", Wanted::Node),
            ("hand-over agv-1 --to", Wanted::Node),
        ] {
            assert_eq!(of(line), Some((expected, Vec::new())), "{line}");
        }
        let shared = vec!["--fleet=7".to_owned(), "--unit=depot".to_owned()];
        assert_eq!(of("--fleet 7 ping --unit=depot"), Some((Wanted::Node, shared.clone())));
        assert_eq!(of("--fleet = 7 ping --unit = depot"), Some((Wanted::Node, shared)));
        for nothing in
            ["", "call --timeout", "--as me/1 call", "scan", "call agv-1 go_to", "nonsense", "set . chunk_size"]
        {
            assert_eq!(of(nothing), None, "{nothing}");
        }
    }
}
