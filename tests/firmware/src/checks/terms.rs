//! The term that a board has obeyed, after a restart of its own.

use std::path::Path;

use anyhow::{Result, ensure};
use cara_std::UnitEvent;

use crate::board::{Bench, Who};
use crate::manager::{Manager, position};

/// The old manager has started once before, and claims the term behind that. What fences it is kept, so that its next start
/// claims a newer one.
pub(super) fn kept(bench: &Bench, _: u32) -> Result<String> {
    let (cable, who, folder) = (bench.cable()?, Who::agv(17), tempfile::tempdir()?);
    let start = |folder: &Path| Manager::of(bench.keys.give(Manager::builder()?.state_folder(folder))?);
    let (old, new) = (folder.path().join("old"), folder.path().join("new"));
    for started_before in [&old, &new, &new] {
        drop(start(started_before)?);
    }
    let manager = start(&new)?;
    let board = bench.board(&cable, &who)?;
    // The term is kept before this call runs.
    position(&manager.meet(&who)?)?;
    let obeyed = manager.system.claim();
    drop(manager);
    board.cut_power()?;

    let manager = start(&old)?;
    let refused = manager.system.claim();
    ensure!(obeyed > refused, "{obeyed} is not higher than {refused}");
    let _board = bench.board(&cable, &who)?;
    let ends = |event: &UnitEvent| matches!(event, UnitEvent::Joined { .. } | UnitEvent::Fenced { .. });
    let event = manager.event("answer of the board", ends)?;
    ensure!(matches!(event, UnitEvent::Fenced { claim } if claim == obeyed), "the old manager sees {event:?}");
    drop(manager);

    let manager = start(&old)?;
    let newest = manager.system.claim();
    ensure!(newest > obeyed, "{newest} is not higher than {obeyed}");
    position(&manager.meet(&who)?)?;
    Ok(format!("term {obeyed} obeyed, {refused} refused after the restart, {newest} obeyed"))
}
