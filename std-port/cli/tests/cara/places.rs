//! Where commands find a manager that was started in another environment, or whose control socket has vanished.

use std::fs::{DirBuilder, remove_dir_all};
use std::os::unix::fs::DirBuilderExt;
use std::path::{Path, PathBuf};
use std::process::Command;

use tempfile::TempDir;

use crate::support::{Ran, Running, Stage, agv, private_folder, until};

const NODE: [&str; 5] = ["node", "--name", "manager", "--id", "1"];

/// The folders of a host: that of a login, which the system removes at a logout, and that for temporary files.
struct Host {
    stage: Stage,
    folder: TempDir,
}

impl Host {
    fn new() -> Self {
        let host = Self { stage: Stage::empty(), folder: private_folder() };
        host.stage.know("agv", 21);
        [host.of_login(), host.temporary()].iter().for_each(|folder| make(folder));
        host
    }

    fn of_login(&self) -> PathBuf {
        self.folder.path().join("run")
    }

    fn temporary(&self) -> PathBuf {
        self.folder.path().join("tmp")
    }

    fn command(&self, is_login: bool, arguments: &[&str]) -> Command {
        let mut command = self.stage.command(arguments);
        command.env_remove("CARA_CONTROL_DIR").env_remove("XDG_RUNTIME_DIR").env("TMPDIR", self.temporary());
        if is_login {
            command.env("XDG_RUNTIME_DIR", self.of_login());
        }
        command
    }

    fn start(&self, is_login: bool) -> Running {
        let mut manager = Running::start(self.command(is_login, &NODE));
        manager.expect(" is up: ");
        manager
    }

    fn cara(&self, is_login: bool, arguments: &[&str]) -> Ran {
        Ran::of(self.command(is_login, arguments).output().unwrap())
    }
}

fn make(folder: &Path) {
    DirBuilder::new().mode(0o700).create(folder).unwrap();
}

#[test]
fn a_manager_is_found_from_a_login_and_from_a_service_whichever_started_it() {
    let host = Host::new();
    let nowhere = host.cara(true, &["stop", "--all"]);
    assert_eq!(nowhere.code, 3, "{}", nowhere.everything());
    for place in [host.of_login().join("cara"), host.temporary(), "/run/user/".into(), Path::new("/tmp").join("cara-")]
    {
        nowhere.says(place.to_str().unwrap());
    }
    let vehicle = agv(host.stage.vehicle("agv", 21));
    for by_login in [false, true] {
        let manager = host.start(by_login);
        for login in [false, true] {
            until("it is found", || host.cara(login, &["stop", "--all"]).out.contains("agv/21: NoStop"));
            host.cara(login, &["scan", "--unit", "manager/1"]).says("agv");
        }
        manager.interrupt();
        manager.end();
    }
    vehicle.stop();
}

#[test]
fn a_socket_that_the_system_removes_is_made_again() {
    let host = Host::new();
    let manager = host.start(true);
    let is_found = || host.cara(true, &["scan"]).code == 0;
    let socket = || host.of_login().join("cara").read_dir().is_ok_and(|mut files| files.next().is_some());
    assert!(is_found() && socket());
    // As with the folder of a login.
    remove_dir_all(host.of_login()).unwrap();
    until("it is found again", is_found);
    // As with old files in one for temporary files.
    until("it is in its folder", socket);
    for file in host.of_login().join("cara").read_dir().unwrap() {
        std::fs::remove_file(file.unwrap().path()).unwrap();
    }
    until("it is found once more", || socket() && is_found());
    // Its folder cannot be made again.
    remove_dir_all(host.of_login()).unwrap();
    std::fs::write(host.of_login(), "in the way").unwrap();
    until("it is found elsewhere", is_found);
    host.cara(false, &["scan"]).says("agv");
    manager.interrupt();
    assert_eq!(manager.end(), 0);
    assert_eq!(
        host.temporary()
            .read_dir()
            .unwrap()
            .flatten()
            .filter_map(|folder| folder.path().read_dir().ok()?.next())
            .count(),
        0
    );
}
