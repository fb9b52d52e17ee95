use cara_core::{TypedCall, interface};

#[interface]
trait Drive {
    fn go_to(&mut self, call: &impl TypedCall<f64>, position: [i64; 2]);
}

fn main() {}
