//! `cara keys` as a process: what it makes, what it shows, what it refuses, and that docs/keys.md says what it prints.

use std::collections::{BTreeMap, BTreeSet};
use std::fs;
use std::io::{BufRead, BufReader};
use std::os::unix::fs::PermissionsExt;
use std::path::{Path, PathBuf};
use std::process::{Child, Command, Output, Stdio};

use cara_std::keys::{KeyRing, RootKey, location, parse_node};
use cara_std::{Fleet, Identity, Role};
use serde_json::Value;
use tempfile::TempDir;

const GUIDE: &str = "../../docs/keys.md";

/// A home without keys.
struct Home(TempDir);

impl Home {
    fn new() -> Self {
        Self(TempDir::new().unwrap())
    }

    /// One with fleet 7: a manager and two AGVs.
    fn with_fleet() -> Self {
        let home = Self::new();
        home.done(&["new-fleet", "--fleet", "7", "depot/1@m_unit", "agv/1", "agv/2"]);
        home
    }

    fn cara(&self, arguments: &[&str]) -> Output {
        let mut command = Command::new(env!("CARGO_BIN_EXE_cara"));
        command.arg("keys").args(arguments).current_dir(self.0.path()).env("HOME", self.0.path());
        command.env_remove("XDG_CONFIG_HOME").env_remove("CARA_KEYS").output().unwrap()
    }

    /// As [`cara`](Self::cara), where no file gets longer than 2 or 4 KiB: shells differ in what they count.
    fn cut_short(&self, arguments: &[&str]) -> Output {
        let mut command = Command::new("sh");
        command.args(["-c", "trap '' XFSZ; ulimit -f 4; exec \"$@\"", "sh", env!("CARGO_BIN_EXE_cara"), "keys"]);
        command.args(arguments).current_dir(self.0.path()).env("HOME", self.0.path());
        command.env_remove("XDG_CONFIG_HOME").env_remove("CARA_KEYS").output().unwrap()
    }

    /// The standard output of what must succeed.
    #[track_caller]
    fn done(&self, arguments: &[&str]) -> String {
        let ran = self.cara(arguments);
        assert!(ran.status.success(), "{arguments:?}: {}", String::from_utf8_lossy(&ran.stderr));
        String::from_utf8(ran.stdout).unwrap()
    }

    #[track_caller]
    fn json(&self, arguments: &[&str]) -> Value {
        serde_json::from_str(&self.done(&[arguments, &["--json"]].concat())).unwrap()
    }

    /// Must end with `code` and say `text`.
    #[track_caller]
    fn refused(&self, arguments: &[&str], code: i32, text: &str) {
        let ran = self.cara(arguments);
        let said = String::from_utf8_lossy(&ran.stderr).into_owned();
        assert_eq!(ran.status.code(), Some(code), "{arguments:?}: {said}");
        assert!(said.contains(text), "{arguments:?}: {said}");
    }

    fn folder(&self) -> PathBuf {
        self.0.path().join(".config/cara/keys")
    }

    fn file(&self, node: &str) -> PathBuf {
        self.folder().join(location::file_name(&named(node), Fleet(7)))
    }

    fn ring(&self, node: &str) -> KeyRing {
        KeyRing::load_of(&self.file(node), &named(node), Fleet(7)).unwrap()
    }
}

fn named(node: &str) -> Identity {
    parse_node(node).unwrap()
}

/// The generations of the keys of two nodes, as the first one has them.
fn generations(ring: &KeyRing, peer: &str) -> Vec<u32> {
    ring.pairs(&named(peer)).map(|(number, _)| number).collect()
}

#[test]
fn a_new_name_that_could_be_anothers_name_and_id_is_refused() {
    let home = Home::new();
    home.refused(&["new-fleet", "--fleet", "7", "depot/1@m_unit", "agv/17/12"], 2, "no slash");
    home.done(&["new-fleet", "--fleet", "7", "depot/1@m_unit", "agv/17"]);
    home.refused(&["derive", "--fleet", "7", "agv/17/12"], 2, "no slash");
}

#[test]
fn nodes_of_a_new_fleet_have_each_others_keys() {
    let home = Home::with_fleet();
    let (depot, agv) = (home.ring("depot/1@m_unit"), home.ring("agv/1"));
    assert_eq!(depot.pair(&named("agv/1")).unwrap().expose(), agv.pair(&named("depot/1@m_unit")).unwrap().expose());
    assert_eq!(depot.discovery().expose(), agv.discovery().expose());
    assert!(agv.pair(&named("agv/2")).is_none());
    let mode = |path: &Path| fs::metadata(path).unwrap().permissions().mode() & 0o777;
    assert_eq!(mode(&home.folder()), 0o700);
    for file in fs::read_dir(home.folder()).unwrap() {
        assert_eq!(mode(&file.unwrap().path()), 0o600);
    }
    let other = Home::with_fleet();
    assert_ne!(other.ring("agv/1").discovery().expose(), agv.discovery().expose(), "roots are drawn");
}

