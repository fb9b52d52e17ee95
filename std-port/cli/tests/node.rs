//! `cara node` as a process: mistakes in its file, what it offers, programs that misbehave, metrics, its end.

use std::io::{Read, Write};
use std::net::{SocketAddr, TcpListener, TcpStream, UdpSocket};
use std::os::unix::net::UnixDatagram;
use std::path::{Path, PathBuf};
use std::process::{Command, Output};
use std::sync::Arc;
use std::time::{Duration, Instant};

use cara_processes::ticker::unless_held_up;
use cara_processes::{Process, random_fleet};
use cara_std::control::Client;
use cara_std::control::protocol::{Answer, Question};
use cara_std::{Error, Identity, Interfaces, Parameters, Peer, Renew, RequestOptions, ServiceError, Unit};
use cara_test_keys::KeyFolder;
use rustix::process::{Pid, Signal, kill_process};
use tempfile::TempDir;

/// Longest wait for anything that is to happen.
const PATIENCE: Duration = Duration::from_secs(30);

fn cara() -> &'static Path {
    Path::new(env!("CARGO_BIN_EXE_cara"))
}

/// Runs `cara node` to its end.
fn outcome(folder: &Path, arguments: &[&str]) -> Output {
    let mut command = Command::new(cara());
    command.arg("node").args(arguments).current_dir(folder).env("CARA_CONTROL_DIR", folder).env("CARA_KEYS", folder);
    command.output().unwrap()
}

fn text(bytes: &[u8]) -> String {
    String::from_utf8_lossy(bytes).into_owned()
}

/// Waits until `condition` holds.
fn until(what: &str, mut condition: impl FnMut() -> bool) {
    let end = Instant::now() + PATIENCE;
    while !condition() {
        assert!(Instant::now() < end, "not in time: {what}");
        std::thread::sleep(Duration::from_millis(5));
    }
}

// --- mistakes

/// A file, where its mistake is, and a part of what is said about it.
const MISTAKES: [(&str, &str, &str); 50] = [
    ("name = \"a", "1:10", "expected `\"`"),
    ("name = \"a\"\nid = \n", "2:6", "value"),
    ("name = \"a\"\nid = 1\nid = 2", "3:1", "duplicate key"),
    ("name = \"a\"\nid = 1\n[constraints\n", "3:13", "]"),
    ("nam = \"a\"\nid = 1", "1:1", "did you mean `name`?"),
    ("id = 1", "1:1", "no name"),
    ("name = \"a\"", "1:1", "no ID number"),
    ("name = \"\"\nid = 1", "1:8", "cannot be a node's name"),
    ("id = 1\nname = \"aaaaaaaaaabbbbbbbbbbccccccccccddd\"", "2:8", "1 to 32 bytes"),
    ("name = \"a\\nb\"\nid = 1", "1:8", "control characters"),
    ("name = 5\nid = 1", "1:8", "expected a string"),
    ("name = \"a\"\nid = -1", "2:6", "-1"),
    ("name = \"a\"\nid = 4294967296", "2:6", "4294967296"),
    ("name = \"a\"\nid = \"1\"", "2:6", "u32"),
    ("name = \"a\"\nid = 1\nrole = \"manager\"", "3:8", "`m_unit`"),
    ("name = \"a\"\nid = 1\nrole = \"s_unit\"", "3:8", "needs a manager"),
    ("name = \"a\"\nid = 1\n[manager]\nname = \"m\"\nid = 1", "3:1", "has no manager"),
    ("name = \"a\"\nid = 1\nrole = \"s_unit\"\n[manager]\nname = \"m\"", "4:1", "a name and an id"),
    (
        "name = \"a\"\nid = 1\nrole = \"s_unit\"\n[manager]\nname = \"m\"\nid = 1\naddress = \"host:1\"",
        "7:11",
        "no address",
    ),
    ("name = \"a\"\nid = 1\nrole = \"s_unit\"\ntcp_port = 1\n[manager]\nname = \"m\"\nid = 1", "4:12", "takes no"),
    ("name = \"a\"\nid = 1\ninterfaces = \"eth0\"", "3:14", "`lo`"),
    ("name = \"a\"\nid = 1\ndiscovery_port = 0", "3:18", "port 0"),
    ("name = \"a\"\nid = 1\nkeys = \"a.keys\"\ninsecure = true", "4:12", "contradicts `keys`"),
    ("name = \"a\"\nid = 1\ninsecure = \"yes\"", "3:12", "expected a boolean"),
    ("name = \"a\"\nid = 1\ntcp_port = 65536", "3:12", "65536"),
    ("name = \"a\"\nid = 1\n[constraints]\nchunk_size = 100", "4:14", "from 320 to 4096"),
    ("name = \"a\"\nid = 1\n[constraints]\n\n\tmessage_size = \"1MiB\"", "5:17", "from 16 to 262144"),
    ("name = \"a\"\nid = 1\n[constraints]\nmaximum_nodes = 0", "4:17", "from 1 to 65535"),
    ("name = \"a\"\nid = 1\nconstraints.keep_alive = \"1us\"", "3:26", "at least 1000 us"),
    ("name = \"a\"\nid = 1\nconstraints = { request_timeout = 5 }", "3:35", "\"50ms\""),
    ("name = \"a\"\nid = 1\n[constraints]\nkeep_alive = \"5 parsecs\"", "4:14", "5 parsecs"),
    ("name = \"a\"\nid = 1\n[constraints]\nkeepalive = \"1s\"", "4:1", "did you mean `keep_alive`?"),
    ("name = \"a\"\nid = 1\n[capacities]\nfunctions = 0", "4:13", "from 1 to 65535"),
    ("name = \"a\"\nid = 1\n[control]\noff = true\npath = \"x\"", "5:8", "no control socket"),
    (
        "name = \"a\"\nid = 1\nrole = \"s_unit\"\nmanager = { name = \"m\", id = 1 }\n[control]\npath = \"/x\"",
        "6:8",
        "an s_unit has no control socket",
    ),
    ("name = \"a\"\nid = 1\nm_units = [\"b/2\", \"b\"]", "3:19", "no m_unit"),
    ("name = \"a\"\nid = 1\nrole = \"s_unit\"\nm_units = []\n[manager]\nname = \"b\"\nid = 1", "4:11", "alone"),
    ("name = \"a\"\nid = 1\n[metrics]\nlisten = \"9464\"", "4:10", "no address"),
    ("name = \"a\"\nid = 1\n[metrics]\nlisten = \"0.0.0.0:9464\"", "4:10", "--metrics-anywhere"),
    ("name = \"a\"\nid = 1\n[log]\nlevel = \"a=b=c\"", "4:9", "no level"),
    ("name = \"a\"\nid = 1\n[log]\nlevel = \"bogus\"", "4:9", "`bogus`"),
    (
        "name = \"a\"\nid = 1\nrole = \"s_unit\"\nmanager = { name = \"m\", id = 1 }\n[black_box]\nstreams = [\"pose\"]",
        "6:11",
        "an s_unit reads no streams",
    ),
    ("name = \"a\"\nid = 1\n[[functions]]\nanswer = \"echo\"", "3:1", "no signature"),
    ("name = \"a\"\nid = 1\n[[functions]]\nsignature = \"f(n: integer)\"\nanswer = \"echo\"", "4:19", "a type"),
    ("name = \"a\"\nid = 1\n[[functions]]\nsignature = '''f(ä: int)'''\nanswer = \"echo\"", "4:18", "a name"),
    ("name = \"a\"\nid = 1\n[[functions]]\nsignature = \"f() -> (n: int)\"\nanswer = \"log\"", "4:13", "result `n`"),
    ("name = \"a\"\nid = 1\n[[functions]]\nsignature = \"f()\"", "4:13", "does nothing"),
    ("name = \"a\"\nid = 1\n[[functions]]\nsignature = \"f()\"\nrun = [\"/no/program\"]", "5:7", "no program"),
    (
        "name = \"a\"\nid = 1\n[[functions]]\nsignature = \"f()\"\nrun = [\"true\"]\nlease = \"1s\"",
        "6:9",
        "at_lease_end",
    ),
    (
        "name = \"a\"\nid = 1\nfunctions = [{ signature = \"f()\", answer = \"echo\" }, { signature = \"f(n: int)\", answer = \"log\" }]",
        "3:68",
        "two functions",
    ),
];

