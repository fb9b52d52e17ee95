//! What a unit tells its application.

use cara_core::config::NAME_BYTES;
use core::net::{Ipv4Addr, SocketAddrV4};

/// The name of a function.
pub type Name = heapless::String<NAME_BYTES>;

/// Something happened that no call returned: functions by their names, the network as the address that the board has.
pub type UnitEvent = cara_core::services::event::UnitEvent<Name, Option<Ipv4Addr>, SocketAddrV4>;

/// Queue of unread events; when it is full, new ones are lost and counted.
pub(crate) struct Events {
    slots: &'static mut [Option<UnitEvent>],
    first: usize,
    count: usize,
    pub(crate) lost: u32,
}

impl Events {
    pub(crate) fn new(slots: &'static mut [Option<UnitEvent>]) -> Self {
        Self { slots, first: 0, count: 0, lost: 0 }
    }

    pub(crate) fn put(&mut self, event: UnitEvent) {
        let length = self.slots.len();
        if self.count >= length {
            self.lost = self.lost.saturating_add(1);
            return;
        }
        let place = self.first.wrapping_add(self.count).checked_rem(length).unwrap_or(0);
        if let Some(slot) = self.slots.get_mut(place) {
            *slot = Some(event);
            self.count = self.count.saturating_add(1);
        }
    }

    pub(crate) fn take(&mut self) -> Option<UnitEvent> {
        let event = self.slots.get_mut(self.first)?.take()?;
        self.first = self.first.wrapping_add(1).checked_rem(self.slots.len()).unwrap_or(0);
        self.count = self.count.saturating_sub(1);
        Some(event)
    }
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used)]
    extern crate std;

    use super::*;
    use cara_core::distribution::identity::Identity;
    use std::boxed::Box;
    use std::vec::Vec;

    fn skipped(count: u16) -> UnitEvent {
        UnitEvent::FunctionsSkipped { peer: Identity::s_unit("agv", 1).unwrap(), skipped: count }
    }

    #[test]
    fn events_come_in_order_and_the_lost_ones_are_counted() {
        let mut events = Events::new(Box::leak(Box::new([const { None }; 3])));
        (0..4).for_each(|count| events.put(skipped(count)));
        assert_eq!(events.lost, 1);
        assert_eq!(events.take(), Some(skipped(0)));
        events.put(skipped(9));
        let rest: Vec<_> = core::iter::from_fn(|| events.take()).collect();
        assert_eq!(rest, [skipped(1), skipped(2), skipped(9)]);
    }
}