#[test]
fn the_next_step_names_the_folder_that_the_environment_does() {
    let home = Home::new();
    assert!(home.done(&["new-fleet", "--fleet", "7", "depot/1@m_unit"]).contains("into ~/.config/cara/keys or"));
    let mut command = Command::new(env!("CARGO_BIN_EXE_cara"));
    command.args(["keys", "new-fleet", "--fleet", "7", "depot/1@m_unit"]).env_remove("CARA_KEYS");
    let ran = command.env("XDG_CONFIG_HOME", home.0.path().join("other")).output().unwrap();
    let said = String::from_utf8_lossy(&ran.stdout).into_owned();
    assert!(said.contains("into $XDG_CONFIG_HOME/cara/keys or"), "{said}");
}

#[test]
fn managers_know_each_other_and_their_own_vehicles() {
    let home = Home::with_fleet();
    home.refused(&["derive", "hall/2@m_unit", "agv/3"], 2, "Say `--manager depot/1` or `--manager hall/2`");
    assert!(!home.file("hall/2@m_unit").exists(), "a mistake changes nothing");
    home.done(&["derive", "agv/3", "hall/2@m_unit", "--manager", "hall/2"]);
    let (depot, hall) = (home.ring("depot/1@m_unit"), home.ring("hall/2@m_unit"));
    assert_eq!(hall.peers(), [&named("depot/1@m_unit"), &named("agv/3")]);
    assert_eq!(
        depot.pair(&named("hall/2@m_unit")).unwrap().expose(),
        hall.pair(&named("depot/1@m_unit")).unwrap().expose()
    );
    assert!(depot.pair(&named("agv/3")).is_none());
    home.refused(&["derive", "agv/3", "--manager", "hal"], 2, "no m_unit of the fleet has this name");
    home.done(&["derive", "agv/3", "--manager", "hall", "--manager", "depot/1"]);
    assert!(home.ring("depot/1@m_unit").pair(&named("agv/3")).is_some());
}

#[test]
fn a_name_that_one_node_has_is_enough_to_revoke_it() {
    let home = Home::with_fleet();
    home.refused(&["revoke", "agv"], 2, "write agv/1 or agv/2");
    assert!(home.done(&["show", "depot"]).starts_with("depot/1@m_unit in fleet 7"));
    assert!(home.done(&["show", "agv/1"]).starts_with("agv/1 in fleet 7"));
    home.refused(&["revoke", "agw"], 2, "no node of the fleet is called `agw`");
    home.done(&["derive", "lift/3"]);
    assert!(home.done(&["revoke", "lift"]).contains("lift/3"));
    assert!(home.done(&["revoke", "lift"]).contains("lift/3 is revoked already"));
}

#[test]
fn who_is_revoked_is_in_nobody_s_file() {
    let home = Home::with_fleet();
    let stolen = home.ring("agv/1");
    let reported = home.json(&["revoke", "agv/1"]);
    let changes: Vec<_> =
        reported["written"].as_array().unwrap().iter().map(|one| [&one["node"], &one["change"]]).collect();
    assert_eq!(changes, [["agv/1", "removed"], ["depot/1@m_unit", "replaced"], ["agv/2", "replaced"]]);
    assert_eq!((&reported["generations"], reported["next"].as_array().unwrap().len()), (&serde_json::json!([1, 2]), 2));
    let depot = home.ring("depot/1@m_unit");
    assert!(generations(&depot, "agv/1").is_empty() && !home.file("agv/1").exists());
    assert_eq!(generations(&depot, "agv/2"), [1, 2]);
    let files = fs::read_dir(home.folder()).unwrap().map(|file| fs::read_to_string(file.unwrap().path()).unwrap());
    let key: String =
        stolen.pair(&named("depot/1@m_unit")).unwrap().expose().iter().map(|byte| format!("{byte:02x}")).collect();
    assert!(files.into_iter().all(|text| !text.contains(&key)));

    home.done(&["derive", "agv/1"]);
    assert_eq!(generations(&home.ring("depot/1@m_unit"), "agv/1"), [2]);
    assert_eq!(home.json(&["show"])["revoked"], serde_json::json!([]));
    home.refused(&["revoke", "agv/9"], 2, "agv/9 is not in the fleet");
    let unknown = String::from_utf8(home.cara(&["revoke", "agv/9"]).stderr).unwrap();
    assert!(!unknown.contains("derive"), "what is to be shut out is not to be added: {unknown}");
    home.refused(&["revoke"], 2, "NODE");
}

