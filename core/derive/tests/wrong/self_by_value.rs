use cara_core::interface;

#[interface]
trait Drive {
    fn go_to(self, position: [i64; 2]);
}

fn main() {}
