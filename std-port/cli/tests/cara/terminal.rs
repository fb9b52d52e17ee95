//! A command on a pseudo-terminal. The unit tests of `cara top` use this file too.

use std::fs::File;
use std::io::{Read, Write};
use std::num::NonZero;
use std::os::fd::OwnedFd;
use std::process::{Child, Command, Stdio};
use std::time::{Duration, Instant};

use rustix::fs::{Mode, OFlags};
use rustix::process::{Pid, Signal, kill_process};
use rustix::pty::{OpenptFlags, grantpt, openpt, ptsname, unlockpt};
use rustix::termios::{LocalModes, Winsize, tcgetattr, tcsetwinsize};

/// Longest wait for anything that is to happen.
const PATIENCE: Duration = Duration::from_secs(30);
/// Between two looks.
const LOOK: Duration = Duration::from_millis(20);
const SIZE: (u16, u16) = (80, 24);
const OF_A_SHELL: LocalModes = LocalModes::ICANON.union(LocalModes::ECHO).union(LocalModes::ISIG);

/// A new terminal: our end, and that of a command. No child of another test keeps an end of it open.
pub(crate) fn pair() -> (OwnedFd, OwnedFd) {
    let flags = OpenptFlags::RDWR | OpenptFlags::NOCTTY | OpenptFlags::CLOEXEC;
    let master = openpt(flags).unwrap();
    grantpt(&master).unwrap();
    unlockpt(&master).unwrap();
    let path = ptsname(&master, Vec::new()).unwrap();
    let flags = OFlags::RDWR | OFlags::NOCTTY | OFlags::CLOEXEC;
    let slave = rustix::fs::open(&path, flags, Mode::empty()).unwrap();
    (master, slave)
}

/// A command and its terminal.
pub(crate) struct OnTerminal {
    child: Child,
    /// What it prints comes from here, and what is typed goes into it.
    terminal: Option<File>,
    slave: OwnedFd,
    screen: vt100::Parser,
}

impl OnTerminal {
    /// Starts the command, with 80 columns and 24 rows.
    pub(crate) fn start(command: &Command) -> Self {
        let (master, slave) = pair();
        rustix::io::ioctl_fionbio(&master, true).unwrap();
        tcsetwinsize(&master, size(SIZE)).unwrap();
        // The terminal is its controlling one, so that a hang-up is told.
        let mut leader = Command::new("setsid");
        leader.arg("--ctty").arg(command.get_program()).args(command.get_args());
        for (name, value) in command.get_envs() {
            match value {
                Some(value) => leader.env(name, value),
                None => leader.env_remove(name),
            };
        }
        let stdio = || Stdio::from(slave.try_clone().unwrap());
        let child = leader.stdin(stdio()).stdout(stdio()).stderr(stdio()).spawn().unwrap();
        let screen = vt100::Parser::new(cells(SIZE.1), cells(SIZE.0), 0);
        Self { child, terminal: Some(File::from(master)), slave, screen }
    }

    /// Gives its window another size.
    pub(crate) fn resize(&mut self, columns: u16, rows: u16) {
        tcsetwinsize(self.terminal.as_ref().unwrap(), size((columns, rows))).unwrap();
        self.screen.screen_mut().set_size(cells(rows), cells(columns));
    }

    /// As it was read last.
    pub(crate) fn screen(&self) -> &vt100::Screen {
        self.screen.screen()
    }

    /// What the terminal does with keys by itself, of all that a shell wants: nothing while it is taken over.
    pub(crate) fn of_keys(&self) -> LocalModes {
        tcgetattr(&self.slave).unwrap().local_modes & OF_A_SHELL
    }

    fn read(&mut self) -> String {
        let mut bytes = [0; 16_384];
        while let Some(Ok(count @ 1..)) = self.terminal.as_mut().map(|terminal| terminal.read(&mut bytes)) {
            self.screen.process(&bytes[..count]);
        }
        self.screen().contents()
    }

    /// Waits until the screen is as wanted.
    #[track_caller]
    pub(crate) fn until(&mut self, what: &str, wanted: impl Fn(&str) -> bool) -> String {
        let start = Instant::now();
        loop {
            let shown = self.read();
            if wanted(&shown) {
                return shown;
            }
            assert!(start.elapsed() < PATIENCE, "not shown: {what}\n{shown}");
            std::thread::sleep(LOOK);
        }
    }

    #[track_caller]
    pub(crate) fn shows(&mut self, text: &str) -> String {
        self.until(text, |shown| shown.contains(text))
    }

    pub(crate) fn type_in(&mut self, keys: &str) {
        self.terminal.as_mut().unwrap().write_all(keys.as_bytes()).unwrap();
    }

    /// Its exit code; the terminal is as it was before.
    #[track_caller]
    pub(crate) fn ends_restored(&mut self) -> i32 {
        let code = self.ends();
        self.read();
        let screen = self.screen();
        assert!(!screen.alternate_screen() && !screen.hide_cursor() && !screen.bracketed_paste());
        assert_eq!(self.of_keys(), OF_A_SHELL);
        code
    }

    /// The terminal itself goes, and the command ends.
    #[track_caller]
    pub(crate) fn hang_up(mut self) {
        self.terminal = None;
        self.ends();
    }

    #[track_caller]
    fn ends(&mut self) -> i32 {
        let start = Instant::now();
        loop {
            self.read();
            if let Some(status) = self.child.try_wait().unwrap() {
                return status.code().unwrap_or(-1);
            }
            assert!(start.elapsed() < PATIENCE, "it does not end");
            std::thread::sleep(LOOK);
        }
    }

    pub(crate) fn signal(&self, signal: Signal) {
        kill_process(Pid::from_child(&self.child), signal).unwrap();
    }
}

impl Drop for OnTerminal {
    fn drop(&mut self) {
        // One that has ended cannot be killed, which is what is wanted.
        let _ = self.child.kill();
        let _ = self.child.wait();
    }
}

fn size((columns, rows): (u16, u16)) -> Winsize {
    Winsize { ws_col: columns, ws_row: rows, ws_xpixel: 0, ws_ypixel: 0 }
}

fn cells(count: u16) -> NonZero<u16> {
    NonZero::new(count).unwrap()
}
