//! A fleet in motion goes to another version and back: its vehicles one after the other while the rest drive on, its manager by a
//! standby of the other version. What one version has stored, the other one starts with.

use std::collections::BTreeMap;
use std::fs::{self, DirBuilder};
use std::os::unix::fs::DirBuilderExt;
use std::path::Path;
use std::time::{Duration, Instant};

use anyhow::{Context, Result, ensure};
use cara_processes::{Process, random_fleet};
use tempfile::TempDir;

use crate::command::Run;

const VEHICLES: u32 = 20;
const MANAGER: &str = "AGV_manager";
/// How long anything may take that takes a few seconds when the machine has nothing else to do.
const STEP: Duration = Duration::from_secs(60);
/// How many the standby commands: each takes a connection of its control socket.
const BY_STANDBY: usize = 4;
/// Lines of the listing behind which the manager's program waits.
const LISTED: usize = 13;

/// From one version to the other and back.
pub(crate) fn there_and_back(from: &Path, to: &Path) -> Result<()> {
    let mut fleet = Fleet::start(from, to)?;
    fleet.change().context("there")?;
    fleet.change().context("and back")?;
    println!("{VEHICLES} vehicles and their manager changed twice, in {:.0} s", fleet.began.elapsed().as_secs_f64());
    Ok(())
}

struct Fleet<'p> {
    place: Place,
    /// Programs of the version that runs, and of the other one.
    from: &'p Path,
    to: &'p Path,
    vehicles: Vec<Process>,
    /// The paper's program.
    manager: Process,
    /// `cara node` of the same identity and the other version.
    standby: Process,
    /// The highest claim in the folder of each, as a term and a claimant.
    claims: BTreeMap<String, (u64, u64)>,
    began: Instant,
}

impl<'p> Fleet<'p> {
    fn start(from: &'p Path, to: &'p Path) -> Result<Self> {
        let place = Place { fleet: random_fleet().to_string(), folder: tempfile::tempdir()? };
        let cara = from.join("cara").display().to_string();
        let keys = Run::new(&cara).args(["keys", "new-fleet", "--fleet", &place.fleet, &format!("{MANAGER}/1@m_unit")]);
        let nodes = (1..=VEHICLES).map(|id| format!("v-{id}/{id}")).collect::<Vec<_>>();
        keys.args(&nodes).env("CARA_KEYS", &place.folder.path().join("keys").to_string_lossy()).text()?;
        let vehicles = (1..=VEHICLES).map(|id| place.vehicle(from, id)).collect::<Result<Vec<_>>>()?;
        let (manager, standby) = (place.manager(from)?, place.standby(to)?);
        let (claims, began) = (BTreeMap::new(), Instant::now());
        let mut fleet = Self { place, from, to, vehicles, manager, standby, claims, began };
        fleet.all_join()?;
        fleet.drive_all()?;
        Ok(fleet)
    }

    fn all_join(&mut self) -> Result<()> {
        let joined = format!("joined {MANAGER}/1");
        self.vehicles.iter_mut().try_for_each(|vehicle| vehicle.expect(&joined, STEP).map(drop))
    }

    fn all_stop(&mut self) -> Result<()> {
        self.vehicles.iter_mut().try_for_each(|vehicle| vehicle.expect("stopped at", STEP).map(drop))
    }

    /// The program has a vehicle drive so far away that it does not arrive.
    fn drive(&mut self, index: usize) -> Result<()> {
        let vehicle = &mut self.vehicles[index];
        self.manager.send("units")?;
        let units = self.manager.expect("= ", STEP)?.text;
        let of_it = units.split("; ").find(|unit| unit.contains(&format!(" is {}/", vehicle.name())));
        let at = of_it.and_then(|unit| unit.split(' ').next()).with_context(|| format!("it is none of {units}"))?;
        self.manager.send(&format!("go_to {at} 9000 0"))?;
        self.manager.expect("= accepted", STEP)?;
        vehicle.expect("driving to [9000", STEP)?;
        vehicle.expect("passed", STEP)?;
        Ok(())
    }

    fn drive_all(&mut self) -> Result<()> {
        (0..self.vehicles.len()).try_for_each(|index| self.drive(index))
    }

    /// Everything that runs becomes the other version.
    fn change(&mut self) -> Result<()> {
        self.standby.seen("stands by", STEP)?;
        self.note_claims()?;
        for index in 0..self.vehicles.len() {
            let ended = self.vehicles[index].terminate(STEP)?;
            ensure!(ended.success(), "{} ended with {ended}", self.vehicles[index].name());
            self.vehicles[index] = self.place.vehicle(self.to, index as u32 + 1)?;
            self.vehicles[index].expect(&format!("joined {MANAGER}/1"), STEP)?;
            self.drive(index)?;
            self.others_drive_on(index)?;
        }
        self.say("all vehicles changed, one after the other, and the others drove on");
        self.note_claims()?;
        self.manager.kill()?;
        self.all_stop()?;
        self.all_join()?;
        self.command_by_standby()?;
        self.note_claims()?;
        let by_standby = self.claims["two"];
        ensure!(by_standby > self.claims["one"], "the standby claims less: {:?}", self.claims);
        self.say("the manager was killed, and its standby commands");
        self.standby.kill()?;
        (self.from, self.to) = (self.to, self.from);
        (self.manager, self.standby) = (self.place.manager(self.from)?, self.place.standby(self.to)?);
        self.all_join()?;
        self.drive_all()?;
        self.note_claims()?;
        let mut obeyed = self.claims.iter().filter(|(place, _)| *place != "two");
        ensure!(obeyed.all(|(_, claim)| *claim > by_standby), "not all obey the new manager: {:?}", self.claims);
        self.say("the changed manager commands, with what the other version stored");
        self.all_could_read()
    }

