//! The boards: where their firmware is and for which processor.

use std::path::{Path, PathBuf};
use std::sync::LazyLock;

use anyhow::{Context, Result, bail};

use crate::command::Run;
use crate::{install, workspace};

/// A board.
pub(crate) struct Board {
    pub(crate) name: &'static str,
    /// Below `examples/firmware`; boards of one family share a folder.
    pub(crate) folder: &'static str,
    /// Chooses the board within its family; none of an emulated board.
    pub(crate) feature: Option<&'static str>,
    pub(crate) target: &'static str,
    pub(crate) images: &'static [Image],
    /// Whether it has a radio that is loaded with files which are no part of the project.
    pub(crate) has_radio: bool,
    /// Whether images of it are built and measured each time that everything is checked.
    by_default: bool,
}

/// What is built for a board.
#[derive(Debug)]
pub(crate) struct Image {
    pub(crate) name: &'static str,
    /// The binary of the board's crate.
    pub(crate) program: &'static str,
    /// Whether it tells what it does.
    pub(crate) has_logs: bool,
    /// Whether it has a cipher and keys.
    pub(crate) is_secured: bool,
    /// What not every image has, on the emulated board.
    pub(crate) feature: Option<&'static str>,
    /// Built and measured with all boards only: it has nothing that the others have not.
    is_seldom: bool,
}

/// Which images of which boards.
pub(crate) type Chosen = fn(&Board, &Image) -> bool;

/// What is built and measured each time that everything is checked.
pub(crate) const fn each_time(board: &Board, image: &Image) -> bool {
    board.by_default && !image.is_seldom
}

impl Image {
    /// With logs and without a cipher.
    const fn plain(name: &'static str, program: &'static str) -> Self {
        Self { name, program, has_logs: true, is_secured: false, feature: None, is_seldom: false }
    }

    const fn named(self, name: &'static str) -> Self {
        Self { name, ..self }
    }

    const fn secured(self) -> Self {
        Self { is_secured: true, ..self }
    }

    const fn quiet(self) -> Self {
        Self { has_logs: false, ..self }
    }

    const fn seldom(self) -> Self {
        Self { is_seldom: true, ..self }
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
const IMAGES: &[Image] = &[AGV, ECHO];
/// The vehicle, with keys or in plain mode.
pub(crate) const AGV: Image = Image::plain("agv", "agv").secured();
const ECHO: Image = Image::plain("echo", "echo");
/// Of the emulated board, on which also the least unit, images without logs and images without a cipher are measured.
const EMULATED: &[Image] = &[
    AGV,
    Image::plain("agv-plain", "agv"),
    STREAMS,
    WAREHOUSE,
    UNIT.secured().named("unit-secured").seldom(),
    UNIT.seldom(),
    FIXED.seldom(),
    ECHO,
    Image::plain("agv-quiet", "agv").secured().quiet(),
    Image { name: "agv-streams-quiet", ..STREAMS }.quiet().seldom(),
    UNIT.secured().quiet().named("unit-secured-quiet").seldom(),
    UNIT.quiet().named("unit-quiet"),
    FIXED.secured().quiet().named("unit-fixed-secured-quiet").seldom(),
    FIXED.quiet().named("unit-fixed-quiet"),
    Image::plain("echo-quiet", "echo").quiet(),
];
/// The least unit, which finds its manager.
const UNIT: Image = Image { feature: Some("discover"), ..Image::plain("unit", "unit") };
/// The same, whose settings say where its manager is.
pub(crate) const FIXED: Image = Image::plain("unit-fixed", "unit");
/// The AGV of an emulated board with its streams.
pub(crate) const STREAMS: Image = Image { name: "agv-streams", feature: Some("streams"), ..AGV };
/// A vehicle of the warehouse.
pub(crate) const WAREHOUSE: Image =
    Image { feature: Some("warehouse"), ..Image::plain("warehouse", "warehouse").secured() };
/// The AGV of an emulated board with a service that makes it fail.
pub(crate) const FAULTS: Image = Image { name: "agv-faults", feature: Some("faults"), ..AGV };
/// The same, whose log comes over its link.
pub(crate) const LOGGED: Image = Image { name: "agv-faults-logs", feature: Some("faults,logs"), ..AGV };
/// The AGV of an emulated board with random numbers that are the same in each life, and with a service that takes lists.
pub(crate) const CONSTANT: Image = Image { name: "agv-constant-random", feature: Some("constant-random,lists"), ..AGV };
/// The AGV of the emulated board that can be handed over to a second manager.
pub(crate) const HANDED: Image = Image { name: "agv-hand-over", feature: Some("hand-over"), ..AGV };
/// The AGV of the emulated board on a serial line.
pub(crate) const SLIP: Image = Image { name: "agv-slip", feature: Some("slip"), ..AGV };
/// The AGV of the emulated board on a serial line without IP.
pub(crate) const LINE: Image = Image { name: "agv-line", feature: Some("line"), ..AGV };
/// The least unit there, which finds its manager.
pub(crate) const UNIT_LINE: Image = Image { name: "unit-line-quiet", feature: Some("discover,line"), ..UNIT }.quiet();
/// Says what each capacity of a unit costs.
pub(crate) const RESOURCES: Image = Image::plain("resources", "resources").secured();

/// One real board of each family.
const OF_FAMILIES: [&str; 2] = ["nucleo-f767zi", "rp2040"];

/// All of them: the emulated ones, and those of the table of boards with settings.
pub(crate) static BOARDS: LazyLock<Vec<Board>> = LazyLock::new(|| {
    let emulated = Board {
        name: "lm3s6965evb",
        folder: "lm3s6965evb",
        feature: None,
        target: "thumbv7m-none-eabi",
        images: EMULATED,
        has_radio: false,
        by_default: true,
    };
    let second = Board {
        name: "mps2-an386",
        folder: "mps2-an386",
        target: "thumbv7em-none-eabihf",
        images: IMAGES,
        by_default: false,
        ..emulated
    };
    let real = cara_settings::board::BOARDS.into_iter().map(|board| Board {
        name: board.name,
        folder: board.folder,
        feature: Some(board.feature),
        target: board.target,
        images: IMAGES,
        has_radio: board.wireless,
        by_default: OF_FAMILIES.contains(&board.name),
    });
    [emulated, second].into_iter().chain(real).collect()
});

/// Boards of which there is such an image, once what the compiler needs for them is installed; why it cannot be.
pub(crate) fn with(of: Chosen) -> Result<Vec<&'static Board>, String> {
    let boards = BOARDS.iter().filter(|board| board.images.iter().any(|image| of(board, image)));
    boards.map(|board| install::rust_target(board.target).map(|()| board)).collect()
}

/// The board of a name; the error lists all.
pub(crate) fn find(name: &str) -> Result<&'static Board> {
    let Some(board) = BOARDS.iter().find(|board| board.name == name) else {
        let names: Vec<&str> = BOARDS.iter().map(|board| board.name).collect();
        bail!("there is no board {name}; there are: {}", names.join(", "));
    };
    Ok(board)
}

