//! `cara provision` as a process: what it writes, what it refuses, and what it asks of `probe-rs`, which a script plays.

use std::fs;
use std::os::unix::fs::PermissionsExt;
use std::path::Path;
use std::process::{Command, Output};

use cara_core::distribution::identity::Fleet;
use cara_settings::keys::{Keys, KeysError, newest, of_text};
use cara_settings::page::{BYTES, decode};
use cara_settings::{Settings, board};
use cara_std::Identity;
use cara_std::keys::{FleetKeys, KeyRing, Store};
use tempfile::TempDir;

/// What every board is told here.
const WHO: [&str; 6] = ["--name", "agv-17", "--id", "17", "--manager", "depot/1"];

/// A `probe-rs` that notes what it is asked, reads pages from the folder and writes them there.
const PROBE: &str = r#"#!/bin/sh
echo "$@" >> asked
case "$1" in
read) for last; do address=$before; before=$last; done
      test -f "page-$address" && cp "page-$address" "$5" ;;
download) test ! -f broken && cp "$8" "page-$7" ;;
esac
"#;

fn cara(folder: &Path, arguments: &[&str]) -> Output {
    let mut command = Command::new(env!("CARGO_BIN_EXE_cara"));
    command.arg("provision").args(arguments).current_dir(folder);
    // Only what a test puts there can be started, and what scripts need.
    command.env("PATH", format!("{}:/usr/bin:/bin", folder.join("programs").display()));
    command.output().unwrap()
}

/// The standard output of what must succeed.
fn done(folder: &Path, arguments: &[&str]) -> String {
    let ran = cara(folder, arguments);
    assert!(ran.status.success(), "{arguments:?}: {}", String::from_utf8_lossy(&ran.stderr));
    String::from_utf8(ran.stdout).unwrap()
}

/// Must end with `code` and say `text`.
fn refused(folder: &Path, arguments: &[&str], code: i32, text: &str) {
    let ran = cara(folder, arguments);
    let said = String::from_utf8_lossy(&ran.stderr).into_owned();
    assert_eq!(ran.status.code(), Some(code), "{arguments:?}: {said}");
    assert!(said.contains(text), "{arguments:?}: {said}");
}

