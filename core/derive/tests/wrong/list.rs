use cara_core::Variables;

#[derive(Variables)]
struct Path {
    stops: Vec<i64>,
}

fn main() {}
