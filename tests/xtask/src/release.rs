//! What a release consists of beside the crates: static programs, Debian packages, checksums and lists of components.

use std::fs;
use std::os::unix::fs::PermissionsExt;
use std::path::{Path, PathBuf};

use anyhow::{Context, Error, Result, ensure};

use crate::book;
use crate::command::Run;
use crate::install;
use crate::workspace;

const VERSION: &str = env!("CARGO_PKG_VERSION");
/// What is installed in `bin`, of which manifest it is, and with which features.
const PROGRAMS: [(&str, &str, &str); 2] =
    [("cara", "std-port/cli/Cargo.toml", "defmt"), ("cara-vda5050", "gateways/vda5050/Cargo.toml", "")];
/// Where it is put together.
const FOLDER: &str = "release-files";
const SHELLS: [(&str, &str); 3] = [
    ("bash", "share/bash-completion/completions/cara"),
    ("zsh", "share/zsh/vendor-completions/_cara"),
    ("fish", "share/fish/vendor_completions.d/cara.fish"),
];

/// A kind of processor: as Debian and as Rust call it, the C compiler for what is not Rust, and what links.
#[derive(Clone, Copy)]
struct Processor {
    debian: &'static str,
    target: &'static str,
    compiler: &'static str,
    package: &'static str,
    linker: &'static str,
}

const PROCESSORS: [Processor; 2] = [
    Processor {
        debian: "amd64",
        target: "x86_64-unknown-linux-musl",
        compiler: "musl-gcc",
        package: "musl-tools",
        linker: "cc",
    },
    Processor {
        debian: "arm64",
        target: "aarch64-unknown-linux-musl",
        compiler: "aarch64-linux-gnu-gcc",
        package: "gcc-aarch64-linux-gnu",
        linker: "aarch64-linux-gnu-gcc",
    },
];

/// Makes all files of a release; returns their folder.
pub(crate) fn make() -> Result<PathBuf> {
    let folder = workspace::target().join(FOLDER);
    empty(&folder)?;
    let native = PROCESSORS.iter().find(|processor| processor.target.starts_with(std::env::consts::ARCH));
    let native = build(*native.context("releases are made on amd64 or arm64")?)?;
    let book = book::make()?;
    for processor in PROCESSORS {
        let programs = build(processor)?;
        let tree = folder.join(processor.debian);
        stage(&tree.join("usr"), &programs, &native.join("cara"), &book)?;
        archive(&folder, &tree, processor)?;
        package(&folder, &tree, processor)?;
        fs::remove_dir_all(&tree)?;
    }
    components(&folder)?;
    checksums(&folder)?;
    println!("{}", folder.display());
    Ok(folder)
}

fn empty(folder: &Path) -> Result<()> {
    match fs::remove_dir_all(folder) {
        Err(error) if error.kind() != std::io::ErrorKind::NotFound => Err(error.into()),
        _ => Ok(fs::create_dir_all(folder)?),
    }
}

/// Static programs, which run on every distribution, are in the archive and in the Debian package. Their folder.
fn build(processor: Processor) -> Result<PathBuf> {
    let Processor { target, compiler, package, linker, .. } = processor;
    install::rust_target(target).and_then(|()| install::program(compiler, package)).map_err(anyhow::Error::msg)?;
    let folder = workspace::target().join("packages");
    let name = target.replace('-', "_");
    for (program, manifest, features) in PROGRAMS {
        Run::cargo()
            .args(["build", "--release", "--locked", "--manifest-path", manifest, "--bin", program])
            .args(["--features", features])
            .args(["--target", target, "--target-dir"])
            .args([&folder])
            .env("CARGO_PROFILE_RELEASE_STRIP", "symbols")
            .env(&format!("CC_{name}"), compiler)
            .env(&format!("CARGO_TARGET_{}_LINKER", name.to_uppercase()), linker)
            .stream()?;
    }
    Ok(folder.join(target).join("release"))
}

