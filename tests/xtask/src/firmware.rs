//! `cargo xtask firmware` and `cargo xtask sizes`: what runs on boards is built, measured and put on a desk.

mod boards;
mod image;
mod sizes;

use std::process::ExitCode;

use anyhow::Result;

use crate::install;
use boards::{BOARDS, Board};
pub(crate) use sizes::sizes;

/// Builds the images of one board, or of all of them.
pub(crate) fn build(name: Option<&str>) -> Result<ExitCode> {
    for board in chosen(name)? {
        install::rust_target(board.target).map_err(anyhow::Error::msg)?;
        for image in board.images {
            println!("{}", board.build(image)?.display());
        }
    }
    Ok(ExitCode::SUCCESS)
}

fn chosen(name: Option<&str>) -> Result<Vec<&'static Board>> {
    match name {
        None => Ok(BOARDS.iter().collect()),
        Some(name) => Ok(vec![boards::find(name)?]),
    }
}
