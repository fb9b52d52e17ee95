//! The unit of the places: an m_unit whose record is on disk before it answers.

use std::collections::HashMap;
use std::fs::{File, TryLockError};
use std::io::{self, Read};
use std::path::{Path, PathBuf};
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};
use std::time::{Duration, Instant};

use anyhow::Result;
use cara_std::keys::{KeyError, full_name, parse_node, write_private};
use cara_std::{
    AnyCall, CommunicationSystem, Definition, Failure, Identity, LeaseWatch, MyFunctionList, ParametersView, Served,
    ServiceError, ServiceOptions,
};

use super::{LEASE_MS, Occupant, Record, Refused, Shared, SharedServer, Shown, refusal};
use crate::network::{Network, PLACES};

/// A manager whose renewals are not answered lets no vehicle in after this.
const STALE: Duration = Duration::from_millis(2 * LEASE_MS);
/// How often the process looks for changes to print.
const LOOK: Duration = Duration::from_millis(100);

/// Why places cannot be opened.
#[derive(Debug, thiserror::Error)]
pub enum OpenError {
    /// Two units with one record would each grant.
    #[error("{0} is open in another process")]
    InUse(PathBuf),
    /// It is not written over: who is in a place is not known.
    #[error("{path}: {what}; restore it, or remove it: then each place is blocked until it is released")]
    Damaged {
        /// The file.
        path: PathBuf,
        /// What is wrong in it.
        what: String,
    },
    /// The file system.
    #[error("{0}: {1}")]
    File(PathBuf, #[source] io::Error),
    /// Writing the file.
    #[error(transparent)]
    Write(#[from] KeyError),
}

/// The places of a unit, as the state of its services or a part of it.
#[derive(Clone, Debug)]
pub struct Places(Arc<Mutex<Inner>>);

#[derive(Debug)]
struct Inner {
    record: Record,
    path: PathBuf,
    /// The newest order of each place since the start.
    orders: HashMap<String, LeaseWatch>,
    /// When an order of each place ended, or the start.
    ended: HashMap<String, Arc<Mutex<Instant>>>,
    _lock: File,
}

impl Places {
    /// Opens the record `places` in a folder. A place that is not in it yet is blocked until it is released.
    pub fn open(folder: &Path, names: &[String]) -> Result<Self, OpenError> {
        let file_error = |error| OpenError::File(folder.to_owned(), error);
        std::fs::create_dir_all(folder).map_err(file_error)?;
        let path = folder.join("places");
        let lock = File::create(folder.join("places.lock")).map_err(file_error)?;
        lock.try_lock().map_err(|error| match error {
            TryLockError::WouldBlock => OpenError::InUse(path.clone()),
            TryLockError::Error(error) => file_error(error),
        })?;
        let text = match std::fs::read_to_string(&path) {
            Err(error) if error.kind() == io::ErrorKind::NotFound => String::new(),
            text => text.map_err(file_error)?,
        };
        let mut record = text.parse::<Record>().map_err(|what| OpenError::Damaged { path: path.clone(), what })?;
        names.iter().for_each(|name| record.add(name));
        write_private(&path, record.to_string().as_bytes())?;
        let ended = names.iter().map(|name| (name.clone(), Arc::new(Mutex::new(Instant::now())))).collect();
        let inner = Inner { record, path, orders: HashMap::new(), ended, _lock: lock };
        Ok(Self(Arc::new(Mutex::new(inner))))
    }

    /// Offers these places.
    pub fn serve(&self, functions: &MyFunctionList<'_, Self>, names: &[String]) -> Result<()> {
        functions.serve(SharedServer)?;
        for name in names {
            let definition = Definition::parse(&format!("enter_{name}(vehicle: string[64]) -> (pass: int)"))?;
            let ended = self.lock().ended.get(name).cloned().unwrap_or_else(|| Arc::new(Mutex::new(Instant::now())));
            // Nothing moves by a pass.
            let options = ServiceOptions::new().lease(Duration::from_millis(LEASE_MS), move || {
                *ended.lock().unwrap_or_else(PoisonError::into_inner) = Instant::now();
            });
            let name = name.clone();
            let enter =
                move |places: &mut Self, call: &Served, view: &mut ParametersView| -> Result<(), ServiceError> {
                    let pass = places.enter(&name, call, view.variable("vehicle")?)?;
                    Ok(view.set_value("pass", pass)?)
                };
            functions.add_service(&definition, options, enter)?;
        }
        Ok(())
    }

    /// The state of a place.
    pub fn shown(&self, place: &str) -> Result<Shown, Refused> {
        self.lock().shown(place)
    }

    fn enter(&self, place: &str, call: &Served, vehicle: &str) -> Result<i64, ServiceError> {
        let vehicle = vehicle_of(vehicle)?;
        let mut inner = self.lock();
        // Not for a caller that has given up meanwhile: nobody would give the place back.
        call.commit(|| ())?;
        let granted = inner.change(|record| record.enter(place, &vehicle));
        let pass = granted.map_err(|refused| call.fail(failure(&refused)))?;
        if let Some(lease) = &call.lease {
            inner.orders.insert(place.to_owned(), lease.clone());
        }
        Ok(pass)
    }

    fn lock(&self) -> MutexGuard<'_, Inner> {
        self.0.lock().unwrap_or_else(PoisonError::into_inner)
    }
}

impl Inner {
    /// On disk before it counts.
    fn change<R>(&mut self, change: impl FnOnce(&mut Record) -> Result<R, Refused>) -> Result<R, Refused> {
        let mut record = self.record.clone();
        let result = change(&mut record)?;
        if record != self.record {
            let written = write_private(&self.path, record.to_string().as_bytes());
            written.map_err(|error| Refused::NotKept(error.to_string()))?;
            self.record = record;
        }
        Ok(result)
    }