/// The emulated board of a name.
pub(crate) fn emulated(name: &str) -> Result<&'static Board> {
    let board = find(name)?;
    if !board.is_emulated() {
        let names: Vec<&str> = BOARDS.iter().filter(|board| board.is_emulated()).map(|board| board.name).collect();
        bail!("{name} is not emulated here, as these are: {}", names.join(", "));
    }
    Ok(board)
}

impl Board {
    /// Whether it runs in QEMU.
    pub(crate) fn is_emulated(&self) -> bool {
        self.feature.is_none()
    }

    /// Builds an image; where it is.
    pub(crate) fn build(&self, image: &Image) -> Result<PathBuf> {
        self.build_of(workspace::root(), image, &place().join("images").join(self.name))
    }

    /// Builds an image of the project's sources in another folder, to a folder; where it is.
    pub(crate) fn build_of(&self, sources: &Path, image: &Image, to: &Path) -> Result<PathBuf> {
        let folder = sources.join("examples/firmware").join(self.folder);
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
        let chosen = |feature, is_chosen: bool| is_chosen.then_some(feature);
        let features: Vec<&str> = match self.feature {
            Some(feature) => vec![feature],
            None => [
                chosen("agv", matches!(image.program, "agv" | "warehouse")),
                chosen("defmt", image.has_logs),
                chosen("net", ![LINE.feature, UNIT_LINE.feature].contains(&image.feature)),
                chosen("secure", image.is_secured),
                image.feature,
            ]
            .into_iter()
            .flatten()
            .collect(),
        };
        let build = build.args(["--no-default-features"]);
        features.iter().fold(build, |build, feature| build.args(["--features", feature])).stream()?;
        self.kept(image, to)
    }

    /// Copies an image to a folder. Whole or not at all: an emulator of another group may load it meanwhile.
    fn kept(&self, image: &Image, folder: &Path) -> Result<PathBuf> {
        std::fs::create_dir_all(folder).with_context(|| format!("cannot make {}", folder.display()))?;
        let (built, kept) = (built(self.target, image.program), folder.join(image.name));
        let whole = kept.with_extension("new");
        std::fs::copy(&built, &whole).with_context(|| format!("cannot copy {}", built.display()))?;
        std::fs::rename(&whole, &kept).with_context(|| format!("cannot write {}", kept.display()))?;
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
