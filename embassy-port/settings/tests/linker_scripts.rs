//! The table of boards and the linker scripts of their firmware say the same about the pages of the settings and of the count of its lives.

use std::fs;
use std::path::Path;

use cara_settings::board::{self, Board};

/// Memory maps of the boards, below the folder of firmware.
const MAPS: [(&Board, &str); 5] = [
    (&board::NUCLEO_F767ZI, "nucleo/memory/f767zi.x"),
    (&board::NUCLEO_H743ZI, "nucleo/memory/h743zi.x"),
    (&board::RP2040_W5500, "rp/memory/rp2040.x"),
    (&board::RP2350_W5500, "rp/memory/rp2350.x"),
    (&board::PICO2W, "rp/memory/pico2w.x"),
];

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

#[test]
fn linker_scripts_keep_the_pages_free() {
    assert_eq!(MAPS.map(|(board, _)| board.name), board::BOARDS.map(|board| board.name));
    for (board, file) in MAPS {
        let path = Path::new(env!("CARGO_MANIFEST_DIR")).join("../../examples/firmware").join(file);
        let map = fs::read_to_string(&path).unwrap_or_else(|error| panic!("{file}: {error}"));
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
