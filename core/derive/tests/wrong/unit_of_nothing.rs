use cara_core::interface;

#[interface]
trait Drive {
    #[unit(positon = "m")]
    fn go_to(&mut self, position: [i64; 2]);
}

fn main() {}
