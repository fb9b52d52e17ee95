use cara_core::interface;

#[interface]
trait Drive {
    fn position(&mut self) -> (f64, f64);
}

fn main() {}
