//! `cara-vda5050`: vehicles of CARA under VDA 5050.

use std::net::TcpListener;
use std::panic::{AssertUnwindSafe, catch_unwind};
use std::path::PathBuf;
use std::process::ExitCode;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::Duration;

use anyhow::{Context, Result};
use cara_std::{StartError, UnitEvent};
use cara_vda5050::config::{Config, Vehicle};
use cara_vda5050::gateway::{self, End};
use cara_vda5050::metrics::{self, Seen};
use cara_vda5050::recording::Recording;
use clap::Parser;

/// Vehicles of CARA under VDA 5050 2.0, 2.1 and, as a preview, 3.0, over an MQTT broker.
#[derive(Parser)]
#[command(version)]
struct Options {
    /// The configuration.
    config: PathBuf,
    /// Check the configuration, the keys, the factsheet and the records, and end.
    #[arg(long)]
    check: bool,
}

/// Exit code for a configuration that cannot be used, as no restart mends it.
const WRONG_FILE: u8 = 2;

/// A vehicle's loop that has failed is begun anew after so long.
const BEGUN_ANEW: Duration = Duration::from_secs(2);

static END: End = End { is_due: AtomicBool::new(false), is_silent: AtomicBool::new(false) };

fn main() -> Result<ExitCode> {
    let options = Options::parse();
    let config = match Config::read(&options.config) {
        Ok(config) => config,
        Err(error) => {
            eprintln!("{error:#}");
            return Ok(ExitCode::from(WRONG_FILE));
        }
    };
    if options.check {
        gateway::check(&config)?;
        println!("{} vehicles, VDA 5050 {}", config.vehicle.len(), config.vda5050.version);
        return Ok(ExitCode::SUCCESS);
    }
    let system = gateway::system(&config)?;
    gateway::check_vehicles(&config, &system)?;
    let events = system.events();
    system.start()?;
    ctrlc::set_handler(|| END.is_due.store(true, Ordering::SeqCst)).context("cannot take signals")?;
    let seen = |vehicle: &Vehicle| Arc::new(Seen { serial_number: vehicle.serial_number.clone(), ..Seen::default() });
    let seen: Vec<Arc<Seen>> = config.vehicle.iter().map(seen).collect();
    if let Some(address) = config.manager.metrics {
        let listener = TcpListener::bind(address).with_context(|| format!("cannot serve metrics at {address}"))?;
        let (unit, seen) = (system.downgrade(), seen.clone());
        let text = move || metrics::text(&unit.upgrade().map(|unit| unit.metrics()).unwrap_or_default(), &seen);
        std::thread::Builder::new().name("metrics".into()).spawn(move || metrics::serve(&listener, text))?;
    }
    let recording = Recording::start(&config)?;
    let is_fenced = std::thread::scope(|scope| -> Result<bool> {
        for (vehicle, seen) in config.vehicle.iter().zip(&seen) {
            let (config, system, recording) = (&config, &system, &recording);
            std::thread::Builder::new().name(vehicle.serial_number.clone()).spawn_scoped(scope, move || {
                // What ends one vehicle's loop is no reason to stop the others: it stops by its lease, and is begun anew.
                while !END.is_due.load(Ordering::SeqCst) {
                    match catch_unwind(AssertUnwindSafe(|| {
                        gateway::run(config, vehicle, system, seen, recording, &END)
                    })) {
                        Ok(Ok(())) => return,
                        Ok(Err(error)) => eprintln!("{}: {error:#}", vehicle.serial_number),
                        Err(_) => eprintln!("{}: its loop has panicked", vehicle.serial_number),
                    }
                    std::thread::sleep(BEGUN_ANEW);
                }
            })?;
        }
        println!("up with {} vehicles", config.vehicle.len());
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