#[test]
fn each_mistake_is_told_with_its_line_and_column() {
    let folder = TempDir::new().unwrap();
    for (file, place, part) in MISTAKES {
        std::fs::write(folder.path().join("bad.toml"), file).unwrap();
        let checked = outcome(folder.path(), &["--check", "bad.toml"]);
        let reported = text(&checked.stderr);
        assert_eq!(checked.status.code(), Some(2), "{file}\n{reported}");
        let start = format!("error: bad.toml:{place}: ");
        assert!(reported.starts_with(&start), "{file}\nexpected at {place}:\n{reported}");
        assert!(reported.contains(part), "{file}\nexpected `{part}`:\n{reported}");
        let line = file.lines().nth(place.split(':').next().unwrap().parse::<usize>().unwrap() - 1).unwrap();
        assert!(reported.contains(&format!(" | {line}\n")) && reported.contains('^'), "{reported}");
        // A node does not start with it either.
        assert_eq!(text(&outcome(folder.path(), &["bad.toml"]).stderr), reported);
    }
}

#[test]
fn all_mistakes_of_meaning_are_told_at_once() {
    let folder = TempDir::new().unwrap();
    let file = "name = \"\"\nid = 1\ndiscovery_port = 0\n[constraints]\nchunk_size = 1\n";
    std::fs::write(folder.path().join("bad.toml"), file).unwrap();
    let reported = text(&outcome(folder.path(), &["--check", "bad.toml"]).stderr);
    for place in ["bad.toml:1:8: ", "bad.toml:3:18: ", "bad.toml:5:14: "] {
        assert!(reported.contains(place), "{reported}");
    }
}

#[test]
fn all_mistakes_of_form_are_told_at_once() {
    let folder = TempDir::new().unwrap();
    let file = "nam = \"ä\"\nid = \"1\"\ntcp_port = 65536\n[constraint]\nkeep_alive = 5\n[log]\nlevl = \"info\"\n\
                [[functions]]\nanswer = \"ehco\"\nsignature = \"f()\"\n";
    std::fs::write(folder.path().join("bad.toml"), file).unwrap();
    let reported = text(&outcome(folder.path(), &["--check", "bad.toml"]).stderr);
    for place in ["1:1: ", "2:6: ", "3:12: ", "4:2: ", "7:1: ", "9:10: "] {
        assert!(reported.contains(&format!("bad.toml:{place}")), "{place}\n{reported}");
    }
    assert_eq!(reported.matches("bad.toml:").count(), 6, "{reported}");
    // What is no TOML hides the rest.
    std::fs::write(folder.path().join("bad.toml"), format!("{file}id = \n")).unwrap();
    let reported = text(&outcome(folder.path(), &["--check", "bad.toml"]).stderr);
    assert_eq!(reported.matches("bad.toml:").count(), 1, "{reported}");
}

