use cara_core::Variables;

#[derive(Variables)]
struct Pair<T> {
    one: T,
    other: T,
}

fn main() {}
