//! Modes and keys that keep a node and its manager apart.

use std::fs::{Permissions, copy, read_to_string, set_permissions, write};
use std::os::unix::fs::PermissionsExt;

use cara_std::control::Control;
use cara_std::keys::Store;
use cara_std::{Builder, CommunicationSystem, Identity, MUnit};

use crate::support::{Clinic, draw, private_directory, until};

fn boss() -> Identity {
    Identity::m_unit("boss", 1).unwrap()
}

fn agv() -> Identity {
    Identity::s_unit("agv", 7).unwrap()
}

/// The manager `boss/1` with what else is said of it, running.
fn manager(clinic: &Clinic, with: impl FnOnce(Builder<(), MUnit>) -> Builder<(), MUnit>) -> CommunicationSystem {
    let manager = with(clinic.system("boss")).build().unwrap();
    manager.start().unwrap();
    manager
}

#[test]
fn a_plain_node_of_a_secured_manager_and_the_other_way_round_is_told() {
    let clinic = Clinic::new();
    let secured = manager(&clinic, |boss| boss);
    let _agv = clinic.started(clinic.unit("agv", 7, "boss").insecure());
    for reported in [clinic.doctor(&["agv"]), clinic.doctor_elsewhere(&["agv"]), clinic.doctor(&[])] {
        reported.is(&["mode-mismatch"], 4);
        assert!(
            reported.found(0).contains("agv/7 at ") && reported.found(0).contains("boss/1 is secured"),
            "{reported:?}"
        );
    }
    secured.stop();
    let clinic = Clinic::new();
    let _plain = manager(&clinic, |boss| boss.insecure());
    let _agv = clinic.started(clinic.unit("agv", 7, "boss"));
    for reported in [clinic.doctor(&["agv"]), clinic.doctor_elsewhere(&["agv"]), clinic.doctor(&[])] {
        reported.is(&["mode-mismatch"], 4);
        assert!(reported.found(0).contains("boss/1 is in plain mode"), "{reported:?}");
    }
}

#[test]
fn without_keys_of_the_fleet_the_doctor_says_so_with_the_command() {
    let clinic = Clinic::new();
    let nothing = private_directory();
    let reported = clinic.doctor_with_keys(nothing.path(), &["agv", "--listen", "3s"]);
    reported.is(&["keys-missing", "not-heard"], 4);
    assert!(reported.advice(0).contains(&format!("`cara keys new-fleet --fleet {} ", clinic.fleet)), "{reported:?}");
    clinic.doctor_with_keys(nothing.path(), &["--listen", "3s"]).is(&["keys-missing", "no-manager"], 4);
    // Plain mode needs no keys.
    clinic.doctor_with_keys(nothing.path(), &["agv", "--listen", "3s", "--insecure"]).is(&["not-heard"], 4);
    clinic.doctor(&["agv", "--listen", "3s"]).is(&["not-heard"], 4);
}

#[test]
fn keys_of_another_root_are_told_of_the_node_and_of_its_manager() {
    let clinic = Clinic::new();
    let others = draw(clinic.fleet);
    let ours = manager(&clinic, |boss| boss);
    let vehicle = clinic.started(clinic.unit("agv", 7, "boss").keys(others.ring(&agv()).unwrap()));
    for reported in [clinic.doctor(&["agv"]), clinic.doctor(&[])] {
        reported.is(&["wrong-keys"], 4);
        assert!(reported.found(0).starts_with("agv/7 at "), "{reported:?}");
        let advice = reported.advice(0);
        assert!(advice.contains(&format!("`cara keys show --fleet {}`", clinic.fleet)), "{reported:?}");
        assert!(advice.contains("do nothing") && !advice.contains("derive"), "it may have been revoked: {reported:?}");
    }
    // Its file is here as well, of a root that has changed its keys: two roots are not two generations of one.
    vehicle.stop();
    let mut others = others;
    others.rotate().unwrap();
    others.switch().unwrap();
    others.finish().unwrap();
    let theirs = others.ring(&agv()).unwrap();
    let folder = private_directory();
    let store = Store::create(folder.path(), others).unwrap();
    store.save().unwrap();
    copy(store.file_of(&agv()), clinic.key_file_of(&agv())).unwrap();
    let _agv = clinic.started(clinic.unit("agv", 7, "boss").keys(theirs));
    let reported = clinic.doctor(&["agv"]);
    reported.is(&["wrong-keys"], 4);
    assert!(reported.found(0).contains("different keys of fleet"), "{reported:?}");
    ours.stop();
    let clinic = Clinic::new();
    // Its socket is another one's, as of a manager of another host.
    let others = draw(clinic.fleet).ring(&boss()).unwrap();
    let _far = manager(&clinic, |boss| boss.keys(others).control(Control::Off));
    let _agv = clinic.started(clinic.unit("agv", 7, "boss"));
    let reported = clinic.doctor(&["agv"]);
    reported.is(&["wrong-keys"], 4);
    assert!(reported.found(0).starts_with("boss/1 at "), "{reported:?}");
}

