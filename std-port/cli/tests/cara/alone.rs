//! Without a manager on this host: what then is said, and `--as`.

use std::io::{BufRead, BufReader, Write};
use std::os::unix::net::UnixStream;
use std::path::Path;
use std::process::Stdio;

use crate::support::{Ran, Stage, private_folder, until};

/// What an operator asks of a manager, running or for the time of the command.
const VERBS: &[&[&str]] = &[
    &["functions", "agv-1"],
    &["call", "agv-1", "fail"],
    &["stop", "agv-1"],
    &["reset", "--all"],
    &["publish"],
    &["set", ".", "request_timeout", "2s"],
    &["watch"],
    &["stream", "agv-1"],
    &["counters"],
    &["ping", "agv-1"],
];

#[test]
fn with_no_unit_the_two_ways_out_are_named() {
    let stage = Stage::empty();
    for &verb in VERBS {
        stage.ends(3, verb).says("cara node").says("--as NAME/ID");
        let reported = stage.ends(3, &[verb, &["--json"]].concat()).error();
        assert_eq!((&reported["exit"], &reported["name"]), (&3.into(), &"NoUnit".into()), "{reported}");
    }
}

/// A verb for a running manager alone does not advise what it refuses.
#[test]
fn with_no_unit_a_verb_for_a_running_manager_names_the_one_way_out() {
    let stage = Stage::empty();
    let reported = stage.ends(3, &["retire", "agv-1"]).says("cara node").everything();
    assert!(!reported.contains("--as"), "{reported}");
    stage.ends(2, &["retire", "agv-1", "--as", "x/9", "--insecure"]).says("leave out --as");
}

#[test]
fn a_unit_that_is_named_and_not_there_is_an_error() {
    let stage = Stage::with(&[]);
    stage.ends(3, &["counters", "--unit", "manager/2"]).says("manager/1");
    let nothing = stage.control().join("nothing");
    stage.ends(3, &["counters", "--socket", nothing.to_str().unwrap()]).says("nothing");
    let not_a_socket = stage.control().join("file");
    std::fs::write(&not_a_socket, "").unwrap();
    stage.ends(3, &["counters", "--socket", not_a_socket.to_str().unwrap()]);
}

/// Options that belong together may stand before the verb and behind it.
#[test]
fn options_before_and_behind_the_verb_are_looked_at_together() {
    let stage = Stage::empty();
    stage.ends(0, &["--as", "x/9", "--insecure", "scan", "--wait", "100ms"]);
    stage.ends(0, &["--insecure", "scan", "--wait", "100ms", "--as", "x/9"]);
    stage.ends(2, &["scan", "--wait", "1s"]).says("--wait").says("--as NAME/ID");
    stage.ends(2, &["scan", "--as-port", "9"]).says("--as-port").says("--as NAME/ID");
    for [before, value] in [["--unit", "a/1"], ["--socket", "here"]] {
        stage.ends(2, &[before, value, "scan", "--as", "x/9"]).says("leave one away");
    }
    stage.ends(2, &["--unit", "a/1", "scan", "--socket", "here"]).says("leave one away");
    stage.ends(2, &["--insecure", "scan", "--key-file", "k"]).says("--key-file");
}

#[test]
fn a_unit_is_chosen_where_several_run() {
    let stage = Stage::with(&[]);
    let mut other = stage.command(&["node", "--name", "other", "--id", "2"]).spawn().unwrap();
    until("the other unit answers", || stage.cara(&["counters", "--unit", "other/2"]).code == 0);
    let several = stage.cara(&["counters"]);
    let chosen = ["other/2", "other"].map(|unit| stage.cara(&["scan", "--unit", unit, "--json"]));
    other.kill().unwrap();
    other.wait().unwrap();
    assert_eq!(several.code, 2, "{}", several.everything());
    several.says("manager/1").says("other/2").says("--unit");
    chosen.iter().for_each(|chosen| assert_eq!(chosen.json()["unit"]["name"], "other"));
}

#[test]
fn as_a_manager_the_same_questions_have_the_same_answers() {
    let mut stage = Stage::empty();
    stage.start_agv("agv-1", 11);
    stage.start_agv("agv-2", 12);
    fn own<'v>(verb: &[&'v str]) -> Vec<&'v str> {
        [verb, &["--as", "manager/1", "--wait", "30s"]].concat()
    }
    // Those that come later than the others have settled are not waited for.
    until("both are there", || {
        let reported = stage.ends(0, &own(&["scan", "--json"])).json();
        assert_eq!(reported["unit"]["name"], "manager", "{reported}");
        reported["nodes"].as_array().unwrap().len() == 2
    });
    stage.ends(0, &own(&["functions", "agv-1"])).says("go_to(position: int[2])");
    let called = stage.ends(0, &own(&["call", "agv-2", "go_to(position: [1, 2])", "--timeout", "20s"]));
    assert_eq!(called.out, "go_to(position: [1, 2])\n");
    until("both are called", || {
        let called = stage.cara(&own(&["call", "--all", "go_to(position: [1, 2])", "--timeout", "20s"]));
        println!("{}", called.everything());
        called.code == 0 && ["agv-1/11", "agv-2/12"].iter().all(|node| called.out.contains(node))
    });
    stage.ends(0, &own(&["call", "agv-2", "echo(text: \"x\")", "--async"])).says("accepted");
    stage.ends(0, &own(&["ping", "agv-1", "-c", "1", "--timeout", "20s"])).says("1 of 1 answered");
    stage.ends(0, &own(&["counters", "agv-1", "--json"]));
    stage.ends(0, &own(&["publish", "agv-1", "--timeout", "20s"]));
    stage.ends(0, &own(&["set", "agv-1", "request_timeout", "1s"]));
    stage.ends(0, &own(&["set", ".", "request_timeout", "1s"]));
    stage.ends(0, &own(&["watch", "--count", "1"])).says("joined");
}

