use cara_core::interface;

#[interface]
trait Drive {
    fn go_to(&mut self, speed: Option<f64>);
}

fn main() {}
