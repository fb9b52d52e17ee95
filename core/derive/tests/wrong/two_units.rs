use cara_core::interface;

#[interface]
trait Lift {
    #[returns(#[unit = "mm"] height)]
    fn lift_to(&mut self, #[unit = "m"] height: f64) -> f64;
}

fn main() {}
