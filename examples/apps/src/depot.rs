//! A store of parcels, whose services are its methods: one in the paper's form, one in place.

use cara_core::distribution::parameters::{Parameters, ParametersView};
use cara_core::error::ServiceError;

/// Stores parcels and tells how many there are now.
pub const STORE: &str = "store(parcels: int) -> (parcels: int)";
/// Takes parcels out and tells how many are left.
pub const TAKE: &str = "take(parcels: int) -> (parcels: int)";

/// The store.
#[derive(Clone, Debug, Default)]
pub struct Depot {
    parcels: i64,
}

impl Depot {
    /// Serves [`STORE`] in the paper's form: parameters in, parameters out. It cannot fail, so what makes no sense
    /// changes nothing.
    pub fn store(&mut self, mut arguments: Parameters) -> Parameters {
        let parcels: i64 = arguments.variable("parcels").unwrap_or(0);
        self.parcels = self.parcels.saturating_add(parcels.max(0));
        // Arguments of another shape never reach a service.
        let _ = arguments.set_value("parcels", self.parcels);
        arguments
    }

    /// Serves [`TAKE`] in place; [`ServiceError::NotReady`] while there are not enough.
    pub fn take(&mut self, parameters: &mut ParametersView) -> Result<(), ServiceError> {
        let parcels: i64 = parameters.variable("parcels").map_err(|_| ServiceError::BadResults)?;
        if !(0..=self.parcels).contains(&parcels) {
            return Err(ServiceError::NotReady);
        }
        self.parcels -= parcels;
        parameters.set_value("parcels", self.parcels).map_err(|_| ServiceError::BadResults)
    }
}

#[cfg(test)]
mod tests {
    use super::Depot;
    use cara_core::distribution::parameters::Parameters;
    use cara_core::error::ServiceError;

    fn parcels(count: i64) -> Parameters {
        let mut parameters = Parameters::new();
        parameters.add_int("parcels", 1).unwrap();
        parameters.set_value("parcels", count).unwrap();
        parameters
    }

    #[test]
    fn what_was_stored_can_be_taken_once() {
        let mut depot = Depot::default();
        assert_eq!(depot.store(parcels(5)).variable::<i64>("parcels"), Ok(5));
        let mut taken = parcels(3);
        assert_eq!(depot.take(&mut taken), Ok(()));
        assert_eq!(taken.variable::<i64>("parcels"), Ok(2));
        assert_eq!(depot.take(&mut parcels(3)), Err(ServiceError::NotReady));
        assert_eq!(depot.take(&mut parcels(-1)), Err(ServiceError::NotReady));
        assert_eq!(depot.store(parcels(i64::MIN)).variable::<i64>("parcels"), Ok(2));
    }
}
