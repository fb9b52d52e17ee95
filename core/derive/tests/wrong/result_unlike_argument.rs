use cara_core::interface;

#[interface]
trait Drive {
    #[returns(position)]
    fn turn(&mut self, position: [i64; 2]) -> [f64; 2];
}

fn main() {}
