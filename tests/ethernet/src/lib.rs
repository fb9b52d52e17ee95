//! An Ethernet switch that exists only in memory: frames go in at one port with a time and come out of others later.
//!
//! It is for testing whatever brings its own network stack, such as the ports on smoltcp, without a device, root, a
//! thread or a clock. A run depends on its seed only. It does not look further into a frame than its two addresses.
//!
//! ```
//! use cara_core::time::{Duration, Instant};
//! use cara_ethernet::{Fault, Faults, Mac, Switch};
//!
//! let mut switch = Switch::new(1);
//! let (first, second) = (Mac([2, 0, 0, 0, 0, 1]), Mac([2, 0, 0, 0, 0, 2]));
//! let (one, two) = (switch.add_port(first), switch.add_port(second));
//! switch.set_faults(Faults { delay: Duration::from_millis(3), duplication: 1.0, ..Faults::NONE });
//!
//! let frame = [&second.0[..], &first.0, b"\x08\x00hello"].concat();
//! switch.send(Instant::START, one, &frame);
//! let arrival = switch.next_event().expect("it is under way");
//! assert_eq!(switch.receive(Instant::START, two), None);
//! assert_eq!(switch.receive(arrival, two), Some(frame.clone()));
//! assert_eq!(switch.receive(arrival, two), Some(frame));
//! assert_eq!(switch.counts().of(Fault::Duplicate), 1);
//! ```

mod faults;
mod port;
mod switch;

pub use faults::{Fault, FaultCounts, Faults};
pub use switch::{Mac, PortId, Switch};
