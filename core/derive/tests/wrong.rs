//! Wrong use is reported in words, at the place of the mistake. `TRYBUILD=overwrite` accepts the present messages.
//!
//! All cases are one call of cargo and use the core only. Most errors are the macros' own; the few of rustc may read differently
//! with another compiler.

use std::fs;
use std::path::Path;
use std::process::Command;

#[test]
fn wrong_use_is_a_readable_error() {
    trybuild::TestCases::new().compile_fail("tests/wrong/*.rs");
}

/// The cases above are built with the features of this crate's tests; a core without lists needs its own package.
#[test]
fn lists_that_the_core_is_built_without_are_a_readable_error() {
    const SOURCE: &str = "
        use cara_core::{Variables, interface};

        #[derive(Variables)]
        pub struct Place {
            x: f64,
        }

        #[interface]
        pub trait Drive {
            fn follow(&mut self, #[size(8)] places: Vec<i64>);
            fn go_to(&mut self, place: Place);
        }
    ";
    let core = Path::new(env!("CARGO_MANIFEST_DIR")).parent().unwrap();
    let package = Path::new(env!("CARGO_TARGET_TMPDIR")).join("without_lists");
    let manifest = format!(
        "[workspace]\n[package]\nname = 'without-lists'\nedition = '2024'\n[dependencies]\ncara-core = {{ path = '{}', features = ['derive'] }}\n",
        core.display()
    );
    fs::create_dir_all(package.join("src")).unwrap();
    fs::write(package.join("Cargo.toml"), manifest).unwrap();
    fs::copy(core.with_file_name("Cargo.lock"), package.join("Cargo.lock")).unwrap();
    fs::write(package.join("src/lib.rs"), SOURCE).unwrap();
    let checked = Command::new(env!("CARGO"))
        .args(["check", "--offline", "--color=never", "--target-dir=target"])
        .current_dir(&package)
        .output();
    let reported = String::from_utf8(checked.unwrap().stderr).unwrap();
    for wrong in [
        "error: lists and `Option` need the feature `nested` of the core\n  --> src/lib.rs:11:",
        "error[E0277]: `Place` cannot be a variable\n  --> src/lib.rs:12:",
        "where the core has the feature `nested`, also structs that `#[derive(Variables)]`",
    ] {
        assert!(reported.contains(wrong), "{reported}");
    }
    assert!(!reported.contains("E0599"), "{reported}");
}
