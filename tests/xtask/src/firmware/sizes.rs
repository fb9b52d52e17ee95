//! The bill: what every firmware takes of its board, and which part of that is CARA's.

use std::path::Path;
use std::process::ExitCode;

use anyhow::Result;
use serde_json::{Value, json};

use super::boards::{BOARDS, Board};
use super::image::{Footprint, footprint};
use crate::install;

/// A line of the bill.
struct Row {
    board: &'static str,
    image: &'static str,
    footprint: Footprint,
    /// The difference to the bare echo on the same board.
    cara: Footprint,
}

/// Builds every firmware, prints what it takes, and writes the same as JSON.
pub(crate) fn sizes(json: Option<&Path>) -> Result<ExitCode> {
    let mut rows = Vec::new();
    for board in &BOARDS {
        rows.extend(of_board(board)?);
    }
    println!("{:16} {:8} {:>9} {:>11} {:>11} {:>9}", "board", "image", "flash", "static RAM", "CARA flash", "CARA RAM");
    for Row { board, image, footprint, cara } in &rows {
        let Footprint { flash, static_ram } = footprint;
        println!("{board:16} {image:8} {flash:>9} {static_ram:>11} {:>11} {:>9}", cara.flash, cara.static_ram);
    }
    if let Some(path) = json {
        let rows: Vec<Value> = rows.iter().map(Row::to_json).collect();
        std::fs::write(path, serde_json::to_string_pretty(&rows)? + "\n")?;
    }
    Ok(ExitCode::SUCCESS)
}

fn of_board(board: &'static Board) -> Result<Vec<Row>> {
    install::rust_target(board.target).map_err(anyhow::Error::msg)?;
    let mut footprints = Vec::new();
    for image in board.images {
        footprints.push((*image, footprint(&board.build(image)?)?));
    }
    let bare = footprints.last().map_or_else(Footprint::default, |(_, bare)| *bare);
    let row = |(image, footprint): (&'static str, Footprint)| Row {
        board: board.name,
        image,
        footprint,
        cara: Footprint {
            flash: footprint.flash.saturating_sub(bare.flash),
            static_ram: footprint.static_ram.saturating_sub(bare.static_ram),
        },
    };
    Ok(footprints.into_iter().map(row).collect())
}

impl Row {
    fn to_json(&self) -> Value {
        let Self { board, image, footprint, cara } = self;
        json!({
            "board": board, "image": image,
            "flash": footprint.flash, "static_ram": footprint.static_ram, "stack": null,
            "cara_flash": cara.flash, "cara_ram": cara.static_ram,
        })
    }
}
