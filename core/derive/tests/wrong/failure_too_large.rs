use cara_core::{ServiceError, TypedCall, Variables, interface};

#[derive(Variables)]
struct Blocked {
    #[size(300)]
    by: String,
}

#[interface]
trait Drive {
    fn go_to(&mut self, call: &impl TypedCall<(), Blocked>) -> Result<(), ServiceError>;
}

fn main() {}
