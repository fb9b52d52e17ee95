//! A shared place as the manager of a vehicle uses it.

use cara_std::keys::full_name;
use cara_std::{CallError, CommunicationSystem, Duration, Error, Heart, Hold, Parameters, Peer, ServiceError};

use super::{LEASE_MS, Occupant, SharedClient, Shown, refusal};

/// A place, and the unit that offers it.
#[derive(Debug)]
pub struct SharedPlace<T: Send + 'static = ()> {
    places: Peer<T>,
    name: String,
    enter: String,
}

/// A vehicle may enter, while its manager has this. Dropping it blocks the place: only [`left`](Self::left) gives it back.
#[derive(Debug)]
#[must_use = "dropped, the place is blocked"]
pub struct Pass<T: Send + 'static = ()> {
    places: Peer<T>,
    name: String,
    vehicle: Peer<T>,
    number: i64,
    heart: Heart,
    hold: Hold<T>,
}

impl<T: Send + 'static> SharedPlace<T> {
    /// A place of this unit.
    pub fn new(places: Peer<T>, name: &str) -> Self {
        Self { places, name: name.to_owned(), enter: format!("enter_{name}") }
    }

    /// What its unit says of it.
    pub fn shown(&self) -> Result<Shown, CallError> {
        SharedClient::at(&self.places).place(&self.name).wait()
    }

    /// Whether a vehicle may be in it. A manager asks this of each of its vehicles when it starts, gets a vehicle, or does not
    /// know what became of a call: if so it [enters](Self::enter) the vehicle again, and so takes its place up.
    pub fn has(&self, vehicle: &Peer<T>) -> Result<bool, CallError> {
        Ok(self.shown()?.occupant == full_name(vehicle.identity()))
    }

    /// Asks that a vehicle of this manager may enter, or stay. Another pass of it counts no longer.
    ///
    /// After any error but [`TAKEN`](super::refusal::TAKEN) the vehicle may have the place: see [`has`](Self::has).
    /// [`Error::Held`] says that the vehicle's earlier manager still renews.
    pub fn enter(&self, system: &CommunicationSystem<T>, vehicle: &Peer<T>) -> Result<Pass<T>, CallError> {
        let name = full_name(vehicle.identity());
        // The call itself would end the lease of another vehicle of this manager before it is refused.
        let occupant = self.shown()?.occupant;
        if occupant != name && occupant != Occupant::Nobody.to_string() {
            return Err(Error::Service(ServiceError::Failed(refusal::TAKEN)).into());
        }
        let mut heart = system.heart(Duration::from_millis(LEASE_MS / 2));
        heart.beat();
        let mut parameters = Parameters::<128>::sized();
        parameters.add_string("vehicle", 64)?;
        parameters.add_int("pass", 1)?;
        parameters.set_value("vehicle", name.as_str())?;
        // A pass that comes later than its lease ends would be taken for live until it is found not to be.
        let call = self.places.call(&self.enter, &mut parameters).timeout(Duration::from_millis(LEASE_MS));
        let held = call.renewing(heart.renew()).hold().wait()?;
        let hold = held.hold;
        let number = parameters.variable("pass")?;
        Ok(Pass { places: self.places.clone(), name: self.name.clone(), vehicle: vehicle.clone(), number, heart, hold })
    }
}

impl<T: Send + 'static> Pass<T> {
    /// Renews it, while the vehicle is linked to this manager: to be called more often than twice a [lease](LEASE_MS). Once this
    /// is `false` the vehicle is no longer to be let in: an operator may release the place. If it is inside, the place stays its
    /// own, and [`SharedPlace::enter`] makes a new pass.
    pub fn keep(&mut self) -> bool {
        if self.vehicle.is_connected() {
            self.heart.beat();
        }
        self.hold.is_held()
    }

    /// Gives the place back. Only for what the vehicle itself has reported: its position is outside, and no order that is live
    /// lets it in. To be repeated until it succeeds, and then dropped: meanwhile other managers get [`Error::Held`]. The vehicle
    /// does not enter again by this pass.
    ///
    /// [`OLD_PASS`](super::refusal::OLD_PASS) says that another pass was given since: see [`SharedPlace::has`].
    pub fn left(&self) -> Result<(), CallError> {
        let client = SharedClient::at(&self.places);
        client.left(&self.name, &full_name(self.vehicle.identity()), self.number).wait()
    }
}
