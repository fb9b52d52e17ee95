//! What a guide asks its reader to do, read from the code blocks of its Markdown.
//!
//! - `console` is what is typed and seen in a terminal: `$ ` begins a command, which a line ending in `\` continues;
//!   the lines below it are what it prints; `^C` ends the command that runs there. `console NAME` is another terminal.
//! - `LANGUAGE file=PATH` is a file that the reader writes, relative to where the first terminal is.
//!
//! Other code blocks are only read.

use anyhow::{Result, bail};

/// A code block.
#[derive(Debug, PartialEq, Eq)]
pub(crate) struct Block {
    /// The terminal's name; empty for the first one.
    pub(crate) terminal: String,
    pub(crate) steps: Vec<Step>,
}

/// One thing that the reader does.
#[derive(Debug, PartialEq, Eq)]
pub(crate) enum Step {
    /// Types a command and sees its output.
    Command { line: usize, text: String, output: Vec<String>, stays: bool },
    /// Ends the running command with Ctrl-C.
    Interrupt { line: usize },
    /// Writes a file.
    File { line: usize, path: String, text: String },
}

impl Step {
    /// Where in the guide it begins.
    pub(crate) const fn line(&self) -> usize {
        match self {
            Self::Command { line, .. } | Self::Interrupt { line } | Self::File { line, .. } => *line,
        }
    }

    /// Whether it builds packages that it names: those of the checkout.
    pub(crate) fn builds_packages(&self) -> bool {
        matches!(self, Self::Command { text, .. } if text.starts_with("cargo build ") && text.contains(" --package "))
    }
}

/// The blocks of a guide that ask for something, in its order.
pub(crate) fn blocks(text: &str) -> Result<Vec<Block>> {
    let mut blocks = Vec::new();
    let mut lines = text.lines().zip(1..);
    while let Some((fence, begin)) = lines.next() {
        let Some(information) = fence.strip_prefix("```") else { continue };
        let mut inside = Vec::new();
        loop {
            match lines.next() {
                Some(("```", _)) => break,
                Some(line) => inside.push(line),
                None => bail!("the code block of line {begin} does not end"),
            }
        }
        blocks.extend(block(information, begin, &inside)?);
    }
    mark_those_that_stay(&mut blocks);
    Ok(blocks)
}

fn block(information: &str, begin: usize, inside: &[(&str, usize)]) -> Result<Option<Block>> {
    let (language, rest) = information.split_once(' ').unwrap_or((information, ""));
    if let Some(path) = rest.split(' ').find_map(|word| word.strip_prefix("file=")) {
        let text = inside.iter().fold(String::new(), |text, (line, _)| text + line + "\n");
        let steps = vec![Step::File { line: begin, path: path.to_owned(), text }];
        return Ok(Some(Block { terminal: String::new(), steps }));
    }
    if language != "console" {
        return Ok(None);
    }
    Ok(Some(Block { terminal: rest.to_owned(), steps: session(inside)? }))
}

fn session(inside: &[(&str, usize)]) -> Result<Vec<Step>> {
    let mut steps: Vec<Step> = Vec::new();
    let mut lines = inside.iter();
    while let Some(&(text, line)) = lines.next() {
        if text == "^C" {
            steps.push(Step::Interrupt { line });
        } else if let Some(typed) = text.strip_prefix("$ ") {
            let mut command = typed.to_owned();
            while command.ends_with('\\') {
                command.truncate(command.len() - 1);
                let Some((more, _)) = lines.next() else { bail!("the command of line {line} does not end") };
                command.push_str(more.strip_prefix("> ").unwrap_or(more));
            }
            steps.push(Step::Command { line, text: command, output: Vec::new(), stays: false });
        } else if let Some(Step::Command { output, .. }) = steps.last_mut() {
            output.push(text.to_owned());
        } else {
            bail!("line {line} is neither a command (`$ …`) nor the output of one");
        }
    }
    Ok(steps)
}

/// A command that a later `^C` of its terminal ends runs until then.
fn mark_those_that_stay(blocks: &mut [Block]) {
    let mut ended = std::collections::BTreeSet::new();
    for block in blocks.iter_mut().rev() {
        for step in block.steps.iter_mut().rev() {
            match step {
                Step::Interrupt { .. } => drop(ended.insert(block.terminal.clone())),
                Step::Command { stays, .. } => *stays = ended.remove(&block.terminal),
                Step::File { .. } => {}
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_session_has_commands_with_their_output() {
        let blocks = blocks("text\n```console\n$ one \\\n> two\nseen\n$ three\n```\n```text\n$ no\n```\n").unwrap();
        let one = Step::Command { line: 3, text: "one two".into(), output: vec!["seen".into()], stays: false };
        let three = Step::Command { line: 6, text: "three".into(), output: vec![], stays: false };
        assert_eq!(blocks, [Block { terminal: String::new(), steps: vec![one, three] }]);
    }

    #[test]
    fn what_is_interrupted_later_stays_until_then() {
        let text = "```console agv\n$ agv\n```\n```console\n$ scan\n```\n```console agv\n^C\n$ true\n```\n";
        let stays = |step: &Step| matches!(step, Step::Command { stays: true, .. });
        let which: Vec<bool> = blocks(text).unwrap().iter().flat_map(|block| block.steps.iter().map(stays)).collect();
        assert_eq!(which, [true, false, false, false]);
    }

    #[test]
    fn a_file_is_written_as_it_stands() {
        let file = Step::File { line: 1, path: "a/b.rs".into(), text: "fn main() {}\n\n".into() };
        let expected = [Block { terminal: String::new(), steps: vec![file] }];
        assert_eq!(blocks("```rust file=a/b.rs\nfn main() {}\n\n```\n").unwrap(), expected);
    }

    #[test]
    fn what_cannot_be_followed_is_refused() {
        assert!(blocks("```console\n$ one\n").is_err());
        assert!(blocks("```console\nseen\n```\n").is_err());
        assert!(blocks("```console\n$ one \\\n```\n").is_err());
    }
}
