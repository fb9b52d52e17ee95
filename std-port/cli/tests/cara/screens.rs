//! `cara top` on a pseudo-terminal, with a manager and vehicles.

use std::sync::Arc;
use std::sync::atomic::{AtomicI64, Ordering};
use std::time::{Duration, Instant};

use cara_std::access::AccessTable;
use cara_std::{Definition, ParametersView, Priority, Served, ServiceError, ServiceOptions, Unit};
use rustix::process::Signal;

use crate::support::{Running, Stage, private_folder, until};
use crate::terminal::OnTerminal;

/// `cara top` on a terminal of its own.
fn top(stage: &Stage, arguments: &[&str], variables: &[(&str, &str)]) -> OnTerminal {
    let mut command = stage.command(&["top"]);
    command.args(arguments).env("TERM", "xterm-256color").env_remove("NO_COLOR").envs(variables.iter().copied());
    OnTerminal::start(&command)
}

/// `agv/21`, whose `go(x)` moves it until it is stopped.
fn vehicle(stage: &Stage, table: Option<&str>) -> (Unit, Arc<AtomicI64>) {
    stage.know("agv", 21);
    let builder = stage.vehicle("agv", 21);
    let table = table.map(|table| AccessTable::parse("table", table).unwrap());
    let unit = table.into_iter().fold(builder, |builder, table| builder.access(table)).build().unwrap();
    let functions = unit.my_function_list();
    let place = Arc::new(AtomicI64::new(0));
    let drive = functions.actuator(|| ()).unwrap();
    let moved = place.clone();
    let go = move |_: &Served, arguments: &mut ParametersView| -> Result<(), ServiceError> {
        let mut x = [0_i64];
        arguments.variable_into("x", &mut x).unwrap();
        moved.store(x[0], Ordering::SeqCst);
        Ok(())
    };
    let moves = ServiceOptions::new().moves(&drive, Duration::from_secs(600));
    functions.add_service(&Definition::parse("go(x: int)").unwrap(), moves, go).unwrap();
    let nothing = |_: &Served, _: &mut ParametersView| -> Result<(), ServiceError> { Ok(()) };
    functions.add_service(&Definition::parse("turn(x: int)").unwrap(), ServiceOptions::new(), nothing).unwrap();
    let stops = ServiceOptions::new().stops(&drive).priority(Priority::Emergency);
    functions.add_service(&Definition::parse("halt()").unwrap(), stops, nothing).unwrap();
    unit.publish_my_function_list().unwrap();
    unit.start().unwrap();
    (unit, place)
}

/// A vehicle in a process of its own.
fn process(stage: &Stage) -> Running {
    stage.know("lift", 22);
    let file = stage.control().join("lift.toml");
    std::fs::write(&file, "name = \"lift\"\nid = 22\nrole = \"s_unit\"\n[manager]\nname = \"manager\"\nid = 1\n")
        .unwrap();
    let mut lift = Running::start(stage.command(&["node", file.to_str().unwrap()]));
    lift.expect("lift");
    lift
}

#[test]
fn a_fleet_is_seen_called_and_stopped() {
    let mut stage = Stage::with(&[]);
    let (agv, place) = vehicle(&stage, None);
    until("it has published", || stage.cara(&["functions", "agv"]).out.contains("halt()"));
    let mut lift = process(&stage);
    let mut top = top(&stage, &[], &[]);
    top.until("both are live", |shown| shown.lines().filter(|line| line.contains(" live ")).count() == 2);
    assert!(top.shows("agv/21").contains("cara top  manager/1  fleet"));
    // A mistake first, as `cara call` tells it; then the AGV moves.
    top.type_in("c");
    top.shows("go(x: int)");
    top.type_in("go(x: true)\r");
    top.shows("`x` is an int, and this is not");
    top.type_in("\x15go(x: 7)\r");
    top.until("it runs", |shown| shown.lines().any(|line| line.contains("agv/21") && line.contains("runs")));
    assert_eq!(place.load(Ordering::SeqCst), 7);
    top.type_in("S");
    let stopped = top.until("it is stopped", |shown| shown.lines().any(|line| line.contains("by unit 1")));
    assert!(!stopped.is_empty());
    // The lift has nothing that stops: that is told by name until it is read.
    top.shows("lift/22: NoStop");
    top.type_in("\x1b");
    lift.kill();
    top.until("the lift is lost", |shown| shown.lines().any(|line| line.contains("lift/22") && line.contains("LOST")));
    // Another size is filled.
    top.resize(120, 40);
    top.until("the new size", |shown| shown.lines().any(|line| line.contains("TROUBLE")));
    stage.kill_manager();
    let gone = top.shows("MANAGER GONE");
    assert!(gone.contains("OLD") && gone.contains("was live") && !gone.contains("_unit live"), "{gone}");
    stage.start_manager();
    top.until("the manager is back", |shown| !shown.contains("MANAGER GONE") && shown.contains(" live "));
    top.type_in("q");
    assert_eq!(top.ends_restored(), 0);
    agv.stop();
}

#[test]
fn the_terminal_is_given_back_however_it_ends() {
    let stage = Stage::with(&[]);
    let started = || {
        let mut top = top(&stage, &[], &[("NO_COLOR", "1")]);
        top.shows("Orders that run");
        top
    };
    let mut top = started();
    let cells = (0..24).flat_map(|row| (0..80).map(move |column| (row, column)));
    let mut cells = cells.filter_map(|(row, column)| top.screen().cell(row, column));
    assert!(cells.all(|cell| (cell.fgcolor(), cell.bgcolor()) == (vt100::Color::Default, vt100::Color::Default)));
    top.type_in("\x03");
    assert_eq!(top.ends_restored(), 0);
    for (signal, code) in [(Signal::TERM, 143), (Signal::INT, 130), (Signal::HUP, 143)] {
        let mut top = started();
        top.signal(signal);
        assert_eq!(top.ends_restored(), code);
    }
    // The terminal itself goes.
    started().hang_up();
}

