//! Masters by others, which are fetched: `cargo xtask test vda5050`.

mod fake;
mod plant;

use std::path::{Path, PathBuf};
use std::process::{Command, Stdio};
use std::time::{Duration, Instant};

use plant::{Plant, Process, check_messages};

/// So many vehicles are driven at a time, and by each master for so long at most.
const VEHICLES: u32 = 20;
const LONGEST: Duration = Duration::from_secs(120);

/// Runs a master control by others, which says by its exit code whether all went as it was to. Each vehicle drives so many edges and
/// does so many actions.
fn by_others(version: &'static str, program: &Path, script: &str, drives: usize, actions: usize) {
    let plant = Plant::of(VEHICLES, "{ do = \"stop\" }", version, |_| Default::default());
    plant.wait_for("all are there", |plant| {
        let heard = plant.heard.lock().unwrap();
        (2..=VEHICLES).all(|number| heard.contains_key(&format!("{number:04}/state")))
    });
    let began = Instant::now();
    let mut command = Command::new(program);
    command.arg(script).args([plant.port.to_string(), VEHICLES.to_string()]).current_dir(masters());
    let mut master = Process::start(&mut command);
    let mut ended = None;
    while ended.is_none() {
        assert!(began.elapsed() < LONGEST, "{:?}", master.lines());
        std::thread::sleep(Duration::from_millis(10));
        ended = master.child.try_wait().unwrap();
    }
    assert!(ended.unwrap().success(), "{:?}\n{:?}", master.lines(), plant.vehicle.lines());
    for vehicle in plant.others.iter().chain([&plant.vehicle]) {
        let lines = vehicle.lines();
        let count = |start: &str| lines.iter().filter(|line| line.starts_with(start)).count();
        assert_eq!([count("drive "), count("act ")], [drives, actions], "{lines:?}");
    }
    println!("{script}: {VEHICLES} vehicles within {:?}", began.elapsed());
    check_messages(&plant);
}

/// A folder with the scripts, into which what they need is installed.
fn masters() -> PathBuf {
    let folder = Path::new(env!("CARGO_TARGET_TMPDIR")).join("masters");
    std::fs::create_dir_all(&folder).unwrap();
    for file in ["package.json", "master.js", "master.py"] {
        let from = Path::new(env!("CARGO_MANIFEST_DIR")).join("tests/masters").join(file);
        std::fs::copy(from, folder.join(file)).unwrap();
    }
    folder
}

fn ran(command: &mut Command) {
    assert!(command.stdout(Stdio::null()).status().unwrap().success(), "{command:?}");
}

#[test]
#[ignore = "fetches vda-5050-lib by npm"]
fn a_master_by_others_drives_vehicles_of_2_0() {
    ran(Command::new("npm").args(["install", "--silent"]).current_dir(masters()));
    by_others("2.0.0", Path::new("node"), "master.js", 5, 1);
}

#[test]
#[ignore = "fetches vda5050-sdk by pip"]
fn a_master_by_others_drives_vehicles_of_2_1() {
    let python = masters().join("python");
    ran(Command::new("python3").args(["-m", "venv"]).arg(&python));
    ran(Command::new(python.join("bin/pip")).args(["install", "--quiet", "vda5050-sdk==0.2.0", "aiomqtt==2.5.1"]));
    by_others("2.1.0", &python.join("bin/python"), "master.py", 4, 0);
}
