//! `cara scan`, `cara publish` and `cara counters`.

use std::io::Read;
use std::os::unix::fs::PermissionsExt;
use std::path::Path;
use std::process::Stdio;

use cara_std::control::Control;
use cara_std::keys::{FleetKeys, Store, location};
use cara_std::{Fleet, Identity, Interfaces, ParametersView, Served, ServiceError, ServiceOptions, Unit};

use serde_json::{Value, json};

use crate::support::{Ran, Running, Stage, agv, until};

#[test]
fn a_scan_shows_who_is_there() {
    let stage = Stage::with(&["agv-1", "agv-2"]);
    let shown = stage.ends(0, &["scan"]);
    shown.says("agv-1").says("11").says("s_unit").says("connected").says("127.0.0.1").says("message");
    let reported = stage.ends(0, &["scan", "--json"]).json();
    assert_eq!(reported["unit"]["name"], "manager");
    let names: Vec<_> =
        reported["nodes"].as_array().unwrap().iter().map(|node| node["name"].as_str().unwrap()).collect();
    assert!(names.len() == 2 && names.contains(&"agv-1") && names.contains(&"agv-2"), "{names:?}");
    let link = &reported["nodes"][0]["link"];
    let numbers = ["silent_ms", "calls", "calls_here", "queued_bytes"].map(|number| link[number].as_u64());
    assert!(numbers.iter().all(Option::is_some) && numbers[0] < Some(30_000), "{link}");
    assert!(["AES-256-GCM", "ChaCha20-Poly1305"].iter().any(|cipher| link["cipher"] == *cipher), "{link}");
    assert_eq!(stage.ends(0, &["scan", "--offering", "go_to", "--json"]).json()["nodes"].as_array().unwrap().len(), 2);
    stage.ends(0, &["scan", "--offering", "fly"]).says("no such node");
    stage.ends(0, &["scan", "--search", "--listen", "10ms"]).says("agv-2");
}

#[test]
fn a_scan_shows_who_was_refused_and_why() {
    let stage = Stage::with(&["agv-1"]);
    // The same name and ID as the one that is there.
    let duplicate = stage.vehicle("agv-1", 11).build().unwrap();
    duplicate.start().unwrap();
    let start = std::time::Instant::now();
    loop {
        let reported = stage.ends(0, &["scan", "--json"]).json();
        if reported["refused"][0]["reason"] == "DuplicateIdentity" {
            break;
        }
        assert!(start.elapsed() < crate::support::PATIENCE, "{reported}");
        std::thread::sleep(std::time::Duration::from_millis(100));
    }
    stage.ends(0, &["scan"]).says("DuplicateIdentity").says("give each node its own");
    duplicate.stop();
}

/// A vehicle whose clock is behind is shown with that by scan and doctor, and its offset is recorded.
#[test]
fn a_clock_that_is_wrong_is_shown_and_recorded() {
    let stage = Stage::with(&[]);
    stage.know("late-1", 12);
    let agv = stage.vehicle("late-1", 12).build().unwrap();
    let tell =
        |_: &Served, view: &mut ParametersView| -> Result<(), ServiceError> { Ok(view.set_value("unix_us", 1)?) };
    let clock = "clock() -> (unix_us: int)".parse().unwrap();
    agv.my_function_list().add_service(&clock, ServiceOptions::new(), tell).unwrap();
    agv.publish_my_function_list().unwrap();
    agv.start().unwrap();
    until("it is shown", || stage.cara(&["scan"]).out.contains("connected, clock "));
    let reported = stage.ends(0, &["scan", "--json"]).json();
    let clock = &reported["nodes"][0]["clock"];
    assert!(clock["offset_us"].as_i64() < Some(-1_000_000_000_000_000) && clock["error_us"].is_u64(), "{clock}");
    assert!(clock["age_ms"].is_u64(), "{clock}");
    stage.cara(&["doctor", "late-1"]).says("clock-wrong").says("s behind, compared with that of manager/1");
    let folder = tempfile::tempdir().unwrap();
    let file = folder.path().join("a.mcap");
    let _recorder = Running::start(stage.command(&["record", file.to_str().unwrap()]));
    until("it is recorded", || {
        let recorded = std::fs::read(&file).unwrap_or_default();
        recorded.windows(14).any(|bytes| bytes == b"\"offset_us\":-1")
    });
    agv.stop();
}

