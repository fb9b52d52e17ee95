//! The board's memory map, and link arguments. The map of the `lm3s6965` crate has its stack above the variables.

use std::path::PathBuf;
use std::{env, fs};

fn main() {
    let place = PathBuf::from(env::var_os("OUT_DIR").expect("cargo sets it"));
    let large = env::var_os("CARGO_FEATURE_LARGE_STACK").is_some();
    let map = if large { "memory-large-stack.x" } else { "memory.x" };
    fs::copy(map, place.join("memory.x")).expect("the memory map is copied");
    // Also for images of other crates that stand on this one.
    println!("cargo::rustc-link-search={}", place.display());
    for argument in ["--nmagic", "-Tlink.x"] {
        println!("cargo::rustc-link-arg-bins={argument}");
    }
    if env::var_os("CARGO_FEATURE_DEFMT").is_some() {
        println!("cargo::rustc-link-arg-bins=-Tdefmt.x");
    }
    println!("cargo::rerun-if-changed={map}");
    println!("cargo::rerun-if-changed=build.rs");
}
