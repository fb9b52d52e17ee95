//! A disk, a terminal or a pipe that takes nothing more holds up neither the end of what an operator holds nor a stop.

use std::fs::File;
use std::io::{BufRead, BufReader, ErrorKind, Read, Write};
use std::os::fd::OwnedFd;
use std::os::unix::net::UnixListener;
use std::path::Path;
use std::process::Stdio;
use std::sync::Arc;
use std::sync::atomic::{AtomicU32, Ordering};
use std::sync::mpsc::channel;

use cara_std::{Definition, LeaseWatch, ParametersView, Served, ServiceError, ServiceOptions, Unit};
use rustix::fs::{CWD, FileType, Mode, OFlags, mknodat};

use crate::support::{PATIENCE, Running, Stage, until};

const LEASE: std::time::Duration = std::time::Duration::from_millis(1_200);

/// A vehicle that is moved by `go()` and stopped by `halt()`.
struct Vehicle {
    unit: Unit,
    lease: LeaseWatch,
    made_safe: Arc<AtomicU32>,
}

impl Vehicle {
    fn start(stage: &Stage) -> Self {
        stage.know("agv", 21);
        let unit = stage.vehicle("agv", 21).build().unwrap();
        let made_safe = Arc::<AtomicU32>::default();
        let counted = made_safe.clone();
        let safe = move || {
            counted.fetch_add(1, Ordering::SeqCst);
        };
        let nothing = |_: &Served, _: &mut ParametersView| -> Result<(), ServiceError> { Ok(()) };
        let functions = unit.my_function_list();
        let wheels = functions.actuator(safe).unwrap();
        let moves = ServiceOptions::new().moves(&wheels, LEASE);
        let lease = functions.add_service(&Definition::parse("go()").unwrap(), moves, nothing).unwrap();
        let stops = ServiceOptions::new().stops(&wheels);
        functions.add_service(&Definition::parse("halt()").unwrap(), stops, nothing).unwrap();
        unit.publish_my_function_list().unwrap();
        unit.start().unwrap();
        until("it is known", || stage.cara(&["functions", "agv"]).out.contains("halt()"));
        Self { unit, lease, made_safe }
    }

    /// A hold whose command is killed ends, and the vehicle is stopped, though what the manager writes to hangs.
    fn is_let_go_and_stopped(&self, stage: &Stage) {
        let mut held = Running::start(stage.command(&["call", "agv", "--hold", "go"]));
        until("it moves", || self.lease.is_live());
        held.kill();
        until("the hold ends", || self.made_safe.load(Ordering::SeqCst) == 1);
        assert!(!self.lease.is_live() && self.unit.is_connected());
        stage.ends(0, &["stop", "--all"]).says("1 of 1 acknowledged");
    }
}

/// Fills a pipe, so that the next one that writes to it waits.
fn fill(mut pipe: &File) {
    rustix::io::ioctl_fionbio(pipe, true).unwrap();
    while pipe.write(&[b'\n'; 4096]).is_ok() {}
    assert_eq!(pipe.write(b"\n").unwrap_err().kind(), ErrorKind::WouldBlock);
    rustix::io::ioctl_fionbio(pipe, false).unwrap();
}

/// A file that can be opened and takes nothing, as one on a disk that hangs.
fn hung_file(path: &Path) -> File {
    mknodat(CWD, path, FileType::Fifo, Mode::RUSR | Mode::WUSR, 0).unwrap();
    let pipe = File::from(rustix::fs::open(path, OFlags::RDWR | OFlags::CLOEXEC, Mode::empty()).unwrap());
    fill(&pipe);
    pipe
}

