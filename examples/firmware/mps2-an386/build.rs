//! The board's memory map, and link arguments.

use std::path::PathBuf;
use std::{env, fs};

fn main() {
    let place = PathBuf::from(env::var_os("OUT_DIR").expect("cargo sets it"));
    fs::copy("memory.x", place.join("memory.x")).expect("the memory map is copied");
    // What cortex-m-rt asks of a crate with a table of interrupts: names of handlers, which this table has by itself.
    fs::write(place.join("device.x"), "").expect("it is written");
    println!("cargo::rustc-link-search={}", place.display());
    for argument in ["--nmagic", "-Tlink.x"] {
        println!("cargo::rustc-link-arg-bins={argument}");
    }
    if env::var_os("CARGO_FEATURE_DEFMT").is_some() {
        println!("cargo::rustc-link-arg-bins=-Tdefmt.x");
    }
    println!("cargo::rerun-if-changed=memory.x");
    println!("cargo::rerun-if-changed=build.rs");
}
