//! A port of the switch as embassy-net sees its device.

use std::cell::{Cell, RefCell};
use std::rc::Rc;
use std::task::{Context, Waker};

use cara_core::time::Instant;
use cara_ethernet::{Mac, PortId, Switch};
use embassy_net_driver::{Capabilities, Driver, HardwareAddress, LinkState, RxToken, TxToken};

use crate::clock;
use crate::gate::Gate;

/// Two addresses, a type and 1,500 bytes.
const FRAME: usize = 1_514;

/// Where a board is plugged in, in all its lives.
#[derive(Clone)]
pub(crate) struct Plug {
    pub(crate) switch: Rc<RefCell<Switch>>,
    pub(crate) port: PortId,
    pub(crate) mac: Mac,
    pub(crate) gate: Rc<RefCell<Gate>>,
    /// The waker for an arrived frame or a moved cable.
    pub(crate) listener: Rc<RefCell<Option<Waker>>>,
    /// The driver has not noticed yet that the cable is plugged in.
    pub(crate) is_unnoticed: Rc<Cell<bool>>,
}

impl Plug {
    fn listen(&self, context: &Context<'_>) {
        *self.listener.borrow_mut() = Some(context.waker().clone());
    }

    /// Has the board's stack look at its device.
    pub(crate) fn wake(&self) {
        if let Some(waker) = self.listener.take() {
            waker.wake();
        }
    }

    /// When the next frame arrives; `None` while the stack has not polled for the one before.
    pub(crate) fn next_arrival(&self) -> Option<Instant> {
        self.listener.borrow().as_ref()?;
        let held = self.gate.borrow().next();
        self.switch.borrow().next_arrival(self.port).into_iter().chain(held).min()
    }

    fn receive(&self) -> Option<Vec<u8>> {
        let mut gate = self.gate.borrow_mut();
        loop {
            let heard = match gate.take(clock::now()) {
                Some(frame) => Some(frame),
                None => {
                    let frame = self.switch.borrow_mut().receive(clock::now(), self.port)?;
                    gate.pass(clock::now(), frame)
                }
            };
            if let Some(frame) = heard {
                gate.hear(&frame);
                return Some(frame);
            }
        }
    }
}

pub(crate) struct Cable(pub(crate) Plug);

impl Driver for Cable {
    type RxToken<'a> = Received;
    type TxToken<'a> = Sending<'a>;

    fn receive(&mut self, context: &mut Context<'_>) -> Option<(Received, Sending<'_>)> {
        self.0.listen(context);
        let frame = self.0.receive()?;
        Some((Received(frame), Sending(&self.0)))
    }

    fn transmit(&mut self, _: &mut Context<'_>) -> Option<Sending<'_>> {
        Some(Sending(&self.0))
    }

    fn link_state(&mut self, context: &mut Context<'_>) -> LinkState {
        self.0.listen(context);
        let is_up = self.0.switch.borrow().is_up(self.0.port) && !self.0.is_unnoticed.get();
        if is_up { LinkState::Up } else { LinkState::Down }
    }

    fn capabilities(&self) -> Capabilities {
        let mut capabilities = Capabilities::default();
        capabilities.max_transmission_unit = FRAME;
        capabilities
    }

    fn hardware_address(&self) -> HardwareAddress {
        HardwareAddress::Ethernet(self.0.mac.0)
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
pub(crate) struct Sending<'c>(&'c Plug);

impl TxToken for Sending<'_> {
    fn consume<R, F: FnOnce(&mut [u8]) -> R>(self, length: usize, write: F) -> R {
        let mut frame = vec![0; length];
        let result = write(&mut frame);
        self.0.switch.borrow_mut().send(clock::now(), self.0.port, &frame);
        result
    }
}
