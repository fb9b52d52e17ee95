use cara_core::interface;

#[interface]
trait Drive {
    #[stop]
    #[reset]
    fn stop(&mut self);
}

fn main() {}
