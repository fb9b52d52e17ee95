use cara_core::interface;

#[interface]
trait Drive {
    #[actuator(drive)]
    #[lease(ms = 400)]
    fn go_to(&mut self, position: [i64; 2]);
}

fn main() {
    let _server = DriveServer::<u8> {};
}
