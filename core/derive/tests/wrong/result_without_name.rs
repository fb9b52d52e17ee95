use cara_core::interface;

#[interface]
trait Sum {
    fn add(&mut self, a: i64, b: i64) -> i64;
}

fn main() {}