#[test]
fn a_check_refuses_what_could_not_start() {
    let folder = TempDir::new().unwrap();
    let keys = cara_test_keys::KeyFolder::draw(3, &["depot/1@m_unit", "agv/2"]).unwrap();
    let file = |node: &str| keys.path().join(format!("{node}-3.keys")).display().to_string();
    let check = |more: &str| {
        std::fs::write(folder.path().join("a.toml"), format!("name = \"depot\"\nid = 1\nfleet = 3\n{more}\n")).unwrap();
        let checked = outcome(folder.path(), &["--check", "a.toml"]);
        (checked.status.code(), text(&checked.stderr))
    };
    assert_eq!(check(&format!("keys = {:?}", file("depot-1-m_unit"))).0, Some(0));
    for (more, part) in [
        (format!("keys = {:?}", file("agv-2-s_unit")), "has the keys of agv/2"),
        ("keys = \"/etc/passwd\"".to_owned(), "is no file of `cara keys`"),
        ("m_units = [\"hall/2\", \"depot/1\"]".to_owned(), "is this node itself"),
    ] {
        let (code, reported) = check(&more);
        assert!(code == Some(2) && reported.contains(part) && !reported.contains("chmod"), "{reported}");
        // So does a start, by which a service manager knows that no restart mends it.
        assert_eq!(outcome(folder.path(), &["a.toml"]).status.code(), Some(2));
    }
    std::fs::write(folder.path().join("a.toml"), [0xFF, 0xFE, b'n', 0]).unwrap();
    assert!(text(&outcome(folder.path(), &["--check", "a.toml"]).stderr).contains("is UTF-16"));
}

#[test]
fn the_example_is_correct() {
    let folder = TempDir::new().unwrap();
    let example = outcome(folder.path(), &["--example"]).stdout;
    std::fs::write(folder.path().join("example.toml"), example).unwrap();
    let checked = outcome(folder.path(), &["--check", "example.toml"]);
    assert_eq!(text(&checked.stderr), "");
    assert_eq!(text(&checked.stdout), "example.toml: correct: m_unit AGV_manager/1, functions of its own: 4\n");
    assert!(checked.status.success());
}

#[test]
fn wrong_options_are_told_with_what_to_do() {
    let folder = TempDir::new().unwrap();
    std::fs::write(folder.path().join("long.toml"), vec![b'\n'; 1048577]).unwrap();
    let cases: [(&[&str], &str); 14] = [
        (&["long.toml"], "more than 1048576 bytes"),
        (&["/dev/zero"], "it is no file"),
        (&["--check", "."], "it is no file"),
        (&["--socket", "x", "--name", "a", "--id", "1"], "a node is a unit itself"),
        (&[], "--name and --id"),
        (&["--id", "1"], "--name and --id"),
        (&["no.toml"], "no.toml cannot be read"),
        (&["--name", "", "--id", "1"], "1 to 32 bytes"),
        (&["--name", "a", "--id", "1", "--metrics", "0.0.0.0:0"], "--metrics-anywhere"),
        (&["--name", "a", "--id", "1", "--log", "a=b=c"], "debug"),
        (&["--name", "a", "--id", "1", "--log", "warn,bogus"], "`bogus` is none of the levels"),
        (&["--name", "a", "--id", "1", "--as", "b/1"], "contradict"),
        (&["--name", "a", "--id", "1", "--as", "a/2"], "contradict"),
        (&["--name", "a", "--id", "1", "--metrics", "localhost:9464"], "write an IP address and a port"),
    ];
    for (arguments, part) in cases {
        let refused = outcome(folder.path(), arguments);
        assert_eq!(refused.status.code(), Some(2), "{arguments:?}");
        assert!(text(&refused.stderr).contains(part), "{arguments:?}: {}", text(&refused.stderr));
    }
}

#[test]
fn a_port_in_use_of_the_command_line_is_told_with_what_to_do() {
    let folder = TempDir::new().unwrap();
    let taken = TcpListener::bind("127.0.0.1:0").unwrap();
    let (address, fleet) = (taken.local_addr().unwrap().to_string(), random_fleet().to_string());
    let arguments = ["--name", "a", "--id", "1", "--loopback", "--fleet", &fleet, "--metrics", &address, "--insecure"];
    let refused = outcome(folder.path(), &arguments);
    let reported = text(&refused.stderr);
    assert_eq!(refused.status.code(), Some(1), "{reported}");
    assert!(reported.contains("in use") && reported.contains("with a free port"), "{reported}");
}

