//! Operators that are other users of the host, with what their roles let them do.

use std::fs;
use std::io::ErrorKind;
use std::os::unix::fs::{PermissionsExt, chown};
use std::os::unix::process::CommandExt;

use crate::support::{Ran, Running, Stage, until};

const USER: u32 = 4711;
/// May only stop.
const STOPPER: u32 = 4713;

#[test]
fn another_user_looks_and_stops_and_is_told_what_else_needs() {
    let mut stage = Stage::empty();
    let socket = stage.control().join(format!("manager-1-{}.sock", stage.fleet));
    let audit = stage.control().join("audit");
    fs::set_permissions(stage.control(), fs::Permissions::from_mode(0o750)).unwrap();
    if chown(stage.control(), None, Some(USER)).is_err() {
        println!("skipped: only root can be other users");
        return;
    }
    let file = stage.control().join("manager.toml");
    let (fleet, operators) = (stage.fleet, format!("operators = {{ {USER} = \"see\", {STOPPER} = \"stop\" }}"));
    let control = format!("[control]\npath = {socket:?}\naudit = {audit:?}\n{operators}\n");
    fs::write(&file, format!("name = \"manager\"\nid = 1\nfleet = {fleet}\n{control}")).unwrap();
    stage.know("agv", 7);
    stage.start_manager_with(&[file.to_str().unwrap()]);
    stage.start_agv("agv", 7);
    until("the AGV is there", || stage.ready() == 1);
    let asked_by = |user: u32, arguments: &[&str]| match stage.command(arguments).uid(user).gid(USER).output() {
        Ok(output) => Some(Ran::of(output)),
        Err(error) if error.kind() == ErrorKind::PermissionDenied => None,
        Err(error) => panic!("{error}"),
    };
    let Some(scan) = asked_by(USER, &["scan"]) else {
        println!("skipped: other users cannot enter the folder of `cara`");
        return;
    };
    assert!(scan.code == 0 && scan.out.contains("agv"), "{}", scan.everything());
    let asked = |arguments: &[&str]| asked_by(USER, arguments).unwrap();
    let call = asked(&["call", "agv", "echo(text: \"hello\")"]);
    assert_eq!(call.code, 1);
    call.says("needs the role `operate`, and you have `see`");
    let reset = asked(&["reset", "agv", "--json"]);
    assert_eq!((reset.code, &reset.error()["name"]), (1, &"NotAllowed".into()));
    let mut log = stage.command(&["logs", "manager"]);
    log.uid(USER).gid(USER);
    Running::start(log).expect("agv/7");
    let stopper = asked_by(STOPPER, &["logs", "manager", "--for", "20s"]).unwrap();
    assert_eq!(stopper.code, 1, "{}", stopper.everything());
    stopper.says("needs the role `see`, and you have `stop`");
    asked(&["stop", "agv"]).says("published no function that stops");
    let stranger = asked_by(USER + 1, &["stop", "agv"]).unwrap();
    assert_eq!(stranger.code, 3);
    stranger.says("have yours added");
    let noted = || fs::read_to_string(&audit).unwrap();
    until("it is noted", || noted().contains("NoStop"));
    let of_user = |line: &&str| line.contains("\"role\":\"see\"") && line.contains("\"uid\":4711");
    assert_eq!(noted().lines().filter(of_user).count(), 3, "{}", noted());
}