#[test]
fn without_its_manager_a_vehicle_is_told() {
    let home = Home::with_fleet();
    let said = home.done(&["revoke", "depot/1@m_unit"]);
    assert!(said.contains("`cara keys derive --fleet 7 agv/1 --manager NAME/ID`"), "{said}");
    home.done(&["derive", "yard/1@m_unit", "agv/1", "agv/2"]);
    assert_eq!(home.ring("yard/1@m_unit").peers().len(), 2);
}

#[test]
fn a_change_of_keys_begins_and_is_finished() {
    let home = Home::with_fleet();
    let held = || generations(&home.ring("agv/1"), "depot/1@m_unit");
    home.refused(&["rotate", "--finish"], 2, "`cara keys rotate --fleet 7` begins another");
    home.refused(&["rotate", "--switch"], 2, "`cara keys rotate --fleet 7` begins another");
    home.done(&["rotate"]);
    assert_eq!(held(), [1, 2]);
    home.refused(&["rotate"], 2, "a change to generation 2 is under way");
    home.refused(&["rotate", "--finish"], 2, "`cara keys rotate --fleet 7 --switch`");
    home.done(&["rotate", "--switch"]);
    assert_eq!(held(), [2, 1]);
    home.refused(&["rotate", "--switch"], 2, "`cara keys rotate --fleet 7 --finish`");
    home.refused(&["rotate", "--switch", "--finish"], 2, "cannot be used with");
    home.done(&["revoke", "agv/2"]);
    assert_eq!(held(), [2, 3]);
    home.done(&["rotate", "--switch"]);
    home.done(&["rotate", "--finish"]);
    assert_eq!(held(), [3]);
}

#[test]
fn what_is_missing_is_written_again() {
    let home = Home::with_fleet();
    let before = fs::read(home.file("agv/1")).unwrap();
    fs::remove_file(home.file("agv/1")).unwrap();
    assert!(home.done(&["show"]).contains("not here"));
    home.done(&["derive"]);
    assert_eq!(fs::read(home.file("agv/1")).unwrap(), before);
    assert!(home.done(&["derive"]).contains("every file is as it should be"));
}

/// No command prints a byte of a key, whatever the form.
#[test]
fn no_key_is_printed() {
    let home = Home::with_fleet();
    let (depot, root) = (home.file("depot/1@m_unit"), home.folder().join("fleet-7.root"));
    let all = |ran: Output| String::from_utf8(ran.stdout).unwrap() + &String::from_utf8(ran.stderr).unwrap();
    let mut held = Vec::new();
    let mut said = Vec::new();
    let changes: [&[&str]; 6] = [
        &["rotate"],
        &["revoke", "agv/2"],
        &["revoke", "agv/2", "--json"],
        &["rotate", "--switch"],
        &["rotate", "--finish", "--json"],
        &["rotate"],
    ];
    for arguments in changes {
        held.extend(fs::read_dir(home.folder()).unwrap().map(|file| fs::read_to_string(file.unwrap().path()).unwrap()));
        let ran = home.cara(arguments);
        assert!(ran.status.success(), "{arguments:?}");
        said.push(all(ran));
    }
    let shown: [&[&str]; 4] =
        [&["show"], &["show", "--json"], &["show", depot.to_str().unwrap()], &["derive", "agv/3", "--json"]];
    said.extend(shown.map(|arguments| home.done(arguments)));
    said.push(home.done(&["show", depot.to_str().unwrap(), "--json"]));
    // Errors neither: each line of the file is cut short in its turn.
    for file in [&depot, &root] {
        let text = fs::read_to_string(file).unwrap();
        for line in text.lines().filter(|line| line.len() > 64) {
            fs::write(file, text.replace(line, &line[..line.len() / 2])).unwrap();
            let ran = home.cara(&if file == &root { vec!["show"] } else { vec!["show", depot.to_str().unwrap()] });
            said.push(String::from_utf8_lossy(&ran.stderr).into_owned());
        }
        fs::write(file, text).unwrap();
    }
    held.extend([depot, root, home.file("agv/1")].map(|file| fs::read_to_string(file).unwrap()));
    let keys = held.iter().flat_map(|text| text.split_whitespace()).filter(|word| word.len() == 64);
    let keys: BTreeSet<_> = keys.collect();
    assert!(keys.len() >= 13, "{}", keys.len());
    for key in keys {
        // Eight digits of a key in a row are no accident.
        let pieces = (0..=56).step_by(8).map(|at| &key[at..at + 8]);
        pieces.for_each(|piece| assert!(said.iter().all(|said| !said.contains(piece)), "{piece} of {key}"));
    }
}

