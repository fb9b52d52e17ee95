//! Help, completions, man page and docs/cara.md.

use std::collections::BTreeSet;
use std::path::Path;

use serde_json::Value;

use crate::support::{Stage, until};

const REFERENCE: &str = "../../docs/cara.md";

/// Every verb of the command, as its help lists them.
fn verbs(stage: &Stage) -> Vec<String> {
    let help = stage.ends(0, &["--help"]).out;
    let listed = help.lines().skip_while(|line| *line != "See:").take_while(|line| *line != "Options:");
    // What goes on in the next line is indented further.
    let verb = |line: &str| Some(line.strip_prefix("  ")?.split(' ').next()?.to_owned());
    let verbs: Vec<_> = listed.filter_map(verb).filter(|verb| !verb.is_empty() && verb != "help").collect();
    assert!(verbs.len() > 10, "{help}");
    verbs
}

#[test]
fn every_verb_has_help() {
    let stage = Stage::empty();
    for verb in verbs(&stage) {
        let help = stage.ends(0, &[&verb, "--help"]);
        help.says("Usage: cara ").says("Options of every verb and exit codes: cara --help");
        assert!(!help.out.contains("--json") && !help.out.contains("130 "), "{}", help.out);
    }
    stage.ends(0, &["--help"]).says("--json").says("Exit codes:");
    let below = stage.ends(0, &["keys", "derive", "--help"]);
    assert!(below.out.contains("--dir") && !below.out.contains("--json"), "{}", below.out);
    // Options that the help leaves out are taken, and completed.
    stage.ends(0, &["man", "--json"]);
    stage.ends(0, &["completions", "fish"]).says("__fish_cara_using_subcommand scan\" -l json");
}

#[test]
fn every_shell_has_completions() {
    let stage = Stage::empty();
    for (shell, sign) in [("bash", "complete -F"), ("zsh", "#compdef cara"), ("fish", "complete -c cara")] {
        let script = stage.ends(0, &["completions", shell]);
        script.says(sign);
        verbs(&stage).iter().for_each(|verb| {
            script.says(verb);
        });
        assert_eq!(
            stage.ends(0, &["completions", shell, "--json"]).json()["script"].as_str(),
            Some(script.out.as_str())
        );
    }
    // With two colons zsh hides the verb from what asks for names.
    let zsh = stage.ends(0, &["completions", "zsh"]).out;
    assert!(zsh.contains("'*:words -- ") && !zsh.contains("'*::"), "{zsh}");
    stage.ends(0, &["completions", "fish"]).says(" -l offering -f -a '(__cara_names; ");
    stage.ends(2, &["completions", "abacus"]);
}

#[test]
fn the_bash_completion_is_read_by_bash() {
    let stage = Stage::empty();
    let script = stage.ends(0, &["completions", "bash"]).out;
    let complete = "COMP_WORDS=(cara sc); COMP_CWORD=1; _cara cara sc cara; echo \"${COMPREPLY[@]}\"";
    let ran = std::process::Command::new("bash").args(["-c", &format!("{script}\n{complete}")]).output();
    let Ok(ran) = ran else { return println!("skipped: no bash here") };
    assert_eq!(String::from_utf8_lossy(&ran.stdout).trim(), "scan", "{}", String::from_utf8_lossy(&ran.stderr));
}

/// What a shell's script asks for, and gets.
fn names(control: &Path, words: &[&str]) -> String {
    let mut command = std::process::Command::new(env!("CARGO_BIN_EXE_cara"));
    command.args(["completions", "--line", "--"]).args(words).env("CARA_CONTROL_DIR", control);
    let ran = command.output().unwrap();
    assert!(ran.status.success() && ran.stderr.is_empty(), "{}", String::from_utf8_lossy(&ran.stderr));
    String::from_utf8(ran.stdout).unwrap()
}

#[test]
fn names_of_the_running_unit_are_completed() {
    let stage = Stage::with(&["agv-1"]);
    let names = |words: &[&str]| names(stage.control(), words);
    // A busy host may not answer in the time that a shell waits.
    until("its nodes are completed", || names(&["ping", "a"]) == "agv-1\n");
    until("and their functions", || names(&["call", "agv-1", "g"]).contains("go_to\n"));
    assert_eq!(names(&["call", "agv-1", "zz"]), "");
    assert_eq!(names(&["set", ".", "chunk"]), "chunk_size\n");
    let script = stage.ends(0, &["completions", "bash"]).out;
    let complete = "COMP_WORDS=(cara ping agv); COMP_CWORD=2; _cara_names cara agv ping; echo \"${COMPREPLY[@]}\"";
    let folder = Path::new(env!("CARGO_BIN_EXE_cara")).parent().unwrap().display();
    let path = format!("{folder}:{}", std::env::var("PATH").unwrap_or_default());
    let mut bash = std::process::Command::new("bash");
    bash.args(["-c", &format!("{script}\n{complete}")]).env("CARA_CONTROL_DIR", stage.control()).env("PATH", path);
    match bash.output() {
        Ok(_) => until("bash asks", || String::from_utf8_lossy(&bash.output().unwrap().stdout).trim() == "agv-1"),
        Err(_) => println!("skipped: no bash here"),
    }
    // Nobody answers, and nobody is there.
    stage.freeze_manager();
    assert_eq!(names(&["ping", ""]), "");
    assert_eq!(self::names(Stage::empty().control(), &["--unit", "manager", "ping", ""]), "");
}

