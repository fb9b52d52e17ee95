use cara_core::{ServiceError, TypedCall, Variables, interface};

#[derive(Variables)]
struct Left {
    left: f64,
}

#[derive(Variables)]
struct Blocked {
    at: [i64; 2],
}

#[interface]
trait Drive {
    fn go_to(&mut self, call: &impl TypedCall<Left, Blocked>) -> Result<(), ServiceError>;
}

struct Agv;

impl Drive for Agv {
    fn go_to(&mut self, call: &impl TypedCall<Left, Blocked>) -> Result<(), ServiceError> {
        call.progress(&Blocked { at: [0, 0] })?;
        Err(call.fail_with(7, "the way is blocked", &Left { left: 1.0 }))
    }
}

fn main() {}
