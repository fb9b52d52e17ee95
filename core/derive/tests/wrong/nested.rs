use cara_core::{Variables, interface};

/// Derives nothing.
struct Place {
    x: i64,
}

#[derive(Variables)]
struct Order {
    #[size(8)]
    to: Vec<Place>,
}

#[derive(Variables)]
struct Inner {
    #[name = "a b"]
    x: i64,
}

#[derive(Variables)]
struct Twice {
    x: i64,
    #[name = "x"]
    y: i64,
}

#[derive(Variables)]
struct Deep {
    #[size(2, 2, 2, 2, 2, 2, 2)]
    x: Vec<Vec<Vec<Vec<Vec<Vec<Vec<i64>>>>>>>,
}

#[interface]
trait Drive {
    fn bad_name(&mut self, inner: Inner);
    fn two_fields(&mut self, twice: Twice);
    fn too_deep(&mut self, #[size(2)] deep: Vec<Deep>);
    fn no_bytes(&mut self, #[size(2)] nothing: Vec<[i64; 0]>);
}

fn main() {}
