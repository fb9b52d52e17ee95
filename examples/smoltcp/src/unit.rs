//! The unit that the program holds: what it offers and requests, and [`SUnit::poll`].

use core::net::SocketAddrV4;

use cara_core::distribution::connection_handler::Node;
use cara_core::distribution::function::{Attributes, Definition};
use cara_core::distribution::function_list::{FunctionList, Slot, TheirFunctionList};
use cara_core::distribution::parameters::ParametersView;
use cara_core::error::{CloseReason, Error, ServiceError};
use cara_core::host::secure::Plain;
use cara_core::services::hub::Hub;
use cara_core::services::lease::{Lease, Order};
use cara_core::services::requests::CallId;
use cara_core::services::session::{RequestOptions, Session, SessionStorage};
use cara_core::services::{Context, Port, Ticket};
use cara_core::storage::{Lent, Pool};
use cara_core::time::Instant;
use smoltcp::phy::Device;
use smoltcp::wire::Ipv4Cidr;

use crate::program::Program;
use crate::resources::{Arguments, Offered, Resources};
use crate::settings::Settings;
use crate::stack::Stack;

/// Frames that one poll takes from the device at most, so that a flood keeps nothing else waiting.
const FRAMES_PER_POLL: usize = 16;

/// Programs on bare smoltcp, as the core's port.
pub enum Smoltcp {}

impl Port for Smoltcp {
    type Storage = Lent;
    type Cipher = Plain;
    type Endpoint = SocketAddrV4;
}

/// An s_unit on smoltcp.
pub struct SUnit {
    pub(crate) stack: Stack,
    pub(crate) hub: Hub<Smoltcp>,
    pub(crate) functions: FunctionList<Lent, Offered>,
    pub(crate) buffers: Pool<Lent>,
    pub(crate) arguments: &'static mut Arguments,
    /// The link to the manager, from dialling to its end.
    pub(crate) session: Option<Session<Smoltcp>>,
    /// What the next link will live in.
    pub(crate) spare: Option<SessionStorage<Lent>>,
    /// Its stream has not opened yet.
    pub(crate) is_dialing: bool,
    /// A call that was served and whose answer found no room yet, and its results.
    pub(crate) results: &'static mut Arguments,
    pub(crate) unanswered: Option<(Ticket, Result<(), Error>)>,
}

/// Lends a session what it needs. A macro, since it borrows the unit's parts one by one.
macro_rules! context {
    ($unit:expr, $now:expr) => {
        &mut Context {
            now: $now,
            mailman: &mut $unit.stack,
            buffers: &mut $unit.buffers,
            functions: &$unit.functions,
            access: None,
            hub: &mut $unit.hub,
            keys: &mut (),
        }
    };
}
pub(crate) use context;

impl SUnit {
    /// A unit that begins to look for its manager at its first poll. `mac` is the device's own, and no group's.
    pub fn new<D: Device>(
        now: Instant,
        settings: Settings,
        mac: [u8; 6],
        device: &mut D,
        resources: &'static mut Resources,
    ) -> Self {
        let parts = resources.split();
        let mut stack = Stack::new(now, mac, settings.node.seed, device, parts.stack);
        stack.set_address(settings.address);
        Self {
            stack,
            hub: Hub { node: Node::new(now, settings.node, parts.node), publications: parts.publications },
            functions: parts.functions,
            buffers: parts.buffers,
            arguments: parts.arguments,
            session: None,
            spare: Some(parts.link),
            is_dialing: false,
            results: parts.results,
            unanswered: None,
        }
    }

    /// Adds a function and publishes it to the manager, now and on each later link. A function that attributes give a
    /// lease needs one here, which the program looks at before each step of a motion.
    pub fn offer(
        &mut self,
        now: Instant,
        definition: &Definition,
        attributes: Attributes,
        lease: Option<&'static Lease>,
    ) -> Result<Slot, Error> {
        if attributes.lease.is_some() != lease.is_some() {
            return Err(Error::BadConstraint);
        }
        let slot = self.functions.add_function(definition, attributes, Offered(lease))?;
        self.hub.publications.publish_to_all(slot)?;
        self.publish(now);
        Ok(slot)
    }