#[test]
fn a_port_in_use_is_told_where_the_file_says_it() {
    let folder = TempDir::new().unwrap();
    let taken = TcpListener::bind("127.0.0.1:0").unwrap();
    let port = taken.local_addr().unwrap().port();
    let taken_by_broadcasts = UdpSocket::bind("0.0.0.0:0").unwrap();
    let udp_port = taken_by_broadcasts.local_addr().unwrap().port();
    let start = format!("name = \"a\"\nid = 1\nfleet = {}\ninterfaces = \"lo\"\ninsecure = true\n", random_fleet());
    for (line, place) in [
        (format!("tcp_port = {port}"), "6:12"),
        (format!("metrics.listen = \"127.0.0.1:{port}\""), "6:18"),
        (format!("discovery_port = {udp_port}"), "6:18"),
    ] {
        std::fs::write(folder.path().join("bad.toml"), format!("{start}{line}\n")).unwrap();
        let refused = outcome(folder.path(), &["bad.toml"]);
        let reported = text(&refused.stderr);
        // Not only a mistake in the file: a restart of the node may succeed.
        assert_eq!(refused.status.code(), Some(1), "{reported}");
        assert!(
            reported.starts_with(&format!("error: bad.toml:{place}: ")) && reported.contains("in use"),
            "{reported}"
        );
    }
}

// --- a node that runs

/// A node as a process, with a folder of its own.
struct Node {
    folder: TempDir,
    keys: Arc<KeyFolder>,
    process: Process,
    fleet: u32,
    /// How many its file offers.
    functions: usize,
    /// What it says when it is up.
    up: String,
}

impl Node {
    /// Starts an m_unit `plant/1` with this in its file, behind its first lines.
    fn start(rest: &str) -> Self {
        Self::start_with(rest, &[])
    }

    fn start_with(rest: &str, options: &[&str]) -> Self {
        let folder = TempDir::new().unwrap();
        let fleet = random_fleet();
        let file = format!("name = \"plant\"\nid = 1\nfleet = {fleet}\ninterfaces = \"lo\"\n{rest}\n");
        std::fs::write(folder.path().join("plant.toml"), file).unwrap();
        let keys = KeyFolder::draw(fleet, &["plant/1@m_unit", "agv/7", "agv/8"]).unwrap();
        Self::run(folder, fleet, keys.into(), options)
    }

    fn run(folder: TempDir, fleet: u32, keys: Arc<KeyFolder>, options: &[&str]) -> Self {
        let script = r#"cd "$1"; cara=$2; export CARA_CONTROL_DIR="$1/control" CARA_KEYS="$3"; shift 3; echo $$ > pid
            if [ -S notify ]; then export NOTIFY_SOCKET="$PWD/notify" WATCHDOG_USEC=40000; fi
            exec "$cara" node plant.toml "$@" 2>>log"#;
        let arguments = ["-c", script, "sh"].map(PathBuf::from).into_iter();
        let arguments = arguments.chain([folder.path(), cara(), keys.path()].map(Path::to_owned));
        let arguments = arguments.chain(options.iter().map(PathBuf::from));
        let mut process = Process::start("node", Path::new("sh"), arguments).unwrap();
        let up = process.expect(" is up: ", PATIENCE).unwrap_or_else(|error| {
            let log = std::fs::read_to_string(folder.path().join("log")).unwrap_or_default();
            panic!("{error}\n{log}");
        });
        let file = std::fs::read_to_string(folder.path().join("plant.toml")).unwrap();
        Self { folder, keys, process, fleet, functions: file.matches("[[functions]]").count(), up: up.text }
    }

    fn control_socket(&self) -> PathBuf {
        self.up.split("control socket ").nth(1).unwrap().split(',').next().unwrap().into()
    }

    fn log(&self) -> String {
        std::fs::read_to_string(self.folder.path().join("log")).unwrap_or_default()
    }

    fn signal(&self, signal: Signal) {
        let pid = std::fs::read_to_string(self.folder.path().join("pid")).unwrap();
        kill_process(Pid::from_raw(pid.trim().parse().unwrap()).unwrap(), signal).unwrap();
    }

    /// An s_unit of this node that has joined and read its list.
    fn vehicle(&self, name: &str, id: u32) -> (Unit, Peer) {
        let unit = Unit::builder(name, id, "plant", 1).unwrap().fleet(self.fleet).interfaces(Interfaces::Loopback);
        let file = self.keys.file(&Identity::s_unit(name, id).unwrap()).unwrap();
        let unit = unit.key_file(file).build().unwrap();
        unit.start().unwrap();
        until("the vehicle has joined", || {
            unit.manager().is_some_and(|manager| manager.their_function_list().len() == self.functions)
        });
        let manager = unit.manager().unwrap();
        (unit, manager)
    }
}

/// One int.
fn number(value: i64) -> Parameters {
    let mut number = Parameters::new();
    number.add_int("n", 1).unwrap();
    number.set_value("n", value).unwrap();
    number
}

fn call(peer: &Peer, function: &str, n: i64) -> Result<i64, Error> {
    let options = RequestOptions { timeout: Some(PATIENCE.into()), ..RequestOptions::renewing(Renew::Process) };
    let mut parameters = number(n);
    parameters.add_int("m", 1).unwrap();
    peer.call(function, &mut parameters)
        .with(options)
        .wait()
        .map(|()| parameters.variable("m").unwrap())
        .map_err(Error::from)
}

/// A function `NAME(n: int) -> (m: int)` that a shell serves.
fn shell(name: &str, script: &str) -> String {
    format!("[[functions]]\nsignature = \"{name}(n: int) -> (m: int)\"\nrun = [\"sh\", \"-c\", '''{script}''']\n")
}

const SERVED: &str = r#"
[[functions]]
signature = "echo(data: string[64], n: int) -> (data: string[64], n: int)"
answer = "echo"
[[functions]]
signature = "report(text: string[64])"
answer = "log"
"#;

