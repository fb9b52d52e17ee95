//! CARA on Linux: sockets, threads and time for the core's state machines.

pub mod pool;
pub mod storage;
pub mod sys;
pub mod timers;
