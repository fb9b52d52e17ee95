//! Masters by others, which are fetched: `cargo xtask test vda5050`.

mod fake;
mod plant;

use std::path::{Path, PathBuf};
use std::process::{Command, Stdio};
use std::sync::OnceLock;
use std::time::{Duration, Instant};

use cara_warehouse::map::Map;
use cara_warehouse::run::truth::Truth;
use plant::{Plant, Process, check_messages};

/// So many vehicles are driven at a time, and by each master for so long at most.
const VEHICLES: u32 = 20;
const LONGEST: Duration = Duration::from_secs(240);

/// Runs a master control by others, which says by its exit code whether all went as it was to. Each vehicle drives so many edges and
/// does so many actions.
fn by_others(version: &'static str, program: &Path, script: &str, drives: usize, actions: usize) {
    let plant = Plant::of(VEHICLES, "{ do = \"stop\" }", version, |_| Default::default());
    run(&plant, program, script, None);
    for vehicle in plant.others.iter().chain([&plant.vehicle]) {
        let lines = vehicle.lines();
        let count = |start: &str| lines.iter().filter(|line| line.starts_with(start)).count();
        assert_eq!([count("drive "), count("act ")], [drives, actions], "{lines:?}");
    }
    check_messages(&plant);
}

fn run(plant: &Plant, program: &Path, script: &str, more: Option<&str>) {
    plant.wait_for("all are there", |plant| {
        let heard = plant.heard.lock().unwrap();
        (2..=VEHICLES).all(|number| heard.contains_key(&format!("{number:04}/state")))
    });
    let began = Instant::now();
    let mut command = Command::new(program);
    command.arg(script).args([plant.port.to_string(), VEHICLES.to_string()]).args(more).current_dir(masters());
    let mut master = Process::start(&mut command);
    let mut ended = None;
    while ended.is_none() {
        assert!(began.elapsed() < LONGEST, "{:?}", master.lines());
        std::thread::sleep(Duration::from_millis(10));
        ended = master.child.try_wait().unwrap();
    }
    assert!(ended.unwrap().success(), "{:?}\n{:?}", master.lines(), plant.vehicle.lines());
    println!("{script}: {VEHICLES} vehicles within {:?}", began.elapsed());
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
    by_others("2.1.0", &python(), "master.py", 4, 0);
}

/// Each drives a lap, on two rings that share a column. The warehouse judges their logs.
#[test]
#[ignore = "fetches vda5050-sdk by pip"]
fn vehicles_of_the_warehouse_share_cells_under_a_master_by_others() {
    let file = Path::new(env!("CARGO_MANIFEST_DIR")).join("../../examples/warehouse/maps/hall.map");
    let map = Map::parse("hall.map", &std::fs::read_to_string(file).unwrap()).unwrap();
    // Half of them on each ring.
    let columns = || (1..=5).chain(11..=15);
    let cells: Vec<String> = [1, 4].into_iter().flat_map(|y| columns().map(move |x| format!("{x},{y}"))).collect();
    let plant = Plant::on_floor(VEHICLES, &cells, "{ do = \"stop\" }", "2.1.0", |_| Default::default());
    run(&plant, &python(), "master.py", Some("floor"));
    let lines = plant.others.iter().chain([&plant.vehicle]).flat_map(Process::lines);
    let mut logged: Vec<String> = lines.filter(|line| line.contains(" enter ") || line.contains(" leave ")).collect();
    // By their time.
    logged.sort_by_key(|line| (line.find('.'), line.clone()));
    let mut truth = Truth::new(&map, &[]);
    logged.iter().for_each(|line| truth.hear(line));
    truth.finish();
    assert!(truth.wrong.is_empty(), "{:?}", truth.wrong);
    for (index, cell) in cells.iter().enumerate() {
        let lap = if cell.split(',').next().unwrap().len() == 1 { 20 } else { 22 };
        assert_eq!(truth.moves[&format!("agv-{}", index + 1)], lap);
    }
    check_messages(&plant);
}

/// With the SDK.
fn python() -> PathBuf {
    static INSTALLED: OnceLock<PathBuf> = OnceLock::new();
    let install = || {
        let python = masters().join("python");
        ran(Command::new("python3").args(["-m", "venv"]).arg(&python));
        ran(Command::new(python.join("bin/pip")).args(["install", "--quiet", "vda5050-sdk==0.2.0", "aiomqtt==2.5.1"]));
        python.join("bin/python")
    };
    INSTALLED.get_or_init(install).clone()
}