/// What an access table forbids is told where the key was pressed: the table of the manager that is asked, and the vehicle's own
/// where `cara top` is the manager itself.
#[test]
fn a_refusal_is_told_and_what_is_allowed_is_done() {
    const OF_MANAGER: &str = "[[allow]]\nwho = \"s_units\"\nfunctions = \"*\"\nverbs = \"publish\"\n\
                              [[allow]]\nwho = \"operator\"\nfunctions = \"*\"\nverbs = \"list\"\n\
                              [[allow]]\nwho = \"operator\"\nfunctions = [\"turn\"]\nverbs = \"call\"\n";
    const OF_VEHICLE: &str = "[[allow]]\nwho = \"m_units\"\nfunctions = \"*\"\nverbs = \"list\"\n\
                              [[allow]]\nwho = \"m_units\"\nfunctions = [\"turn\"]\nverbs = \"call\"\n";
    let mut stage = Stage::empty();
    let folder = private_folder();
    let table = folder.path().join("access.toml");
    std::fs::write(&table, OF_MANAGER).unwrap();
    stage.start_manager_with(&["--access", table.to_str().unwrap()]);
    let (agv, place) = vehicle(&stage, Some(OF_VEHICLE));
    let refused = |mut top: OnTerminal, why: &str| {
        top.shows(" live ");
        top.type_in("c");
        top.shows("go(x: int)");
        top.type_in("go(x: 7)\r");
        top.shows(why);
        top.type_in("\x15turn(x: 1)\r");
        top.shows("turn()");
        top.type_in("S");
        top.shows("agv/21: NotAllowed");
        top.type_in("xq");
        assert_eq!(top.ends_restored(), 0);
    };
    refused(top(&stage, &[], &[]), "does not let the operator call 'go'");
    stage.kill_manager();
    refused(top(&stage, &["--as", "manager/1"], &[]), "NotAllowed");
    assert_eq!(place.load(Ordering::SeqCst), 0);
    agv.stop();
}

/// The row of the chosen node.
fn chosen(shown: &str) -> &str {
    let mut rows = shown.lines().filter(|line| line.starts_with("> "));
    let row = rows.next().unwrap_or_default();
    if rows.next().is_some() { "several" } else { row }
}

#[test]
fn two_hundred_nodes_are_scrolled_in_any_window() {
    const NODES: u32 = 200;
    let mut stage = Stage::empty();
    let names: Vec<_> = (1..=NODES).map(|id| format!("agv-{id:03}")).collect();
    let nodes: Vec<_> = names.iter().zip(1..).map(|(name, id)| format!("{name}/{id}")).collect();
    stage.know_all(&nodes.iter().map(String::as_str).collect::<Vec<_>>());
    stage.start_manager_with(&["--log", "error"]);
    let build = |(name, id): (&String, u32)| stage.vehicle(name, id).build().unwrap();
    let units: Vec<_> = names.iter().zip(1..).map(build).collect();
    units.iter().for_each(|unit| unit.start().unwrap());
    // So many take their time on a busy host.
    let start = Instant::now();
    let joined = || {
        let reported = stage.ends(0, &["scan", "--json"]).json();
        reported["nodes"].as_array().unwrap().iter().filter(|node| node["connected"] == true).count()
    };
    while joined() < units.len() {
        assert!(start.elapsed() < Duration::from_secs(180), "not all have joined");
        std::thread::sleep(Duration::from_millis(500));
    }
    let mut top = top(&stage, &[], &[]);
    top.shows("200 of 200 s_units");
    for (keys, node) in [
        ("", "agv-001"),
        ("\x1b[F", "agv-200"),
        ("\x1b[A", "agv-199"),
        ("\x1b[5~\x1b[5~", "agv-179"),
        ("\x1b[B", "agv-180"),
        ("\x1b[H", "agv-001"),
        (&"j".repeat(100), "agv-101"),
    ] {
        top.type_in(keys);
        top.until(node, |shown| chosen(shown).contains(node));
    }
    // The chosen row stays in view, below the head of the screen and above its foot.
    for (columns, rows) in [(120, 40), (80, 12), (50, 9), (80, 24)] {
        top.resize(columns, rows);
        let last = usize::from(rows) - 1;
        top.until(&format!("{columns} x {rows}"), |shown| {
            let lines: Vec<_> = shown.lines().collect();
            let (head, foot) = (lines.first().is_some_and(|line| line.starts_with("cara top")), lines.get(last));
            head && foot.is_some_and(|line| line.starts_with("S STOP ALL")) && chosen(shown).contains("/101 ")
        });
    }
    top.type_in("q");
    assert_eq!(top.ends_restored(), 0);
    units.iter().for_each(|unit| unit.stop());
}

#[test]
fn without_a_terminal_another_verb_is_named() {
    let stage = Stage::empty();
    stage.ends(2, &["top"]).says("no terminal").says("`cara watch`");
    stage.ends(2, &["top", "--json"]).says("cara watch --json");
    let mut top = top(&stage, &[], &[("TERM", "dumb")]);
    top.until("what to do", |shown| shown.contains("TERM=dumb") && shown.contains("`cara watch`"));
    assert_eq!(top.ends_restored(), 2);
}
