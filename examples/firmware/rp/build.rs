//! The board's memory map, link arguments, and what the radio of a Pico 2 W is loaded with.

use std::path::{Path, PathBuf};
use std::{env, fs};

/// The folder with the radio's files.
const RADIO: &str = "CARA_CYW43_FIRMWARE";
/// What stands there to link an image that tells, when it starts, that it has none.
const NONE: &str = "none";
/// Firmware, regulatory data and board data, as they are called where embassy and Raspberry Pi keep them.
const RADIO_FILES: [&str; 3] = ["43439A0.bin", "43439A0_clm.bin", "nvram_rp2040.bin"];

fn main() {
    let is = |feature: &str| env::var_os(format!("CARGO_FEATURE_{feature}")).is_some();
    let (board, maps, link): (_, &[&str], &[&str]) = match (is("RP2040"), is("RP2350"), is("PICO2W")) {
        (true, false, false) => ("rp2040", &["memory/rp2040.x"], &["-Tlink-rp.x"]),
        (false, true, false) => ("rp2350", &["memory/rp2350.x", "memory/blocks.x"], &[]),
        (false, false, true) => ("pico2w", &["memory/pico2w.x", "memory/blocks.x"], &[]),
        _ => panic!("choose one board: --no-default-features --features rp2040, rp2350 or pico2w"),
    };
    println!("cargo::rustc-env=CARA_BOARD={board}");
    let place = PathBuf::from(env::var_os("OUT_DIR").expect("cargo sets it"));
    let map: String = maps.iter().map(|map| fs::read_to_string(map).expect("the memory map is read")).collect();
    fs::write(place.join("memory.x"), map).expect("the memory map is written");
    println!("cargo::rustc-link-search={}", place.display());
    for argument in ["--nmagic", "-Tlink.x", "-Tdefmt.x"].iter().chain(link) {
        println!("cargo::rustc-link-arg-bins={argument}");
    }
    println!("cargo::rerun-if-changed=build.rs");
    println!("cargo::rerun-if-changed=memory");
    if is("PICO2W") {
        take_radio_files(&place);
    }
}

/// Copies the radio's files to where the image includes them; empty ones if the user asks for an image without.
fn take_radio_files(place: &Path) {
    println!("cargo::rerun-if-env-changed={RADIO}");
    let Some(folder) = env::var_os(RADIO) else {
        return refuse(&format!(
            "the radio of a Pico 2 W needs files whose licence keeps them out of this project: fetch {} from \
             https://github.com/embassy-rs/embassy/tree/main/cyw43-firmware and set {RADIO} to their folder; or set it \
             to {NONE} to link an image that only tells that it has none",
            RADIO_FILES.join(", ")
        ));
    };
    for file in RADIO_FILES {
        let copy = place.join(file);
        if folder == NONE {
            fs::write(copy, []).expect("an empty file is written");
            continue;
        }
        let source = Path::new(&folder).join(file);
        println!("cargo::rerun-if-changed={}", source.display());
        match fs::read(&source) {
            Ok(bytes) if !bytes.is_empty() => fs::write(copy, bytes).expect("the file is copied"),
            Ok(_) => refuse(&format!("{RADIO}: {} is empty", source.display())),
            Err(error) => refuse(&format!("{RADIO}: {}: {error}", source.display())),
        }
    }
    if folder == NONE {
        println!("cargo::warning={RADIO}={NONE}: this image has no radio firmware; it says so and does nothing else");
    }
}

/// Ends the build with an error; cargo waits for the script to end.
fn refuse(why: &str) {
    println!("cargo::error={why}");
}
