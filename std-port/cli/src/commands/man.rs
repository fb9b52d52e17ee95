//! `cara man`: the man page, made of the help texts.

use std::path::PathBuf;
use std::process::ExitCode;

use anyhow::Context;
use clap::Command;
use clap_mangen::Man;
use serde_json::json;

use crate::command_line;
use cara_tools::exit::Exit;
use cara_tools::global::Global;
use cara_tools::output;

/// Prints the man page, or writes it with one page for each verb into a folder.
#[derive(clap::Args)]
pub(crate) struct Arguments {
    /// Write cara.1 and a page for each verb there.
    #[arg(long, value_name = "FOLDER")]
    dir: Option<PathBuf>,
}

pub(crate) fn run(Arguments { dir }: Arguments, global: &Global) -> anyhow::Result<ExitCode> {
    let mut command = command_line::command();
    command.build();
    match dir {
        Some(dir) => write(command, &dir, global)?,
        None => {
            let page = page(command)?;
            match global.json {
                true => output::object(&json!({ "page": String::from_utf8_lossy(&page) }))?,
                false => output::bytes(&page)?,
            }
        }
    }
    Ok(Exit::Done.into())
}

fn page(command: Command) -> anyhow::Result<Vec<u8>> {
    let mut page = Vec::new();
    Man::new(command).render(&mut page)?;
    Ok(page)
}

/// The command, its verbs, and theirs.
fn with_verbs(command: Command) -> Vec<Command> {
    let verbs: Vec<_> = command.get_subcommands().filter(|verb| verb.get_name() != "help").cloned().collect();
    [command].into_iter().chain(verbs.into_iter().flat_map(with_verbs)).collect()
}

fn write(command: Command, dir: &std::path::Path, global: &Global) -> anyhow::Result<()> {
    std::fs::create_dir_all(dir).with_context(|| format!("{} cannot be made", dir.display()))?;
    let mut written = Vec::new();
    for command in with_verbs(command) {
        let path = dir.join(format!("{}.1", command.get_display_name().unwrap_or_else(|| command.get_name())));
        std::fs::write(&path, page(command)?).with_context(|| format!("{} cannot be written", path.display()))?;
        written.push(path.display().to_string());
    }
    match global.json {
        true => output::object(&json!({ "written": written }))?,
        false => written.iter().try_for_each(output::line)?,
    }
    Ok(())
}
