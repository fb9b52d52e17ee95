//! The table of the groups of checks: the one place that says what is checked, at what cost, and how.

use std::path::Path;

use anyhow::{Result, bail};

use crate::command::Run;
use crate::{
    alerts, bad_input, binaries, claims, demo, dependencies, firmware, fleet, hygiene, install, instructions, later,
    layers, licences, links, manifests, msrv, names, orders, packages, panic_free, paper, planted, release, security,
    workspace,
};

/// A group of checks that is run and reported as one.
pub(crate) struct Group {
    pub(crate) name: &'static str,
    pub(crate) what: &'static str,
    /// Seconds that the group may take on a clean checkout and a machine of two cores, with others beside it if it waits.
    pub(crate) budget: u64,
    /// The same for `--quick` in a tree that was built before, or `None` where the quick run leaves the group out.
    pub(crate) quick: Option<u64>,
    /// Whether it runs when no group is named. A group that does not is not part of what `.ci/run` promises.
    pub(crate) by_default: bool,
    /// Whether another such group can run beside it: it leaves most of the processors idle, or takes what others leave idle.
    pub(crate) waits: bool,
    pub(crate) run: fn(Extent) -> Outcome,
}

/// How much of a group is run.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum Extent {
    Full,
    Quick,
}

/// How a group ended. A skipped group has shown nothing.
#[derive(Debug, PartialEq, Eq)]
pub(crate) enum Outcome {
    Passed,
    Failed(String),
    Skipped(String),
}

