use cara_core::interface;

#[interface]
trait Drive {
    #[actuator(drive)]
    #[lease(ms = 10)]
    fn go_to(&mut self, position: [i64; 2]);
}

fn main() {}
