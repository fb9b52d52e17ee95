use cara_std::{ServiceError, interface};

#[interface]
pub trait Agv17 {
    #[idempotent]
    #[returns(position)]
    fn pos_info(&mut self, position: [i64; 2]) -> Result<[i64; 2], ServiceError>;

    #[priority(high)]
    #[actuator(actuator_3)]
    #[lease(ms = 400)]
    fn go_to(&mut self, position: [i64; 2]) -> Result<(), ServiceError>;

    #[priority(emergency)]
    #[actuator(actuator_3)]
    #[stop]
    #[idempotent]
    fn stop() -> Result<(), ServiceError>;

    #[reset]
    fn reset(&mut self) -> Result<(), ServiceError>;

    #[name = "log/line"]
    #[returns(#[size(9)] text, "is-new")]
    fn log_line(&mut self, #[size(64)] line: &str, #[name = "a-b"] a_b: f64, #[name = "a.b"] a_b_: bool, r#type: i64, #[name = "self"] self_: i64, #[size(8)] _raw: &[u8], #[name = "2nd"] _2nd: i64) -> Result<(String, bool), ServiceError>;
}
