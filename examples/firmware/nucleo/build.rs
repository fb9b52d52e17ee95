//! The board's memory map, and link arguments.

use std::path::PathBuf;
use std::{env, fs};

fn main() {
    let is_chosen = |board: &String| env::var_os(format!("CARGO_FEATURE_{}", board.to_uppercase())).is_some();
    let boards = boards();
    let mut chosen = boards.iter().filter(|board| is_chosen(board));
    let (Some(board), None) = (chosen.next(), chosen.next()) else {
        panic!("choose one board: --no-default-features --features {}", boards.join(", or "));
    };
    println!("cargo::rustc-env=CARA_BOARD={board}");
    let place = PathBuf::from(env::var_os("OUT_DIR").expect("cargo sets it"));
    fs::copy(format!("memory/{board}.x"), place.join("memory.x")).expect("the memory map is copied");
    println!("cargo::rustc-link-search={}", place.display());
    for argument in ["--nmagic", "-Tlink.x", "-Tdefmt.x"] {
        println!("cargo::rustc-link-arg-bins={argument}");
    }
    println!("cargo::rerun-if-changed=build.rs");
    println!("cargo::rerun-if-changed=memory");
}

/// The boards that have a memory map; each is a feature as well.
fn boards() -> Vec<String> {
    let maps = fs::read_dir("memory").expect("the folder of maps is there");
    let names = maps.filter_map(|map| map.ok()?.file_name().into_string().ok());
    names.filter_map(|name| Some(name.strip_suffix(".x")?.to_owned())).collect()
}