#[test]
fn without_a_manager_a_scan_surveys_the_network() {
    let stage = Stage::empty();
    let agv = Unit::builder("lost-agv", 5, "nobody", 9).unwrap().fleet(stage.fleet).interfaces(Interfaces::Loopback);
    let agv = agv.insecure().build().unwrap();
    agv.start().unwrap();
    let reported = stage.ends(0, &["scan", "--listen", "10s", "--json"]).json();
    agv.stop();
    let heard = reported["heard"].as_array().unwrap();
    let found = heard.iter().find(|heard| heard["name"] == "lost-agv").unwrap_or_else(|| panic!("{reported}"));
    assert_eq!((&found["id"], &found["role"]), (&5.into(), &"s_unit".into()));
    assert!(found["looks_for"].as_str().unwrap().contains("nobody"), "{found}");
    assert!(reported["unit"].is_null());
    stage.ends(0, &["scan", "--listen", "10ms"]).says("A survey hears");
    stage.ends(3, &["scan", "--offering", "go_to"]).says("--as NAME/ID");
}

#[test]
fn a_survey_can_be_had_beside_a_manager() {
    let stage = Stage::with(&[]);
    let reported = stage.ends(0, &["scan", "--survey", "--listen", "5s", "--json"]).json();
    assert!(reported["heard"].as_array().unwrap().iter().any(|heard| heard["name"] == "manager"), "{reported}");
}

/// `manager/1` has `agv-1`, `other/2` has `agv-2`, and `far/3`, without a control socket, has `agv-3`. `agv-4` is away, and
/// `agv-5` looks for a manager that is not there.
fn three_managers() -> (Stage, [cara_std::CommunicationSystem; 2], Vec<Unit>) {
    let mut stage = Stage::empty();
    stage.know_all(&["far/3@m_unit", "nobody/9@m_unit"]);
    stage.know_all(&["agv-1/11", "agv-2/12", "agv-3/13", "agv-4/14", "agv-5/15"]);
    stage.start_manager();
    let socket = stage.control().join(format!("other-2-{}.sock", stage.fleet));
    let managers = [stage.m_unit("other", 2).control(Control::Path(socket)), stage.m_unit("far", 3)];
    let managers = managers.map(|manager| manager.build().unwrap());
    managers.iter().for_each(|manager| manager.start().unwrap());
    let vehicles = [("agv-1", 11, "manager", 1), ("agv-2", 12, "other", 2), ("agv-3", 13, "far", 3)];
    let vehicles = vehicles.into_iter().chain([("agv-5", 15, "nobody", 9)]);
    let vehicles: Vec<_> = vehicles.map(|(name, id, of, number)| agv(stage.vehicle_of(name, id, of, number))).collect();
    until("three are connected", || vehicles.iter().filter(|vehicle| vehicle.is_connected()).count() == 3);
    until("all are linked", || {
        let links =
            |manager: &cara_std::CommunicationSystem| (manager.number_of_m_units(), manager.number_of_s_units());
        managers.iter().all(|manager| links(manager) == (2, 1))
            && stage.cara(&["functions", "agv-1", "--unit", "manager/1"]).code == 0
    });
    (stage, managers, vehicles)
}

/// What `list` has of that name.
fn called<'l>(list: &'l Value, key: &str, name: &str) -> &'l Value {
    list.as_array().unwrap().iter().find(|entry| entry[key] == name).unwrap_or_else(|| panic!("no {name} in {list}"))
}

const ALL_MANAGERS: [&str; 4] = ["scan", "--all-managers", "--listen", "2s"];

/// Until its datagrams have shown `far/3` and whom `agv-5` looks for, which searches every 8 to 16 s in the end.
fn scan_all(stage: &Stage, more: &[&str]) -> Ran {
    let mut ran = None;
    let mut times = ["2s", "17s"].into_iter();
    until("they are heard", || {
        let listen = ["scan", "--all-managers", "--listen", times.next().unwrap_or("17s")];
        let scan = ran.insert(stage.ends(0, &[&listen, more].concat()));
        scan.out.contains("far/3") && scan.out.contains("nobody/9")
    });
    ran.unwrap()
}

