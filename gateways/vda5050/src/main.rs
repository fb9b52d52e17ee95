//! `cara-vda5050`: vehicles of CARA under VDA 5050.

use std::io::{ErrorKind, Write, stdout};
use std::net::TcpListener;
use std::panic::{AssertUnwindSafe, catch_unwind};
use std::path::PathBuf;
use std::process::ExitCode;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::Duration;

use anyhow::{Context, Error, Result};
use cara_std::{BuildError, Cause, CommunicationSystem, StartError, UnitEvent};
use cara_vda5050::config::{Config, Vehicle};
use cara_vda5050::gateway::{self, End};
use cara_vda5050::metrics::{self, Seen};
use cara_vda5050::recording::Recording;
use cara_vda5050::{log, tls};
use clap::Parser;
use sd_notify::NotifyState;

/// Vehicles of CARA under VDA 5050 2.0, 2.1 and, as a preview, 3.0, over an MQTT broker.
#[derive(Parser)]
#[command(version)]
struct Options {
    /// The configuration.
    config: PathBuf,
    /// Check the configuration, the keys, the factsheet, the certificates and the records, and end: 2 if something is wrong.
    #[arg(long)]
    check: bool,
}

/// Exit code for a configuration that cannot be used, as no restart mends it.
const WRONG_FILE: u8 = 2;

/// A vehicle's loop that has failed is begun anew after so long.
const BEGUN_ANEW: Duration = Duration::from_secs(2);

/// A service manager hears no sooner again.
const TOLD: Duration = Duration::from_millis(10);

static END: End = End { is_due: AtomicBool::new(false), is_silent: AtomicBool::new(false) };

/// Ends all vehicles' loops when the main thread leaves for any reason: it waits for them, and nobody else would end them.
struct EndsAll;

impl Drop for EndsAll {
    fn drop(&mut self) {
        END.is_due.store(true, Ordering::SeqCst);
    }
}

fn main() -> Result<ExitCode> {
    let options = Options::parse();
    let config = match Config::read(&options.config) {
        Ok(config) => config,
        Err(error) => return Ok(wrong(&error)),
    };
    if options.check {
        if let Err(error) = gateway::check(&config) {
            return Ok(wrong(&error));
        }
        println!("{} vehicles, VDA 5050 {}", config.vehicle.len(), config.vda5050.version);
        return Ok(ExitCode::SUCCESS);
    }
    let system = match build(&config) {
        Ok(system) => system,
        Err(error) if is_mistake(&error, &config) => return Ok(wrong(&error)),
        Err(error) => return Err(error),
    };
    let events = system.events();
    match system.start() {
        Err(error) if error.is_running_already() => {
            eprintln!("{error}");
            return Ok(ExitCode::from(StartError::ALREADY_RUNNING_EXIT));
        }
        started => started?,
    }
    ctrlc::set_handler(|| END.is_due.store(true, Ordering::SeqCst)).context("cannot take signals")?;
    let seen = |vehicle: &Vehicle| Arc::new(Seen { serial_number: vehicle.serial_number.clone(), ..Seen::default() });
    let seen: Vec<Arc<Seen>> = config.vehicle.iter().map(seen).collect();
    if let Some(address) = config.manager.metrics {
        let listener = TcpListener::bind(address).with_context(|| format!("cannot serve metrics at {address}"))?;
        let (unit, seen) = (system.downgrade(), seen.clone());
        let text = move || metrics::text(&unit.upgrade().map(|unit| unit.metrics()).unwrap_or_default(), &seen);
        let thread = std::thread::Builder::new().name("metrics".into());
        thread.spawn(move || metrics::serve(&listener, text)).context("cannot start the thread of metrics")?;
    }
    // No line of the log holds a vehicle up from here on.
    let _log = log::start().context("cannot start the thread of the log")?;
    let clients = config.vehicle.iter().zip(&seen);
    let clients = clients.map(|(vehicle, seen)| (config.broker.of(vehicle), seen.expiry.clone())).collect();
    tls::watch(clients).context("cannot start the thread that looks at certificates")?;
    let recording = Recording::start(&config)?;
    let is_fenced = std::thread::scope(|scope| -> Result<bool> {
        let _ends = EndsAll;
        for (vehicle, seen) in config.vehicle.iter().zip(&seen) {
            let (config, system, recording) = (&config, &system, &recording);
            let serial_number = &vehicle.serial_number;
            let thread = std::thread::Builder::new().name(serial_number.clone());
            let started = thread.spawn_scoped(scope, move || {
                // What ends one vehicle's loop is no reason to stop the others: it stops by its lease, and is begun anew.
                while !END.is_due.load(Ordering::SeqCst) {
                    seen.turns.fetch_add(1, Ordering::Relaxed);
                    match catch_unwind(AssertUnwindSafe(|| {
                        gateway::run(config, vehicle, system, seen, recording, &END)
                    })) {
                        Ok(Ok(())) => return,
                        Ok(Err(error)) => log::line(format_args!("{}: {error:#}", vehicle.serial_number)),
                        Err(_) => log::line(format_args!("{}: its loop has panicked", vehicle.serial_number)),
                    }
                    std::thread::sleep(BEGUN_ANEW);
                }
            });
            started.with_context(|| format!("cannot start the thread of vehicle {serial_number}"))?;
        }
        tell(seen.clone()).context("cannot start the thread of the watchdog")?;
        // Whether anybody reads it or not.
        let _ = writeln!(stdout(), "up with {} vehicles", config.vehicle.len());
        while !END.is_due.load(Ordering::SeqCst) {
            recording.turn();
            let event = events.recv_timeout(Duration::from_millis(200));
            // Another gateway speaks for these vehicles now: this one says nothing more.
            if matches!(event, Ok(UnitEvent::Fenced { .. })) {
                END.is_silent.store(true, Ordering::SeqCst);
                END.is_due.store(true, Ordering::SeqCst);
                return Ok(true);
            }
        }
        Ok(false)
    })?;
    system.stop();
    recording.end();
    Ok(if is_fenced { ExitCode::from(StartError::FENCED_EXIT) } else { ExitCode::SUCCESS })
}

