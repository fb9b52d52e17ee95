//! `cara completions`: a script that lets a shell complete verbs and options.

use std::process::ExitCode;

use clap_complete::{Shell, generate};
use serde_json::json;

use crate::command_line;
use cara_tools::exit::Exit;
use cara_tools::global::Global;
use cara_tools::output;

/// Prints a script with which a shell completes verbs and options.
#[derive(clap::Args)]
#[command(after_help = "\
bash:  cara completions bash > ~/.local/share/bash-completion/completions/cara
zsh:   cara completions zsh > \"${fpath[1]}/_cara\"
fish:  cara completions fish > ~/.config/fish/completions/cara.fish")]
pub(crate) struct Arguments {
    /// The shell.
    shell: Shell,
}

pub(crate) fn run(Arguments { shell }: Arguments, global: &Global) -> anyhow::Result<ExitCode> {
    let mut script = Vec::new();
    generate(shell, &mut command_line::command(), "cara", &mut script);
    match global.json {
        true => output::object(&json!({ "shell": shell.to_string(), "script": String::from_utf8_lossy(&script) }))?,
        false => output::bytes(&script)?,
    }
    Ok(Exit::Done.into())
}
