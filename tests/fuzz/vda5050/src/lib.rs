//! The files of `gateways/vda5050` that read messages and decide. The gateway is a workspace of its own, whose MQTT and TLS nobody
//! who fuzzes needs, and these files use neither.
// What only the rest of the gateway uses is not used here.
#![allow(dead_code)]

#[path = "../../../../gateways/vda5050/src"]
mod gateway {
    pub mod actions;
    pub mod errors;
    pub mod machine;
    pub mod message;
    pub mod order;
    pub mod state;
    pub mod stretch;
    pub mod version;
}

// Where they look for each other.
pub use gateway::*;