    fn shown(&self, place: &str) -> Result<Shown, Refused> {
        let occupant = self.record.occupant(place)?;
        let state = match occupant {
            Occupant::Nobody => "free",
            Occupant::Vehicle(_) if self.is_live(place) => "held",
            _ => "blocked",
        };
        Ok(Shown { state: state.to_owned(), occupant: occupant.to_string() })
    }

    /// Whether the manager of the vehicle may think that its pass is live.
    fn may_be_used(&self, place: &str, now: Instant) -> bool {
        let ended = self.ended.get(place).map(|ended| *ended.lock().unwrap_or_else(PoisonError::into_inner));
        self.is_live(place) || ended.is_some_and(|ended| now.saturating_duration_since(ended) < STALE)
    }

    fn is_live(&self, place: &str) -> bool {
        self.orders.get(place).is_some_and(LeaseWatch::is_live)
    }
}

impl Shared for Places {
    fn place(&mut self, place: &str) -> Result<Shown, ServiceError> {
        self.shown(place).map_err(|refused| failure(&refused).error())
    }

    fn left(&mut self, place: &str, vehicle: &str, pass: i64) -> Result<(), ServiceError> {
        let vehicle = vehicle_of(vehicle)?;
        self.lock().change(|record| record.left(place, &vehicle, pass)).map_err(|refused| failure(&refused).error())
    }

    fn release(
        &mut self,
        call: &impl AnyCall<Order = LeaseWatch>,
        place: &str,
        occupant: &str,
        reason: &str,
    ) -> Result<(), ServiceError> {
        let looked_for = occupant.parse::<Occupant>().map_err(|_| ServiceError::Failed(refusal::NO_VEHICLE))?;
        let mut inner = self.lock();
        if looked_for != Occupant::Unknown && inner.may_be_used(place, Instant::now()) {
            return Err(ServiceError::Failed(refusal::LIVE));
        }
        inner.change(|record| record.release(place, &looked_for)).map_err(|refused| call.fail(failure(&refused)))?;
        println!("released {place} of {looked_for} by {}: {reason:?}", full_name(call.caller()));
        Ok(())
    }
}

fn vehicle_of(text: &str) -> Result<Identity, ServiceError> {
    parse_node(text).map_err(|_| ServiceError::Failed(refusal::NO_VEHICLE))
}

fn failure(refused: &Refused) -> Failure {
    let code = match refused {
        Refused::NoPlace => refusal::NO_PLACE,
        Refused::Taken(_) => refusal::TAKEN,
        Refused::OldPass => refusal::OLD_PASS,
        Refused::NotKept(_) => refusal::NOT_KEPT,
    };
    Failure::new(code, &refused.to_string())
}

/// Options of the process.
#[derive(clap::Args, Clone, Debug)]
pub struct Options {
    #[command(flatten)]
    network: Network,
    /// Where the record is kept.
    #[arg(long, value_name = "FOLDER")]
    state: PathBuf,
    /// The names of the places: letters, digits and underscores.
    #[arg(required = true)]
    places: Vec<String>,
}

/// Runs until standard input ends. Prints each change of a place.
pub fn run(options: &Options) -> Result<()> {
    let Options { network, state, places: names } = options;
    let places = Places::open(state, names)?;
    let builder = network.place(CommunicationSystem::builder(PLACES.0, PLACES.1)?).state_folder(state);
    let unit = builder.state(places.clone()).build()?;
    places.serve(&unit.my_function_list(), names)?;
    unit.publish_my_function_list()?;
    unit.start()?;
    std::thread::spawn(|| {
        // Only the end counts.
        let _ = io::stdin().lock().read_to_end(&mut Vec::new());
        std::process::exit(0);
    });
    let mut known = HashMap::new();
    loop {
        for name in names {
            let shown = places.shown(name)?;
            if known.get(name) != Some(&shown) {
                println!("{name} {} {}", shown.state, shown.occupant);
                known.insert(name.clone(), shown);
            }
        }
        std::thread::sleep(LOOK);
    }
}

#[cfg(test)]
mod tests {
    use super::{Instant, Places, STALE};

    #[test]
    fn a_place_is_not_released_before_its_last_manager_has_noticed() {
        let (folder, names) = (tempfile::tempdir().unwrap(), ["gate".to_owned()]);
        let before = Instant::now();
        let places = Places::open(folder.path(), &names).unwrap();
        let inner = places.lock();
        assert!(inner.may_be_used("gate", before + STALE));
        assert!(!inner.may_be_used("gate", Instant::now() + STALE));
    }
}
