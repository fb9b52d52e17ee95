use cara_core::interface;

#[interface]
trait Drive {
    #[returns(x)]
    fn position(&mut self) -> Result<(f64, f64), cara_core::ServiceError>;
}

fn main() {}