#[test]
fn a_command_whose_manager_stops_answering_ends() {
    let stage = Stage::with(&["agv-1"]);
    let mut ping = Running::start(stage.command(&["ping", "agv-1", "--count", "400", "--interval", "100ms"]));
    ping.expect("agv-1");
    let vehicle = Vehicle::start(&stage);
    let mut held = Running::start(stage.command(&["call", "agv", "--hold", "go"]));
    until("it moves", || vehicle.lease.is_live());
    stage.freeze_manager();
    until("the ping ends", || ping.has_ended());
    until("the hold ends", || held.has_ended());
    assert!(!vehicle.lease.is_live());
    assert_eq!((ping.end(), held.end()), (1, 1));
}

#[test]
fn an_audit_log_on_a_disk_that_hangs_holds_nothing_up() {
    let mut stage = Stage::empty();
    let audit = stage.control().join("audit");
    let _hung = hung_file(&audit);
    let file = stage.control().join("manager.toml");
    let text = format!("name = \"manager\"\nid = 1\nfleet = {}\n[control]\naudit = {audit:?}\n", stage.fleet);
    std::fs::write(&file, text).unwrap();
    stage.start_manager_with(&[file.to_str().unwrap()]);
    Vehicle::start(&stage).is_let_go_and_stopped(&stage);
}

#[test]
fn a_log_that_nobody_reads_holds_nothing_up() {
    let mut stage = Stage::empty();
    let (unread, stderr) = std::io::pipe().unwrap();
    let stderr = File::from(std::os::fd::OwnedFd::from(stderr));
    fill(&stderr);
    let mut command = stage.command(&["node", "--name", "manager", "--id", "1", "--log", "trace"]);
    command.stdout(Stdio::null()).stderr(stderr);
    stage.adopt_manager(&mut command);
    Vehicle::start(&stage).is_let_go_and_stopped(&stage);
    drop(unread);
}

/// A manager by hand, which ends when the first of two vehicles has acknowledged, and is there again. Its operator's terminal
/// takes nothing before the second round has been answered.
#[test]
fn a_later_round_of_a_stop_calls_all_again_and_waits_for_no_output() {
    let stage = Stage::empty();
    let path = stage.control().join("m_1-1-3.sock");
    let listener = UnixListener::bind(&path).unwrap();
    let (mut output, unread) = std::io::pipe().unwrap();
    let unread = File::from(OwnedFd::from(unread));
    fill(&unread);
    let mut command = stage.command(&["stop", "--all", "--socket", path.to_str().unwrap()]);
    let mut stopping = command.stdout(unread.try_clone().unwrap()).stderr(unread).spawn().unwrap();
    drop(command);
    let called = |node: &str, id: u32| {
        format!(
            "{{\"answer\":\"called\",\"node\":\"{node}\",\"id\":{id},\"results\":[],\"call\":null,\"error\":null,\"took_us\":400,\
             \"functions\":[\"halt\"]}}\n"
        )
    };
    let first = called("agv", 7);
    let second = called("agv", 7) + &called("lift", 8) + "{\"answer\":\"done\"}\n";
    let (asked, questions) = channel();
    std::thread::spawn(move || {
        for answers in [first, second] {
            let mut stream = listener.accept().unwrap().0;
            stream.write_all(b"{\"answer\":\"hello\",\"control_version\":2,\"unit\":\"m_1/1\",\"fleet\":3}\n").unwrap();
            let mut question = String::new();
            BufReader::new(&stream).read_line(&mut question).unwrap();
            stream.write_all(answers.as_bytes()).unwrap();
            let _ = asked.send(question);
        }
    });
    let next = || questions.recv_timeout(PATIENCE).expect("it is asked though nothing is read");
    let first = next();
    assert_eq!(next(), first, "agv/7 may have started anew");
    let mut text = String::new();
    output.read_to_string(&mut text).unwrap();
    assert_eq!(stopping.wait().unwrap().code(), Some(0), "{text}");
    assert_eq!(text.matches("agv/7  acknowledged after").count(), 1, "{text}");
    assert!(text.contains("lift/8  acknowledged after") && text.contains("2 of 2 acknowledged"), "{text}");
}