#[test]
fn every_mistake_is_reported() {
    let home = Home::new();
    home.refused(&[], 2, "cara keys");
    home.refused(&["derive", "agv/1"], 1, "`cara keys new-fleet --fleet 0`");
    home.refused(&["new-fleet", "--fleet", "9", "agv/1"], 2, "`cara keys new-fleet --fleet 9 depot/1@m_unit agv/1`");
    fs::write(home.0.path().join("file"), "").unwrap();
    home.refused(&["new-fleet", "--dir", "file"], 1, "the folder file cannot be made");
    home.refused(&["new-fleet", "agv"], 2, "NAME/ID@m_unit for an m_unit");
    home.refused(&["new-fleet", "agv/1@manager"], 2, "0 to 4294967295");
    home.refused(&["new-fleet", "depot/1@m_unit", "--manager", "depot/1"], 2, "leave out --manager");
    assert!(!home.folder().exists());
    let home = Home::with_fleet();
    home.refused(&["new-fleet", "--fleet", "7"], 1, "is there already");
    // Whatever else is wrong, the advice is a command that this fleet takes.
    home.refused(&["new-fleet", "--fleet", "7", "agv/8"], 1, "`cara keys derive --fleet 7 agv/8`");
    home.done(&["derive", "--fleet", "7", "agv/8"]);
    home.refused(
        &["new-fleet", "--fleet", "7", "--dir", ".config/cara/keys", "a/9"],
        1,
        "--dir .config/cara/keys a/9`",
    );
    home.refused(&["derive", "agv/3", "--manager", "agv/1"], 2, "agv/1 is no m_unit of the fleet");
    home.refused(&["show", "--fleet", "8"], 1, "`cara keys new-fleet --fleet 8`");
    home.refused(&["show", "agv/11"], 2, "is no file");
    home.refused(&["show", "absent.keys"], 1, "absent.keys");
    home.done(&["new-fleet", "--fleet", "9"]);
    home.refused(&["show"], 2, "say --fleet 7 or --fleet 9");
    let said = String::from_utf8(home.cara(&["show", "/etc/passwd"]).stderr).unwrap();
    assert!(said.contains("is no file of `cara keys`") && !said.contains("chmod") && !said.contains("chown"), "{said}");
    fs::set_permissions(home.file("agv/1"), fs::Permissions::from_mode(0o640)).unwrap();
    let text = format!("chmod 600 {}", home.file("agv/1").display());
    home.refused(&["show", home.file("agv/1").to_str().unwrap()], 1, &text);
    home.refused(&["rotate", "--fleet", "7"], 1, &text);
    home.refused(&["rotate", "--fleet", "7"], 1, "`cara keys revoke --fleet 7 NODE`");
    home.refused(&["revoke", "--fleet", "7", "agv/9"], 2, "`cara keys show --fleet 7`");
    fs::set_permissions(home.file("agv/1"), fs::Permissions::from_mode(0o600)).unwrap();
    fs::write(home.file("agv/1"), [0xFF; 9]).unwrap();
    home.refused(&["show", home.file("agv/1").to_str().unwrap()], 1, "`cara keys derive --fleet 7`");
    home.done(&["derive", "--fleet", "7"]);
    let error: Value = serde_json::from_slice(&home.cara(&["show", "--fleet", "8", "--json"]).stderr).unwrap();
    assert_eq!((&error["error"]["name"], &error["error"]["exit"]), (&"Keys".into(), &1.into()));
}

#[test]
fn a_root_that_leaked_needs_another_fleet_and_a_list_that_is_missing_a_copy() {
    let home = Home::with_fleet();
    let (root, nodes) = (home.folder().join("fleet-7.root"), home.folder().join("fleet-7.nodes"));
    fs::set_permissions(&root, fs::Permissions::from_mode(0o644)).unwrap();
    home.refused(&["show"], 1, "`cara keys new-fleet --fleet 7 NODE...`");
    let said = String::from_utf8(home.cara(&["show"]).stderr).unwrap();
    assert!(said.contains(&format!("chmod 600 {}", root.display())) && !said.contains("revoke the node"), "{said}");
    fs::set_permissions(&root, fs::Permissions::from_mode(0o600)).unwrap();
    fs::rename(&nodes, home.0.path().join("away")).unwrap();
    home.refused(&["show"], 1, "fleet-7.nodes is missing, the list of fleet 7's nodes");
    home.refused(&["derive", "agv/3"], 1, "`cara keys new-fleet --fleet 7 NODE...`");
}

/// What is in the folder, by name.
fn contents(home: &Home) -> BTreeMap<PathBuf, Vec<u8>> {
    let files = fs::read_dir(home.folder()).unwrap().map(|file| file.unwrap().path());
    files.map(|path| (path.clone(), fs::read(path).unwrap())).collect()
}

