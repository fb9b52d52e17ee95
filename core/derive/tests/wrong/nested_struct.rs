use cara_core::Variables;

#[derive(Variables)]
struct Place {
    x: i64,
}

#[derive(Variables)]
struct Order {
    to: Place,
}

fn main() {}