/// Puts what is installed under `usr`. The program of this host prints the texts.
fn stage(usr: &Path, programs: &Path, native: &Path, book: &Path) -> Result<()> {
    for (program, ..) in PROGRAMS {
        place(&fs::read(programs.join(program))?, &usr.join("bin").join(program), 0o755)?;
    }
    let native = native.to_string_lossy();
    let manuals = usr.join("share/man/man1");
    Run::new(&native).args(["man", "--dir"]).args([&manuals]).text()?;
    copy("packaging/cara-vda5050.1", &manuals.join("cara-vda5050.1"))?;
    for page in fs::read_dir(&manuals)? {
        Run::new("gzip").args(["-9n"]).args([page?.path()]).stream()?;
    }
    for (shell, path) in SHELLS {
        place(Run::new(&native).args(["completions", shell]).text()?.as_bytes(), &usr.join(path), 0o644)?;
    }
    let documents = usr.join("share/doc/cara");
    copy("packaging/README.md", &documents.join("README.md"))?;
    for file in ["CHANGELOG.md", "LICENSE-MIT", "LICENSE-APACHE"] {
        copy(file, &documents.join(file))?;
    }
    copy("packaging/debian/copyright", &documents.join("copyright"))?;
    copy("packaging/prometheus/cara.rules.yml", &usr.join("share/cara/prometheus/cara.rules.yml"))?;
    copy("packaging/grafana/cara.json", &usr.join("share/cara/grafana/cara.json"))?;
    let units = usr.join("lib/systemd/system");
    copy("packaging/systemd/cara@.service", &units.join("cara@.service"))?;
    // A standby is the same node, started otherwise.
    copy("packaging/systemd/cara@.service", &units.join("cara-standby@.service"))?;
    copy("packaging/systemd/standby.conf", &units.join("cara-standby@.service.d/standby.conf"))?;
    copy("gateways/vda5050/cara-vda5050.service", &units.join("cara-vda5050.service"))?;
    copy("packaging/systemd/sysusers.conf", &usr.join("lib/sysusers.d/cara.conf"))?;
    Run::new("cp").args(["--recursive"]).args([book, &documents.join("book")]).stream()?;
    copy("gateways/vda5050/example.toml", &documents.join("vda5050.toml"))?;
    copy("gateways/vda5050/example-factsheet.json", &documents.join("example-factsheet.json"))?;
    let example = Run::new(&native).args(["node", "--example"]).text()?;
    place(example.as_bytes(), &documents.join("node.toml"), 0o644)
}

/// A file of the project, which only root changes there.
fn copy(file: &str, path: &Path) -> Result<()> {
    place(workspace::read(Path::new(file))?.as_bytes(), path, 0o644)
}

fn place(content: &[u8], path: &Path, mode: u32) -> Result<()> {
    fs::create_dir_all(path.parent().context("a file lies in a folder")?)?;
    fs::write(path, content).with_context(|| path.display().to_string())?;
    Ok(fs::set_permissions(path, fs::Permissions::from_mode(mode))?)
}

/// For distributions without Debian's packages.
fn archive(folder: &Path, tree: &Path, processor: Processor) -> Result<()> {
    let name = format!("cara-{VERSION}-{}.tar.gz", processor.target);
    Run::new("tar")
        .args(["--create", "--gzip", "--owner=0", "--group=0", "--sort=name", "--mtime=@0", "--file"])
        .args([&folder.join(name)])
        .args(["--directory"])
        .args([&tree.join("usr")])
        .args(["bin", "lib", "share"])
        .stream()
}

fn package(folder: &Path, tree: &Path, processor: Processor) -> Result<()> {
    fs::create_dir_all(tree.join("etc/cara"))?;
    let size = Run::new("du").args(["--summarize", "--block-size=1024"]).args([tree]).text()?;
    let size = size.split_whitespace().next().unwrap_or_default().to_owned();
    let control = format!(
        "Package: cara\nVersion: {VERSION}\nArchitecture: {}\nMaintainer: {}\nInstalled-Size: {size}\nDepends: procps, systemd\n\
         Section: net\nPriority: optional\nDescription: {}\n Managers of automated guided vehicles, the command that asks, starts and\n \
         diagnoses them, and a gateway to VDA 5050.\n",
        processor.debian,
        env!("CARGO_PKG_AUTHORS"),
        "nodes of the Communication Architecture for Robotic Applications",
    );
    place(control.as_bytes(), &tree.join("DEBIAN/control"), 0o644)?;
    for script in ["postinst", "prerm", "postrm"] {
        let text = workspace::read(&Path::new("packaging/debian").join(script))?;
        place(text.as_bytes(), &tree.join("DEBIAN").join(script), 0o755)?;
    }
    // For `dpkg --verify`.
    let sums = Run::new("find").args(["usr", "-type", "f", "-exec", "md5sum", "{}", "+"]).within(tree).text()?;
    place(sums.as_bytes(), &tree.join("DEBIAN/md5sums"), 0o644)?;
    let file = folder.join(format!("cara_{VERSION}_{}.deb", processor.debian));
    Run::new("dpkg-deb").args(["--root-owner-group", "--build"]).args([tree, &file]).stream()
}

