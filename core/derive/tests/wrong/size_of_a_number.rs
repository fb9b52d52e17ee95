use cara_core::Variables;

#[derive(Variables)]
struct Speed {
    #[size(8)]
    limit: i64,
}

fn main() {}
