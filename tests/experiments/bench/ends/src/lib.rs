//! What the processes of one measured pair do: a server, a client that makes blocks of calls and times each, and in
//! distribution 2 five further nodes. `cara-bench` starts them and asks them, one line of JSON each way per question;
//! whichever system they play, the code that measures is this.
//!
//! It refuses to compare anything: that is `cara-bench`.

mod block;
mod burst;
pub mod clock;
mod further;
mod peer;
pub mod pin;
mod print;
mod questions;

pub use block::{Callers, Order, Outcome, text};
pub use burst::{Burst, Offered};
pub use peer::{CABLE_END, Caller, Constrain, Counters, Delivery, Executed, Limits, Peer, Place, Server, cable_end};
pub use pin::Pin;
pub use print::Printer;
pub use questions::{ClientQuestion, End, ServerQuestion, answer_all, answer_client, further, main, main_with, serve};