#[test]
fn a_node_that_the_managers_file_does_not_have_is_told() {
    let clinic = Clinic::new();
    let mut without = clinic.root();
    without.revoke(&[agv()]).unwrap();
    let manager = manager(&clinic, |system| system.keys(without.ring(&boss()).unwrap()));
    let _agv = clinic.started(clinic.unit("agv", 7, "boss"));
    until("it was refused", || !manager.findings().is_empty());
    for reported in [clinic.doctor(&["agv"]), clinic.doctor(&["--listen", "3s"])] {
        reported.is(&["no-pair-key"], 4);
        assert!(reported.found(0).contains("agv/7"), "{reported:?}");
    }
}

#[test]
fn a_change_of_keys_that_left_a_node_behind_is_told() {
    let clinic = Clinic::new();
    let old = clinic.ring(&agv());
    let mut store = clinic.store();
    store.keys_mut().rotate().unwrap();
    store.keys_mut().switch().unwrap();
    store.keys_mut().finish().unwrap();
    store.save().unwrap();
    drop(store);
    let _manager = manager(&clinic, |boss| boss);
    let _agv = clinic.started(clinic.unit("agv", 7, "boss").keys(old));
    for reported in [clinic.doctor(&["agv"]), clinic.doctor(&[])] {
        reported.is(&["key-generations"], 4);
        assert!(
            reported.found(0).contains("with generation 1 ") && reported.found(0).contains("generation 2:"),
            "{reported:?}"
        );
    }
    // As on another host: both were heard, and neither takes the other.
    clinic.doctor_elsewhere(&["agv"]).is(&["key-generations"], 4);
}

#[test]
fn a_key_file_that_others_can_read_is_told_with_the_command() {
    let clinic = Clinic::new();
    let _manager = clinic.manager_of_few_files(2048);
    until("it is up", || clinic.doctor(&["boss", "--listen", "0s"]).ids() == ["answers"]);
    let file = clinic.key_file("boss");
    set_permissions(&file, Permissions::from_mode(0o644)).unwrap();
    let reported = clinic.doctor(&["--listen", "3s"]);
    reported.is(&["key-file-refused"], 4);
    assert!(reported.found(0).contains("chmod 600"), "{reported:?}");
    // Copied in text mode, or opened by an editor of Windows.
    set_permissions(&file, Permissions::from_mode(0o600)).unwrap();
    write(&file, read_to_string(&file).unwrap().replace('\n', "\r\n")).unwrap();
    let reported = clinic.doctor(&["--listen", "0s"]);
    reported.is(&["key-file-refused"], 4);
    assert!(reported.found(0).contains("the lines end with CR LF"), "{reported:?}");
    // With this key file only, and no other node: the file explains why nothing is heard.
    let clinic = Clinic::new();
    set_permissions(clinic.key_file("boss"), Permissions::from_mode(0o644)).unwrap();
    let reported = clinic.doctor_with_keys(&clinic.key_file("boss"), &["agv", "--listen", "3s"]);
    reported.is(&["key-file-refused", "not-heard"], 4);
}

#[test]
fn a_fleet_in_plain_mode_is_looked_at_in_plain_mode() {
    let clinic = Clinic::new();
    let nothing = private_directory();
    let plain = manager(&clinic, |boss| boss.insecure());
    let _agv = clinic.started(clinic.unit("agv", 7, "boss").insecure());
    until("it has come", || plain.number_of_s_units() == 1);
    clinic.doctor_with_keys(nothing.path(), &["agv"]).is(&["connected"], 0);
    clinic.doctor_with_keys(nothing.path(), &["--listen", "3s", "--insecure"]).is(&[], 0);
    clinic.doctor_elsewhere(&["boss", "--insecure"]).is(&["answers"], 0);
}