#[test]
fn a_vehicle_joins_and_calls_what_the_file_offers() {
    let script = r#"IFS= read -r line; echo "called with $line by $CARA_CALLER" >&2; echo '{"m": 42}'"#;
    let mut node = Node::start(&format!("{SERVED}{}", shell("answer", script)));
    assert!(node.up.starts_with("plant/1 is up: "), "{}", node.up);
    let (unit, manager) = node.vehicle("agv", 7);
    assert_eq!(manager.their_function_list().len(), 3);
    let mut parameters = number(5);
    parameters.add_string("data", 64).unwrap();
    parameters.set_value("data", "there and back").unwrap();
    manager.block_request("echo", &mut parameters).unwrap();
    assert_eq!((parameters.variable("n"), parameters.variable("data")), (Ok(5), Ok("there and back")));
    let mut report = Parameters::new();
    report.add_string("text", 64).unwrap();
    report.set_value("text", "a wheel\nsqueaks").unwrap();
    manager.block_request("report", &mut report).unwrap();
    assert_eq!(call(&manager, "answer", 6), Ok(42));
    // Threads of their own write these.
    for line in ["joined", r#"called with {"n":6} by agv/7"#, r"a wheel\nsqueaks"] {
        until(line, || node.log().contains(line));
    }
    unit.stop();
    assert!(node.process.terminate(PATIENCE).unwrap().success());
}

#[test]
fn programs_that_misbehave_are_errors_of_their_own_calls() {
    let functions = [
        shell("hangs", "sleep 1000") + "timeout = \"200ms\"\n",
        shell("hangs_behind", "sleep 1000 & echo '{\"m\": 3}'"),
        shell("fails", "exit 7"),
        shell("crashes", "kill -SEGV $$"),
        shell("garbage", "echo '{\"m\": '"),
        shell("nothing", ":"),
        shell("wrong", "echo '{\"m\": \"four\"}'"),
        shell("endless", "yes"),
        shell("deaf", "exec <&-; sleep 0.1; echo '{\"m\": 1}'"),
        shell("right", "cat >/dev/null; echo '{\"m\": 2, \"more\": []}'"),
    ];
    let node = Node::start(&functions.concat());
    let (_unit, manager) = node.vehicle("agv", 7);
    let failed = |code| Err(Error::Service(ServiceError::Failed(code)));
    let bad = Err(Error::Service(ServiceError::BadResults));
    let expected = [
        ("hangs", failed(124)),
        ("hangs_behind", Ok(3)),
        ("fails", failed(7)),
        ("crashes", failed(128 + 11)),
        ("garbage", bad),
        ("nothing", bad),
        ("wrong", bad),
        ("endless", bad),
        ("deaf", Ok(1)),
        ("right", Ok(2)),
    ];
    for (function, outcome) in expected {
        assert_eq!(call(&manager, function, 1), outcome, "{function}\n{}", node.log());
    }
    // Nothing of what they started is left.
    until("no program is left", || children_of(&node).is_empty());
    let log = node.log();
    for reported in ["its time was up", "exit status: 7", "SIGSEGV", "no JSON", "m: expected int", "more than"] {
        assert!(log.contains(reported), "`{reported}` in\n{log}");
    }
}

/// Processes that sleep on behalf of a node: their environment has the node's folder of sockets.
fn children_of(node: &Node) -> Vec<String> {
    let mut found = Vec::new();
    for process in std::fs::read_dir("/proc").unwrap().flatten() {
        let is_in_folder = std::fs::read_link(process.path().join("cwd"))
            .is_ok_and(|folder| folder == node.folder.path().canonicalize().unwrap());
        let name = std::fs::read_to_string(process.path().join("comm")).unwrap_or_default();
        if is_in_folder && name.trim() != "cara" {
            found.push(name);
        }
    }
    found
}

#[test]
fn a_program_that_hangs_keeps_no_other_call_waiting() {
    let node = Node::start(&format!("{SERVED}{}timeout = \"1h\"\n", shell("hangs", "sleep 1000")));
    let (_unit, manager) = node.vehicle("agv", 7);
    // As many as may run, and one more, all from one caller.
    for _ in 0..7 {
        let mut parameters = number(1);
        parameters.add_int("m", 1).unwrap();
        manager.request("hangs", &parameters).unwrap();
    }
    until("the seventh is refused", || node.log().contains("6 calls run programs already"));
    let mut parameters = number(5);
    parameters.add_string("data", 64).unwrap();
    assert_eq!(manager.block_request("echo", &mut parameters), Ok(()));
    assert_eq!(call(&manager, "hangs", 1), Err(Error::Service(ServiceError::NotReady)));
    let mut node = node;
    assert!(node.process.terminate(PATIENCE).unwrap().success());
    assert!(children_of(&node).is_empty(), "{:?}", children_of(&node));
}

const LEASE: Duration = Duration::from_millis(1_500);
/// Begins to drive, and returns.
const GO: &str = "echo going >> motion; echo '{\"m\": 1}'";

/// A node whose function `go` runs a script, and whose lease's end writes `stopped` into a file.
fn leased(script: &str) -> Node {
    let go = shell("go", script);
    Node::start(&format!(
        "{go}lease = \"{}ms\"\nat_lease_end = [\"sh\", \"-c\", \"sleep 0.2; echo stopped >> motion\"]\n",
        LEASE.as_millis()
    ))
}

fn motion(node: &Node) -> String {
    std::fs::read_to_string(node.folder.path().join("motion")).unwrap_or_default()
}

