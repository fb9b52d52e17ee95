use cara_core::interface;

#[interface]
trait Drive {
    fn go_to(state: &impl cara_core::AsyncState<Self>, position: [i64; 2]);
}

fn main() {}