#[test]
fn a_file_that_is_refused_is_told_before_anything_is_written() {
    let home = Home::with_fleet();
    let file = home.file("agv/2");
    let text = format!("chmod 600 {}", file.display());
    let mode = |mode| fs::set_permissions(&file, fs::Permissions::from_mode(mode)).unwrap();
    let steps: [&[&str]; 5] =
        [&["derive", "agv/3"], &["revoke", "agv/1"], &["rotate", "--switch"], &["rotate", "--finish"], &["rotate"]];
    for step in steps {
        mode(0o640);
        let before = contents(&home);
        home.refused(step, 1, &text);
        assert!(contents(&home) == before, "{step:?} has changed something");
        mode(0o600);
        home.done(step);
    }
    fs::remove_file(&file).unwrap();
    fs::create_dir(&file).unwrap();
    home.refused(&["revoke", "agv/2"], 1, "is no file");
    home.refused(&["revoke", "agv/3"], 1, "move it away");
    assert!(home.file("agv/3").exists());
}

/// A key file that cannot be read must not prevent a revocation.
#[test]
fn a_file_of_garbage_is_written_again_and_holds_up_no_revocation() {
    let home = Home::with_fleet();
    let long = vec![b'#'; 9 << 20];
    for garbage in [&[0xFF, 0x00, 0xFE][..], b"", b"cara-keys", &long] {
        let before = fs::read(home.file("agv/2")).unwrap();
        fs::write(home.file("agv/2"), garbage).unwrap();
        assert!(home.done(&["derive", "--fleet", "7"]).contains("changed  agv/2"));
        assert!(fs::read(home.file("agv/2")).unwrap() == before);
    }
    fs::write(home.file("agv/1"), [0xFF; 9]).unwrap();
    fs::write(home.file("agv/2"), [0xFF; 9]).unwrap();
    fs::set_permissions(home.file("agv/1"), fs::Permissions::from_mode(0o640)).unwrap();
    home.done(&["revoke", "agv/1"]);
    assert_eq!(generations(&home.ring("agv/2"), "depot/1@m_unit"), [1, 2]);
    assert!(!home.file("agv/1").exists());
}

/// Of forty vehicles and their manager, whose file is longer than what the system lets be written.
fn forty() -> Vec<String> {
    let vehicles = (1..=40).map(|id| format!("agv/{id}"));
    std::iter::once("depot/1@m_unit".to_owned()).chain(vehicles).collect()
}

fn new_fleet(nodes: &[String]) -> Vec<&str> {
    ["new-fleet", "--fleet", "7"].into_iter().chain(nodes.iter().map(String::as_str)).collect()
}

/// Writing fails in the middle.
#[test]
fn a_command_that_cannot_write_all_changes_nothing() {
    let home = Home::new();
    let nodes = forty();
    let ran = home.cut_short(&new_fleet(&nodes));
    assert_eq!(ran.status.code(), Some(1), "{}", String::from_utf8_lossy(&ran.stderr));
    assert!(contents(&home).is_empty(), "{:?}", contents(&home).keys());
    home.done(&new_fleet(&nodes));
    let steps: [&[&str]; 4] = [&["revoke", "agv/1"], &["rotate", "--switch"], &["rotate", "--finish"], &["rotate"]];
    for step in steps {
        let before = contents(&home);
        let ran = home.cut_short(step);
        assert_eq!(ran.status.code(), Some(1), "{step:?}: {}", String::from_utf8_lossy(&ran.stderr));
        assert!(contents(&home) == before, "{step:?} has changed something");
        home.done(step);
    }
}

/// The host went down after the list of nodes, and before a node's file was in its place.
#[test]
fn what_stops_half_way_is_completed_by_the_same_command() {
    let home = Home::with_fleet();
    home.done(&["new-fleet", "--fleet", "9"]);
    let held = || home.ring("depot/1@m_unit").generations().collect::<Vec<_>>();
    let complete = |step: &[&str], other: &[&str]| {
        let before = fs::read(home.file("depot/1@m_unit")).unwrap();
        home.done(step);
        fs::write(home.file("depot/1@m_unit"), before).unwrap();
        home.refused(other, 2, "`cara keys derive --fleet 7` writes the rest");
        let said = home.done(step);
        assert!(said.contains("already") && said.contains("changed  depot/1@m_unit"), "{said}");
        let said = home.done(&["derive", "--fleet", "7"]);
        assert!(said.contains("every file is as it should be"), "{said}");
    };
    complete(&["revoke", "--fleet", "7", "agv/1"], &["rotate", "--fleet", "7", "--switch"]);
    assert_eq!(held(), [1, 2]);
    assert!(generations(&home.ring("depot/1@m_unit"), "agv/1").is_empty());
    let said = home.done(&["revoke", "--fleet", "7", "agv/1"]);
    assert!(said.contains("agv/1 is revoked already") && said.contains("every file is as it should be"), "{said}");
    assert!(said.contains("rotate --fleet 7 --switch"), "{said}");
    assert_eq!(held(), [1, 2]);
    complete(&["rotate", "--fleet", "7", "--switch"], &["rotate", "--fleet", "7", "--finish"]);
    assert_eq!(held(), [2, 1]);
    complete(&["rotate", "--fleet", "7", "--finish"], &["rotate", "--fleet", "7"]);
    assert_eq!(held(), [2]);
    complete(&["rotate", "--fleet", "7"], &["rotate", "--fleet", "7", "--switch"]);
    assert_eq!(held(), [2, 3]);
    home.refused(&["rotate", "--fleet", "7"], 2, "a change to generation 3 is under way");
    // Nor does it hold up a revocation.
    let before = fs::read(home.file("depot/1@m_unit")).unwrap();
    home.done(&["rotate", "--fleet", "7", "--switch"]);
    fs::write(home.file("depot/1@m_unit"), before).unwrap();
    home.done(&["revoke", "--fleet", "7", "agv/2"]);
    assert_eq!(held(), [3, 4]);
}