#[test]
fn the_end_of_a_lease_runs_what_makes_safe() {
    unless_held_up(LEASE, || {
        let node = leased(GO);
        let (unit, manager) = node.vehicle("agv", 7);
        assert_eq!(call(&manager, "go", 1), Ok(1));
        // Its caller is there, so that it goes on for longer than the lease.
        std::thread::sleep(2 * LEASE);
        assert_eq!(motion(&node), "going\n");
        manager.release("go").unwrap();
        until("the release stops it", || motion(&node) == "going\nstopped\n");
        assert_eq!(call(&manager, "go", 1), Ok(1));
        unit.stop();
        until("the caller's end stops it", || motion(&node) == "going\nstopped\ngoing\nstopped\n");
    });
}

#[test]
fn the_end_of_a_lease_ends_the_program_first() {
    let node = leased("echo going >> motion; sleep 1000; echo going >> motion");
    let (unit, manager) = node.vehicle("agv", 7);
    let mut parameters = number(1);
    parameters.add_int("m", 1).unwrap();
    manager.call("go", &mut parameters).renewing(Renew::Process).send().unwrap();
    until("it drives", || motion(&node) == "going\n");
    unit.stop();
    until("it is stopped", || motion(&node) == "going\nstopped\n");
    until("no program is left", || children_of(&node).is_empty());
}

#[test]
fn the_end_of_the_node_makes_safe_once() {
    let mut node = leased(GO);
    let (_unit, manager) = node.vehicle("agv", 7);
    assert_eq!(call(&manager, "go", 1), Ok(1));
    assert!(node.process.terminate(PATIENCE).unwrap().success());
    assert_eq!(motion(&node), "going\nstopped\n");
}

#[test]
fn what_led_to_a_stop_is_in_a_black_box() {
    let halt = "[[functions]]\nsignature = \"halt(n: int) -> (n: int)\"\nanswer = \"echo\"\nstop = true\n";
    let mut node = Node::start_with(&format!("[black_box]\nstreams = [\"pose\"]\n{halt}"), &["--state", "state"]);
    let (unit, manager) = node.vehicle("agv", 7);
    let definition = cara_std::Definition::stream("pose(n: int)").unwrap();
    let pose = unit.my_function_list().add_stream(&definition, cara_std::Duration::ZERO).unwrap();
    unit.publish_my_function_list().unwrap();
    // The first one is in the box long before the second one is sent.
    until("two values are sent", || {
        pose.publish(&number(1234)).unwrap();
        manager.counters().into_iter().any(|(name, count)| name == "SamplesSent" && count > 1)
    });
    manager.block_request("halt", &mut number(17)).unwrap();
    assert!(node.process.terminate(PATIENCE).unwrap().success());
    let cara = |arguments: &[&str]| {
        let ran = Command::new(cara()).args(arguments).current_dir(node.folder.path()).output().unwrap();
        assert!(ran.status.success(), "{}", text(&ran.stderr));
        text(&ran.stdout)
    };
    let listed: serde_json::Value =
        serde_json::from_str(&cara(&["black-box", "plant", "--state", "state", "--json"])).unwrap();
    let boxes = listed["black_boxes"].as_array().unwrap();
    assert_eq!(
        (boxes.len(), &boxes[0]["cause"], &boxes[0]["node"]),
        (1, &"stop".into(), &"plant/1".into()),
        "{listed}"
    );
    let file = boxes[0]["file"].as_str().unwrap();
    let written = std::fs::read(node.folder.path().join(file)).unwrap();
    assert!(text(&written).contains("\"values\":{\"n\":1234}"), "no value of `pose` is in it");
    let replayed = cara(&["replay", file]);
    for part in ["joined", "halt {\"n\":17}", "signal=\"SIGTERM\""] {
        assert!(replayed.contains(part), "`{part}` is not in {replayed}");
    }
}

#[test]
fn a_service_manager_hears_that_the_node_is_up_that_it_lives_and_that_it_ends() {
    let folder = TempDir::new().unwrap();
    let socket = UnixDatagram::bind(folder.path().join("notify")).unwrap();
    socket.set_read_timeout(Some(PATIENCE)).unwrap();
    let fleet = random_fleet();
    let file = format!("name = \"plant\"\nid = 1\nfleet = {fleet}\ninterfaces = \"lo\"\n");
    std::fs::write(folder.path().join("plant.toml"), file).unwrap();
    let keys = KeyFolder::draw(fleet, &["plant/1@m_unit"]).unwrap();
    let mut node = Node::run(folder, fleet, keys.into(), &[]);
    let heard = || {
        let mut buffer = [0; 64];
        let count = socket.recv(&mut buffer).unwrap();
        text(&buffer[..count]).trim().to_owned()
    };
    assert_eq!([heard(), heard(), heard()], ["READY=1", "WATCHDOG=1", "WATCHDOG=1"]);
    node.signal(Signal::STOP);
    // As a process that hangs: nothing comes behind what was said before.
    socket.set_nonblocking(true).unwrap();
    until("it is silent", || {
        while socket.recv(&mut [0; 64]).is_ok() {}
        std::thread::sleep(Duration::from_millis(200));
        socket.recv(&mut [0; 64]).is_err()
    });
    socket.set_nonblocking(false).unwrap();
    node.signal(Signal::CONT);
    assert!(node.process.terminate(PATIENCE).unwrap().success());
    while heard() != "STOPPING=1" {}
}