    fn command_by_standby(&mut self) -> Result<()> {
        let cara = self.to.join("cara");
        for vehicle in &mut self.vehicles[..BY_STANDBY] {
            let arguments = ["call", vehicle.name(), "go_to(position: [8000, 0])", "--hold", "--detached"];
            let order = self.place.start("two", "order", &cara, &arguments)?;
            let driving = vehicle.expect("driving to [8000", STEP);
            driving.with_context(|| format!("its order says {:?}", order.lines()))?;
            vehicle.expect("passed", STEP)?;
            drop(order);
            vehicle.expect("stopped at", STEP)?;
        }
        Ok(())
    }

    /// Every vehicle but this one passes a further place, and has not stood since it was sent away.
    fn others_drive_on(&mut self, changed: usize) -> Result<()> {
        for (_, vehicle) in self.vehicles.iter_mut().enumerate().filter(|(index, _)| *index != changed) {
            vehicle.expect("passed", STEP)?;
            let lines = vehicle.lines();
            let mut since = lines.iter().rev().take_while(|line| !line.text.starts_with("driving to"));
            let stood = since.any(|line| line.text.starts_with("stopped"));
            ensure!(!stood, "{} stopped while another one changed", vehicle.name());
        }
        Ok(())
    }

    fn say(&self, what: &str) {
        println!("{:>6.1} s  {what}", self.began.elapsed().as_secs_f64());
    }

    /// No claim is below what it was.
    fn note_claims(&mut self) -> Result<()> {
        for place in fs::read_dir(self.place.folder.path())? {
            let place = place?;
            let Ok(files) = fs::read_dir(place.path().join("state")) else { continue };
            for file in files.flatten().filter(|file| file.path().extension().is_some_and(|end| end == "claims")) {
                let name = place.file_name().to_string_lossy().into_owned();
                let text = fs::read_to_string(file.path())?;
                let claim =
                    text.lines().filter_map(claim).max().with_context(|| format!("no claim of {name}: {text}"))?;
                let before = self.claims.insert(name.clone(), claim);
                ensure!(before <= Some(claim), "{name} had the claim {before:?}, and has {claim:?}");
            }
        }
        ensure!(self.claims.len() > self.vehicles.len(), "too few store their claims: {:?}", self.claims);
        Ok(())
    }

    /// What the other version stored was read by everybody.
    fn all_could_read(&self) -> Result<()> {
        for process in self.vehicles.iter().chain([&self.manager, &self.standby]) {
            ensure!(!process.has("count as none"), "{} could not read its claims", process.name());
        }
        Ok(())
    }
}

/// One fleet on loopback. Every process has folders of its own, as if on a host of its own.
struct Place {
    fleet: String,
    folder: TempDir,
}

impl Place {
    fn vehicle(&self, programs: &Path, id: u32) -> Result<Process> {
        let (name, id) = (format!("v-{id}"), id.to_string());
        let arguments = ["--attended", "--name", &name, "--id", &id, "--loopback", "--fleet", &self.fleet];
        self.start(&name, &name, &programs.join("agv"), &arguments)
    }

    fn manager(&self, programs: &Path) -> Result<Process> {
        let arguments = ["--console", "--loopback", "--fleet", &self.fleet];
        let mut manager = self.start("one", "manager", &programs.join("agv_manager"), &arguments)?;
        (0..LISTED).try_for_each(|_| manager.send(""))?;
        manager.expect("line 24", STEP)?;
        Ok(manager)
    }

    fn standby(&self, programs: &Path) -> Result<Process> {
        let arguments = ["node", "--name", MANAGER, "--id", "1", "--standby", "--loopback", "--fleet", &self.fleet];
        self.start("two", "standby", &programs.join("cara"), &arguments)
    }

    /// Starts a program; what it logs is among its lines.
    fn start(&self, place: &str, name: &str, program: &Path, arguments: &[&str]) -> Result<Process> {
        let (keys, own) = (self.folder.path().join("keys"), self.folder.path().join(place));
        for made in ["state", "control"] {
            DirBuilder::new().recursive(true).mode(0o700).create(own.join(made))?;
        }
        let set = [("CARA_KEYS", keys), ("CARA_STATE", own.join("state")), ("CARA_CONTROL_DIR", own.join("control"))];
        let set = set.iter().map(|(name, path)| format!("{name}={}", path.display())).collect::<Vec<_>>();
        let program = program.display().to_string();
        let words = set.iter().map(String::as_str).chain(["sh", "-c", "exec \"$0\" \"$@\" 2>&1", &program]);
        Process::start(name, Path::new("env"), words.chain(arguments.iter().copied()))
    }
}

/// The claim in a line of a file with claims.
fn claim(line: &str) -> Option<(u64, u64)> {
    let mut words = line.split(' ');
    let is_one = words.next().is_some_and(|word| ["own", "obeyed"].contains(&word));
    is_one.then(|| Some((words.next()?.parse().ok()?, words.next()?.parse().ok()?)))?
}
