//! `cara functions` and `cara call`.

use std::io::Write;
use std::process::Stdio;

use crate::support::{FUNCTIONS, Ran, Stage, private_folder};

#[test]
fn functions_are_shown_as_they_are_called() {
    let stage = Stage::with(&["agv-1"]);
    for form in ["agv-1", "agv-1/11", "#11"] {
        let shown = stage.ends(0, &["functions", form]);
        FUNCTIONS.iter().for_each(|signature| {
            shown.says(signature);
        });
    }
    let reported = stage.ends(0, &["functions", "agv-1", "--json"]).json();
    assert_eq!(reported["node"], "agv-1/11");
    assert_eq!(reported["functions"].as_array().unwrap().len(), FUNCTIONS.len());
}

#[test]
fn functions_are_shown_as_the_trait_of_a_typed_program() {
    let stage = Stage::with(&["agv-1"]);
    let shown = stage.ends(0, &["functions", "agv-1", "--rust"]);
    shown.says("#[interface]").says("pub trait Agv1 {");
    shown.says("    fn go_to(&mut self, position: [i64; 2]) -> Result<");
    let reported = stage.ends(0, &["functions", "agv-1", "--rust", "--json"]).json();
    assert_eq!(reported["rust"], shown.out);
}

#[test]
fn results_can_be_pasted_back() {
    let stage = Stage::with(&["agv-1"]);
    let calls = [
        "go_to(position: [1, -2])",
        r#"echo(text: "größe: \"3\"\n")"#,
        "mix(f: 0.5, fs: [NaN, -inf], b: true, data: 0x01ff)",
        "mix(f: 1e300, fs: [0.1, 2.0], b: false, data: 0x)",
    ];
    for call in calls {
        let ran = stage.ends(0, &["call", "agv-1", call]);
        assert_eq!(ran.out, format!("{call}\n"));
        assert_eq!(stage.ends(0, &["call", "agv-1", ran.out.trim()]).out, ran.out);
    }
    let reported = stage.ends(0, &["call", "agv-1", "go_to(position: [1, -2])", "--json"]).json();
    assert_eq!(reported["text"], "go_to(position: [1, -2])");
    assert_eq!(reported["node"], "agv-1/11");
    assert_eq!(reported["results"][0]["value"], serde_json::json!([1, -2]));
}

#[test]
fn what_may_be_absent_is_null_or_left_out_and_comes_back_so() {
    let stage = Stage::with(&["agv-1"]);
    for (call, back) in [
        ("set_up(load: {})", "set_up(speed: null, load: {})"),
        ("set_up(speed: 1.5, load: {kg: 2.5, name: null})", "set_up(speed: 1.5, load: {kg: 2.5})"),
        (r#"set_up(speed: [0.5], load: {name: "box"})"#, r#"set_up(speed: 0.5, load: {name: "box"})"#),
    ] {
        assert_eq!(stage.ends(0, &["call", "agv-1", call]).out.trim(), back);
        assert_eq!(stage.ends(0, &["call", "agv-1", back]).out.trim(), back);
    }
    let reported = stage.ends(0, &["call", "agv-1", "set_up(load: {kg: 1.0})", "--json"]).json();
    assert_eq!(reported["results"][0]["value"], serde_json::Value::Null);
    assert_eq!(reported["results"][1]["value"], serde_json::json!({ "kg": 1.0 }));
    stage.ends(2, &["call", "agv-1", "set_up(speed: true, load: {})"]).says("`speed` is a float, and this is not");
}

#[test]
fn arguments_come_from_a_file_or_standard_input() {
    let stage = Stage::with(&["agv-1"]);
    let folder = private_folder();
    let file = folder.path().join("arguments.json");
    fn call<'a>(more: &[&'a str]) -> Vec<&'a str> {
        [&["call", "agv-1", "set_up", "--arguments"], more].concat()
    }
    let path = file.to_str().unwrap();
    std::fs::write(&file, "\n{ \"load\": { \"kg\": 3.0 },\n  \"speed\": null }\n").unwrap();
    let back = "set_up(speed: null, load: {kg: 3.0})\n";
    assert_eq!(stage.ends(0, &call(&[path])).out, back);

    let piped = |more: &[&str]| {
        let mut command = stage.command(&call(more));
        command.stdin(Stdio::piped()).stdout(Stdio::piped()).stderr(Stdio::piped()).spawn().unwrap()
    };
    let mut child = piped(&["-"]);
    child.stdin.take().unwrap().write_all(&std::fs::read(&file).unwrap()).unwrap();
    let ran = Ran::of(child.wait_with_output().unwrap());
    assert_eq!((ran.code, &*ran.out), (0, back), "{}", ran.everything());

    stage.ends(2, &["call", "agv-1", "set_up()", "--arguments", path]).says("the function's name alone");
    let mut held = piped(&["-", "--hold"]);
    let open = held.stdin.take();
    let ran = Ran::of(held.wait_with_output().unwrap());
    drop(open);
    assert_eq!(ran.code, 2);
    ran.says("--hold watches standard input");
    std::fs::write(&file, "{ \"load\": { \"kg\": true } }").unwrap();
    stage.ends(2, &call(&[path])).says("`load.kg` is a float");
    std::fs::write(&file, "[1]").unwrap();
    stage.ends(2, &call(&[path])).says("no JSON object");
    std::fs::remove_file(&file).unwrap();
    stage.ends(2, &call(&[path])).says("cannot be read from");
}

