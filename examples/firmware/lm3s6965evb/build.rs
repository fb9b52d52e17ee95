//! The board's memory map, and link arguments. The map of the `lm3s6965` crate has its stack above the variables.

use std::path::PathBuf;
use std::{env, fs};

fn main() {
    let place = PathBuf::from(env::var_os("OUT_DIR").expect("cargo sets it"));
    let has = |feature: &str| env::var_os(format!("CARGO_FEATURE_{feature}")).is_some();
    let map = match () {
        () if has("LARGE_STACK") => "memory-large-stack.x",
        () if has("LOGS") => "memory-logs.x",
        () => "memory-usual.x",
    };
    // The linker takes a memory.x of the folder of the package before this one.
    fs::copy(map, place.join("memory.x")).expect("the memory map is copied");
    // Also for images of other crates that stand on this one.
    println!("cargo::rustc-link-search={}", place.display());
    for argument in ["--nmagic", "-Tlink.x"] {
        println!("cargo::rustc-link-arg-bins={argument}");
    }
    if has("DEFMT") {
        println!("cargo::rustc-link-arg-bins=-Tdefmt.x");
    }
    if has("LOGS") {
        fs::copy("build-id.x", place.join("build-id.x")).expect("the script is copied");
        // Eight bytes, which is what a log tells.
        println!("cargo::rustc-link-arg-bins=--build-id=fast");
        println!("cargo::rustc-link-arg-bins=-Tbuild-id.x");
    }
    println!("cargo::rerun-if-changed=build-id.x");
    println!("cargo::rerun-if-changed={map}");
    println!("cargo::rerun-if-changed=build.rs");
}
