use cara_core::{Variables, interface};

#[derive(Variables)]
struct Path {
    stops: Vec<i64>,
}

#[derive(Variables)]
struct Names {
    #[size(8)]
    names: Vec<String>,
}

#[derive(Variables)]
struct Sizes {
    #[size(8, 32)]
    numbers: Vec<i64>,
    #[size(1)]
    gap: Option<i64>,
}

#[interface]
trait Drive {
    fn go_to(&mut self, #[size(8)] names: Vec<&str>);
}

fn main() {}
