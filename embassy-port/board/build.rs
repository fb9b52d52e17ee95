//! Puts `stack.x` where linkers of images find it, and tells processors with a stack limit register from others.

use std::path::PathBuf;
use std::{env, fs, io};

fn main() -> io::Result<()> {
    let place = PathBuf::from(env::var_os("OUT_DIR").unwrap_or_default());
    fs::copy("stack.x", place.join("stack.x"))?;
    println!("cargo::rustc-link-search={}", place.display());
    println!("cargo::rustc-check-cfg=cfg(has_stack_limit)");
    if env::var("TARGET").is_ok_and(|target| target.starts_with("thumbv8m.main")) {
        println!("cargo::rustc-cfg=has_stack_limit");
    }
    println!("cargo::rerun-if-changed=build.rs");
    println!("cargo::rerun-if-changed=stack.x");
    Ok(())
}
