use cara_core::interface;
use cara_core::services::call::BlockingCaller;

#[interface]
trait Drive {
    fn go_to(&mut self, position: [i64; 2]);
}

fn drive(peer: &impl BlockingCaller) {
    let _ = DriveClient::at(peer).go_to([1.0, 2.0]).wait();
}

fn main() {}