#[test]
fn all_managers_show_their_vehicles_and_what_is_not_known() {
    let (stage, _managers, _vehicles) = three_managers();
    let shown = scan_all(&stage, &[]);
    let row = |text: &str| {
        let row =
            shown.out.lines().find(|line| line.contains(text)).unwrap_or_else(|| panic!("{}", shown.everything()));
        row.split_whitespace().collect::<Vec<_>>().join(" ")
    };
    let fleet = stage.fleet;
    assert_eq!(row("agv-1/11"), format!("manager/1 {fleet} agv-1/11 connected"));
    assert_eq!(row("agv-2/12"), format!("other/2 {fleet} agv-2/12 connected"));
    assert!(row("far/3").starts_with(&format!("far/3 {fleet} not known not asked: heard from 127.0.0.1:")));
    // The first is at far/3, which was not asked.
    for s_unit in ["agv-3/13", "agv-4/14"] {
        let state = "at no m_unit that was asked; missed by manager/1; missed by other/2";
        assert_eq!(row(s_unit), format!("- {fleet} {s_unit} {state}"));
    }
    assert!(row("agv-5/15").contains("; looks for nobody/9, heard from 127.0.0.1:"), "{}", shown.out);
    let empty = crate::support::private_folder();
    let without = Ran::of(stage.command(&ALL_MANAGERS).env("CARA_KEYS", empty.path()).output().unwrap());
    without.says(&format!("there are no keys of fleet {fleet} here")).says("agv-1/11");
    let both = [&["--unit", "other/2"], &ALL_MANAGERS[..]].concat();
    stage.ends(2, &both).says("leave --unit, --socket and --as away");
    // One that hangs was not asked, and holds up no other one.
    stage.freeze_manager();
    let frozen = stage.ends(0, &[&ALL_MANAGERS[..], &["--json"]].concat()).json();
    let hangs = frozen["managers"].as_array().unwrap().iter().find(|manager| !manager["not_asked"].is_null()).unwrap();
    assert!(hangs["manager"] == "manager/1" && hangs["s_units"].is_null(), "{hangs}");
    assert_eq!(called(&frozen["managers"], "manager", "other/2")["s_units"], json!(["agv-2/12"]));
    assert!(called(&frozen["without_manager"], "s_unit", "agv-1/11")["missed_by"].get("other/2").is_some());
}

#[test]
fn all_managers_as_json() {
    let (stage, managers, _vehicles) = three_managers();
    let shown = scan_all(&stage, &["--json"]).json();
    let names = |list, key| shown[list].as_array().unwrap().iter().map(|entry| &entry[key]).collect::<Vec<_>>();
    assert_eq!(names("managers", "manager"), ["far/3", "manager/1", "other/2"], "each once: {shown}");
    assert_eq!(names("without_manager", "s_unit"), ["agv-3/13", "agv-4/14", "agv-5/15"]);
    let [far, other] = ["far/3", "other/2"].map(|name| called(&shown["managers"], "manager", name));
    let socket = stage.control().join(format!("other-2-{}.sock", stage.fleet));
    assert_eq!((&other["s_units"], &other["socket"]), (&json!(["agv-2/12"]), &json!(socket)));
    let heard = &far["heard"];
    assert_eq!(heard[0], json!({ "source": heard[0]["source"], "proof": "fleet", "looks_for": null }));
    let expected = json!({
        "manager": "far/3", "fleet": stage.fleet, "epoch": format!("{:016x}", managers[1].epoch().0), "socket": null,
        "not_asked": null, "s_units": null, "heard": heard, "linked_to": ["manager/1", "other/2"]
    });
    assert_eq!(far, &expected);
    let [away, lost] = ["agv-4/14", "agv-5/15"].map(|name| called(&shown["without_manager"], "s_unit", name));
    let missed = json!({ "manager/1": null, "other/2": null });
    assert_eq!(away, &json!({ "s_unit": "agv-4/14", "fleet": stage.fleet, "missed_by": missed, "heard": [] }));
    assert_eq!(lost["heard"][0]["looks_for"], "nobody/9");
    let rest = ["not_looked", "fleets_without_keys", "key_files_refused"].map(|key| &shown[key]);
    assert_eq!(rest, [&json!([]), &json!([]), &json!([])]);
    // A socket that hangs belongs to the run that is heard.
    let socket = stage.control().join(format!("far-3-{}.sock", stage.fleet));
    let _hangs = std::os::unix::net::UnixListener::bind(&socket).unwrap();
    let shown = scan_all(&stage, &["--json"]).json();
    let far: Vec<_> =
        shown["managers"].as_array().unwrap().iter().filter(|manager| manager["manager"] == "far/3").collect();
    let [far] = far[..] else { panic!("each once: {shown}") };
    assert_eq!((&far["socket"], &far["epoch"]), (&json!(socket), &expected["epoch"]));
    assert!(far["not_asked"].is_string() && far["heard"][0]["source"].is_string(), "{far}");
    assert_eq!(far["linked_to"], expected["linked_to"]);
}

