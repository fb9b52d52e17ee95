//! The claim that a board has obeyed, after a restart of its own.

use std::path::Path;

use anyhow::{Result, ensure};
use cara_std::UnitEvent;

use crate::board::{Bench, Who};
use crate::manager::{Manager, position, sets_out};

/// The old manager has started once before, and claims the term behind that. The board refuses it. It finds that the new one is not
/// there any more, and raises its claim.
pub(super) fn kept(bench: &Bench, _: u32) -> Result<String> {
    let (cable, who, folder) = (bench.cable()?, Who::agv(17), tempfile::tempdir()?);
    let start = |folder: &Path| Manager::of(bench.keys.give(Manager::builder()?.state_folder(folder))?);
    let (old, new) = (folder.path().join("old"), folder.path().join("new"));
    for started_before in [&old, &new, &new] {
        drop(start(started_before)?);
    }
    let manager = start(&new)?;
    let board = bench.board(&cable, &who)?;
    // The claim is stored before this call runs.
    let agv = manager.meet(&who)?;
    sets_out(&agv, [0, 5])?;
    agv.release("go_to")?;
    let obeyed = manager.system.claim();
    drop(manager);
    board.cut_power()?;

    let manager = start(&old)?;
    let refused = manager.system.claim();
    ensure!(obeyed > refused, "{obeyed} is not higher than {refused}");
    let _board = bench.board(&cable, &who)?;
    let answers = |event: &UnitEvent| matches!(event, UnitEvent::Joined { .. } | UnitEvent::Raised { .. });
    let event = manager.event("answer of the board", answers)?;
    ensure!(matches!(event, UnitEvent::Raised { claim } if claim > obeyed), "the old manager sees {event:?}");
    position(&manager.meet(&who)?)?;
    let raised = manager.system.claim();
    Ok(format!("{obeyed} obeyed, {refused} refused after the restart, {raised} obeyed"))
}
