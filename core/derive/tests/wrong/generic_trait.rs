use cara_core::interface;

#[interface]
trait Drive<T> {
    fn go_to(&mut self, position: T);
}

fn main() {}
