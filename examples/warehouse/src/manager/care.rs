//! Vehicles that are stopped: by the operator, or by themselves since they have a fault, for which the mechanic is called.

use std::sync::PoisonError;
use std::time::{Duration, Instant};

use cara_std::{CallError, CommunicationSystem, Error, Parameters, Peer, RequestOptions};

use super::driver::Command;
use super::known::State;
use super::{Desk, Manager};
use crate::network::MECHANIC;
use cara_apps::warehouse::{BrakeClient, FAULT, WorkshopClient};

/// The mechanic is called again for a vehicle that is still not mended.
const MECHANIC_AGAIN: Duration = Duration::from_secs(10);
/// A reset that came to nothing is tried again.
const RESET_AGAIN: Duration = Duration::from_secs(1);
/// How long the answers to a stop of all are waited for: a busy machine is late with them. How soon a vehicle stands is measured
/// in the vehicle.
const STOP_TOLD: Duration = Duration::from_secs(20);

impl Manager<'_> {
    /// Stops all vehicles at the same time, whatever else is on its way to them.
    pub(super) fn stop_all(&self) {
        let system = self.post.system.clone();
        std::thread::spawn(move || {
            let began = Instant::now();
            let patient = RequestOptions { timeout: Some(STOP_TOLD.into()), ..RequestOptions::new() };
            let outcomes = system.call_all("stop", &Parameters::new()).with(patient).wait();
            let took = began.elapsed();
            let stopped = outcomes.iter().filter(|(_, outcome)| outcome.is_ok()).count();
            // One that is switched off, or just now, slows down by itself.
            let is_off = |failed: &CallError| matches!(failed.error, Error::NotConnected | Error::Interrupted);
            let mut asked = stopped;
            for (vehicle, outcome) in &outcomes {
                if let Some(failed) = outcome.as_ref().err().filter(|failed| !is_off(failed)) {
                    asked += 1;
                    println!("not-stopped {} {failed}", vehicle.name());
                }
            }
            println!("stopped-all {stopped} {asked} {}", took.as_micros());
        });
    }

    /// Calls the mechanic to those with a fault, and lets those drive again that may.
    pub(super) fn care(&mut self) {
        let now = Instant::now();
        for name in std::mem::take(&mut *self.post.desk.mended.lock().unwrap_or_else(PoisonError::into_inner)) {
            if let Some(vehicle) = self.vehicles.iter_mut().find(|vehicle| vehicle.name == name) {
                vehicle.reset = Some(true);
            }
        }
        for vehicle in self.vehicles.iter_mut().filter(|vehicle| vehicle.is_faulty()) {
            if vehicle.mechanic.is_none_or(|called| now.saturating_duration_since(called) > MECHANIC_AGAIN) {
                vehicle.mechanic = Some(now);
                let (system, name) = (self.post.system.clone(), vehicle.name.clone());
                std::thread::spawn(move || call_mechanic(&system, &name));
            }
        }
        if now.saturating_duration_since(self.last_reset) < RESET_AGAIN {
            return;
        }
        self.last_reset = now;
        for vehicle in &mut self.vehicles {
            let Some(mended) = vehicle.reset else { continue };
            match vehicle.state {
                State::Lost(_) | State::Asked => {}
                // Without the mechanic's word a fault stays one.
                State::Stopped { .. } if vehicle.is_faulty() && !mended => {
                    vehicle.reset = None;
                    println!("goes-on {}", vehicle.name);
                }
                // Also one of which no stop is known: the news of it may still be on its way.
                _ => vehicle.command(Command::Reset { mended }),
            }
        }
    }
}

/// Stops one vehicle, until it is reset; past what its thread may be waiting for.
pub(super) fn stop(vehicle: &Peer<Desk>) {
    let vehicle = vehicle.clone();
    std::thread::spawn(move || {
        let began = Instant::now();
        match BrakeClient::at(&vehicle).stop().wait() {
            Ok(()) => println!("call stop {}", began.elapsed().as_micros()),
            Err(error) => println!("failed stop {vehicle:?}: {error}"),
        }
    });
}

/// Calls the mechanic to a vehicle; where he is away, it is tried again later.
fn call_mechanic(system: &CommunicationSystem<Desk>, vehicle: &str) {
    let called =
        system.m_unit(MECHANIC.0).map(|mechanic| WorkshopClient::at(&mechanic).call_mechanic(vehicle, FAULT).wait());
    match called {
        Ok(Ok(seconds)) => println!("mechanic {vehicle} {seconds}"),
        Ok(Err(error)) => println!("failed mechanic {vehicle}: {error}"),
        Err(error) => println!("failed mechanic {vehicle}: {error}"),
    }
}
