use cara_std::{ServiceError, TypedCall, Variables, interface};

#[derive(Variables, Clone, Debug, PartialEq)]
pub struct PlanNodesActions {
    #[size(8)]
    pub kind: String,
    pub r#type: i64,
}

#[derive(Variables, Clone, Debug, PartialEq)]
pub struct PlanNodes {
    #[size(32)]
    pub id: String,
    #[name = "at-m"]
    pub at_m: [f64; 2],
    #[size(4)]
    pub actions: Vec<PlanNodesActions>,
    #[size(20)]
    pub note: Option<String>,
}

#[derive(Variables, Clone, Debug, PartialEq)]
pub struct PlanStart {
    pub x: f64,
}

#[derive(Variables, Clone, Debug, PartialEq)]
pub struct DockProgress {
    #[unit = "m"]
    pub left: f64,
}

#[derive(Variables, Clone, Debug, PartialEq)]
pub struct DockFailure {
    pub at: [i64; 2],
    #[size(8)]
    pub by: String,
}

#[interface]
pub trait Agv17 {
    #[help = "Tells where it is, or goes \"to be\"."]
    #[idempotent]
    #[returns(#[unit = "m"] position)]
    fn pos_info(&mut self, #[unit = "m"] position: [i64; 2]) -> Result<[i64; 2], ServiceError>;

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
    #[returns(#[size(9)] #[unit = "words"] text, "is-new")]
    fn log_line(&mut self, #[size(64)] line: &str, #[name = "a-b"] a_b: f64, #[name = "a.b"] a_b_: bool, r#type: i64, #[name = "self"] self_: i64, #[size(8)] _raw: &[u8], #[name = "2nd"] _2nd: i64) -> Result<(String, bool), ServiceError>;

    #[returns(last, #[size(3)] photos)]
    fn plan(&mut self, #[size(50)] nodes: Vec<PlanNodes>, start: PlanStart, speed: Option<f64>) -> Result<(Option<PlanStart>, Option<Vec<u8>>), ServiceError>;

    fn dock(&mut self, call: &impl TypedCall<DockProgress, DockFailure>, #[name = "call"] call_: i64) -> Result<(), ServiceError>;

    fn undock(&mut self, call: &impl TypedCall<DockProgress>) -> Result<(), ServiceError>;

    fn lift(&mut self, call: &impl TypedCall<(), DockFailure>) -> Result<(), ServiceError>;
}