    /// Does all that is due and possible, without waiting, and says when to call it again; call it earlier when the
    /// device has received a frame, and after any other call of this unit.
    pub fn poll<D: Device, P: Program>(&mut self, now: Instant, device: &mut D, program: &mut P) -> Instant {
        // What is due comes before what has arrived: a lease that has ended stops its motion first.
        self.work(now, program);
        let taken = (0..FRAMES_PER_POLL).take_while(|_| {
            let any = self.stack.take_frame(now, device);
            if any {
                self.read(now, program);
            }
            any
        });
        let more = taken.count() == FRAMES_PER_POLL;
        self.work(now, program);
        self.stack.send_frames(now, device);
        if more { now } else { self.deadline(now) }
    }

    fn deadline(&mut self, now: Instant) -> Instant {
        let session = self.session.as_ref().map_or(Instant::FAR_FUTURE, Session::deadline);
        session.min(self.hub.node.next_deadline()).min(self.stack.deadline(now))
    }

    /// Requests a function of the manager. With `wants_reply` its end comes as [`Program::replied`] under the returned
    /// id; without, only a failure is told.
    pub fn request(
        &mut self,
        now: Instant,
        function: &str,
        parameters: &ParametersView,
        options: &RequestOptions,
        wants_reply: bool,
    ) -> Result<CallId, Error> {
        let session = self.session.as_mut().ok_or(Error::NotConnected)?;
        session.request(context!(self, now), function.into(), parameters, options, wants_reply)
    }

    /// Answers a call that the program serves [later](crate::Outcome::Later). [`Error::Full`]: try again after a poll.
    pub fn answer(
        &mut self,
        now: Instant,
        ticket: Ticket,
        results: Result<&ParametersView, ServiceError>,
    ) -> Result<(), Error> {
        let Some(session) = &mut self.session else { return Ok(()) };
        session.answer(context!(self, now), ticket, results.map_err(Error::Service))
    }

    /// What an order of this lease ([`Served::order`](cara_core::services::session::Incoming::order)) has started is finished: it ends,
    /// and nothing is made safe. `false` for one that has ended before.
    pub fn end_order(&mut self, now: Instant, lease: &'static Lease, order: Order) -> bool {
        let Some(session) = &mut self.session else { return false };
        session.end_order(context!(self, now), lease, order)
    }

    /// Gives up the leases that calls of a function of the manager have begun or will begin.
    pub fn release(&mut self, now: Instant, function: Slot) -> Result<(), Error> {
        let Some(session) = &mut self.session else { return Err(Error::NotConnected) };
        session.release(context!(self, now), function)
    }

    /// The manager has taken the unit.
    pub fn is_connected(&self) -> bool {
        self.session.as_ref().is_some_and(Session::is_live)
    }

    /// What the manager has published; nothing while there is no link.
    pub fn their_function_list(&self) -> Option<&TheirFunctionList<Lent>> {
        self.session.as_ref().map(Session::their_function_list)
    }

    /// Discovery and membership, for its counters and findings.
    pub fn node(&self) -> &Node<Smoltcp> {
        &self.hub.node
    }

    /// The link to the manager, for its counters.
    pub fn session(&self) -> Option<&Session<Smoltcp>> {
        self.session.as_ref()
    }

    /// The cable is out, as the device says: what goes on for the manager ends at the next poll instead of when nothing
    /// has been heard for long enough.
    pub fn link_down(&mut self) {
        if let Some(session) = &mut self.session {
            session.disconnected(CloseReason::Reset);
        }
    }

    /// The cable is in again: the unit looks for its manager at once.
    pub fn link_up(&mut self, now: Instant) {
        self.hub.node.broadcast(now);
    }

    /// The unit has another address, or none, as DHCP says. A link from the old one ends.
    pub fn set_address(&mut self, now: Instant, address: Option<Ipv4Cidr>) {
        self.stack.set_address(address);
        self.link_down();
        self.link_up(now);
    }
}
