use cara_core::interface;

#[interface]
trait Drive {
    #[priority(highest)]
    fn go_to(&mut self, position: [i64; 2]);
}

fn main() {}
