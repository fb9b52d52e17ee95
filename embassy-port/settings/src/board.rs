//! The boards that keep settings in flash, and where: the one table that linker scripts, firmware, tools and builds agree on.
//!
//! Each board has two pages of settings and two that count its lives, which are erased separately and which no code lies in.
//! A linker script calls them `SETTINGS` and `BOOTS`; a test compares it with this table.

/// A board with settings in flash.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Board {
    /// As on the command line.
    pub name: &'static str,
    /// What it is, for a person.
    pub description: &'static str,
    /// The chip, as `probe-rs` calls it.
    pub chip: &'static str,
    /// Its firmware's crate below `examples/firmware`; boards of one family share it.
    pub folder: &'static str,
    /// Chooses the board within its family. Its memory map is `memory/FEATURE.x` in the folder.
    pub feature: &'static str,
    /// The processor, as the compiler calls it.
    pub target: &'static str,
    /// Addresses of the two pages.
    pub pages: [u32; 2],
    /// Addresses of the two pages that count the board's lives.
    pub boots: [u32; 2],
    /// Bytes that are erased at once, at each of those addresses.
    pub erase_bytes: u32,
    /// Family numbers of UF2 files; none where the chip's boot loader takes no such files.
    pub uf2: Option<Families>,
    /// Whether it is on Wi-Fi, and so must be told an access point.
    pub wireless: bool,
}

/// The family that a UF2 file is for.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Families {
    /// Of an image.
    pub image: u32,
    /// Of bytes that go to where the file says, whatever the image.
    pub data: u32,
}

const RP2040: Families = Families { image: 0xE48B_FF56, data: 0xE48B_FF56 };
/// Secure Arm images; and "absolute", for which the boot ROM ignores partitions.
const RP2350: Families = Families { image: 0xE48B_FF59, data: 0xE48B_FF57 };

/// ST NUCLEO-F767ZI.
pub const NUCLEO_F767ZI: Board = Board {
    name: "nucleo-f767zi",
    description: "ST NUCLEO-F767ZI, Ethernet on board",
    chip: "STM32F767ZITx",
    folder: "nucleo",
    feature: "f767zi",
    target: "thumbv7em-none-eabihf",
    pages: [0x0818_0000, 0x081C_0000],
    boots: [0x0810_0000, 0x0814_0000],
    erase_bytes: 256 * 1024,
    uf2: None,
    wireless: false,
};
/// ST NUCLEO-H743ZI and NUCLEO-H743ZI2.
pub const NUCLEO_H743ZI: Board = Board {
    name: "nucleo-h743zi",
    description: "ST NUCLEO-H743ZI or -H743ZI2, Ethernet on board",
    chip: "STM32H743ZITx",
    folder: "nucleo",
    feature: "h743zi",
    target: "thumbv7em-none-eabihf",
    pages: [0x081C_0000, 0x081E_0000],
    boots: [0x0818_0000, 0x081A_0000],
    erase_bytes: 128 * 1024,
    uf2: None,
    wireless: false,
};
/// RP2040 with a W5500.
pub const RP2040_W5500: Board = Board {
    name: "rp2040",
    description: "RP2040 with a W5500 on SPI, as on a W5500-EVB-Pico",
    chip: "RP2040",
    folder: "rp",
    feature: "rp2040",
    target: "thumbv6m-none-eabi",
    pages: [0x101F_E000, 0x101F_F000],
    boots: [0x101F_C000, 0x101F_D000],
    erase_bytes: 4096,
    uf2: Some(RP2040),
    wireless: false,
};
/// RP2350 with a W5500.
pub const RP2350_W5500: Board = Board {
    name: "rp2350",
    description: "RP2350 with a W5500 on SPI, as on a W5500-EVB-Pico2",
    chip: "RP235x",
    folder: "rp",
    feature: "rp2350",
    target: "thumbv8m.main-none-eabihf",
    pages: [0x101F_E000, 0x101F_F000],
    boots: [0x101F_C000, 0x101F_D000],
    erase_bytes: 4096,
    uf2: Some(RP2350),
    wireless: false,
};
/// Raspberry Pi Pico 2 W.
pub const PICO2W: Board = Board {
    name: "pico2w",
    description: "Raspberry Pi Pico 2 W, Wi-Fi on board",
    chip: "RP235x",
    folder: "rp",
    feature: "pico2w",
    target: "thumbv8m.main-none-eabihf",
    pages: [0x103F_E000, 0x103F_F000],
    boots: [0x103F_C000, 0x103F_D000],
    erase_bytes: 4096,
    uf2: Some(RP2350),
    wireless: true,
};

/// All of them.
pub const BOARDS: [Board; 5] = [NUCLEO_F767ZI, NUCLEO_H743ZI, RP2040_W5500, RP2350_W5500, PICO2W];

/// The board of a name.
///
/// ```
/// assert_eq!(cara_settings::board::find("rp2040").map(|board| board.pages[0]), Some(0x101F_E000));
/// ```
pub fn find(name: &str) -> Option<&'static Board> {
    BOARDS.iter().find(|board| board.name == name)
}

/// The board of a feature of a family's firmware, for a constant there: a name that is not in the table does not compile.
///
/// ```
/// const BOARD: cara_settings::board::Board = cara_settings::board::of_feature("rp2040");
/// ```
pub const fn of_feature(feature: &str) -> Board {
    let mut rest = BOARDS.as_slice();
    while let Some((board, behind)) = rest.split_first() {
        if is_same(board.feature.as_bytes(), feature.as_bytes()) {
            return *board;
        }
        rest = behind;
    }
    panic!("no board has this feature")
}

const fn is_same(mut one: &[u8], mut other: &[u8]) -> bool {
    while let (Some((first, behind_one)), Some((second, behind_other))) = (one.split_first(), other.split_first()) {
        if *first != *second {
            return false;
        }
        (one, other) = (behind_one, behind_other);
    }
    one.is_empty() && other.is_empty()
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::page;

    #[test]
    fn pages_are_erased_separately() {
        for Board { name, pages: [first, second], boots, erase_bytes, .. } in BOARDS {
            for (one, other) in [(boots[0], boots[1]), (boots[1], first), (first, second)] {
                assert!(other - one >= erase_bytes, "{name}");
                assert!(one % erase_bytes == 0 && other % erase_bytes == 0, "{name}");
            }
            assert!(erase_bytes as usize >= page::BYTES, "{name}");
        }
    }

    #[test]
    fn names_are_unique() {
        for board in BOARDS {
            assert_eq!(find(board.name), Some(&board));
            assert_eq!(of_feature(board.feature), board);
        }
        assert_eq!(find("lm3s6965evb"), None);
    }
}
