//! The board's memory map, and link arguments.

use std::path::PathBuf;
use std::{env, fs};

fn main() {
    let is = |feature: &str| env::var_os(format!("CARGO_FEATURE_{feature}")).is_some();
    let map = match (is("F767ZI"), is("H743ZI")) {
        (true, false) => "memory/f767zi.x",
        (false, true) => "memory/h743zi.x",
        _ => panic!("choose one board: --no-default-features --features f767zi, or h743zi"),
    };
    let place = PathBuf::from(env::var_os("OUT_DIR").expect("cargo sets it"));
    fs::copy(map, place.join("memory.x")).expect("the memory map is copied");
    println!("cargo::rustc-link-search={}", place.display());
    for argument in ["--nmagic", "-Tlink.x", "-Tdefmt.x"] {
        println!("cargo::rustc-link-arg-bins={argument}");
    }
    println!("cargo::rerun-if-changed=build.rs");
    println!("cargo::rerun-if-changed=memory");
}