#[test]
fn twenty_thousand_characters_travel() {
    let stage = Stage::with(&["agv-1"]);
    let call = format!("echo(text: \"{}\")", "x".repeat(20_000));
    assert_eq!(stage.ends(0, &["call", "agv-1", &call]).out.trim(), call);
    let longer = format!("echo(text: \"{}\")", "x".repeat(20_001));
    stage.ends(2, &["call", "agv-1", &longer]).says("at most 20000 bytes, and this has 20001").says("signature: echo(");
}

#[test]
fn all_nodes_are_called_at_once() {
    let stage = Stage::with(&["agv-1", "agv-2"]);
    let shown = stage.ends(0, &["call", "--all", "go_to(position: [1, 2])"]);
    shown.says("agv-1/11  go_to(position: [1, 2])").says("agv-2/12  go_to(position: [1, 2])");
    let reported = stage.ends(0, &["call", "--all", "go_to(position: [1, 2])", "--json"]).lines();
    assert_eq!(reported.len(), 2);
    stage.ends(1, &["call", "--all", "fail"]).says("agv-1/11: Service").says("agv-2/12: Service");
    stage.ends(2, &["call", "--all", "goto"]).says("did you mean `go_to`?");
    let none = stage.ends(2, &["call", "--all", "goto"]);
    none.says("agv-1/11: UnknownFunction").says("no connected node has published `goto`");
}

#[test]
fn an_asynchronous_call_returns_when_it_is_accepted() {
    let stage = Stage::with(&["agv-1"]);
    stage.ends(0, &["call", "agv-1", "slow", "--async"]).says("accepted as call ");
    stage.ends(0, &["call", "agv-1", "fail", "--async", "--priority", "high"]).says("accepted as call ");
    let reported =
        stage.ends(0, &["call", "agv-1", "go_to(position: [1, 2])", "--async", "--best-effort", "--json"]).json();
    assert!(reported["call"].is_u64() && reported["error"].is_null(), "{reported}");
    stage.ends(0, &["call", "--all", "go_to(position: [1, 2])", "--async"]).says("agv-1/11  accepted");
}

#[test]
fn a_failure_of_the_node_is_told_by_name() {
    let stage = Stage::with(&["agv-1"]);
    stage.ends(1, &["call", "agv-1", "fail"]).says("agv-1/11: Service").says("code 7");
    stage.ends(1, &["call", "agv-1", "slow", "--timeout", "100ms"]).says("TimedOut");
    let reported = stage.ends(1, &["call", "agv-1", "slow", "--timeout", "100ms", "--json"]).json();
    assert_eq!((&reported["error"]["error"], &reported["text"]), (&"TimedOut".into(), &serde_json::Value::Null));
}

