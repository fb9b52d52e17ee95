//! What boards there are, and what a page says.

use std::path::Path;

use anyhow::Context;
use cara_settings::board::BOARDS;
use cara_settings::page::{PageError, decode};
use cara_settings::uf2::{BLOCK, PAYLOAD};
use serde_json::json;

use crate::exit::Ended;
use crate::global::Global;
use crate::output::{self, PLAIN, Rows};

/// Prints the table of boards.
pub(super) fn boards(global: &Global) -> anyhow::Result<()> {
    let mut rows = Rows::new(["board", "chip", "first page", "second page", "file", "what it is"]);
    for board in BOARDS {
        let [first, second] = board.pages;
        let file = if board.uf2.is_some() { "uf2" } else { "bin" };
        if global.json {
            output::object(&json!({
                "board": board.name, "chip": board.chip, "pages": board.pages, "erase_bytes": board.erase_bytes,
                "file": file, "wireless": board.wireless, "description": board.description,
            }))?;
        }
        let cells = [board.name, board.chip, &format!("{first:#x}"), &format!("{second:#x}"), file, board.description];
        rows.add(PLAIN, cells.map(str::to_owned));
    }
    if global.json { Ok(()) } else { Ok(rows.print()?) }
}

/// Prints what the pages in a file say. Passwords are not shown.
pub(super) fn file(file: &Path, global: &Global) -> anyhow::Result<()> {
    let bytes = std::fs::read(file).with_context(|| format!("cannot read {}", file.display()))?;
    for page in pages(&bytes) {
        page_of(page, global).map_err(|error| Ended::failed("Page", format!("{}: {error}", file.display())))??;
    }
    Ok(())
}

/// The pages of a UF2 file, or the one page that the file is.
fn pages(bytes: &[u8]) -> Vec<&[u8]> {
    const HEADER: usize = 32;
    if !bytes.starts_with(b"UF2\n") {
        return vec![bytes];
    }
    bytes.chunks(BLOCK).map(|block| block.get(HEADER..HEADER + PAYLOAD).unwrap_or_default()).collect()
}

fn page_of(page: &[u8], global: &Global) -> Result<std::io::Result<()>, PageError> {
    let (settings, generation) = decode(page)?;
    let wifi = settings.wifi.as_ref().map(|wifi| wifi.name());
    Ok(match global.json {
        true => output::object(&json!({ "generation": generation, "settings": settings.to_string(), "wifi": wifi })),
        false => {
            let wifi = wifi.map(|name| format!(", Wi-Fi {name}")).unwrap_or_default();
            output::line(format_args!("generation {generation}: {settings}{wifi}"))
        }
    })
}

#[cfg(test)]
mod tests {
    use super::pages;

    #[test]
    fn a_cut_file_has_a_page_of_nothing() {
        assert_eq!(pages(b""), [b""]);
        assert_eq!(pages(b"UF2\nshort"), [b""]);
    }
}
