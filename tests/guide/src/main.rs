//! Runs every command of a guide as its reader would, and compares what it prints with what the guide says.
//!
//! What a guide's code blocks mean is told in [`document`].

mod document;
mod expectation;
mod terminal;

use std::collections::BTreeMap;
use std::path::{Path, PathBuf};
use std::time::Instant;

use anyhow::{Context, Result, ensure};
use clap::Parser;

use document::{Block, Step};
use terminal::{Surroundings, Terminal};

/// Runs the commands of a guide in its order, each in its terminal.
#[derive(Parser)]
struct Arguments {
    /// The guide, a Markdown file.
    guide: PathBuf,
    /// Where its commands begin: the root of a checkout.
    #[arg(long, default_value = ".")]
    root: PathBuf,
    /// The checkout is built: what the guide builds there is left out.
    #[arg(long)]
    built: bool,
}

fn main() -> Result<()> {
    let Arguments { guide, root, built } = Arguments::parse();
    let text = std::fs::read_to_string(&guide).with_context(|| format!("cannot read {}", guide.display()))?;
    let mut blocks = document::blocks(&text).with_context(|| guide.display().to_string())?;
    if built {
        blocks.iter_mut().for_each(|block| block.steps.retain(|step| !step.builds_packages()));
    }
    ensure!(!blocks.is_empty(), "{} has no commands", guide.display());
    let start = Instant::now();
    let commands = follow(&blocks, &root.canonicalize()?)?;
    println!("{commands} commands of {} did what it says, in {:.0} s", guide.display(), start.elapsed().as_secs_f64());
    Ok(())
}

/// Goes through the guide; returns how many commands were run.
fn follow(blocks: &[Block], root: &Path) -> Result<usize> {
    let surroundings = Surroundings::new(root)?;
    let mut terminals: BTreeMap<&str, Terminal> = BTreeMap::new();
    let mut commands = 0;
    for block in blocks {
        let terminal =
            terminals.entry(&block.terminal).or_insert_with(|| Terminal::new(&block.terminal, &surroundings));
        for step in &block.steps {
            commands += usize::from(matches!(step, Step::Command { .. }));
            terminal.take(step).with_context(|| format!("line {} of the guide", step.line()))?;
        }
    }
    terminals.values_mut().try_for_each(Terminal::close)?;
    Ok(commands)
}
