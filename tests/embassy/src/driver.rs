//! A port of the switch as embassy-net sees its device.

use std::cell::RefCell;
use std::rc::Rc;
use std::task::{Context, Waker};

use cara_ethernet::{Mac, PortId, Switch};
use embassy_net_driver::{Capabilities, Driver, HardwareAddress, LinkState, RxToken, TxToken};

use crate::clock;

/// Two addresses, a type and 1,500 bytes.
const FRAME: usize = 1_514;

/// Who is told when a frame has come or the cable was moved.
pub(crate) type Listener = Rc<RefCell<Option<Waker>>>;

pub(crate) struct Cable {
    pub(crate) switch: Rc<RefCell<Switch>>,
    pub(crate) port: PortId,
    pub(crate) mac: Mac,
    pub(crate) listener: Listener,
}

impl Cable {
    fn listen(&self, context: &Context<'_>) {
        *self.listener.borrow_mut() = Some(context.waker().clone());
    }
}

impl Driver for Cable {
    type RxToken<'a> = Received;
    type TxToken<'a> = Sending<'a>;

    fn receive(&mut self, context: &mut Context<'_>) -> Option<(Received, Sending<'_>)> {
        self.listen(context);
        let frame = self.switch.borrow_mut().receive(clock::now(), self.port)?;
        Some((Received(frame), Sending(self)))
    }

    fn transmit(&mut self, _: &mut Context<'_>) -> Option<Sending<'_>> {
        Some(Sending(self))
    }

    fn link_state(&mut self, context: &mut Context<'_>) -> LinkState {
        self.listen(context);
        if self.switch.borrow().is_up(self.port) { LinkState::Up } else { LinkState::Down }
    }

    fn capabilities(&self) -> Capabilities {
        let mut capabilities = Capabilities::default();
        capabilities.max_transmission_unit = FRAME;
        capabilities
    }

    fn hardware_address(&self) -> HardwareAddress {
        HardwareAddress::Ethernet(self.mac.0)
    }
}

/// A frame that has come.
pub(crate) struct Received(Vec<u8>);

impl RxToken for Received {
    fn consume<R, F: FnOnce(&mut [u8]) -> R>(mut self, read: F) -> R {
        read(&mut self.0)
    }
}

/// Leave to send a frame.
pub(crate) struct Sending<'c>(&'c Cable);

impl TxToken for Sending<'_> {
    fn consume<R, F: FnOnce(&mut [u8]) -> R>(self, length: usize, write: F) -> R {
        let mut frame = vec![0; length];
        let result = write(&mut frame);
        self.0.switch.borrow_mut().send(clock::now(), self.0.port, &frame);
        result
    }
}
