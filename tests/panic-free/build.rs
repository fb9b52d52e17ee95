//! Makes every entry point a root of the link; whatever none of them reaches is dropped.
//!
//! `PANIC_FREE_ENTRY` names a single entry point to link alone, which tells where a panic is reached from.

use std::path::Path;
use std::{env, fs};

/// Everything in one piece; the result is never loaded.
const SCRIPT: &str = "SECTIONS {
  .text : { *(.text .text.*) }
  .rodata : { *(.rodata .rodata.*) }
  .data : { *(.data .data.*) }
  .bss : { *(.bss .bss.*) }
  /DISCARD/ : { *(.ARM.*) }
}
";

fn main() {
    println!("cargo::rerun-if-changed=src");
    println!("cargo::rerun-if-env-changed=PANIC_FREE_ENTRY");
    let roots = match env::var("PANIC_FREE_ENTRY") {
        Ok(entry) => vec![entry],
        Err(_) => entries(Path::new("src")),
    };
    let first = roots.first().expect("no entry points: nothing would be checked");
    let folder = env::var("OUT_DIR").expect("cargo sets OUT_DIR");
    let script = Path::new(&folder).join("roots.x");
    fs::write(&script, [SCRIPT.to_owned(), roots.iter().map(|root| root_line(root)).collect()].concat())
        .expect("the build folder can be written to");
    for argument in [format!("-T{}", script.display()), format!("--entry={first}"), "--gc-sections".to_owned()] {
        println!("cargo::rustc-link-arg-bins={argument}");
    }
}

/// Keeps an entry point; a name that nothing defines fails the link, rather than checking nothing.
fn root_line(name: &str) -> String {
    format!("EXTERN({name})\nASSERT(DEFINED({name}), \"there is no entry point {name}\")\n")
}

/// The names behind `entry!(` in the source files, which `cargo xtask` finds in the same way.
fn entries(folder: &Path) -> Vec<String> {
    let planted = env::var_os("CARGO_FEATURE_PLANTED").is_some();
    let mut names = Vec::new();
    for file in fs::read_dir(folder).expect("the sources can be read").flatten() {
        let text = fs::read_to_string(file.path()).expect("the sources can be read");
        names.extend(text.lines().filter_map(name).map(str::to_owned));
    }
    names.retain(|name| planted || name != "planted");
    names.sort();
    names
}

fn name(line: &str) -> Option<&str> {
    line.strip_prefix("entry!(")?.split(',').next()
}