/// Tells the service manager, if there is one, that the program is up; and where it has a watchdog, while the loop of any vehicle
/// comes round: one may wait for its own disk, and when all of them stand the program hangs. A thread of its own does that, as a
/// manager that does not read holds it up.
fn tell(seen: Vec<Arc<Seen>>) -> std::io::Result<()> {
    let tell = move || -> std::io::Result<()> {
        sd_notify::notify(&[NotifyState::Ready])?;
        let Some(limit) = sd_notify::watchdog_enabled() else { return Ok(()) };
        let mut turns = 0;
        loop {
            std::thread::sleep((limit / 4).max(TOLD));
            let sum = seen.iter().map(|seen| seen.turns.load(Ordering::Relaxed)).sum();
            if std::mem::replace(&mut turns, sum) != sum || seen.is_empty() {
                sd_notify::notify(&[NotifyState::Watchdog])?;
            }
        }
    };
    let told = move || {
        if let Err(error) = tell() {
            log::line(format_args!("the service manager (NOTIFY_SOCKET) does not hear this program: {error}"));
        }
    };
    std::thread::Builder::new().name("watchdog".into()).spawn(told).map(drop)
}

/// The unit, not started yet, and that all is there that its start needs.
fn build(config: &Config) -> Result<CommunicationSystem> {
    let folder = &config.manager.state_folder;
    std::fs::create_dir_all(folder).with_context(|| format!("state_folder {} cannot be made", folder.display()))?;
    let system = gateway::system(config)?;
    gateway::check_vehicles(config, &system)?;
    Ok(system)
}

/// The configuration cannot be used.
fn wrong(error: &Error) -> ExitCode {
    eprintln!("{error:#}");
    ExitCode::from(WRONG_FILE)
}

/// Whether the mistake is in the configuration or in a file that it names, which no restart mends. Keys that it does not name may
/// come later, a port may become free, and a disk may have space again.
fn is_mistake(error: &Error, config: &Config) -> bool {
    if error.downcast_ref::<std::io::Error>().is_some_and(|error| error.kind() == ErrorKind::StorageFull) {
        return false;
    }
    match error.downcast_ref::<BuildError>() {
        Some(BuildError::Keys(_)) => config.manager.key_file.is_some(),
        Some(BuildError::Unit(error)) => error.cause() == Cause::Configuration,
        Some(_) => false,
        None => true,
    }
}