#[test]
fn what_is_published_is_read() {
    let stage = Stage::with(&["agv-1"]);
    stage.ends(0, &["publish", "agv-1", "--timeout", "20s"]).says("published to agv-1/11");
    stage.ends(0, &["publish", "--timeout", "20s"]).says("published to all nodes");
    let reported = stage.ends(0, &["publish", "--json", "--timeout", "20s"]).json();
    assert_eq!(reported["unread"], serde_json::json!([]));
    stage.ends(1, &["publish", "agv-2"]).says("agv-1/11");
}

#[test]
fn counters_are_shown() {
    let stage = Stage::with(&["agv-1"]);
    let reported = stage.ends(0, &["counters", "--json"]).json();
    assert!(reported["unit"].as_object().is_some_and(|unit| !unit.is_empty()), "{reported}");
    assert!(reported["nodes"]["agv-1/11"].as_object().is_some_and(|link| !link.is_empty()), "{reported}");
    stage.ends(0, &["counters"]).says("unit").says("link to agv-1/11");
    let (few, all) = (stage.ends(0, &["counters", "agv-1"]), stage.ends(0, &["counters", "agv-1", "--zeros"]));
    assert!(few.out.lines().count() < all.out.lines().count(), "{}", all.out);
    assert!(!few.out.contains("unit\n"), "{}", few.out);
    let metrics = stage.ends(0, &["counters", "--prometheus"]);
    metrics.says("# TYPE ").says("# HELP ");
    stage.ends(2, &["counters", "--prometheus", "--zeros"]);
}

#[test]
fn a_reader_that_goes_is_no_error() {
    let stage = Stage::with(&["agv-1"]);
    for verb in [["scan", "--json"], ["functions", "agv-1"], ["counters", "--zeros"], ["completions", "zsh"]] {
        let mut child = stage.command(&verb).stdout(Stdio::piped()).stderr(Stdio::piped()).spawn().unwrap();
        drop(child.stdout.take());
        let mut err = String::new();
        child.stderr.take().unwrap().read_to_string(&mut err).unwrap();
        let ran = Ran { code: child.wait().unwrap().code().unwrap_or(-1), out: String::new(), err };
        assert!(ran.code == 0 && ran.err.is_empty(), "{verb:?}: {}", ran.everything());
    }
}

#[test]
fn a_pipe_gets_no_colours_and_nobody_with_no_color() {
    let stage = Stage::with(&["agv-1"]);
    for verb in [&["scan"][..], &["counters"], &["functions", "agv-9"], &["call", "agv-1", "fail"]] {
        let ran = stage.cara(verb);
        assert!(!ran.out.contains('\x1b') && !ran.err.contains('\x1b'), "{}", ran.everything());
        let forced = |no_colour: &str| {
            let mut command = stage.command(verb);
            Ran::of(command.env("CLICOLOR_FORCE", "1").env("NO_COLOR", no_colour).output().unwrap())
        };
        let (coloured, plain) = (forced(""), forced("1"));
        assert!(coloured.out.contains('\x1b') || coloured.err.contains('\x1b'), "{}", coloured.everything());
        assert!(!plain.out.contains('\x1b') && !plain.err.contains('\x1b'), "{}", plain.everything());
    }
}

/// A manager with keys, a vehicle without, and one with keys of another root, all of one fleet.
struct Modes {
    stage: Stage,
    keys: tempfile::TempDir,
    _units: (cara_std::CommunicationSystem, [Unit; 2]),
}

impl Modes {
    fn new() -> Self {
        let (stage, keys) = (Stage::empty(), crate::support::private_folder());
        let (boss, stranger) = (Identity::m_unit("boss", 1).unwrap(), Identity::s_unit("stranger", 6).unwrap());
        let draw = || FleetKeys::draw(Fleet(stage.fleet)).unwrap();
        let (mut ours, mut theirs) = (draw(), draw());
        [&mut ours, &mut theirs].into_iter().for_each(|keys| keys.add(&boss, &[]).unwrap());
        theirs.add(&stranger, &[]).unwrap();
        let manager = cara_std::CommunicationSystem::builder("boss", 1).unwrap().keys(ours.ring(&boss).unwrap());
        let manager = manager.fleet(stage.fleet).interfaces(Interfaces::Loopback).control(Control::Off);
        let manager = manager.build().unwrap();
        manager.start().unwrap();
        let vehicle = |name, id| {
            let unit = Unit::builder(name, id, "boss", 1).unwrap();
            unit.fleet(stage.fleet).interfaces(Interfaces::Loopback)
        };
        let stranger = vehicle("stranger", 6).keys(theirs.ring(&stranger).unwrap());
        let units = [vehicle("open", 5).insecure(), stranger].map(|unit| unit.build().unwrap());
        units.iter().for_each(|unit| unit.start().unwrap());
        // As on a host where the fleet's keys are made.
        Store::create(keys.path(), ours).unwrap().save().unwrap();
        Self { stage, keys, _units: (manager, units) }
    }

