use cara_core::Variables;

#[derive(Variables)]
enum Target {
    Dock,
    At(i64),
}

fn main() {}
