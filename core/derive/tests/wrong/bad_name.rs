use cara_core::interface;

#[interface]
trait Drive {
    #[name = "go to"]
    fn go_to(&mut self, position: [i64; 2]);
}

fn main() {}