/// All groups, in the order in which they run: cheap ones first, but for those side by side, of which the longest begins.
pub(crate) const GROUPS: [Group; 43] = [
    Group {
        name: "format",
        what: "every crate is formatted",
        budget: 10,
        quick: Some(10),
        by_default: true,
        waits: false,
        run: |_| needing(install::rust_component("rustfmt", "rustfmt"), format),
    },
    Group {
        name: "layers",
        what: "arrows between layers and crates; file sizes; no unsafe, no machine paths",
        budget: 5,
        quick: Some(5),
        by_default: true,
        waits: false,
        run: |_| all(&[layers::check, manifests::check, hygiene::check]),
    },
    Group {
        name: "dependencies",
        what: "each dependency has its reason; licences, sources and the Rust that they need are allowed",
        budget: 5,
        quick: Some(5),
        by_default: true,
        waits: false,
        run: |_| all(&[dependencies::check, licences::check, msrv::check]),
    },
    Group {
        name: "links",
        what: "links of the documents lead to files and headings, and the tests that they name exist",
        budget: 2,
        quick: Some(2),
        by_default: true,
        waits: false,
        run: |_| links::check().into(),
    },
    Group {
        name: "paper",
        what: "every promise of the paper, item of bad input and claim about security has its test; forty have a patch",
        budget: 2,
        quick: Some(2),
        by_default: true,
        waits: false,
        run: |_| all(&[paper::check, bad_input::check, claims::check, orders::check, planted::check]),
    },
    Group {
        name: "names",
        what: "every name of the paper leads to its Rust name in the documentation's search",
        budget: 2,
        quick: Some(2),
        by_default: true,
        waits: false,
        run: |_| names::check().into(),
    },
    Group {
        name: "clippy",
        what: "clippy on all crates and targets, and on the Linux port without its features, warnings are errors",
        budget: 135,
        quick: Some(60),
        by_default: true,
        waits: true,
        run: |_| needing(install::rust_component("clippy", "cargo-clippy"), clippy),
    },
    Group {
        name: "doc",
        what: "the documentation of all crates, warnings are errors",
        budget: 45,
        quick: None,
        by_default: true,
        waits: true,
        run: |_| doc().into(),
    },
    Group {
        name: "build",
        what: "every test of the workspace builds; apart, so that the time of `unit` is that of its tests",
        budget: 280,
        quick: Some(120),
        by_default: true,
        waits: false,
        run: |_| binaries::tests().args(["--no-run"]).stream().into(),
    },
    Group {
        name: "unit",
        what: "cargo test of the whole workspace, of the Linux port with its asynchronous face, and of the core without features; docs/paper.md names these",
        budget: 680,
        quick: Some(300),
        by_default: true,
        waits: true,
        run: |_| unit().into(),
    },
    Group {
        name: "thumb",
        what: "the core builds for a Cortex-M3; in full also: no panic is reachable from its entry points",
        budget: 60,
        quick: Some(20),
        by_default: true,
        waits: true,
        run: |extent| needing(install::rust_target(panic_free::TARGET), || thumb(extent)),
    },
    Group {
        name: "vectors",
        what: "a decoder in a second language reads the golden vectors",
        budget: 20,
        quick: Some(20),
        by_default: true,
        waits: true,
        run: |_| needing(install::program("python3", "python3"), vectors),
    },
    Group {
        name: "loom",
        what: "the hand-over of a link's reader, in every order of its threads; and a lost wake-up is found",
        budget: 120,
        quick: None,
        by_default: true,
        waits: true,
        run: |_| planted::loom().into(),
    },
    Group {
        name: "scenarios",
        what: "every scenario on the simulator, with faults, for 150 seeds (quick: 50), with checks of overflows",
        budget: 120,
        quick: Some(90),
        by_default: true,
        waits: true,
        run: |extent| scenarios(extent).into(),
    },
    Group {
        name: "planted",
        what: "two bugs, planted on purpose, are found by the scenarios (the third one by loom)",
        budget: 170,
        quick: None,
        by_default: false,
        waits: true,
        run: |_| planted::scenarios().into(),
    },
    Group {
        name: "later",
        what: "units of this version and of a later one, which says what this one does not know: scenarios, the demonstration; before a release",
        budget: 180,
        quick: None,
        by_default: false,
        waits: true,
        run: |_| later::check().into(),
    },
    Group {
        name: "security",
        what: "attackers on the simulator, a board in QEMU (not quick) and Linux units: none of them comes to anything",
        budget: 300,
        quick: Some(90),
        by_default: true,
        waits: true,
        run: security::check,
    },
    Group {
        name: "fleet",
        what: "1,000 s_units on one manager (quick: 500): broadcasts, threads, memory; times far beyond their goals",
        budget: 70,
        quick: Some(60),
        by_default: true,
        waits: false,
        run: |extent| fleet::check(extent).into(),
    },
    Group {
        name: "counts",
        what: "a blocking round trip takes no more system calls, switches and wake-ups at either end than it may",
        budget: 90,
        quick: None,
        by_default: true,
        waits: false,
        run: |_| counts().into(),
    },
    Group {
        name: "demo",
        what: "cargo xtask demo: the listing between real processes",
        budget: 30,
        quick: None,
        by_default: true,
        waits: true,
        run: |_| demo::run().map(drop).into(),
    },
    Group {
        name: "warehouse",
        what: "cargo xtask demo --warehouse --board: 14 vehicles, one in QEMU, at work while everything fails; no two ever in one cell",
        budget: 115,
        quick: None,
        by_default: true,
        waits: true,
        run: |_| demo::check_warehouse(),
    },
    Group {
        name: "guide",
        what: "every command of the guide does what it says",
        budget: 110,
        quick: None,
        by_default: true,
        waits: true,
        run: |_| guide().into(),
    },
    Group {
        name: "web",
        what: "the page of cara web, clicked through in a browser: vehicles move, are called, stopped and lost, behind nginx as well; the warehouse",
        budget: 75,
        quick: None,
        by_default: true,
        waits: true,
        run: |_| web(),
    },
    Group {
        name: "boards",
        what: "firmware of an emulated board and of one real board of each family links, and leaves the pages of its settings free",
        budget: 200,
        quick: None,
        by_default: true,
        waits: true,
        run: |_| firmware::link(firmware::each_time),
    },
    Group {
        name: "all-boards",
        what: "the same of every board and image, and none takes 2 % more than docs/sizes.md says",
        budget: 900,
        quick: None,
        by_default: false,
        waits: true,
        run: |_| firmware::check_all_boards(),
    },
    Group {
        name: "firmware",
        what: "firmware in QEMU against the Linux manager: calls, cables, losses of power, a serial line",
        budget: 360,
        quick: None,
        by_default: true,
        waits: true,
        run: |_| firmware::test(),
    },
    Group {
        name: "faults",
        what: "an emulated vehicle's motors stand within the bound, whatever fails; cargo xtask faults does it 26 times for each kind",
        budget: 350,
        quick: None,
        by_default: true,
        waits: true,
        run: |_| firmware::check_faults(),
    },
    Group {
        name: "sizes",
        what: "no firmware of these boards takes 2 % more flash, RAM or stack than docs/sizes.md says",
        budget: 150,
        quick: None,
        by_default: true,
        waits: true,
        run: |_| firmware::check_sizes(firmware::each_time),
    },
    Group {
        name: "instructions",
        what: "no operation takes 3 % more instructions than docs/instructions.md says, on this host and a Cortex-M3",
        budget: 110,
        quick: None,
        by_default: true,
        waits: false,
        run: |_| instructions::check(),
    },
    Group {
        name: "recordings",
        what: "the MCAP tools of PyPI read what `cara record` writes, each message by its schema; asks PyPI",
        budget: 120,
        quick: None,
        by_default: false,
        waits: false,
        run: |_| needing(install::program("python3", "python3"), recordings),
    },
    Group {
        name: "alerts",
        what: "Prometheus reads the alert rules and the dashboard: each rule fires for its cause; a manager is scraped, a vehicle goes",
        budget: 120,
        quick: None,
        by_default: false,
        waits: true,
        run: |_| needing(install::program("promtool", "prometheus"), alerts::check),
    },
    Group {
        name: "packages",
        what: "each crate to publish is packaged and builds, a program that has the packages alone runs, the oldest dependencies build, and the guide from its first build on; before a release",
        budget: 900,
        quick: None,
        by_default: false,
        waits: false,
        run: |_| packages::check().into(),
    },
    Group {
        name: "release",
        what: "the files of a release, and its Debian package installed, run, upgraded, removed and purged in a clean root; before a release",
        budget: 1_200,
        quick: None,
        by_default: false,
        waits: false,
        run: |_| release::check().into(),
    },
    Group {
        name: "line",
        what: "the emulated board on a serial line without IP, against cara line and the Linux manager, and how small a unit is there",
        budget: 300,
        quick: None,
        by_default: false,
        waits: true,
        run: |_| firmware::line(),
    },
    Group {
        name: "logs",
        what: "the emulated board's log over its link: decoded by cara logs, record and web, also behind a panic; builds a cara with defmt",
        budget: 120,
        quick: None,
        by_default: false,
        waits: true,
        run: |_| firmware::logs(),
    },
    Group {
        name: "hand-over",
        what: "the emulated board handed over between two Linux managers, and beside a manager that is killed or frozen and its standby",
        budget: 120,
        quick: None,
        by_default: false,
        waits: true,
        run: |_| firmware::hand_over(),
    },
    Group {
        name: "deny",
        what: "cargo-deny: licences, sources and version requirements of every workspace, with all features; lists duplicates",
        budget: 300,
        quick: None,
        by_default: false,
        waits: false,
        run: |_| {
            install::crate_program("cargo-deny", "0.20.2")
                .map_or_else(Outcome::Skipped, |tool| licences::deny(&tool).into())
        },
    },
    Group {
        name: "etcd",
        what: "managers that lead by an etcd, which is killed, stopped and cut off; clippy on that crate, which is outside of the workspace",
        budget: 300,
        quick: None,
        by_default: false,
        waits: true,
        run: |_| needing(install::program("etcd", "etcd-server"), etcd),
    },
    Group {
        name: "standby",
        what: "two managers and their vehicles on a host each: killed, frozen, without power, cut off either way; no two are obeyed by turns; times are printed",
        budget: 500,
        quick: None,
        by_default: false,
        waits: true,
        run: |_| needing(install::program("nft", "nftables"), standby),
    },
    Group {
        name: "rp2040",
        what: "an RP2040's image in rp2040js with a W5500, against the Linux manager: calls, the motors' pin, losses of power, cuts in flash",
        budget: 1_200,
        quick: None,
        by_default: false,
        waits: true,
        run: |_| firmware::test_rp2040(),
    },
    Group {
        name: "abilities",
        what: "the embassy port with each of its features alone, with all and with none builds for a Cortex-M0, M3 and M4, without a warning",
        budget: 300,
        quick: None,
        by_default: false,
        waits: false,
        run: |_| needing(firmware::targets(), firmware::abilities),
    },
    Group {
        name: "mps2-an386",
        what: "the second emulated board, a Cortex-M4 with another Ethernet controller: checks of the first one, faults, its sizes",
        budget: 900,
        quick: None,
        by_default: false,
        waits: true,
        run: |_| firmware::test_second(),
    },
    Group {
        name: "vda5050",
        what: "the gateway to VDA 5050: schemas, order handling, record, mosquitto, and masters by others; its clippy, as it is outside of the workspace",
        budget: 600,
        quick: None,
        by_default: false,
        waits: true,
        run: |_| {
            let broker = install::program("mosquitto", "mosquitto");
            let tools = broker.and_then(|()| install::program("openssl", "openssl"));
            needing(tools.and_then(|()| install::program("npm", "npm")), vda5050)
        },
    },
];