fn reported<'a>(board: &'a str, more: &[&'a str]) -> Vec<&'a str> {
    [&[board], &WHO[..], more].concat()
}

fn folder() -> TempDir {
    TempDir::new().unwrap()
}

/// A folder with a `probe-rs`.
fn with_probe() -> TempDir {
    let folder = folder();
    let programs = folder.path().join("programs");
    fs::create_dir(&programs).unwrap();
    fs::write(programs.join("probe-rs"), PROBE).unwrap();
    fs::set_permissions(programs.join("probe-rs"), fs::Permissions::from_mode(0o755)).unwrap();
    folder
}

#[test]
fn a_file_has_what_the_command_line_says() {
    let folder = folder();
    let more = ["--fleet", "7", "--address", "10.0.0.17/24", "--gateway", "10.0.0.1", "--output", "page.bin"];
    let said = done(folder.path(), &reported("nucleo-f767zi", &more));
    assert!(said.contains("0x8180000, generation 1") && said.contains("0x81c0000 would count as newer"), "{said}");
    let page = fs::read(folder.path().join("page.bin")).unwrap();
    let expected: Settings =
        "name=agv-17 id=17 manager=depot/1 fleet=7 address=10.0.0.17/24 gateway=10.0.0.1".parse().unwrap();
    assert_eq!((page.len(), decode(&page)), (BYTES, Ok((expected, 1))));
    let shown = done(folder.path(), &["--read", "page.bin"]);
    assert!(shown.starts_with("generation 1: name=agv-17 id=17 manager=depot/1"), "{shown}");
}

#[test]
fn the_older_copy_is_replaced() {
    let folder = folder();
    done(folder.path(), &reported("rp2040", &["--output", "1.bin"]));
    fs::write(folder.path().join("0.bin"), [0xFF; BYTES]).unwrap();
    let next = |name: &str, first: &str, second: &str| {
        done(folder.path(), &reported("rp2040", &["--output", name, "--json", "--previous", first, second]))
    };
    let second = next("2.bin", "1.bin", "0.bin");
    assert!(second.contains(r#""address":270528512"#) && second.contains(r#""generation":2"#), "{second}");
    let third = next("3.bin", "1.bin", "2.bin");
    assert!(third.contains(r#""address":270524416"#) && third.contains(r#""generation":3"#), "{third}");
    // Power was cut while the first copy was written.
    let mut cut = fs::read(folder.path().join("1.bin")).unwrap();
    cut[20] ^= 1;
    fs::write(folder.path().join("cut.bin"), cut).unwrap();
    let third = next("4.bin", "cut.bin", "2.bin");
    assert!(third.contains(r#""address":270524416"#) && third.contains(r#""generation":3"#), "{third}");
}

#[test]
fn files_that_are_no_pages_of_the_board_are_refused_as_previous() {
    let folder = folder();
    let path = folder.path();
    done(path, &reported("rp2040", &["--output", "1.bin"]));
    done(path, &reported("rp2040", &["--uf2", "--output", "both.uf2"]));
    fs::write(path.join("empty"), "").unwrap();
    fs::write(path.join("half"), [0xFF; BYTES / 2]).unwrap();
    let previous = |file| reported("rp2040", &["--output", "2.bin", "--previous", "1.bin", file]);
    for file in ["/etc/passwd", "both.uf2", "empty", "half"] {
        refused(path, &previous(file), 2, &format!("{file} is neither a copy of settings nor an erased page"));
    }
    refused(path, &previous("1.bin"), 2, "both files hold one page, that of generation 1");
    assert!(!path.join("2.bin").exists());
}

#[test]
fn a_uf2_file_holds_both_copies() {
    let folder = folder();
    for (name, family) in [("rp2040", 0xE48B_FF56_u32), ("rp2350", 0xE48B_FF57)] {
        done(folder.path(), &reported(name, &["--uf2", "--output", "settings.uf2"]));
        let file = fs::read(folder.path().join("settings.uf2")).unwrap();
        let word = |at: usize| u32::from_le_bytes(file[at..at + 4].try_into().unwrap());
        let pages = board::find(name).unwrap().pages;
        assert_eq!((file.len(), [word(12), word(512 + 12)], word(28)), (1024, pages, family));
        assert_eq!(decode(&file[32..288]).unwrap().1 + 1, decode(&file[544..800]).unwrap().1);
        assert_eq!(done(folder.path(), &["--read", "settings.uf2"]).lines().count(), 2);
    }
    refused(folder.path(), &reported("nucleo-h743zi", &["--uf2", "--output", "x"]), 2, "no boot loader that takes UF2");
}

#[test]
fn a_board_on_wifi_is_told_its_access_point() {
    let folder = folder();
    fs::write(folder.path().join("password"), "open sesame\n").unwrap();
    let access = ["--wifi", "hall 3", "--wifi-password-file", "password", "--output", "page.bin"];
    done(folder.path(), &reported("pico2w", &access));
    let page = fs::read(folder.path().join("page.bin")).unwrap();
    let wifi = decode(&page).unwrap().0.wifi.unwrap();
    assert_eq!((wifi.name(), wifi.password()), ("hall 3", "open sesame"));
    let shown = done(folder.path(), &["--read", "page.bin"]);
    assert!(shown.contains("Wi-Fi hall 3") && !shown.contains("sesame"), "{shown}");
    refused(folder.path(), &reported("pico2w", &[]), 2, "name its access point with --wifi");
    refused(folder.path(), &reported("rp2040", &["--wifi", "hall"]), 2, "has no Wi-Fi");
    fs::write(folder.path().join("password"), "short").unwrap();
    refused(folder.path(), &reported("pico2w", &access), 2, "8 to 63 bytes");
    for empty in ["", "\nopen sesame\n"] {
        fs::write(folder.path().join("password"), empty).unwrap();
        refused(folder.path(), &reported("pico2w", &access), 2, "leave --wifi-password-file away");
    }
    done(folder.path(), &reported("pico2w", &["--wifi", "hall 3", "--output", "page.bin"]));
}

#[test]
fn every_mistake_is_reported() {
    let folder = folder();
    let output = ["--output", "page.bin"];
    let long = "n".repeat(33);
    let boards = board::BOARDS.map(|board| board.name);
    refused(folder.path(), &[], 2, "BOARD");
    refused(folder.path(), &reported("toaster", &output), 2, &format!("there are: {}", boards.join(", ")));
    refused(folder.path(), &reported("lm3s6965evb", &[]), 2, "a file of this computer");
    refused(folder.path(), &["rp2040", "--output", "page.bin"], 2, "--name and an --id");
    refused(folder.path(), &["rp2040", "--name", "a"], 2, "--id");
    refused(folder.path(), &["rp2040", "--name", &long, "--id", "1", "--output", "x"], 2, "--name");
    refused(folder.path(), &reported("rp2040", &["--address", "10.0.0.1"]), 2, "10.0.0.17/24");
    refused(folder.path(), &reported("rp2040", &["--gateway", "10.0.0.1", "--output", "x"]), 2, "the server tells");
    let address = ["--address", "10.0.0.1/24", "--gateway", "255.255.255.255", "--output", "page.bin"];
    refused(folder.path(), &reported("rp2040", &address), 2, "no host's address");
    let address = ["--address", "10.0.0.17/24", "--gateway", "10.0.1.1", "--output", "page.bin"];
    refused(
        folder.path(),
        &reported("rp2040", &address),
        2,
        "10.0.1.1 is no other host of the network of 10.0.0.17/24",
    );
    let manager = ["--manager-address", "10.0.0.1:0", "--output", "page.bin"];
    refused(folder.path(), &reported("rp2040", &manager), 2, "port 0 is no port");
    refused(folder.path(), &reported("rp2040", &["--address", "255.255.255.255/24"]), 2, "no address of a host");
    refused(folder.path(), &reported("rp2040", &["--uf2"]), 2, "--output");
    refused(folder.path(), &reported("rp2040", &["--output", "absent/page.bin"]), 1, "cannot write absent/page.bin");
    refused(folder.path(), &["--read", "absent.bin"], 1, "cannot read absent.bin");
    fs::write(folder.path().join("empty.bin"), [0xFF; BYTES]).unwrap();
    refused(folder.path(), &["--read", "empty.bin"], 1, "holds no settings");
    assert!(!folder.path().join("page.bin").exists());
}

#[test]
fn boards_are_listed() {
    let folder = folder();
    let shown = done(folder.path(), &["--list"]);
    for board in board::BOARDS {
        assert!(shown.contains(board.name) && shown.contains(&format!("{:#x}", board.pages[1])), "{shown}");
    }
    for word in ["0x8100000, 0x8140000", "256 KiB", "lm3s6965evb", "mps2-an386"] {
        assert!(shown.contains(word), "{word}: {shown}");
    }
    let json = done(folder.path(), &["--list", "--json"]);
    assert_eq!(json.lines().count(), board::BOARDS.len() + 2);
    assert!(json.contains(r#""starts":[270516224,270520320]"#) && json.contains(r#""pages":null"#), "{json}");
}

#[test]
fn without_a_probe_it_says_what_to_do() {
    refused(folder().path(), &reported("nucleo-f767zi", &[]), 1, "cargo install probe-rs-tools");
}

#[test]
fn the_board_on_the_probe_is_told_and_started_again() {
    let folder = with_probe();
    let path = folder.path();
    let pages = ["page-0x8180000", "page-0x81c0000"].map(|page| path.join(page));
    pages.iter().for_each(|page| fs::write(page, [0xFF; BYTES]).unwrap());
    let fleets = ["1", "2", "3"];
    for fleet in fleets {
        done(path, &reported("nucleo-f767zi", &["--fleet", fleet]));
    }
    let held = pages.map(|page| decode(&fs::read(page).unwrap()).unwrap());
    assert_eq!(held.each_ref().map(|(settings, _)| settings.fleet), [Fleet(3), Fleet(3)]);
    assert_eq!(held.map(|(_, generation)| generation), [5, 6]);
    let asked = fs::read_to_string(path.join("asked")).unwrap();
    assert!(asked.lines().all(|line| line.contains("--chip STM32F767ZITx")), "{asked}");
    assert!(asked.contains("download --chip STM32F767ZITx --binary-format bin --base-address 0x8180000"), "{asked}");
    assert!(asked.ends_with("reset --chip STM32F767ZITx\n"), "{asked}");
    // Wherever that is cut, the board has a sound copy.
    let written: Vec<_> =
        asked.lines().filter(|line| line.starts_with("download")).map(|line| line.contains("0x8180000")).collect();
    assert_eq!(written, [true, false].repeat(fleets.len()), "the older one first: {asked}");
}

/// Keys that were revoked, or those with a manager of before, do not count again when a bit of the newest copy changes.
#[test]
fn no_older_keys_are_left_on_the_board() {
    let folder = with_probe();
    let path = folder.path();
    let (mut store, keys) = with_keys(path);
    let pages = ["page-0x8180000", "page-0x81c0000"].map(|page| path.join(page));
    pages.iter().for_each(|page| fs::write(page, [0xFF; BYTES]).unwrap());
    let provision = || done(path, &["nucleo-f767zi", "--keys", &keys]);
    let held = |page: &Path| held(page).1.discoveries().map(|(number, _)| number).collect::<Vec<_>>();
    provision();
    assert_eq!(pages.each_ref().map(|page| held(page)), [[1], [1]]);
    store.keys_mut().rotate().unwrap();
    store.save().unwrap();
    provision();
    assert_eq!(pages.each_ref().map(|page| held(page).len()), [2, 2]);
    // In a file for another programmer there is one copy, and the other is named.
    let [first, second] = ["page-0x8180000", "page-0x81c0000"];
    let previous = |first, second, more: &[&'static str]| {
        done(path, &[&["rp2040", "--keys", &keys, "--output", "next", "--previous", first, second], more].concat())
    };
    let said = previous(first, second, &[]);
    assert!(said.contains("erase the page at 0x101ff000"), "{said}");
    fs::write(path.join("blank"), [0xFF; BYTES]).unwrap();
    let said = previous("blank", second, &[]);
    assert!(said.contains("erase the page at 0x101ff000"), "{said}");
    assert!(!previous("blank", "blank", &[]).contains("erase"));
    let said = previous(first, second, &["--uf2"]);
    assert!(!said.contains("erase") && said.matches("settings and keys").count() == 2, "{said}");
}

/// An STM32H7 cannot read what it was writing when its power was cut.
#[test]
fn a_page_that_cannot_be_read_is_written_again_with_the_other_one() {
    let folder = with_probe();
    let said = done(folder.path(), &reported("nucleo-h743zi", &[]));
    assert!(said.contains("generation 1") && said.contains("generation 2"), "{said}");
    assert!(folder.path().join("page-0x81c0000").exists() && folder.path().join("page-0x81e0000").exists());
}

#[test]
fn a_probe_that_fails_is_told() {
    let folder = with_probe();
    fs::write(folder.path().join("broken"), "").unwrap();
    refused(folder.path(), &reported("nucleo-h743zi", &[]), 1, "Is the board connected");
}

fn depot() -> Identity {
    Identity::m_unit("depot", 1).unwrap()
}

fn agv() -> Identity {
    Identity::s_unit("agv-17", 17).unwrap()
}

/// Makes fleet 7 with `depot/1` and `agv-17/17` in the folder; the path of the AGV's file.
fn with_keys(folder: &Path) -> (Store, String) {
    let mut store = Store::create(&folder.join("keys"), FleetKeys::draw(Fleet(7)).unwrap()).unwrap();
    [depot(), agv()].iter().for_each(|node| store.keys_mut().add(node, &[]).unwrap());
    store.save().unwrap();
    let file = store.file_of(&agv()).display().to_string();
    (store, file)
}

/// Settings and keys of a file with a page.
fn held(file: &Path) -> (Settings, Keys) {
    newest(&fs::read(file).unwrap(), &[]).unwrap()
}

#[test]
fn a_file_with_keys_tells_who_the_board_is() {
    let folder = folder();
    let (mut store, keys) = with_keys(folder.path());
    store.keys_mut().rotate().unwrap();
    store.save().unwrap();
    let page = folder.path().join("page.bin");
    fs::write(&page, "").unwrap();
    let said = done(folder.path(), &["nucleo-f767zi", "--keys", &keys, "--output", "page.bin"]);
    assert!(said.contains("settings and keys for nucleo-f767zi"), "{said}");
    assert_eq!(fs::metadata(&page).unwrap().permissions().mode() & 0o777, 0o600);
    let (settings, held_keys) = held(&page);
    assert_eq!(settings, "name=agv-17 id=17 manager=depot/1 fleet=7".parse().unwrap());
    let ring = KeyRing::load(Path::new(&keys)).unwrap();
    for (number, key) in ring.pairs(&depot()) {
        let (_, held) = held_keys.pairs(&depot()).find(|(held, _)| *held == number).unwrap();
        assert_eq!(held.expose(), key.expose());
    }
    let discoveries: Vec<_> = held_keys.discoveries().map(|(number, key)| (number, *key.expose())).collect();
    assert_eq!(discoveries, ring.discoveries().map(|(number, key)| (number, *key.expose())).collect::<Vec<_>>());

    let shown = done(folder.path(), &["--read", "page.bin"]);
    assert!(shown.contains("keys of generation 1 and 2 with depot/1@m_unit"), "{shown}");
    let json = done(folder.path(), &["--read", "page.bin", "--json"]);
    assert!(json.contains(r#""keys":{"generations":[1,2],"peers":["depot/1@m_unit"]}"#), "{json}");
    let secrets = [held_keys.secret().expose(), held_keys.pair(&depot()).unwrap().expose()];
    for secret in secrets {
        let digits: String = secret.iter().take(4).map(|byte| format!("{byte:02x}")).collect();
        let numbers = format!("{},{}", secret[0], secret[1]);
        assert!(!shown.contains(&digits) && !json.contains(&digits) && !json.contains(&numbers));
    }
    // Each board gets a secret of its own, also of the same node.
    done(folder.path(), &["nucleo-f767zi", "--keys", &keys, "--output", "other.bin"]);
    assert_ne!(held(&folder.path().join("other.bin")).1.secret().expose(), held_keys.secret().expose());
}

#[test]
fn a_uf2_file_with_keys_holds_both_copies() {
    let folder = folder();
    let (_store, keys) = with_keys(folder.path());
    done(folder.path(), &["rp2040", "--keys", &keys, "--uf2", "--output", "settings.uf2"]);
    let file = fs::read(folder.path().join("settings.uf2")).unwrap();
    let pages = board::find("rp2040").unwrap().pages;
    let word = |block: &[u8], at: usize| u32::from_le_bytes(block[at..at + 4].try_into().unwrap());
    for page in pages {
        let mut copy = [0xFF; BYTES];
        for block in file.chunks(512).filter(|block| (page..page + BYTES as u32).contains(&word(block, 12))) {
            let at = (word(block, 12) - page) as usize;
            copy[at..at + 256].copy_from_slice(&block[32..288]);
        }
        assert!(newest::<1>(&copy, &[]).is_ok());
    }
    assert!(file.chunks(512).enumerate().all(|(number, block)| word(block, 20) == number as u32));
    let shown = done(folder.path(), &["--read", "settings.uf2"]);
    assert_eq!(shown.lines().filter(|line| line.contains("keys of generation 1 with depot/1")).count(), 2, "{shown}");
}

#[test]
fn keys_stay_on_the_board_as_long_as_it_is_the_same_unit() {
    let folder = with_probe();
    let path = folder.path();
    let (_store, keys) = with_keys(path);
    let pages = ["page-0x8180000", "page-0x81c0000"].map(|page| path.join(page));
    pages.iter().for_each(|page| fs::write(page, [0xFF; BYTES]).unwrap());
    done(path, &["nucleo-f767zi", "--keys", &keys]);
    let first = held(&pages[0]).1;
    let said = done(path, &reported("nucleo-f767zi", &["--fleet", "7", "--address", "10.0.0.17/24"]));
    assert!(said.contains("settings and keys"), "{said}");
    let (settings, kept) = held(&pages[1]);
    assert!(settings.to_string().contains("10.0.0.17/24"), "{settings}");
    assert_eq!(kept.secret().expose(), first.secret().expose());
    let said = done(path, &reported("nucleo-f767zi", &["--fleet", "8"]));
    assert!(said.contains("settings without keys"), "{said}");
    assert_eq!(newest::<1>(&fs::read(&pages[0]).unwrap(), &[]).map(drop), Err(KeysError::Absent));
}

#[test]
fn keys_of_another_unit_are_refused() {
    let folder = folder();
    let (mut store, keys) = with_keys(folder.path());
    let with = |more: &[&'static str]| [&["rp2040", "--keys", &keys, "--output", "x"], more].concat();
    refused(folder.path(), &with(&["--fleet", "8"]), 2, "--keys are those of agv-17/17 in fleet 7");
    refused(folder.path(), &with(&["--name", "agv-18", "--id", "17"]), 2, "the board would be agv-18/17");
    let command = "`cara keys derive --fleet 7 agv-17/17 --manager hall/2@m_unit`";
    refused(folder.path(), &with(&["--manager", "hall/2"]), 2, &command.replace("@m_unit", ""));
    let hall = Identity::m_unit("hall", 2).unwrap();
    store.keys_mut().add(&hall, &[]).unwrap();
    store.keys_mut().add(&agv(), &[depot(), hall]).unwrap();
    store.save().unwrap();
    refused(folder.path(), &with(&[]), 2, "say --manager depot/1 or --manager hall/2");
    done(folder.path(), &with(&["--manager", "depot/1", "--manager", "hall/2"]));
    let page = fs::read(folder.path().join("x")).unwrap();
    let (settings, both) = newest::<2>(&page, &[]).unwrap();
    assert_eq!((settings.manager.unwrap().name.as_str(), both.peers().count()), ("depot", 2), "to be handed over");
    assert_eq!(newest::<1>(&page, &[]).map(drop), Err(KeysError::Full));
    let plain =
        ["rp2040", "--name", "agv-17", "--id", "17", "--manager", "depot/1", "--manager", "hall/2", "--insecure"];
    refused(folder.path(), &plain, 2, "with keys only");
    done(folder.path(), &with(&["--manager", "hall/2"]));
    let peers: Vec<_> = held(&folder.path().join("x")).1.peers().map(ToString::to_string).collect();
    assert_eq!(peers, ["hall/2"]);
    fs::set_permissions(&keys, fs::Permissions::from_mode(0o644)).unwrap();
    refused(folder.path(), &with(&[]), 1, "chmod 600");
    refused(folder.path(), &["rp2040", "--keys", "absent.keys", "--output", "y"], 1, "absent.keys");
    assert!(!folder.path().join("y").exists());
}

#[test]
fn the_emulated_board_is_told_by_text() {
    let folder = folder();
    let (_store, keys) = with_keys(folder.path());
    done(folder.path(), &["lm3s6965evb", "--keys", &keys, "--output", "argument"]);
    let file = folder.path().join("argument");
    let text = fs::read_to_string(&file).unwrap();
    assert_eq!(text.parse(), "name=agv-17 id=17 manager=depot/1 fleet=7".parse::<Settings>());
    let held = of_text::<1>(&text).unwrap().unwrap();
    let ring = KeyRing::load(Path::new(&keys)).unwrap();
    assert_eq!(held.pair(&depot()).unwrap().expose(), ring.pair(&depot()).unwrap().expose());
    assert_eq!(fs::metadata(&file).unwrap().permissions().mode() & 0o777, 0o600);
    done(folder.path(), &reported("lm3s6965evb", &["--output", "plain"]));
    let plain = fs::read_to_string(folder.path().join("plain")).unwrap();
    assert_eq!(plain, "name=agv-17 id=17 manager=depot/1 fleet=0 address=dhcp");
    refused(folder.path(), &reported("lm3s6965evb", &["--uf2", "--output", "x"]), 2, "no boot loader that takes UF2");
    let shown = done(folder.path(), &["--read", "argument"]);
    let expected =
        "emulated board: name=agv-17 id=17 manager=depot/1 fleet=7 address=dhcp, keys of generation 1 with depot/1";
    assert_eq!(shown, format!("{expected}@m_unit\n"));
    let json = done(folder.path(), &["--read", "plain", "--json"]);
    assert!(json.contains(r#""generation":null"#) && json.contains(r#""keys":null"#), "{json}");
    fs::write(folder.path().join("cut"), "name=agv-17").unwrap();
    refused(folder.path(), &["--read", "cut"], 1, "id is missing");
}

#[test]
fn words_that_the_emulated_board_would_split_are_refused() {
    let folder = folder();
    let board = |name, manager, file| {
        ["lm3s6965evb", "--name", name, "--id", "17", "--manager", manager, "--output", file].map(str::to_owned)
    };
    for (name, manager, file) in [("agv 17", "depot/1", "x"), ("agv-17", "the depot/1", "x")] {
        let arguments = board(name, manager, file);
        refused(folder.path(), &arguments.each_ref().map(String::as_str), 2, "no name may have a blank");
    }
    for file in ["a file", "a,file", "a\"file"] {
        let arguments = board("agv-17", "depot/1", file);
        refused(folder.path(), &arguments.each_ref().map(String::as_str), 2, "name a path without them");
    }
    assert_eq!(fs::read_dir(folder.path()).unwrap().count(), 0);
}

#[test]
fn what_is_no_file_is_neither_replaced_nor_waited_for() {
    let folder = folder();
    let (_store, keys) = with_keys(folder.path());
    let pipe = folder.path().join("pipe");
    assert!(Command::new("mkfifo").arg(&pipe).status().unwrap().success());
    for board in ["rp2040", "lm3s6965evb"] {
        for output in ["pipe", "keys"] {
            refused(folder.path(), &reported(board, &["--output", output]), 2, "is no file");
            refused(folder.path(), &[board, "--keys", &keys, "--output", output], 2, "is no file");
        }
    }
    refused(folder.path(), &["--read", "pipe"], 1, "it is no file");
    assert!(!fs::metadata(&pipe).unwrap().is_file());
}

#[test]
fn keys_that_are_left_behind_are_told() {
    let folder = folder();
    let (_store, keys) = with_keys(folder.path());
    done(folder.path(), &["rp2040", "--keys", &keys, "--output", "1.bin"]);
    fs::write(folder.path().join("0.bin"), [0xFF; BYTES]).unwrap();
    let previous = ["--output", "2.bin", "--previous", "1.bin", "0.bin"];
    let said = done(folder.path(), &reported("rp2040", &previous));
    assert!(said.contains("the keys of agv-17/17 in fleet 7 that the board had are not kept"), "{said}");
    let said = done(folder.path(), &reported("rp2040", &[&["--fleet", "7"], &previous[..]].concat()));
    assert!(said.contains("settings and keys") && !said.contains("not kept"), "{said}");
}

#[test]
fn an_m_unit_on_a_board_has_keys_with_all_that_fit() {
    let folder = folder();
    let (mut store, _) = with_keys(folder.path());
    let file = store.file_of(&depot()).display().to_string();
    let arguments = ["rp2350", "--keys", &file, "--output", "page.bin"];
    done(folder.path(), &arguments);
    let page = fs::read(folder.path().join("page.bin")).unwrap();
    let (settings, keys) = newest::<8>(&page, &[]).unwrap();
    assert_eq!((settings.identity, keys.peers().count()), (depot(), 1));
    (1..30).for_each(|id| store.keys_mut().add(&Identity::s_unit("agv", id).unwrap(), &[]).unwrap());
    store.save().unwrap();
    refused(folder.path(), &arguments, 2, "with as many as fit");
}
