//! Emulated boards, which are told by a file of the host: the text of its settings, and its keys behind it.

use std::path::Path;

use cara_settings::board::Board;
use serde_json::json;
use zeroize::Zeroizing;

use super::copy::Content;
use super::store;
use cara_settings::Settings;
use cara_tools::exit::Ended;
use cara_tools::global::Global;
use cara_tools::output;

/// Emulated boards. They have no pages.
pub(super) const EMULATED: [Board; 2] = [
    emulated("lm3s6965evb", "emulated Cortex-M3", "LM3S6965", "thumbv7m-none-eabi"),
    emulated("mps2-an386", "emulated Cortex-M4", "AN386", "thumbv7em-none-eabihf"),
];

const fn emulated(name: &'static str, description: &'static str, chip: &'static str, target: &'static str) -> Board {
    Board {
        name,
        description,
        chip,
        folder: name,
        feature: "",
        target,
        pages: [0; 2],
        boots: [0; 2],
        erase_bytes: 0,
        uf2: None,
        wireless: false,
    }
}

/// Begins the word with the keys.
const WORD: &str = " keys=";

/// Writes the file.
pub(super) fn write(name: &str, content: &Content, file: Option<&Path>, global: &Global) -> anyhow::Result<()> {
    let file = file.ok_or_else(|| {
        Ended::usage(format!("{name} is emulated: it is told by a file of this computer, which --output FILE writes"))
    })?;
    check_words(name, &content.settings, file)?;
    let text = text(content);
    store(file, text.as_bytes(), content.secrets.is_some())?;
    match global.json {
        true => output::object(&json!({ "board": name, "file": file }))?,
        false => output::line(format_args!(
            "{0}: for QEMU's -semihosting-config, arg=agv,arg=\"file={0} boots={0}.boots\"",
            file.display()
        ))?,
    }
    Ok(())
}

/// The text of a file that was written here.
pub(super) fn of_emulated(bytes: &[u8]) -> Option<&str> {
    std::str::from_utf8(bytes).ok().filter(|text| text.starts_with("name="))
}

/// The image splits its arguments at blanks, and QEMU its options at commas.
fn check_words(board: &str, settings: &Settings, file: &Path) -> anyhow::Result<()> {
    let names = [Some(settings.identity.name()), settings.manager.as_ref().map(|manager| &*manager.name)];
    if let Some(name) = names.into_iter().flatten().find(|name| name.contains(char::is_whitespace)) {
        let text = format!("{board} is told by words, so no name may have a blank in it: rename {name:?}");
        return Err(Ended::usage(text));
    }
    let path = file.to_string_lossy();
    if path.contains(|character: char| character.is_whitespace() || matches!(character, ',' | '"')) {
        let text =
            format!("--output {path:?}: QEMU's options end at blanks, commas and quotes: name a path without them");
        return Err(Ended::usage(text));
    }
    Ok(())
}

fn text(Content { settings, secrets }: &Content) -> Zeroizing<String> {
    let (settings, keys) = (settings.to_string(), secrets.as_ref().map_or(&[][..], |secrets| secrets.bytes()));
    let mut digits = Zeroizing::new(vec![0; 2 * keys.len()]);
    // There is room for each byte's two digits, and digits are text.
    let _ = hex::encode_to_slice(keys, &mut digits);
    let digits = std::str::from_utf8(&digits).unwrap_or_default();
    // All of it at once: a text that grows leaves keys behind.
    let mut text = Zeroizing::new(String::with_capacity(settings.len() + WORD.len() + digits.len()));
    text.push_str(&settings);
    if !digits.is_empty() {
        text.push_str(WORD);
        text.push_str(digits);
    }
    text
}