/// A file system of its own with as many pages, or as many files, as are said; prints the exit code and what is left.
const SMALL_DISK: &str = r#"
mount -t tmpfs -o "$1" none "$2" || exit 9
HOME=$2 "$3" keys --dir "$2" new-fleet --fleet 7 depot/1@m_unit agv/1 agv/2 >/dev/null 2>"$4"
echo "$?"
ls -A "$2"
"#;

#[test]
fn a_new_fleet_on_a_full_disk_is_all_there_or_nothing_is() {
    let folder = TempDir::new().unwrap();
    let (disk, errors) = (folder.path().join("disk"), folder.path().join("errors"));
    fs::create_dir(&disk).unwrap();
    let kinds: [&[&str]; 2] = [&["--mount"], &["--user", "--map-root-user", "--mount"]];
    let run = |kind: &[&str], options: &str| {
        let mut command = Command::new("unshare");
        command.args(kind).args(["sh", "-c", SMALL_DISK, "sh", options]).arg(&disk).arg(env!("CARGO_BIN_EXE_cara"));
        command.arg(&errors).env_remove("XDG_CONFIG_HOME").env_remove("CARA_KEYS").output()
    };
    let works = |kind: &&[&str]| run(kind, "size=1m").is_ok_and(|ran| ran.status.success());
    let Some(kind) = kinds.into_iter().find(works) else {
        return cara_processes::skip("this user cannot mount a file system in a namespace");
    };
    let mut ends = BTreeSet::new();
    let pages = (1..=8).map(|pages| format!("size={}k", 4 * pages));
    // The folder is one of them.
    let files = (1..=8).map(|files| format!("nr_inodes={files}"));
    for options in pages.chain(files) {
        let ran = run(kind, &options).unwrap();
        let said = String::from_utf8(ran.stdout).unwrap();
        let (code, left) = said.split_once('\n').unwrap();
        let (left, error) = (left.lines().count(), fs::read_to_string(&errors).unwrap());
        match code {
            "0" => assert_eq!(left, 5, "{options}: {said}"),
            "1" => assert!(left == 0 && error.contains("No space left"), "{options}: {said}{error}"),
            _ => panic!("{options}: {said}{error}"),
        }
        ends.insert(code.to_owned());
    }
    assert_eq!(ends.len(), 2, "some disks are too small, and some are not");
}

/// Ctrl-C and SIGTERM while files are being written.
#[test]
fn a_new_fleet_that_is_interrupted_is_all_there_or_nothing_is() {
    let nodes: Vec<_> =
        std::iter::once("depot/1@m_unit".to_owned()).chain((1..=300).map(|id| format!("agv/{id}"))).collect();
    let mut codes = BTreeSet::new();
    for (round, signal) in ["INT", "TERM"].into_iter().cycle().take(12).enumerate() {
        let home = Home::new();
        fs::create_dir_all(home.folder()).unwrap();
        let mut command = Command::new(env!("CARGO_BIN_EXE_cara"));
        command.arg("keys").args(new_fleet(&nodes)).env("HOME", home.0.path()).stdout(Stdio::null());
        command.env_remove("XDG_CONFIG_HOME").env_remove("CARA_KEYS").stderr(Stdio::null());
        let mut child = command.spawn().unwrap();
        let written = || fs::read_dir(home.folder()).unwrap().count();
        while written() <= round * 30 && child.try_wait().unwrap().is_none() {}
        let _ = Command::new("sh").args(["-c", &format!("kill -{signal} {} 2>&1", child.id())]).output();
        let code = child.wait().unwrap().code();
        let left = contents(&home);
        match code {
            Some(0) => assert_eq!(left.len(), nodes.len() + 2),
            Some(130 | 143) => assert!(left.is_empty(), "{:?}", left.keys()),
            code => panic!("{code:?}"),
        }
        codes.insert(code);
    }
    assert!(codes.len() > 1 || !codes.contains(&Some(0)), "it was never interrupted: {codes:?}");
}