    fn scan(&self, keys: &Path, more: &[&str]) -> Ran {
        let mut command = self.stage.command(&[&["scan", "--survey", "--listen", "8s"], more].concat());
        Ran::of(command.env("CARA_KEYS", keys).output().unwrap())
    }
}

/// Name, mode and proof of those of the fleet: other tests are on the same ports.
fn proofs(fleet: u32, reported: &serde_json::Value) -> Vec<(String, String, String)> {
    let text = |value: &serde_json::Value| value.as_str().unwrap_or("-").to_owned();
    let heard = reported["heard"].as_array().unwrap().iter().filter(|heard| heard["fleet"] == fleet);
    let mut heard: Vec<_> =
        heard.map(|heard| (text(&heard["name"]), text(&heard["mode"]), text(&heard["proof"]))).collect();
    heard.sort();
    heard.dedup();
    heard
}

fn three(heard: [[&str; 3]; 3]) -> Vec<(String, String, String)> {
    heard.map(|[name, mode, proof]| (name.into(), mode.into(), proof.into())).into()
}

#[test]
fn a_survey_tells_whose_datagrams_are_proven() {
    let modes = Modes::new();
    let reported = modes.scan(modes.keys.path(), &["--json"]).json();
    let expected =
        three([["boss", "secured", "fleet"], ["open", "plain", "none"], ["stranger", "secured", "other_keys"]]);
    assert_eq!(proofs(modes.stage.fleet, &reported), expected, "{reported}");
    // Of the same test beside it there is another one.
    let own = |heard: &&serde_json::Value| heard["name"] == "boss" && heard["fleet"] == modes.stage.fleet;
    let boss = reported["heard"].as_array().unwrap().iter().find(own).unwrap();
    // The manager answered the survey's question.
    assert!(boss["answers"].as_u64() > Some(0) && boss["generation"] == 1, "{reported}");
    assert_eq!(reported["keys_of"], serde_json::json!([modes.stage.fleet]));
    modes.scan(modes.keys.path(), &[]).says("secured, of the fleet").says("secured, other keys").says("do not meet");
}

#[test]
fn without_keys_a_survey_hears_secured_units_and_tells_how_to_get_keys() {
    let modes = Modes::new();
    let empty = crate::support::private_folder();
    let reported = modes.scan(empty.path(), &["--json"]).json();
    let expected =
        three([["boss", "secured", "unchecked"], ["open", "plain", "none"], ["stranger", "secured", "unchecked"]]);
    assert_eq!(proofs(modes.stage.fleet, &reported), expected, "{reported}");
    let command = format!("`cara keys new-fleet --fleet {} ", modes.stage.fleet);
    modes.scan(empty.path(), &[]).says("secured, not checked").says(&command).says("--key-file");
    // In plain mode the survey hears plain units only.
    let reported = modes.scan(modes.keys.path(), &["--json", "--insecure"]).json();
    assert!(
        proofs(modes.stage.fleet, &reported).iter().all(|(_, mode, _)| mode == "plain")
            && reported["keys_of"] == serde_json::json!([])
    );
    // A file of the fleet's is enough.
    let file = location::file_name(&Identity::m_unit("boss", 1).unwrap(), Fleet(modes.stage.fleet));
    let file = modes.keys.path().join(file);
    let reported = modes.scan(empty.path(), &["--json", "--key-file", file.to_str().unwrap()]).json();
    assert!(
        proofs(modes.stage.fleet, &reported).iter().any(|(name, _, proof)| name == "boss" && proof == "fleet"),
        "{reported}"
    );
    std::fs::set_permissions(&file, std::fs::Permissions::from_mode(0o644)).unwrap();
    let ran = modes.scan(empty.path(), &["--key-file", file.to_str().unwrap()]);
    assert_eq!(ran.says("chmod 600").code, 1);
    modes.scan(&file, &[]).says("keys were not taken").says("chmod 600");
}
