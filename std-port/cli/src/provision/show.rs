//! What boards there are, and what a page says.

use std::path::Path;

use cara_settings::board::BOARDS;
use cara_settings::keys::KeysError;
use cara_settings::page::{BYTES, decode};
use cara_settings::uf2::{BLOCK, PAYLOAD};
use serde_json::json;
use zeroize::Zeroizing;

use super::secrets::{Shown, told};
use crate::exit::Ended;
use crate::global::Global;
use crate::output::{self, PLAIN, Rows};

/// Bytes of a UF2 block before its payload.
const HEADER: usize = 32;

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

/// Prints what the pages in a file say. Passwords and keys are not shown.
pub(super) fn file(file: &Path, global: &Global) -> anyhow::Result<()> {
    let bytes = super::read_whole(file)?;
    for page in pages(&bytes) {
        page_of(&page, global).map_err(|error| Ended::failed("Page", format!("{}: {error}", file.display())))??;
    }
    Ok(())
}

/// The pages of a UF2 file, or the one page that the file is. Blocks that follow each other are of one page.
fn pages(bytes: &[u8]) -> Vec<Zeroizing<Vec<u8>>> {
    if !bytes.starts_with(b"UF2\n") {
        return vec![Zeroizing::new(bytes.to_vec())];
    }
    let mut pages: Vec<(u32, Zeroizing<Vec<u8>>)> = Vec::new();
    for block in bytes.chunks(BLOCK) {
        let address = block.get(12..).and_then(|rest| rest.first_chunk()).map_or(0, |bytes| u32::from_le_bytes(*bytes));
        let payload = block.get(HEADER..HEADER + PAYLOAD).unwrap_or_default();
        match pages.last_mut().filter(|(start, page)| start.checked_add(page.len() as u32) == Some(address)) {
            Some((_, page)) => page.extend_from_slice(payload),
            None => {
                let mut page = Zeroizing::new(Vec::with_capacity(BYTES));
                page.extend_from_slice(payload);
                pages.push((address, page));
            }
        }
    }
    pages.into_iter().map(|(_, page)| page).collect()
}

fn page_of(page: &[u8], global: &Global) -> Result<std::io::Result<()>, KeysError> {
    let (settings, generation) = decode(page)?;
    let wifi = settings.wifi.as_ref().map(|wifi| wifi.name());
    let keys = told(page)?;
    Ok(match global.json {
        true => {
            let keys = keys.map(|Shown { generations, peers }| json!({ "generations": generations, "peers": peers }));
            let settings = settings.to_string();
            output::object(&json!({ "generation": generation, "settings": settings, "wifi": wifi, "keys": keys }))
        }
        false => {
            let wifi = wifi.map(|name| format!(", Wi-Fi {name}")).unwrap_or_default();
            output::line(format_args!(
                "generation {generation}: {settings}{wifi}{}",
                keys.map(in_words).unwrap_or_default()
            ))
        }
    })
}

fn in_words(Shown { generations, peers }: Shown) -> String {
    let generations: Vec<_> = generations.iter().map(u32::to_string).collect();
    format!(", keys of generation {} with {}", generations.join(" and "), peers.join(", "))
}

#[cfg(test)]
mod tests {
    use super::pages;

    #[test]
    fn a_cut_file_has_a_page_of_nothing() {
        let of = |bytes: &[u8]| pages(bytes).iter().map(|page| page.to_vec()).collect::<Vec<_>>();
        assert_eq!(of(b""), [b""]);
        assert_eq!(of(b"UF2\nshort"), [b""]);
    }
}