/// Killed, or without power: what is there is of a root that is there, and one command writes the rest.
#[test]
fn a_new_fleet_that_is_killed_leaves_no_keys_without_a_root() {
    let nodes: Vec<_> =
        std::iter::once("depot/1@m_unit".to_owned()).chain((1..=300).map(|id| format!("agv/{id}"))).collect();
    let mut half = 0;
    for _ in 0..12 {
        let home = Home::new();
        fs::create_dir_all(home.folder()).unwrap();
        let mut command = Command::new(env!("CARGO_BIN_EXE_cara"));
        command.arg("keys").args(new_fleet(&nodes)).env("HOME", home.0.path()).stdout(Stdio::null());
        let mut child = command.env_remove("XDG_CONFIG_HOME").env_remove("CARA_KEYS").spawn().unwrap();
        let rings = || {
            let files = fs::read_dir(home.folder()).unwrap().flatten();
            files.filter(|file| file.file_name().to_string_lossy().ends_with("-7.keys")).count()
        };
        while rings() == 0 && child.try_wait().unwrap().is_none() {}
        child.kill().unwrap();
        child.wait().unwrap();
        half += usize::from(rings() < nodes.len());
        home.done(&["derive", "--fleet", "7"]);
        assert_eq!(rings(), nodes.len());
        home.ring("depot/1@m_unit");
    }
    println!("{half} of 12 were half done");
    let home = Home::with_fleet();
    fs::remove_file(home.folder().join("fleet-7.root")).unwrap();
    home.refused(&["show", "--fleet", "7"], 1, "`cara keys new-fleet --fleet 7 depot/1@m_unit agv/1 agv/2`");
}

#[test]
fn another_folder_is_another_store() {
    let home = Home::with_fleet();
    let other = home.0.path().join("other folder");
    home.done(&["--dir", other.to_str().unwrap(), "new-fleet", "--fleet", "7", "depot/1@m_unit"]);
    assert!(other.join("depot-1-m_unit-7.keys").exists());
    let ran = Command::new(env!("CARGO_BIN_EXE_cara"))
        .args(["keys", "show", "--json"])
        .env("CARA_KEYS", &other)
        .output()
        .unwrap();
    let shown: Value = serde_json::from_slice(&ran.stdout).unwrap();
    assert_eq!(shown["nodes"].as_array().unwrap().len(), 1);
}

/// What a guide shows after `$ `, run in order, prints what it shows; keys are drawn, so their fingerprints differ.
#[test]
fn the_guide_shows_what_is_printed() {
    let home = Home::new();
    let text = fs::read_to_string(Path::new(env!("CARGO_MANIFEST_DIR")).join(GUIDE)).unwrap();
    let blocks: Vec<_> = text.split("```console\n").skip(1).map(|block| block.split("```").next().unwrap()).collect();
    assert!(blocks.len() >= 5);
    for block in blocks {
        let (line, expected) = block.strip_prefix("$ cara keys ").unwrap().split_once('\n').unwrap();
        let printed = home.done(&line.split(' ').collect::<Vec<_>>());
        let printed = printed.replace(home.0.path().to_str().unwrap(), "/home/me");
        assert_eq!(without_fingerprints(&printed), without_fingerprints(expected), "cara keys {line}");
    }
}

/// A program in Python, written from the guide, makes the same files out of the root and the list.
#[test]
fn what_the_guide_says_about_files_is_enough_to_make_them() {
    let home = Home::with_fleet();
    home.done(&["derive", "hall/2@m_unit", "it's long/3", "--manager", "hall/2", "--manager", "depot/1"]);
    home.done(&["revoke", "agv/2"]);
    home.done(&["derive", "agv/2", "--manager", "depot/1"]);
    home.done(&["rotate", "--switch"]);
    let program = Path::new(env!("CARGO_MANIFEST_DIR")).join("../../tests/vectors/cara_keys.py");
    for node in ["depot/1@m_unit", "hall/2@m_unit", "agv/1", "agv/2", "it's long/3"] {
        let node = named(node);
        let role = if node.role() == Role::MUnit { "m_unit" } else { "s_unit" };
        let made = Command::new("python3")
            .arg(&program)
            .arg(home.folder())
            .args(["7", role, &node.id().to_string(), node.name()])
            .output();
        let Ok(made) = made else {
            return cara_processes::skip("python3 is not installed");
        };
        assert!(made.status.success(), "{}", String::from_utf8_lossy(&made.stderr));
        let file = fs::read_to_string(home.folder().join(location::file_name(&node, Fleet(7)))).unwrap();
        assert_eq!(String::from_utf8(made.stdout).unwrap(), file);
    }
}