impl From<Result<()>> for Outcome {
    fn from(result: Result<()>) -> Self {
        match result {
            Ok(()) => Self::Passed,
            Err(error) => Self::Failed(format!("{error:#}")),
        }
    }
}

/// Most of the slow tests wait, so that more of them than there are CPUs end sooner.
const THREADS: &str = "8";

fn unit() -> Result<()> {
    // A few tests of the doctor make networks and firewalls of their own; without these programs they say so, and fail
    // where `CI` is set.
    for (program, package) in [("ip", "iproute2"), ("nft", "nftables")] {
        if let Err(reason) = install::program(program, package) {
            println!("some tests will be skipped: {reason}");
        }
    }
    binaries::tests().args(["--no-fail-fast"]).env("RUST_TEST_THREADS", THREADS).stream()?;
    // The core of a board, with none of the features that the workspace's other crates turn on.
    Run::cargo().args(["test", "--quiet", "--package", "cara-core", "--lib"]).stream()?;
    paper::check_ran(&["--workspace", "--features", binaries::FEATURES])
}

/// Runs a check once what it needs is there; what cannot be had is a reason to skip it.
fn needing(installed: Result<(), String>, check: impl FnOnce() -> Result<()>) -> Outcome {
    match installed {
        Ok(()) => check().into(),
        Err(reason) => Outcome::Skipped(reason),
    }
}

