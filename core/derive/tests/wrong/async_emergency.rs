use cara_core::interface;

#[interface]
trait Drive {
    #[priority(emergency)]
    #[stop]
    async fn stop();
}

fn main() {}