#[test]
fn the_guide_s_keys_come_from_its_root() {
    let text = fs::read_to_string(Path::new(env!("CARGO_MANIFEST_DIR")).join(GUIDE)).unwrap();
    let (root, hex) =
        (RootKey::new([7; 32]), |bytes: &[u8]| bytes.iter().map(|byte| format!("{byte:02x}")).collect::<String>());
    let pair = root.pair(Fleet(3), 1, &named("agv/17"), &named("depot/1@m_unit"));
    for shown in [hex(pair.expose()), hex(root.discovery(Fleet(3), 1).expose()), hex(&root.fingerprint())] {
        assert!(text.contains(&format!("| `{shown}` |")), "{shown}");
    }
}

#[test]
fn the_reference_has_every_key_of_the_json() {
    let reference = fs::read_to_string(Path::new(env!("CARGO_MANIFEST_DIR")).join("../../docs/cara.md")).unwrap();
    let section = reference.split("## `cara keys`").nth(1).unwrap().split("\n## ").next().unwrap();
    let words: Vec<_> = section.split(|c: char| !c.is_ascii_alphanumeric()).collect();
    let home = Home::with_fleet();
    let file = home.file("depot/1@m_unit");
    let reported =
        [home.json(&["revoke", "agv/1"]), home.json(&["show"]), home.json(&["show", file.to_str().unwrap()])];
    for reported in reported.map(|reported| reported.to_string()) {
        let keys: Vec<_> = reported
            .split("\":")
            .filter_map(|before| before.rsplit('"').next())
            .filter(|key| !key.contains('}'))
            .collect();
        assert!(keys.len() > 3);
        keys.iter().for_each(|key| assert!(words.contains(key), "{key} is not in docs/cara.md"));
    }
}

/// With every word of 12 hexadecimal digits as the same one.
fn without_fingerprints(text: &str) -> String {
    let is_one = |word: &str| word.len() == 12 && word.chars().all(|c| c.is_ascii_hexdigit());
    let pieces = text.split_inclusive(|c: char| !c.is_ascii_alphanumeric());
    let replaced = pieces.map(|piece| {
        let word = piece.trim_end_matches(|c: char| !c.is_ascii_alphanumeric());
        if is_one(word) { piece.replace(word, "FINGERPRINT") } else { piece.to_owned() }
    });
    replaced.collect()
}

/// What the file of the vehicle's node says.
const VEHICLE: &str = "\
name = \"agv\"
id = 1
role = \"s_unit\"
interfaces = \"lo\"
manager = { name = \"depot\", id = 1 }
[[functions]]
signature = \"echo(n: int) -> (n: int)\"
answer = \"echo\"
";

/// A node finds its keys where `cara keys` has put them; from then on a peer without keys cannot reach it.
#[test]
fn a_node_takes_the_keys_that_are_there_and_is_called_with_keys_alone() {
    let home = Home::new();
    let fleet = cara_processes::random_fleet().to_string();
    home.done(&["new-fleet", "--fleet", &fleet, "depot/1@m_unit", "agv/1"]);
    fs::write(home.0.path().join("agv.toml"), VEHICLE).unwrap();
    let cara = |arguments: &[&str], home: &Path| {
        let mut command = Command::new(env!("CARGO_BIN_EXE_cara"));
        command
            .args(["--fleet", &fleet, "--loopback"])
            .args(arguments)
            .env("HOME", home)
            .env("CARA_CONTROL_DIR", home.join("control"));
        command.env_remove("XDG_CONFIG_HOME").env_remove("CARA_KEYS").current_dir(home);
        command
    };
    let node = cara(&["node", "agv.toml"], home.0.path()).stdout(Stdio::piped()).spawn().unwrap();
    let mut node = Ended(node);
    let mut up = String::new();
    BufReader::new(node.0.stdout.take().unwrap()).read_line(&mut up).unwrap();
    assert!(up.contains("discovery port 21971"), "{up}");

    let call = ["--as", "depot/1", "call", "agv", "echo(n: 3)"];
    let called = cara(&[&["--wait", "30s"], &call[..]].concat(), home.0.path()).output().unwrap();
    assert!(called.status.success(), "{}", String::from_utf8_lossy(&called.stderr));
    assert_eq!(String::from_utf8(called.stdout).unwrap().trim(), "echo(n: 3)");
    let stranger = Home::new();
    let called = cara(&[&["--wait", "2s"], &call[..]].concat(), stranger.0.path()).output().unwrap();
    assert_eq!(called.status.code(), Some(1), "{}", String::from_utf8_lossy(&called.stdout));
    fs::set_permissions(home.folder().join(format!("depot-1-m_unit-{fleet}.keys")), PermissionsExt::from_mode(0o640))
        .unwrap();
    let called = cara(&call, home.0.path()).output().unwrap();
    let said = String::from_utf8_lossy(&called.stderr).into_owned();
    assert!(called.status.code() == Some(1) && said.contains("chmod 600"), "{said}");
}

/// A process that ends with the test.
struct Ended(Child);

impl Drop for Ended {
    fn drop(&mut self) {
        let _ = self.0.kill();
        let _ = self.0.wait();
    }
}