#[test]
fn the_socket_is_there_while_the_node_runs() {
    let mut node = Node::start("[log]\nlevel = \"warn\"");
    let socket = node.control_socket();
    assert!(socket.starts_with(node.folder.path()) && socket.exists(), "{}", node.up);
    let ended = node.process.terminate(PATIENCE).unwrap();
    assert_eq!(ended.code(), Some(0), "{}", node.log());
    assert!(!socket.exists());
}

#[test]
fn sighup_takes_over_constraints_and_log_of_a_file_without_mistakes() {
    let mut node = Node::start(&format!("constraints.minimum_interval = 0\nlog.level = \"warn\"\n{SERVED}"));
    let (_unit, manager) = node.vehicle("agv", 7);
    let mut report = Parameters::new();
    report.add_string("text", 64).unwrap();
    let twice = || manager.request("report", &report).and_then(|_| manager.request("report", &report));
    assert!(twice().is_ok());

    let file = node.folder.path().join("plant.toml");
    let right = std::fs::read_to_string(&file).unwrap();
    std::fs::write(&file, right.replace("minimum_interval = 0", "minimum_interval = \"1 parsec\"")).unwrap();
    node.signal(Signal::HUP);
    until("the mistake is told", || node.log().contains("the old configuration stays: plant.toml:5:32: "));
    assert!(twice().is_ok());
    assert!(!node.log().contains(" INFO "), "{}", node.log());

    let fresh = right.replace("minimum_interval = 0", "minimum_interval = \"1h\"").replace("\"warn\"", "\"info\"");
    std::fs::write(&file, fresh).unwrap();
    node.signal(Signal::HUP);
    until("the vehicle is told", || matches!(twice(), Err(Error::TooSoon { .. })));
    until("the log has the file's level", || node.log().contains(" INFO "));
    assert!(node.process.terminate(PATIENCE).unwrap().success());
}

#[test]
fn without_a_file_sighup_ends_it() {
    let folder = TempDir::new().unwrap();
    std::fs::write(folder.path().join("plant.toml"), "").unwrap();
    let fleet = random_fleet().to_string();
    let script = r#"cd "$1"; export CARA_CONTROL_DIR="$1/control"; echo $$ > pid
        exec "$2" node --name a --id 1 --loopback --fleet "$3" --insecure"#;
    let arguments = ["-c", script, "sh", folder.path().to_str().unwrap(), cara().to_str().unwrap(), &fleet];
    let mut process = Process::start("node", Path::new("sh"), arguments).unwrap();
    process.expect("a/1 is up: ", PATIENCE).unwrap();
    let pid = std::fs::read_to_string(folder.path().join("pid")).unwrap();
    kill_process(Pid::from_raw(pid.trim().parse().unwrap()).unwrap(), Signal::HUP).unwrap();
    assert!(process.wait(PATIENCE).unwrap().success());
}

/// What `GET /metrics` answers.
fn scrape(address: SocketAddr) -> String {
    let mut stream = TcpStream::connect(address).unwrap();
    stream.set_read_timeout(Some(PATIENCE)).unwrap();
    write!(stream, "GET /metrics HTTP/1.1\r\nHost: {address}\r\nConnection: close\r\n\r\n").unwrap();
    let mut answer = String::new();
    stream.read_to_string(&mut answer).unwrap();
    answer
}

/// The counters of the node, as an operator reads them: of itself and of each link.
fn counters(socket: &Path) -> Vec<(Option<String>, String, u64)> {
    let mut client = Client::connect(socket).unwrap();
    let answers = client.ask(&Question::Counters { node: None }).unwrap();
    let of = |answer| match answer {
        Answer::Counters { node, counters } => {
            counters.into_iter().map(|(name, count)| (node.clone(), name, count)).collect()
        }
        _ => Vec::new(),
    };
    answers.flat_map(|answer| of(answer.unwrap())).collect()
}

/// `RequestsSent` as `requests_sent`.
fn lower(name: &str) -> String {
    let mut lower = String::new();
    for character in name.chars() {
        if character.is_ascii_uppercase() && !lower.is_empty() {
            lower.push('_');
        }
        lower.push(character.to_ascii_lowercase());
    }
    lower
}

fn without_values(metrics: &str) -> Vec<&str> {
    let names = metrics.lines().map(|line| if line.starts_with('#') { Some(line) } else { line.rsplit(' ').nth(1) });
    names.map(Option::unwrap).collect()
}

/// Metrics that alert rules and dashboard name and no node has.
fn unknown(metrics: &str) -> Vec<&'static str> {
    const FILES: [&str; 2] = [
        include_str!("../../../packaging/prometheus/cara.rules.yml"),
        include_str!("../../../packaging/grafana/cara.json"),
    ];
    let is_there =
        |name: &str| metrics.lines().any(|line| line.strip_prefix(name).is_some_and(|rest| rest.starts_with('{')));
    let words =
        FILES.iter().flat_map(|file| file.split(|letter: char| !letter.is_ascii_alphanumeric() && letter != '_'));
    let names: Vec<_> = words.filter(|word| word.starts_with("cara_")).collect();
    assert!(names.len() > 30, "{names:?}");
    names.into_iter().filter(|name| !is_there(name)).collect()
}

