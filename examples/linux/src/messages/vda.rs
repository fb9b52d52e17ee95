//! Actions of VDA 5050 2.1 with their parameters, whose values are of several types.
//!
//! In an order these nest eight deep, which is the limit. There an `Option<Vec<…>>` would be too deep: a list that is absent is an
//! empty one.

use cara_std::Variables;

/// Nodes of an order, with what is done there.
#[derive(Variables, Clone, Debug, PartialEq)]
pub struct Visits {
    #[name = "orderId"]
    #[size(36)]
    pub order_id: String,
    #[size(64)]
    pub nodes: Vec<Visit>,
}

/// A node of an order.
#[derive(Variables, Clone, Debug, PartialEq)]
pub struct Visit {
    #[name = "nodeId"]
    #[size(36)]
    pub node_id: String,
    #[name = "sequenceId"]
    pub sequence_id: u32,
    pub released: bool,
    #[size(8)]
    pub actions: Vec<Action>,
}

/// An action.
#[derive(Variables, Clone, Debug, PartialEq)]
pub struct Action {
    #[name = "actionType"]
    #[size(32)]
    pub action_type: String,
    #[name = "actionId"]
    #[size(36)]
    pub action_id: String,
    #[name = "actionDescription"]
    #[size(80)]
    pub action_description: Option<String>,
    /// `NONE`, `SOFT` or `HARD`.
    #[name = "blockingType"]
    #[size(4)]
    pub blocking_type: String,
    #[name = "actionParameters"]
    #[size(8)]
    pub action_parameters: Vec<ActionParameter>,
}

/// A parameter of an action.
#[derive(Variables, Clone, Debug, PartialEq)]
pub struct ActionParameter {
    #[size(32)]
    pub key: String,
    pub value: ActionValue,
}

/// What a parameter's value may be.
#[derive(Variables, Clone, Debug, PartialEq)]
pub enum ActionValue {
    #[name = "string"]
    #[size(64)]
    Text(String),
    #[name = "integer"]
    Integer(i64),
    #[name = "number"]
    Number(f64),
    #[name = "boolean"]
    Truth(bool),
    /// An array or object, as JSON.
    #[name = "json"]
    #[size(256)]
    Json(String),
}
