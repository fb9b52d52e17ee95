use cara_core::interface;
use cara_core::typed::{AnyCall, Functions, Interface};

#[interface]
trait Drive {
    async fn go_to(call: &impl AnyCall, position: [i64; 2]);
}

struct Vehicle;

impl Drive for Vehicle {
    async fn go_to(_: &impl AnyCall, _: [i64; 2]) {}
}

/// As the list of a board, whose services are no futures.
fn serve<List: Functions<Vehicle>>(list: &List, interface: impl Interface<Vehicle, List>) {
    interface.add_to(list).unwrap();
}

fn on_board<List: Functions<Vehicle>>(list: &List) {
    serve(list, DriveServer);
}

fn main() {}
