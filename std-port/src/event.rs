//! What a unit tells its subscribers.

/// Something happened that no call returned: functions by their names, the network as the names of the interfaces that are up.
pub type UnitEvent = cara_core::services::event::UnitEvent<String, Vec<String>>;