#[test]
fn metrics_are_the_counters() {
    let node = Node::start(&format!("[metrics]\nlisten = \"127.0.0.1:0\"\n{SERVED}"));
    let url = node.up.split("metrics http://").nth(1).unwrap();
    let address = url.strip_suffix("/metrics").unwrap().parse().unwrap();
    let (unit, manager) = node.vehicle("agv", 7);
    unit.my_function_list().add_clock().unwrap();
    unit.publish_my_function_list().unwrap();
    let mut report = Parameters::new();
    report.add_string("text", 64).unwrap();
    for _ in 0..5 {
        manager.block_request("report", &mut report).unwrap();
    }
    until("its clock is measured", || scrape(address).contains("cara_clock_offset_seconds{"));
    let socket = node.control_socket();
    let before = counters(&socket);
    let answer = scrape(address);
    let after = counters(&socket);
    let (head, body) = answer.split_once("\r\n\r\n").unwrap();
    assert!(head.starts_with("HTTP/1.1 200 ") && head.contains(cara_std::metrics::CONTENT_TYPE), "{head}");
    let value = |prefix: &str, labels: &str| {
        let start = format!("{prefix}{{{labels}}} ");
        body.lines().find_map(|line| line.strip_prefix(&start)).map(|value| value.parse::<u64>().unwrap())
    };
    let mut compared = 0;
    for ((of, name, low), (_, _, high)) in before.iter().zip(&after) {
        let name = lower(name);
        let scraped = match of {
            Some(peer) => {
                let labels = format!("unit=\"plant/1\",peer=\"{peer}\",role=\"s_unit\"");
                value(&format!("cara_link_{name}_total"), &labels)
            }
            None => ["node", "links", "unit"].into_iter().find_map(|group| {
                let labels = "unit=\"plant/1\"";
                let name = format!("cara_{group}_{name}");
                value(&format!("{name}_total"), labels).or_else(|| value(&name, labels))
            }),
        };
        let scraped = scraped.unwrap_or_else(|| panic!("no {name} of {of:?} in\n{body}"));
        // Gauges may have gone either way meanwhile.
        assert!(scraped >= *low.min(high) && scraped <= *low.max(high), "{name} of {of:?}: {low}..{high}, {scraped}");
        compared += 1;
    }
    assert!(compared > 40, "{compared}");
    let printed = Command::new(cara()).args(["counters", "--prometheus", "--socket"]).arg(&socket).output().unwrap();
    assert!(printed.status.success(), "{}", text(&printed.stderr));
    assert_eq!(without_values(&text(&printed.stdout)), without_values(body));
    let received = before.iter().find(|(of, name, _)| of.is_some() && name == "RequestsReceived").unwrap().2;
    assert_eq!(received, 5);
    assert_eq!(unknown(body), Vec::<&str>::new());
}

#[test]
fn an_s_unit_is_a_node_too() {
    let manager = Node::start("");
    let vehicle = TempDir::new().unwrap();
    let file = format!(
        "name = \"agv\"\nid = 7\nrole = \"s_unit\"\nfleet = {}\ninterfaces = \"lo\"\nclock = true\n[manager]\nname = \"plant\"\nid = 1\n\
         [[functions]]\nsignature = \"echo(text: string[20000]) -> (text: string[20000])\"\nanswer = \"echo\"\n",
        manager.fleet
    );
    std::fs::write(vehicle.path().join("plant.toml"), file).unwrap();
    let vehicle = Node::run(vehicle, manager.fleet, manager.keys.clone(), &["--metrics", "127.0.0.1:0"]);
    assert!(vehicle.up.starts_with("agv/7 is up: ") && vehicle.up.contains("control socket none"), "{}", vehicle.up);
    let ask = |arguments: &[&str]| {
        let mut command = Command::new(cara());
        let asked = command.args(arguments).arg("--socket").arg(manager.control_socket()).output().unwrap();
        (asked.status.success(), text(&asked.stdout))
    };
    until("its function is there", || ask(&["functions", "agv/7"]).1.contains("echo"));
    until("its clock is measured", || ask(&["scan", "--json"]).1.contains("\"offset_us\":"));
    assert!(ask(&["scan"]).1.contains(" connected "), "its clock is that of its manager");
    let (called, results) = ask(&["call", "agv/7", "echo(text: \"there and back\")"]);
    assert!(called && results.contains("there and back"), "{results}");
    let (measured, times) = ask(&["ping", "agv/7", "--count", "2", "--interval", "1ms", "--json"]);
    assert!(measured && times.contains("\"tried\":2"), "{times}");
    let address = vehicle.up.split("metrics http://").nth(1).unwrap().strip_suffix("/metrics").unwrap();
    assert!(scrape(address.parse().unwrap()).contains("unit=\"agv/7\",peer=\"plant/1\",role=\"m_unit\"} 1\n"));
}

/// What a peer says in a call is in the log, and nothing of it acts on the terminal that shows the log.
#[test]
fn hidden_characters_of_a_caller_are_written_out_in_the_log() {
    let node = Node::start(SERVED);
    let (_unit, manager) = node.vehicle("agv", 7);
    let hidden = ['\u{9b}', '\u{202e}', '\u{200b}', '\u{1b}'];
    let mut report = Parameters::new();
    report.add_string("text", 64).unwrap();
    report.set_value("text", "a\u{9b}31mb\u{202e}c\u{200b}d\u{1b}[2J").unwrap();
    manager.block_request("report", &mut report).unwrap();
    until("the call is in the log", || node.log().contains("called"));
    let log = node.log();
    assert!(!log.contains(hidden), "{log:?}");
    assert!(log.contains(r"a\u{9b}31mb\u{202e}c\u{200b}d\u001b[2J"), "{log}");
}
