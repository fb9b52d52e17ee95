//! The table of boards and the linker scripts of their firmware say the same about the pages of the settings and of the count of its lives.

use std::fs;
use std::path::Path;

use cara_settings::board::BOARDS;

/// Start and end of a region of a linker script.
fn region(map: &str, name: &str) -> (u32, u32) {
    let is = |line: &&str| line.split_once(':').is_some_and(|(before, _)| before.trim() == name);
    let line = map.lines().find(is).unwrap_or_else(|| panic!("no region {name}"));
    let field = |field: &str| {
        let (_, value) = line.split_once(field).and_then(|(_, rest)| rest.split_once('=')).unwrap();
        number(value.split(',').next().unwrap())
    };
    (field("ORIGIN"), field("ORIGIN") + field("LENGTH"))
}

/// `0x100`, `8K` or `2040K - 0x100`.
fn number(text: &str) -> u32 {
    let text = text.trim();
    if let Some((first, second)) = text.split_once(" - ") {
        return number(first) - number(second);
    }
    match (text.strip_prefix("0x"), text.strip_suffix('K')) {
        (Some(digits), _) => u32::from_str_radix(digits, 16).unwrap(),
        (_, Some(digits)) => digits.parse::<u32>().unwrap() * 1024,
        _ => panic!("no number: {text}"),
    }
}

/// A file of the repository.
fn read(file: &str) -> String {
    let path = Path::new(env!("CARGO_MANIFEST_DIR")).join("../..").join(file);
    fs::read_to_string(&path).unwrap_or_else(|error| panic!("{file}: {error}"))
}

#[test]
fn the_page_of_boards_says_the_same() {
    let page = read("docs/boards.md");
    for board in BOARDS {
        let ([first, second], [one, other]) = (board.pages, board.boots);
        let erased = board.erase_bytes / 1024;
        for line in [
            format!("| `{}` | {} | [{2}](../examples/firmware/{2}) |", board.name, board.description, board.folder),
            format!(
                "| `{}` | {first:#010X} | {second:#010X} | {one:#010X}, {other:#010X} | {erased} KiB |",
                board.name
            ),
        ] {
            let line = line.replace("0X", "0x");
            assert!(page.contains(&line), "docs/boards.md has no line `{line}`");
        }
    }
}

#[test]
fn linker_scripts_keep_the_pages_free() {
    for board in BOARDS {
        let file = format!("examples/firmware/{}/memory/{}.x", board.folder, board.feature);
        let map = read(&file);
        for (name, [first, second]) in [("SETTINGS", board.pages), ("BOOTS", board.boots)] {
            assert_eq!(region(&map, name), (first, second + board.erase_bytes), "{file}");
        }
        let (_, end_of_code) = region(&map, "FLASH");
        assert!(end_of_code <= board.boots[0], "{file}");
        let (stack, variables) = (region(&map, "STACK"), region(&map, "RAM"));
        assert!(stack.1 <= variables.0 && map.contains("INCLUDE stack.x"), "{file}: an overflow would not fault");
        assert_eq!(stack.0, 0x2000_0000, "{file}: there is memory in front of the stack");
        assert!(map.contains("ASSERT(ORIGIN(FLASH) + LENGTH(FLASH) <= ORIGIN(BOOTS)"), "{file}");
    }
}
