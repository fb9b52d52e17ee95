//! The emulated board as one of the vehicles: QEMU behind a virtual cable.

use std::path::{Path, PathBuf};
use std::process::{Command, Stdio};
use std::time::Duration;

use anyhow::{Context, Result, ensure};
use cara_std::Identity;
use cara_std::keys::location::file_name;

use crate::map::Cell;
use crate::network::{MANAGER, Network, vehicle_id, vehicle_name};

/// How a board is had.
#[derive(clap::Args, Clone, Debug)]
#[group(requires_all = ["board", "cable", "address"], multiple = true)]
pub(super) struct BoardOptions {
    /// The last vehicle is an emulated board with this image: `cargo xtask demo --warehouse --board` builds it.
    #[arg(long, value_name = "IMAGE")]
    board: Option<PathBuf>,
    /// The virtual Ethernet device (tap) that it is connected to, which is up and has an address.
    #[arg(long)]
    cable: Option<String>,
    /// The board's address there, as `10.77.0.2/24`.
    #[arg(long)]
    address: Option<String>,
}

/// The board that is the last of the vehicles.
#[derive(Clone, Debug)]
pub(super) struct Board {
    image: PathBuf,
    cable: String,
    address: String,
    /// Its number among the vehicles.
    pub(super) number: u32,
    /// Where it stands at first.
    at: Cell,
}

impl Board {
    /// The board of the options, if they have one.
    pub(super) fn of(BoardOptions { board, cable, address }: &BoardOptions, number: u32, at: Cell) -> Option<Self> {
        let (image, cable, address) = (board.clone()?, cable.clone()?, address.clone()?);
        Some(Self { image, cable, address, number, at })
    }

    /// Puts power on it. `folder` has the keys of all.
    pub(super) fn start(&self, folder: &Path, fleet: Network) -> Result<Command> {
        let reported = folder.join("told");
        self.provision(folder, fleet, &reported)?;
        let Cell { x, y } = self.at;
        let words = format!("file={} boots={} at={x},,{y}", reported.display(), folder.join("boots").display());
        let mut emulator = Command::new("setpriv");
        emulator
            .args(["--pdeathsig", "KILL", "qemu-system-arm", "-M", "lm3s6965evb", "-display", "none"])
            .args(["-monitor", "none", "-serial", "none", "-semihosting-config"])
            .arg(format!("enable=on,target=native,arg=warehouse,arg={words}"))
            .arg("-kernel")
            .arg(&self.image)
            .arg("-nic")
            .arg(format!("tap,ifname={},script=no,downscript=no,model=stellaris,mac=52:54:00:00:00:02", self.cable));
        Ok(emulator)
    }

    /// Its settings and keys in a file, made as a user makes them.
    fn provision(&self, folder: &Path, network: Network, reported: &Path) -> Result<()> {
        let (name, id, fleet) = (vehicle_name(self.number), vehicle_id(self.number), network.fleet.to_string());
        let keys = folder.join("keys").join(file_name(&Identity::s_unit(&name, id)?, cara_std::Fleet(network.fleet)));
        let cara = std::env::current_exe()?.with_file_name("cara");
        let mut command = Command::new(&cara);
        command.args(["provision", "lm3s6965evb", "--name", &name, "--id", &id.to_string(), "--fleet", &fleet]);
        command.args(["--manager", &format!("{}/{}", MANAGER.0, MANAGER.1), "--address", &self.address]);
        command.arg("--keys").arg(keys).arg("--output").arg(reported).stdin(Stdio::null());
        let output = command.output().with_context(|| format!("cannot start {}", cara.display()))?;
        ensure!(output.status.success(), "cara provision: {}", String::from_utf8_lossy(&output.stderr));
        Ok(())
    }
}

/// Lines of the board's log as those of other vehicles: its microseconds on the clock of this machine.
#[derive(Debug)]
pub(super) struct Log {
    vehicle: String,
    /// The earliest that its clock can have begun: each line is heard a little after it was written.
    began: Option<Duration>,
}

impl Log {
    pub(super) const fn new(vehicle: String) -> Self {
        Self { vehicle, began: None }
    }

    /// A line that is heard at `now`; `None` for one that is not the board's.
    pub(super) fn line(&mut self, now: Duration, line: &str) -> Option<String> {
        let (micros, what) = line.split_once(' ')?;
        let micros = Duration::from_micros(micros.parse().ok()?);
        let began = now.saturating_sub(micros);
        let began = *self.began.insert(self.began.map_or(began, |known| known.min(began)));
        let at = began + micros;
        Some(format!("{}.{:09} {} {what}", at.as_secs(), at.subsec_nanos(), self.vehicle))
    }
}

#[cfg(test)]
mod tests {
    use super::Log;
    use std::time::Duration;

    #[test]
    fn the_times_of_a_board_are_those_of_the_machine_however_late_a_line_is_heard() {
        let mut log = Log::new("agv-9".to_owned());
        let mut heard = |millis, line| log.line(Duration::from_millis(millis), line);
        assert_eq!(heard(60_150, "100000 enter 1,1").as_deref(), Some("60.150000000 agv-9 enter 1,1"));
        assert_eq!(heard(61_001, "1000000 enter 1,2").as_deref(), Some("61.001000000 agv-9 enter 1,2"));
        assert_eq!(heard(63_500, "2000000 leave 1,1").as_deref(), Some("62.001000000 agv-9 leave 1,1"));
        assert_eq!(heard(64_000, "qemu-system-arm: warning"), None);
    }
}
