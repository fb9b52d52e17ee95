use cara_core::interface;

#[interface]
trait Drive {
    async fn go_to(&mut self, position: [i64; 2]);
}

fn main() {}
