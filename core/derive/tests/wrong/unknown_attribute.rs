use cara_core::interface;

#[interface]
trait Drive {
    #[idempotant]
    fn halt();
}

fn main() {}