#[test]
fn a_node_that_is_told_an_address_is_met_there() {
    let stage = Stage::empty();
    let address = {
        let free = std::net::TcpListener::bind("127.0.0.1:0").unwrap();
        free.local_addr().unwrap()
    };
    stage.know("fixed", 5);
    let agv = stage.vehicle("fixed", 5).manager_address(address).build().unwrap();
    agv.start().unwrap();
    let port = address.port().to_string();
    let verb =
        ["ping", "fixed", "-c", "1", "--timeout", "20s", "--as", "manager/1", "--as-port", &port, "--wait", "30s"];
    stage.ends(0, &verb).says("1 of 1 answered");
    agv.stop();
}

#[test]
fn who_does_not_join_in_the_stated_time_is_told() {
    let stage = Stage::empty();
    let ran = stage.ends(1, &["functions", "agv-1", "--as", "manager/1", "--wait", "200ms"]);
    ran.says("no node `agv-1` is connected").says("waited 200 ms");
}

#[test]
fn cara_does_not_pretend_to_be_a_unit_that_runs() {
    let stage = Stage::with(&["agv-1"]);
    for &verb in VERBS {
        let ran = stage.ends(2, &[verb, &["--as", "manager/1"]].concat());
        ran.says("manager/1 runs on this host").says("without --as");
    }
    // Its control socket is elsewhere, yet it answers on the network.
    let elsewhere = private_folder();
    let scan = || {
        let mut command = stage.command(&["scan", "--as", "manager/1"]);
        Ran::of(command.env("CARA_CONTROL_DIR", elsewhere.path()).output().unwrap())
    };
    let mut ran = scan();
    // Where the answer comes late it has begun to be the unit, and is told that it runs already.
    until("the answer comes in time", || {
        if ran.code == 5 {
            ran = scan();
        }
        ran.code != 5
    });
    assert_eq!(ran.code, 2, "{}", ran.everything());
    ran.says("manager/1 answers at");
}

/// A control connection that the unit serves; `None` when it has refused it. It waits for an answer: an idle one gives way.
fn served(socket: &Path) -> Option<UnixStream> {
    let stream = UnixStream::connect(socket).unwrap();
    let mut lines = BufReader::new(&stream).lines().map_while(Result::ok);
    let hello = lines.next()?;
    if !hello.contains(r#""answer":"hello""#) || hello.contains("full") {
        return None;
    }
    (&stream).write_all(b"{\"ask\":\"watch\"}\n").ok()?;
    let is_watching = lines.next()?.contains("watching");
    drop(lines);
    is_watching.then_some(stream)
}

#[test]
fn a_unit_that_cannot_be_asked_now_is_not_overlooked() {
    let stage = Stage::with(&[]);
    let socket = std::fs::read_dir(stage.control()).unwrap().next().unwrap().unwrap().path();
    // Those of commands that have just ended may still count, and are free a little later.
    let mut held = Vec::new();
    while held.len() < 8 {
        held.extend(served(&socket));
    }
    for verb in [&["scan"][..], &["call", "agv-1", "fail"]] {
        stage.ends(1, verb).says("manager/1 runs here").says("close one");
    }
    let hung = Stage::empty();
    let path = hung.control().join(format!("hung-7-{}.sock", hung.fleet));
    let _listener = std::os::unix::net::UnixListener::bind(path).unwrap();
    hung.ends(1, &["scan"]).says("hung/7").says("restart it");
}

#[test]
fn what_else_may_answer_on_a_socket_does_not_panic() {
    let stage = Stage::empty();
    let path = stage.control().join("other.sock");
    let listener = std::os::unix::net::UnixListener::bind(&path).unwrap();
    let hello = r#"{"answer":"hello","control_version":2,"unit":"manager/1","fleet":0}"#;
    let says: [(String, i32); 6] = [
        (String::new(), 1),
        ("\0\u{ff} garbage\n".into(), 1),
        (r#"{"answer":"hello","control_version":99,"unit":"manager/1","fleet":0}"#.to_owned() + "\n", 3),
        (format!("{hello}\n"), 1),
        (format!("{hello}\ngarbage\n"), 1),
        (format!("{hello}\n{{\"answer\":\"failed\",\"cause\":\"peer\",\"error\":\"Odd\",\"text\":\"odd\"}}\n"), 1),
    ];
    for (text, code) in says {
        let mut command = stage.command(&["functions", "agv-1", "--socket", path.to_str().unwrap()]);
        let cara = command.stdout(Stdio::piped()).stderr(Stdio::piped()).spawn().unwrap();
        let (mut stream, _) = listener.accept().unwrap();
        // A command that is content with less may have ended.
        let _ = stream.write_all(text.as_bytes());
        drop(stream.shutdown(std::net::Shutdown::Write));
        let ran = Ran::of(cara.wait_with_output().unwrap());
        assert!(ran.code == code && ran.err.starts_with("error: "), "{text:?}: {}", ran.everything());
    }
}
