//! The manager's service of the listing: an AGV calls for a mechanic and hears when one comes.

use cara_core::distribution::parameters::Parameters;
use cara_core::error::Error;

/// Bytes that the description of a fault may have.
pub const FAULT_BYTES: u32 = 64;
/// Minutes that a mechanic walks through the warehouse.
const WALK: i64 = 5;

/// What `call_mechanic` takes and returns: the fault, and the minutes until a mechanic is there.
pub fn arguments() -> Result<Parameters, Error> {
    let mut arguments = Parameters::new();
    arguments.add_string("fault", FAULT_BYTES)?;
    arguments.add_int("minutes", 1)?;
    Ok(arguments)
}

/// The service, in the paper's form.
pub fn call_mechanic(mut arguments: Parameters) -> Parameters {
    // Arguments of another shape never reach a service, so this cannot fail.
    let _ = arguments.set_value("minutes", WALK);
    arguments
}

#[cfg(test)]
mod tests {
    use super::{WALK, arguments, call_mechanic};

    #[test]
    fn a_mechanic_comes() {
        let mut call = arguments().unwrap();
        call.set_value("fault", "a wheel squeaks").unwrap();
        let answer = call_mechanic(call);
        assert_eq!(answer.variable::<i64>("minutes"), Ok(WALK));
        assert_eq!(answer.variable::<&str>("fault"), Ok("a wheel squeaks"));
    }
}