/// Runs every check, also behind one that fails.
fn all(checks: &[fn() -> Result<()>]) -> Outcome {
    let failures: Vec<String> =
        checks.iter().filter_map(|check| check().err()).map(|error| format!("{error:#}")).collect();
    if failures.is_empty() { Outcome::Passed } else { Outcome::Failed(failures.join("; ")) }
}

fn format() -> Result<()> {
    Run::cargo().args(["fmt", "--all", "--check"]).stream()?;
    for manifest in manifests::all()?.iter().filter(|manifest| manifest.is_workspace()) {
        let file = manifest.file.to_string_lossy();
        Run::cargo().args(["fmt", "--check", "--manifest-path", &file]).stream()?;
    }
    Ok(())
}

fn clippy() -> Result<()> {
    let all = [
        "clippy",
        "--workspace",
        "--all-targets",
        "--features",
        binaries::FEATURES,
        "--",
        "-D",
        "warnings",
        "-D",
        "clippy::incompatible_msrv",
    ];
    Run::cargo().args(all).stream()?;
    // What only a feature uses is behind it.
    Run::cargo().args(["clippy", "--package", "cara-std", "--no-default-features", "--", "-D", "warnings"]).stream()
}

fn doc() -> Result<()> {
    Run::cargo().args(["doc", "--workspace", "--no-deps"]).env("RUSTDOCFLAGS", "-D warnings").stream()
}

fn thumb(extent: Extent) -> Result<()> {
    let packages = ["--package", "cara-core", "--package", "cara-smoltcp", "--package", "cara-embassy"];
    let build = || Run::cargo().args(["build", "--target", panic_free::TARGET]);
    build().args(packages).stream()?;
    // Log lines are code that nothing else compiles.
    build().args(["--package", "cara-embassy", "--features", "cara-embassy/defmt"]).stream()?;
    if extent == Extent::Full { panic_free::check() } else { Ok(()) }
}

fn vectors() -> Result<()> {
    present("tests/vectors/decode.py")?;
    Run::new("python3").args(["tests/vectors/decode.py"]).stream()
}

fn scenarios(extent: Extent) -> Result<()> {
    present("tests/scenarios/Cargo.toml")?;
    let seeds = if extent == Extent::Full { "150" } else { "50" };
    binaries::debug("seeds")?.args(["--seeds", seeds]).stream()
}

/// Uses programs that are built as for the other tests; the guide's own build command runs in the group `packages`.
fn guide() -> Result<()> {
    binaries::build(&["cara", "agv"])?;
    binaries::debug("cara-guide")?.args(["docs/guide.md", "--built"]).stream()
}

/// A kernel that lets nobody count fails nothing: it says nothing about CARA.
fn counts() -> Result<()> {
    match counted_by_perf() {
        Ok(()) => binaries::release("cara-bench")?.args(["counts"]).stream(),
        Err(reason) => {
            println!("nothing was counted: {reason}");
            Ok(())
        }
    }
}

