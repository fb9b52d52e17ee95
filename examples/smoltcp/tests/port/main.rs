//! The port on an Ethernet switch in memory, in virtual time, beside a manager of the core's own machines.

mod calls;
mod faults;
mod joining;
mod losses;
mod world;