/// CycloneDX lists of what is in the programs and in the firmware.
fn components(folder: &Path) -> Result<()> {
    let tool = install::crate_program("cargo-cyclonedx", "0.5.9").map_err(Error::msg)?;
    let images = fs::read_dir(workspace::root().join("examples/firmware"))?.collect::<Result<Vec<_>, _>>()?;
    let images = images.into_iter().map(|image| image.path().join("Cargo.toml")).filter(|path| path.is_file());
    let images = images.filter(|path| path.with_file_name("Cargo.lock").is_file());
    let programs = PROGRAMS.map(|(_, manifest, features)| (workspace::root().join(manifest), features));
    for (manifest, features) in images.map(|manifest| (manifest, "")).chain(programs) {
        let name = format!("cara-components-{}", folder_name(&manifest));
        Run::new(&tool.to_string_lossy())
            .args(["cyclonedx", "--format", "json", "--spec-version", "1.5", "--override-filename", &name])
            .args(["--manifest-path"])
            .args([&manifest])
            .args(if features.is_empty() { vec![] } else { vec!["--features", features] })
            .env("SOURCE_DATE_EPOCH", "0")
            .stream()?;
        collect(&manifest, &format!("{name}.json"), folder)?;
    }
    Ok(())
}

fn folder_name(manifest: &Path) -> String {
    let folder = manifest.parent().and_then(Path::file_name).unwrap_or_default();
    folder.to_string_lossy().into_owned()
}

/// The tool writes a list beside each manifest of the workspace; the one of this package stays.
fn collect(manifest: &Path, name: &str, folder: &Path) -> Result<()> {
    let wanted = manifest.with_file_name(name);
    ensure!(wanted.is_file(), "there is no {}", wanted.display());
    // Where it was built is nobody's business.
    let text = fs::read_to_string(&wanted)?.replace(&workspace::root().display().to_string(), "");
    fs::write(folder.join(name), &text)?;
    let written =
        Run::new("git").args(["ls-files", "--others", "--exclude-standard", "--", &format!("*{name}")]).text()?;
    written.lines().try_for_each(|path| fs::remove_file(workspace::root().join(path)))?;
    let list: serde_json::Value = serde_json::from_str(&text)?;
    ensure!(list["components"].as_array().is_some_and(|components| !components.is_empty()), "{name} lists nothing");
    Ok(())
}

fn checksums(folder: &Path) -> Result<()> {
    let mut names = fs::read_dir(folder)?.map(|entry| Ok(entry?.file_name())).collect::<Result<Vec<_>>>()?;
    names.sort();
    let sums = Run::new("sha256sum").args(["--binary", "--"]).args(&names).within(folder).text()?;
    Ok(fs::write(folder.join("SHA256SUMS"), sums)?)
}

/// Makes a release, and installs, runs, upgrades, removes and purges its package in a clean root.
pub(crate) fn check() -> Result<()> {
    let folder = make()?;
    install::program("mmdebstrap", "mmdebstrap").map_err(anyhow::Error::msg)?;
    let root = workspace::target().join("release-root");
    empty(&root)?;
    let packages = "--include=systemd,man-db,procps";
    Run::new("mmdebstrap").args(["--variant=minbase", packages, "bookworm"]).args([&root]).stream()?;
    let processor = PROCESSORS.iter().find(|processor| processor.target.starts_with(std::env::consts::ARCH));
    let package = format!("cara_{VERSION}_{}.deb", processor.context("amd64 or arm64")?.debian);
    fs::copy(folder.join(&package), root.join("cara.deb"))?;
    place(workspace::read(Path::new("tests/packages/in-root.sh"))?.as_bytes(), &root.join("check.sh"), 0o755)?;
    // With a network of its own, in which there is loopback only.
    let arguments = ["--net", "--mount", "--pid", "--fork", "--kill-child", "chroot"];
    let printed = Run::new("unshare").args(arguments).args([&root]).args(["/check.sh"]).text()?;
    print!("{printed}");
    ensure!(printed.lines().last() == Some("all well"), "the check in the clean root did not come to its end");
    Run::new("sha256sum").args(["--check", "--quiet", "SHA256SUMS"]).within(&folder).stream()
}
