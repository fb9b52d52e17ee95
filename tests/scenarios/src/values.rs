//! Short names for what scenarios write most.

use cara_core::distribution::parameters::{Parameters, ParametersView};
use cara_core::time::Duration;
use cara_sim::{BoxedParameters, boxed_parameters};

/// A span of `millis` milliseconds.
pub const fn millis(millis: u64) -> Duration {
    Duration::from_millis(millis)
}

/// A span of `secs` seconds.
pub const fn secs(secs: u64) -> Duration {
    Duration::from_secs(secs)
}

/// The listing's `pos`: two ints named `position`.
pub fn position() -> Parameters {
    numbers("position", &[0, 0])
}

/// One variable with these ints.
///
/// # Panics
/// For a name that is none.
pub fn numbers(name: &str, values: &[i64]) -> Parameters {
    let mut parameters = Parameters::new();
    parameters.add_int(name, values.len() as u32).expect("a short variable fits");
    parameters.set_value(name, values).expect("it was just added");
    parameters
}

/// One variable with one int.
pub fn number(name: &str, value: i64) -> Parameters {
    numbers(name, &[value])
}

/// A string of `length` bytes named `text`.
///
/// # Panics
/// For more than a hundred thousand bytes.
pub fn text(length: usize) -> BoxedParameters {
    let letters: String = (0..length).map(|index| char::from(b'a' + (index % 26) as u8)).collect();
    let mut parameters = boxed_parameters(length + 512);
    parameters.add_string("text", length.max(1) as u32).expect("there is room");
    parameters.set_value("text", letters.as_str()).expect("it fits");
    parameters
}

/// The ints of a variable.
///
/// # Panics
/// When there is no such variable.
pub fn variable(parameters: &ParametersView, name: &str) -> [i64; 2] {
    let mut values = [0; 2];
    parameters.variable_into(name, &mut values).expect("the variable is there");
    values
}

/// A copy on the heap.
pub fn boxed(parameters: &ParametersView) -> BoxedParameters {
    let mut copy = boxed_parameters(size_of_val(parameters));
    copy.copy_from(parameters).expect("a copy is not larger");
    copy
}