/// Tracepoints are for root alone where the system is as it comes.
fn counted_by_perf() -> Result<(), String> {
    install::program("perf", "linux-perf")?;
    let (counts, _, errors) = Run::new("perf")
        .args(["stat", "--event", "sched:sched_waking", "true"])
        .captured()
        .map_err(|error| format!("{error:#}"))?;
    if counts { Ok(()) } else { Err(format!("perf counts no tracepoints here: {}", errors.trim())) }
}

fn web() -> Outcome {
    let browser = install::program("chromium", "chromium");
    let driver = browser.and_then(|()| install::program("chromedriver", "chromium-driver"));
    let proxy = driver.and_then(|()| install::program("nginx", "nginx"));
    needing(proxy, || {
        binaries::build(&["cara", "agv", "warehouse", "cara-web-clicks"])?;
        Run::new(&workspace::target().join("debug/cara-web-clicks").to_string_lossy()).stream()
    })
}

fn recordings() -> Result<()> {
    let folder = workspace::target().join("recordings");
    let of_folder = |program: &str| folder.join("bin").join(program);
    Run::new("python3").args(["-m", "venv", &folder.to_string_lossy()]).stream()?;
    Run::new(&of_folder("pip").to_string_lossy()).args(["install", "--quiet", "mcap", "jsonschema"]).stream()?;
    let test = Run::cargo().args(["test", "-p", "cara-cli", "--test", "cara", "--", "--ignored", "tools_of_pypi"]);
    test.env("CARA_TEST_PYTHON", &of_folder("python").to_string_lossy()).stream()
}

fn standby() -> Result<()> {
    let test = Run::cargo().args(["test", "-p", "cara-std", "--test", "port", "--"]);
    test.args(["hosts::", "--ignored", "--nocapture", "--test-threads=1"]).stream()
}

fn etcd() -> Result<()> {
    outside("std-port/etcd/Cargo.toml", "target/etcd", &["--features", "tls"], &[])
}

fn vda5050() -> Result<()> {
    outside("gateways/vda5050/Cargo.toml", "target/vda5050", &[], &["--include-ignored"])
}

/// Clippy and the tests of a crate that is a workspace of its own.
fn outside(manifest: &str, target: &str, of_clippy: &[&str], of_tests: &[&str]) -> Result<()> {
    let cargo = |command| {
        let place = ["--locked", "--manifest-path", manifest, "--target-dir", target];
        Run::cargo().args([command]).args(place)
    };
    cargo("clippy").args(["--all-targets"]).args(of_clippy).args(["--", "-D", "warnings"]).stream()?;
    cargo("test").args(["--", "--nocapture"]).args(of_tests).stream()
}

fn present(file: &str) -> Result<()> {
    if !workspace::root().join(Path::new(file)).is_file() {
        bail!("{file} is absent");
    }
    Ok(())
}

#[cfg(test)]
mod tests {
    use super::{GROUPS, Group, Outcome, all, needing};
    use crate::runner::SIDE_BY_SIDE;
    use std::collections::HashSet;

    #[test]
    fn names_are_unique() {
        let names: HashSet<&str> = GROUPS.iter().map(|group| group.name).collect();
        assert_eq!(names.len(), GROUPS.len());
    }

    /// Seconds that the groups take where each takes as long as it may, some of them side by side.
    fn together(budget: fn(&Group) -> Option<u64>) -> u64 {
        let groups = || GROUPS.iter().filter(|group| group.by_default);
        let one_by_one: u64 = groups().filter(|group| !group.waits).filter_map(budget).sum();
        let waiting: Vec<u64> = groups().filter(|group| group.waits).filter_map(budget).collect();
        let shared = waiting.iter().sum::<u64>() / SIDE_BY_SIDE as u64;
        one_by_one + shared.max(waiting.into_iter().max().unwrap_or_default())
    }

    #[test]
    fn all_groups_together_fit_into_their_time() {
        let (full, quick) = (together(|group| Some(group.budget)), together(|group| group.quick));
        assert!(full <= 28 * 60 && quick <= 10 * 60, "{full} s, quick {quick} s");
    }

    #[test]
    fn what_cannot_be_had_is_skipped_not_passed() {
        assert_eq!(needing(Err("no rustup".into()), || Ok(())), Outcome::Skipped("no rustup".into()));
    }

    #[test]
    fn one_failure_of_several_fails() {
        let outcome = all(&[|| Ok(()), || anyhow::bail!("broken"), || Ok(())]);
        assert_eq!(outcome, Outcome::Failed("broken".into()));
    }
}
