use cara_core::interface;

#[interface]
trait Drive {
    #[priority(emergency)]
    #[stop]
    fn stop(&mut self);
}

fn main() {}