#[test]
fn a_mistake_is_pointed_at_and_nothing_is_sent() {
    let stage = Stage::with(&["agv-1"]);
    let mistakes = [
        ("go_to(position: [1, 2, 3])", "                  ^^^^^^^^^"),
        ("go_to(positon: [1, 2])", "`position`"),
        ("go_to()", "the argument `position` is missing"),
        ("go_to(position: [1, 2", "ends too early"),
        ("go_to(position: \"x\")", "is an int"),
    ];
    for (call, said) in mistakes {
        stage.ends(2, &["call", "agv-1", call]).says(said);
        let error = stage.ends(2, &["call", "agv-1", call, "--json"]).error();
        assert!(error["exit"] == 2 && error["text"].as_str().unwrap().contains(said.trim()), "{error}");
    }
    stage.ends(2, &["call", "agv-1", "go_to(position: [1])"]).says("signature: go_to(position: int[2])");
    stage.ends(2, &["call", "agv-1", "goto(position: [1, 2])"]).says("did you mean `go_to`?").says("swallow(text");
}

#[test]
fn who_is_not_there_is_told_with_who_is() {
    let stage = Stage::with(&["agv-1"]);
    stage.ends(1, &["functions", "agv1"]).says("no node `agv1` is connected; there is agv-1/11");
    stage.ends(1, &["call", "agv-9", "fail"]).says("agv-1/11");
    stage.ends(1, &["ping", "#99"]).says("cara doctor");
}

#[test]
fn wrong_usage_ends_with_2() {
    let stage = Stage::empty();
    let usages: [&[&str]; 8] = [
        &[],
        &["fly"],
        &["call"],
        &["call", "agv-1"],
        &["call", "--all", "agv-1", "fail"],
        &["call", "agv-1", "fail", "--best-effort"],
        &["call", "agv-1", "fail", "--timeout", "5"],
        &["scan", "--as", "manager"],
    ];
    for usage in usages {
        assert!(!stage.ends(2, usage).err.is_empty(), "{usage:?}");
        let error = stage.ends(2, &[usage, &["--json"]].concat()).error();
        assert_eq!((&error["exit"], &error["name"]), (&2.into(), &"Usage".into()), "{error}");
        assert!(!error["text"].as_str().unwrap().starts_with("error"), "{error}");
    }
}

/// What a terminal obeys or does not show, in a result and in a call's error: C1's CSI, a turn of direction, no width, ESC.
#[test]
fn hidden_characters_are_written_out() {
    let stage = Stage::with(&["agv-1"]);
    let hidden = ['\u{9b}', '\u{202e}', '\u{200b}', '\u{1b}'];
    let shows_none = |ran: &crate::support::Ran| {
        assert!(!ran.everything().contains(hidden), "{:?}", ran.everything());
    };
    let raw = "a\u{9b}31mb\u{202e}c\u{200b}d";
    let escaped = r"a\u009b31mb\u202ec\u200bd\u001b[2J";
    let call = format!("echo(text: \"{raw}\\u001b[2J\")");
    let text = stage.ends(0, &["call", "agv-1", &call]);
    shows_none(&text);
    assert_eq!(text.out, format!("echo(text: \"{escaped}\")\n"));
    assert_eq!(stage.ends(0, &["call", "agv-1", text.out.trim()]).out, text.out, "it can be pasted back");
    let json = stage.ends(0, &["call", "agv-1", &call, "--json"]);
    shows_none(&json);
    assert!(json.out.contains(&format!("\"value\":\"{escaped}\"")), "{}", json.out);
    assert_eq!(json.json()["results"][0]["value"], format!("{raw}\u{1b}[2J"), "JSON reads it back");
    for wrong in [format!("swallow(text: \"{raw}\", more: 1)"), format!("fail(\"{raw}\u{1b}[2J\")")] {
        let text = stage.ends(2, &["call", "agv-1", &wrong]);
        shows_none(&text);
        text.says("a·31mb·c·d");
        shows_none(&stage.ends(2, &["call", "agv-1", &wrong, "--json"]));
    }
    let nobody = stage.ends(1, &["call", &format!("agv{raw}\u{1b}"), "fail"]);
    shows_none(&nobody);
    nobody.says(r"agva\u{9b}31mb\u{202e}c\u{200b}d\u{1b}");
    let json = stage.ends(1, &["call", &format!("agv{raw}\u{1b}"), "fail", "--json"]);
    shows_none(&json);
    assert!(json.err.contains(r"agva\u009b31mb\u202ec\u200bd\u001b"), "{}", json.err);
    assert!(json.error()["text"].as_str().unwrap().contains(raw), "JSON reads it back");
}
