//! No panic is reachable from the core's public entry points: the link of `tests/panic-free` fails if one is.

use anyhow::{Result, bail};

use crate::command::Run;

/// The smallest processor that the core is built for.
pub(crate) const TARGET: &str = "thumbv7m-none-eabi";

/// The symbol that the panic handler calls and that nothing defines.
const UNDEFINED: &str = "a_panic_is_reachable";

/// Links the binary, then once more with a panic planted in it, which must not link.
pub(crate) fn check() -> Result<()> {
    link(&[]).stream()?;
    let (linked, _, errors) = link(&["--features", "planted"]).captured()?;
    if linked {
        bail!("a planted panic links: the check shows nothing");
    }
    if !errors.contains(UNDEFINED) {
        bail!("with a planted panic the build fails for another reason: {errors}");
    }
    println!("no panic is reachable; a planted one is found");
    Ok(())
}

fn link(arguments: &[&str]) -> Run {
    let build = ["build", "--release", "--locked", "--manifest-path", "tests/panic-free/Cargo.toml"];
    let place = ["--target", TARGET, "--target-dir", "target/panic-free"];
    Run::cargo().args(build).args(place).args(arguments)
}
