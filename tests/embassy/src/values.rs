//! Parameters of the tests' functions.

use cara_core::distribution::parameters::Parameters;

/// The arguments of a function of one integer `n`.
pub fn number(value: i64) -> Parameters {
    let mut parameters = Parameters::new();
    parameters.add_int("n", 1).unwrap();
    parameters.set_value("n", value).unwrap();
    parameters
}
