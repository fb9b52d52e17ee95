use cara_core::Variables;

#[derive(Variables)]
struct Place(i64, i64);

fn main() {}
