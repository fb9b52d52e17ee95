//! What a unit tells its subscribers, and the operator.

use core::net::SocketAddr;

use cara_core::distribution::connection_handler;

/// Something happened that no call returned: functions by their names, the network as the names of the interfaces that are up.
pub type UnitEvent = cara_core::services::event::UnitEvent<String, Vec<String>, SocketAddr>;

/// The last time that something was refused, here or there.
pub type Finding = connection_handler::Finding<SocketAddr>;
