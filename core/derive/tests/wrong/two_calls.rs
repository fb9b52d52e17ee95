use cara_core::typed::{AnyCall, TypedCall};
use cara_core::{Variables, interface};

#[derive(Variables)]
struct Left {
    left: f64,
}

#[interface]
trait Lift {
    fn lift_to(&mut self, call: &impl AnyCall, reported: &impl TypedCall<Left>, height: f64);
}

fn main() {}