#[test]
fn the_man_page_renders() {
    let stage = Stage::empty();
    let page = stage.ends(0, &["man"]).out;
    assert!(page.contains(".TH cara 1"), "{page}");
    assert_eq!(stage.ends(0, &["man", "--json"]).json()["page"].as_str(), Some(page.as_str()));
    let folder = tempfile::TempDir::new().unwrap();
    stage.ends(0, &["man", "--dir", folder.path().to_str().unwrap()]).says("cara-scan.1");
    for verb in verbs(&stage) {
        let page = std::fs::read_to_string(folder.path().join(format!("cara-{verb}.1"))).unwrap();
        assert!(page.contains(&format!(".TH cara-{verb} 1")) && page.contains(".SH OPTIONS"), "{page}");
        formats(&folder.path().join(format!("cara-{verb}.1")));
    }
    formats(&folder.path().join("cara.1"));
}

/// The formatter of man pages, where there is one, has nothing to say about a page.
fn formats(page: &Path) {
    let groff = std::process::Command::new("groff").args(["-man", "-Tascii", "-ww"]).arg(page).output();
    let Ok(ran) = groff else { return println!("not formatted: no groff here") };
    let said = String::from_utf8_lossy(&ran.stderr);
    assert!(ran.status.success() && said.is_empty(), "{}: {said}", page.display());
    assert!(ran.stdout.len() > 500, "{}", page.display());
}

/// All keys of an object and of what it holds, except those that are names of counters and nodes.
fn keys(value: &Value, found: &mut BTreeSet<String>) {
    match value {
        Value::Array(values) => values.iter().for_each(|value| keys(value, found)),
        Value::Object(object) => object.iter().for_each(|(key, value)| {
            if !key.contains('/') && !key.starts_with(|c: char| c.is_ascii_uppercase()) {
                found.insert(key.clone());
            }
            keys(value, found);
        }),
        _ => {}
    }
}

#[test]
fn the_reference_has_every_key_of_the_json() {
    let reference = std::fs::read_to_string(Path::new(env!("CARGO_MANIFEST_DIR")).join(REFERENCE)).unwrap();
    let words: BTreeSet<_> = reference.split(|c: char| !c.is_ascii_alphanumeric() && c != '_').collect();
    let stage = Stage::with(&["agv-1"]);
    let runs: &[&[&str]] = &[
        &["scan"],
        &["scan", "--survey", "--listen", "3s"],
        &["scan", "--all-managers", "--listen", "1s"],
        &["functions", "agv-1"],
        &["call", "agv-1", "go_to(position: [1, 2])"],
        &["call", "agv-1", "fail"],
        &["publish"],
        &["set", ".", "request_timeout", "2s"],
        &["watch", "--for", "100ms"],
        &["counters"],
        &["ping", "agv-1", "-c", "1"],
        &["completions", "bash"],
        &["man"],
    ];
    for &verb in runs {
        let mut found = BTreeSet::new();
        stage.cara(&[verb, &["--json"]].concat()).lines().iter().for_each(|object| keys(object, &mut found));
        assert!(!found.is_empty(), "{verb:?}");
        let missing: Vec<_> = found.iter().filter(|key| !words.contains(key.as_str())).collect();
        assert!(missing.is_empty(), "{verb:?}: {missing:?} not in docs/cara.md");
    }
}

#[test]
fn the_reference_has_every_verb_option_and_exit_code() {
    let reference = std::fs::read_to_string(Path::new(env!("CARGO_MANIFEST_DIR")).join(REFERENCE)).unwrap();
    let stage = Stage::empty();
    let verbs = verbs(&stage);
    verbs.iter().for_each(|verb| assert!(reference.contains(&format!("## `cara {verb}")), "no section for {verb}"));
    for verb in verbs.iter().map(Some).chain([None]) {
        let words: Vec<_> = verb.map(String::as_str).into_iter().chain(["-h"]).collect();
        let help = stage.ends(0, &words).out;
        let options =
            help.split(|c: char| !c.is_ascii_alphanumeric() && c != '-').filter(|word| word.starts_with("--"));
        for option in options.filter(|option| option.len() > 2) {
            assert!(reference.contains(&format!("`{option}")), "no {option} of cara {verb:?}");
        }
    }
    let help = stage.ends(0, &["--help"]).out;
    let codes = help.split("Exit codes:").nth(1).unwrap();
    for line in codes.lines().filter(|line| !line.trim().is_empty()) {
        let (code, meaning) = line.trim().split_once("  ").unwrap();
        assert!(reference.contains(&format!("| {code} | {meaning} |")), "no `| {code} | {meaning} |`");
    }
}

/// Pages below a folder of documents, as `docs/SUMMARY.md` links them.
fn pages(folder: &Path, below: &str, found: &mut BTreeSet<String>) {
    for entry in std::fs::read_dir(folder).unwrap().map(Result::unwrap) {
        let name = format!("{below}{}", entry.file_name().to_str().unwrap());
        match entry.path().is_dir() {
            true => pages(&entry.path(), &format!("{name}/"), found),
            false if name.ends_with(".md") && name != "SUMMARY.md" => drop(found.insert(name)),
            false => {}
        }
    }
}

#[test]
fn every_page_is_in_the_book_once() {
    let docs = Path::new("../../docs");
    let mut there = BTreeSet::new();
    pages(docs, "", &mut there);
    let summary = std::fs::read_to_string(docs.join("SUMMARY.md")).unwrap();
    let mut linked: Vec<_> = summary.split("](").skip(1).filter_map(|rest| Some(rest.split_once(')')?.0)).collect();
    linked.sort_unstable();
    assert_eq!(linked, there.iter().map(String::as_str).collect::<Vec<_>>());
}
