//! What boards there are, and what a page says.

use std::path::Path;

use cara_settings::Settings;
use cara_settings::board::{BOARDS, Board};
use cara_settings::keys::KeysError;
use cara_settings::page::{BYTES, decode};
use cara_settings::uf2::{BLOCK, PAYLOAD};
use serde_json::json;
use zeroize::Zeroizing;

use super::secrets::{Shown, given, given_by};
use super::text::{self, EMULATED};
use cara_tools::exit::Ended;
use cara_tools::global::Global;
use cara_tools::output::{self, PLAIN, Rows};

/// Bytes of a UF2 block before its payload.
const HEADER: usize = 32;

/// Prints the table of boards.
pub(super) fn boards(global: &Global) -> anyhow::Result<()> {
    let heads =
        ["board", "chip", "first page", "second page", "count of starts", "erased at once", "file", "what it is"];
    let mut rows = Rows::new(heads);
    for board in BOARDS.iter().chain(&EMULATED) {
        if global.json {
            // Emulated boards have no flash.
            let flash = (!EMULATED.contains(board)).then_some((board.pages, board.boots, board.erase_bytes));
            output::object(&json!({
                "board": board.name, "chip": board.chip, "pages": flash.map(|(pages, ..)| pages),
                "starts": flash.map(|(_, starts, _)| starts), "erase_bytes": flash.map(|(.., bytes)| bytes),
                "file": form(board), "wireless": board.wireless, "description": board.description,
            }))?;
        }
        let [first, second, starts, erased] = flash(board);
        let [name, chip, description] = [board.name, board.chip, board.description].map(str::to_owned);
        rows.add(PLAIN, [name, chip, first, second, starts, erased, form(board).to_owned(), description]);
    }
    if global.json { Ok(()) } else { Ok(rows.print()?) }
}

/// The form of the file that is written for a board.
fn form(board: &Board) -> &'static str {
    match board.uf2 {
        _ if EMULATED.contains(board) => "text",
        Some(_) => "uf2",
        None => "bin",
    }
}

/// Where settings and the count of starts are, and how much is erased at once.
fn flash(board: &Board) -> [String; 4] {
    if EMULATED.contains(board) {
        return ["-"; 4].map(str::to_owned);
    }
    let ([first, second], [one, other]) = (board.pages, board.boots);
    let starts = format!("{one:#x}, {other:#x}");
    [format!("{first:#x}"), format!("{second:#x}"), starts, format!("{} KiB", board.erase_bytes / 1024)]
}

/// Prints what the pages in a file say. Passwords and keys are not shown.
pub(super) fn file(file: &Path, global: &Global) -> anyhow::Result<()> {
    let bytes = super::read_whole(file)?;
    let wrong = |error: KeysError| Ended::failed("Page", format!("{}: {error}", file.display()));
    if let Some(text) = text::of_emulated(&bytes) {
        return Ok(given_by_text(text).map_err(wrong)?.print(global)?);
    }
    for page in pages(&bytes) {
        page_of(&page).map_err(wrong)?.print(global)?;
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

/// What a board is told.
struct Given {
    settings: Settings,
    /// None of an emulated board, which has one text and no copies.
    generation: Option<u32>,
    keys: Option<Shown>,
}

fn page_of(page: &[u8]) -> Result<Given, KeysError> {
    let (settings, generation) = decode(page)?;
    Ok(Given { settings, generation: Some(generation), keys: given(page)? })
}

fn given_by_text(text: &str) -> Result<Given, KeysError> {
    Ok(Given { settings: text.parse()?, generation: None, keys: given_by(text)? })
}

impl Given {
    fn print(self, global: &Global) -> std::io::Result<()> {
        let Self { settings, generation, keys } = self;
        let wifi = settings.wifi.as_ref().map(|wifi| wifi.name());
        if global.json {
            let keys = keys.map(|Shown { generations, peers }| json!({ "generations": generations, "peers": peers }));
            let settings = settings.to_string();
            return output::object(
                &json!({ "generation": generation, "settings": settings, "wifi": wifi, "keys": keys }),
            );
        }
        let wifi = wifi.map(|name| format!(", Wi-Fi {name}")).unwrap_or_default();
        let keys = keys.map(in_words).unwrap_or_default();
        let head = generation.map_or_else(|| "emulated board".to_owned(), |number| format!("generation {number}"));
        output::line(format_args!("{head}: {settings}{wifi}{keys}"))
    }
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
