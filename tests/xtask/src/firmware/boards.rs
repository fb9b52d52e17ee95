//! The boards: where their firmware is and for which processor.

use std::path::PathBuf;

use anyhow::{Result, bail};

use crate::command::Run;
use crate::workspace;

/// A board.
pub(crate) struct Board {
    pub(crate) name: &'static str,
    /// Below `examples/firmware`; boards of one family share a folder.
    pub(crate) folder: &'static str,
    /// Chooses the board within its family.
    pub(crate) feature: Option<&'static str>,
    pub(crate) target: &'static str,
    /// The last one is the bare echo, with which the others are compared.
    pub(crate) images: &'static [&'static str],
}

/// All of them.
pub(crate) const BOARDS: [Board; 1] = [Board {
    name: "lm3s6965evb",
    folder: "lm3s6965evb",
    feature: None,
    target: "thumbv7m-none-eabi",
    images: &["agv", "echo"],
}];

/// The board of a name; the error lists all.
pub(crate) fn find(name: &str) -> Result<&'static Board> {
    let Some(board) = BOARDS.iter().find(|board| board.name == name) else {
        let names: Vec<&str> = BOARDS.iter().map(|board| board.name).collect();
        bail!("there is no board {name}; there are: {}", names.join(", "));
    };
    Ok(board)
}

impl Board {
    /// Builds an image; where it is.
    pub(crate) fn build(&self, image: &str) -> Result<PathBuf> {
        let folder = workspace::root().join("examples/firmware").join(self.folder);
        let manifest = folder.join("Cargo.toml");
        // Folders of the machine stand in the text of panics: without this, sizes would differ from machine to machine.
        let remap = format!("--remap-path-prefix={}=.", workspace::root().display());
        let registry = std::env::var("CARGO_HOME").or_else(|_| std::env::var("HOME").map(|home| home + "/.cargo"));
        let remap = registry.map_or(remap.clone(), |home| format!("{remap} --remap-path-prefix={home}=cargo"));
        let place = workspace::root().join("target/firmware");
        let build = Run::cargo()
            .args(["build", "--quiet", "--release", "--locked", "--target", self.target, "--bin", image])
            .args(["--manifest-path".as_ref(), manifest.as_os_str(), "--target-dir".as_ref(), place.as_os_str()])
            .env("RUSTFLAGS", &remap)
            .env("DEFMT_LOG", "info");
        match self.feature {
            Some(feature) => build.args(["--no-default-features", "--features", feature]).stream()?,
            None => build.stream()?,
        }
        Ok(place.join(self.target).join("release").join(image))
    }
}
