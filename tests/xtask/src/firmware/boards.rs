//! The boards: where their firmware is and for which processor.

use std::path::{Path, PathBuf};

use anyhow::{Context, Result, bail};

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
    pub(crate) images: &'static [Image],
    /// Whether it has a radio that is loaded with files which are no part of the project.
    pub(crate) has_radio: bool,
}

/// What is built for a board.
#[derive(Debug)]
pub(crate) struct Image {
    pub(crate) name: &'static str,
    /// The binary of the board's crate.
    pub(crate) program: &'static str,
    /// Whether it tells what it does. An image without logs is built with none of the default features.
    pub(crate) has_logs: bool,
    /// What only tests want of it, on the emulated board.
    pub(crate) feature: Option<&'static str>,
}

impl Image {
    const fn with_logs(program: &'static str) -> Self {
        Self { name: program, program, has_logs: true, feature: None }
    }

    const fn quiet(name: &'static str, program: &'static str) -> Self {
        Self { name, program, has_logs: false, feature: None }
    }

    /// Whether the other images of its kind are compared with it.
    pub(crate) fn is_bare(&self) -> bool {
        self.program == "echo"
    }
}

/// The environment variable with the folder of the radio's files, or with [`NO_RADIO`].
pub(crate) const RADIO: &str = "CARA_CYW43_FIRMWARE";
/// The image is linked without them: it only tells that it has none.
const NO_RADIO: &str = "none";

/// Of every board.
const IMAGES: &[Image] = &[Image::with_logs("agv"), Image::with_logs("echo")];
/// Of the emulated board, on which also the least unit and images without logs are measured.
const EMULATED: &[Image] = &[
    Image::with_logs("agv"),
    Image::with_logs("unit"),
    Image::with_logs("echo"),
    Image::quiet("agv-quiet", "agv"),
    Image::quiet("unit-quiet", "unit"),
    Image::quiet("echo-quiet", "echo"),
];
/// The AGV of the emulated board with a service that makes it fail.
pub(crate) const FAULTS: Image = Image { name: "agv-faults", feature: Some("faults"), ..Image::with_logs("agv") };
/// Says what each capacity of a unit costs.
pub(crate) const RESOURCES: Image = Image::with_logs("resources");

/// All of them.
pub(crate) const BOARDS: [Board; 6] = [
    Board {
        name: "lm3s6965evb",
        folder: "lm3s6965evb",
        feature: None,
        target: "thumbv7m-none-eabi",
        images: EMULATED,
        has_radio: false,
    },
    Board {
        name: "nucleo-f767zi",
        folder: "nucleo",
        feature: Some("f767zi"),
        target: "thumbv7em-none-eabihf",
        images: IMAGES,
        has_radio: false,
    },
    Board {
        name: "nucleo-h743zi",
        folder: "nucleo",
        feature: Some("h743zi"),
        target: "thumbv7em-none-eabihf",
        images: IMAGES,
        has_radio: false,
    },
    Board {
        name: "rp2040",
        folder: "rp",
        feature: Some("rp2040"),
        target: "thumbv6m-none-eabi",
        images: IMAGES,
        has_radio: false,
    },
    Board {
        name: "rp2350",
        folder: "rp",
        feature: Some("rp2350"),
        target: "thumbv8m.main-none-eabihf",
        images: IMAGES,
        has_radio: false,
    },
    Board {
        name: "pico2w",
        folder: "rp",
        feature: Some("pico2w"),
        target: "thumbv8m.main-none-eabihf",
        images: IMAGES,
        has_radio: true,
    },
];

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
    pub(crate) fn build(&self, image: &Image) -> Result<PathBuf> {
        let folder = Path::new("examples/firmware").join(self.folder);
        // Boards with one processor, and an image with and without logs, are built into the same file: another build must
        // not begin before this one's is copied.
        std::fs::create_dir_all(place()).with_context(|| format!("cannot make {}", place().display()))?;
        let lock = std::fs::File::create(place().join("images.lock"))?;
        lock.lock()?;
        let build = image_build(&folder, self.target, image.program);
        let build = match (self.has_radio, std::env::var(RADIO)) {
            (true, Err(_)) => build.env(RADIO, NO_RADIO),
            _ => build,
        };
        let build =
            if self.feature.is_some() || !image.has_logs { build.args(["--no-default-features"]) } else { build };
        let features = self.feature.iter().chain(&image.feature);
        features.fold(build, |build, feature| build.args(["--features", feature])).stream()?;
        self.kept(image)
    }

    /// Copies an image to the board's own folder.
    fn kept(&self, image: &Image) -> Result<PathBuf> {
        let folder = place().join("images").join(self.name);
        std::fs::create_dir_all(&folder).with_context(|| format!("cannot make {}", folder.display()))?;
        let (built, kept) = (built(self.target, image.program), folder.join(image.name));
        std::fs::copy(&built, &kept).with_context(|| format!("cannot copy {}", built.display()))?;
        Ok(kept)
    }
}

/// The build of an image whose crate is in a folder of the project, optimised.
pub(crate) fn image_build(folder: &Path, target: &str, image: &str) -> Run {
    let manifest = workspace::root().join(folder).join("Cargo.toml");
    // Folders of the machine stand in the text of panics: without this, sizes would differ from machine to machine.
    let remap = format!("--remap-path-prefix={}=.", workspace::root().display());
    let registry = std::env::var("CARGO_HOME").or_else(|_| std::env::var("HOME").map(|home| home + "/.cargo"));
    let remap = registry.map_or(remap.clone(), |home| format!("{remap} --remap-path-prefix={home}=cargo"));
    Run::cargo()
        .args(["build", "--quiet", "--release", "--locked", "--target", target, "--bin", image])
        .args(["--manifest-path".as_ref(), manifest.as_os_str(), "--target-dir".as_ref(), place().as_os_str()])
        .env("RUSTFLAGS", &remap)
        .env("DEFMT_LOG", "info")
}

/// Where [`image_build`] puts an image.
pub(crate) fn built(target: &str, image: &str) -> PathBuf {
    place().join(target).join("release").join(image)
}

fn place() -> PathBuf {
    workspace::root().join("target/firmware")
}

#[cfg(test)]
mod tests {
    use super::BOARDS;

    /// What is provisioned can be built, and what is built can be provisioned or is emulated.
    #[test]
    fn boards_are_those_with_settings() {
        let built: Vec<&str> = BOARDS.iter().map(|board| board.name).filter(|name| *name != "lm3s6965evb").collect();
        assert_eq!(built, cara_settings::board::BOARDS.map(|board| board.name));
    }
}
