//! The core's two machines of one unit, in one cell, with the sockets and tables that they use.

use cara_core::distribution::claim::{Claim, StoredClaim, TaggedClaim};
use cara_core::distribution::connection_handler::Command;
use cara_core::distribution::function_list::FunctionList;
use cara_core::distribution::identity::{Identity, Role};
use cara_core::host::connections::LinkCounter;
use cara_core::host::mailman::LinkId;
use cara_core::services::hub::Hub;
use cara_core::services::session::{Incoming, Session, SessionConfig};
use cara_core::services::{Context, Port};
use cara_core::storage::{Lent, Pool};
use cara_core::time::{Duration, Instant};
use core::cell::{Cell, RefCell};
use core::future::Future;
use core::net::{Ipv4Addr, SocketAddrV4};
use core::pin::pin;
use core::task::{Context as TaskContext, Waker};
use embassy_sync::waitqueue::WakerRegistration;

use crate::config::Table;
use crate::event::{Events, UnitEvent};
use crate::handler::{Hook, Listed};
use crate::limits::Limits;
use crate::link::Link;
use crate::mail::{Connection, Mail};
use crate::owned::{Owned, Places};
use crate::port::{Board, LinkContext, LinkCounters, LinkSession};
use crate::replies::ReplyBox;
use crate::security::Proof;
use crate::task_slots::TaskSlot;
use crate::time::{now, timer};

/// Tasks that are woken for the same thing. Each further one looks every [`LOOK`].
const TASKS_WAITING: usize = 4;
const LOOK: Duration = Duration::from_millis(100);

/// What a handle points to.
pub(crate) struct Shared<T: 'static> {
    pub(crate) machine: RefCell<Machine<T>>,
    /// The application's state, which has a cell of its own: a service that runs with it may use the unit.
    pub(crate) state: RefCell<T>,
    /// What was dropped while the machine was in use.
    pub(crate) unwanted: Unwanted<T>,
}

/// A pointer, so that the image of a unit that drops no such thing does not contain the function.
type GiveUp<T> = Cell<Option<fn(&mut Machine<T>)>>;

/// What the machine gives up when it is free: outside of its cell, for what is dropped while it is in use.
pub(crate) struct Unwanted<T: 'static> {
    /// Of each link.
    places: &'static [Places],
    /// Gives up this unit's calls that are marked there.
    pub(crate) made: GiveUp<T>,
    /// Answers calls of peers that are marked there.
    pub(crate) taken: GiveUp<T>,
    /// Ends the subscriptions whose cells say that they were dropped.
    #[cfg(feature = "streams")]
    pub(crate) readings: GiveUp<T>,
}

impl<T> Unwanted<T> {
    pub(crate) const fn new(places: &'static [Places]) -> Self {
        Self {
            places,
            made: Cell::new(None),
            taken: Cell::new(None),
            #[cfg(feature = "streams")]
            readings: Cell::new(None),
        }
    }

    fn all(&self) -> impl Iterator<Item = &GiveUp<T>> {
        #[cfg(feature = "streams")]
        let all = [&self.made, &self.taken, &self.readings];
        #[cfg(not(feature = "streams"))]
        let all = [&self.made, &self.taken];
        all.into_iter()
    }

    /// The value of a call was dropped.
    pub(crate) fn mark(&self, link: u16, call: Owned) {
        if let Some(places) = self.places.get(usize::from(link)) {
            places.mark(call);
        }
    }

    /// Whether something was dropped.
    pub(crate) fn is_due(&self) -> bool {
        self.all().any(|give_up| give_up.get().is_some())
    }

    pub(crate) fn release(&self, machine: &mut Machine<T>) {
        for give_up in self.all() {
            if let Some(give_up) = give_up.take() {
                give_up(machine);
            }
        }
    }
}

/// The call that the runner is to run next, if there is one; its arguments are in the runner's parameters.
// A wide tag, and nothing narrow beside the call: it is then moved in words, and not byte by byte.
#[repr(u32)]
pub(crate) enum Started {
    Nothing,
    Call(Incoming),
}

/// What the unit is made of.
pub(crate) struct Machine<T: 'static> {
    pub(crate) hub: Hub<Board>,
    /// Proves this unit's identity to peers.
    pub(crate) proof: Proof,
    /// The access table.
    pub(crate) access: Table,
    /// Stores the claim of an m_unit.
    pub(crate) store_own: Option<fn(Claim) -> bool>,
    /// Stores a claim that is obeyed.
    pub(crate) store: Option<fn(&StoredClaim) -> bool>,
    /// One that is to be stored as soon as nothing moves.
    pub(crate) unstored: Option<(Identity, TaggedClaim)>,
    pub(crate) functions: FunctionList<Lent, Listed<T>>,
    pub(crate) pool: Pool<Lent>,
    pub(crate) links: &'static mut [Link],
    /// Where calls of each link are marked.
    pub(crate) places: &'static [Places],
    pub(crate) mail: Mail,
    pub(crate) reply: ReplyBox,
    #[cfg(feature = "streams")]
    pub(crate) readings: crate::readings::Readings,
    pub(crate) tasks: &'static mut [TaskSlot],
    /// Calls that were left to tasks so far.
    pub(crate) left_to_tasks: u32,
    pub(crate) events: Events,
    pub(crate) started: Started,
    /// The link that it came on.
    pub(crate) started_on: u16,
    /// The runner is to let other tasks run.
    pub(crate) yields: bool,
    pub(crate) lost_hook: Option<&'static Hook<T>>,
    /// Where an m_unit listens.
    pub(crate) tcp_port: u16,
    /// The unit's own address; none while the cable is out or no address is known.
    pub(crate) address: Option<Ipv4Addr>,
    /// When the cable and the address are looked at again.
    pub(crate) look: Instant,
    /// It has had an address.
    pub(crate) has_started: bool,
    /// It has been stopped, and only ends its connections.
    pub(crate) stopped: bool,
    /// When the next refused link may be logged.
    pub(crate) logged: Instant,
    /// How old the keys of a link become.
    pub(crate) renews_every: Duration,
    /// Of the links that have ended.
    pub(crate) counters: LinkCounters,
    pub(crate) limits: &'static Limits,
    pub(crate) wakers: Wakers,
}

/// Wakers of waiting tasks.
pub(crate) struct Wakers {
    /// The runner: something was asked of the unit.
    pub(crate) runner: WakerRegistration,
    /// The reader of events.
    pub(crate) events: WakerRegistration,
    /// A peer came, went or was told something.
    pub(crate) news: Waiting,
    /// A call waits for a task.
    pub(crate) calls: Waiting,
    /// A lease of one of this unit's services has ended, or gone over to a newer call; or a call that runs was given up.
    pub(crate) leases: Waiting,
}

/// Tasks that wait for the same thing.
pub(crate) struct Waiting(heapless::Vec<Waker, TASKS_WAITING>);

impl Waiting {
    const fn new() -> Self {
        Self(heapless::Vec::new())
    }

    /// The task is woken once, for all of them or in [`LOOK`]: were another task woken to make room for it, they would wake each
    /// other for ever.
    pub(crate) fn register(&mut self, context: &mut TaskContext<'_>) {
        let waker = context.waker();
        let is_known = self.0.iter().any(|known| known.will_wake(waker));
        if !is_known && self.0.push(waker.clone()).is_err() {
            let _ = pin!(timer(now() + LOOK)).poll(context);
        }
    }

    pub(crate) fn wake(&mut self) {
        core::mem::take(&mut self.0).into_iter().for_each(Waker::wake);
    }
}

impl Wakers {
    pub(crate) const fn new() -> Self {
        Self {
            runner: WakerRegistration::new(),
            events: WakerRegistration::new(),
            news: Waiting::new(),
            calls: Waiting::new(),
            leases: Waiting::new(),
        }
    }
}

impl<T> Machine<T> {
    pub(crate) fn link(&self, index: u16) -> Option<&Link> {
        self.links.get(usize::from(index))
    }

    pub(crate) fn link_mut(&mut self, index: u16) -> Option<&mut Link> {
        self.links.get_mut(usize::from(index))
    }

    /// The index of each link.
    pub(crate) fn indices(&self) -> core::ops::Range<u16> {
        0..u16::try_from(self.links.len()).unwrap_or(u16::MAX)
    }

    /// The live link to a peer.
    pub(crate) fn link_to(&self, peer: &Identity) -> Option<u16> {
        self.indices().find(|index| self.link(*index).is_some_and(|link| link.is_live() && link.peer() == Some(peer)))
    }

    /// Lends the session of a link with its context.
    pub(crate) fn with<R>(
        &mut self,
        index: u16,
        act: impl FnOnce(&mut LinkSession, &mut LinkContext<'_>) -> R,
    ) -> Option<R> {
        let (session, mut context) = self.lend(index)?;
        Some(act(session, &mut context))
    }

    /// Kept apart from the many that use it.
    #[inline(never)]
    fn lend(&mut self, index: u16) -> Option<(&mut LinkSession, LinkContext<'_>)> {
        let Self { links, mail, pool, functions, access, hub, proof, .. } = self;
        let session = links.get_mut(usize::from(index))?.session.as_mut()?;
        let access = access.0;
        Some((session, Context { now: now(), mailman: mail, buffers: pool, functions, access, hub, keys: proof }))
    }

    /// Lets the node do what is due.
    #[inline(never)]
    pub(crate) fn poll_node(&mut self, context: &mut TaskContext<'_>) -> Option<Command<SocketAddrV4>> {
        if Board::MANAGES && self.mail.has_datagram(context) {
            self.hub.node.left_unread();
        }
        self.hub.node.poll(now(), &mut self.mail, self.proof.codes())
    }

    /// Makes the session of a link. `None` when the link is in use.
    #[inline(never)]
    pub(crate) fn open(&mut self, index: u16, address: SocketAddrV4, dialed: bool) -> Option<()> {
        let storage = self.link_mut(index)?.storage.take()?;
        let nonce = self.hub.node.nonce();
        let constraints = *self.hub.node.constraints();
        let config = SessionConfig { link: LinkId(index), dialed, address, nonce, constraints };
        let cipher = self.proof.cipher();
        let mut session = Session::new(now(), config, cipher, storage);
        session.renew_every(self.renews_every);
        let link = self.link_mut(index)?;
        link.session = Some(session);
        link.since = now();
        Some(())
    }

    /// A link that could dial: one whose socket is idle, if there is any.
    pub(crate) fn free_link(&self) -> Option<u16> {
        let free = |index: &u16| {
            let line = self.mail.connections.get(usize::from(*index)).is_some_and(|line| !line.is_in_use());
            line && self.link(*index).is_some_and(|link| link.storage.is_some())
        };
        let closing = |index: &u16| self.mail.connections.get(usize::from(*index)).is_some_and(Connection::is_closing);
        let mut candidates = self.indices().filter(free);
        let first = candidates.next()?;
        if closing(&first) { candidates.find(|index| !closing(index)).or(Some(first)) } else { Some(first) }
    }

    /// The accepted links on which the peer has not proven its identity, or in plain mode not sent its hello: when each
    /// was opened, and its index.
    pub(crate) fn pending(&self) -> impl Iterator<Item = (Instant, u16)> {
        self.indices().filter_map(|index| {
            let link = self.link(index)?;
            let session = link.session.as_ref()?;
            (!session.dialed() && !session.is_proven()).then_some((link.since, index))
        })
    }

    /// Takes connections with every socket that has nothing else to do, if the unit is one that is dialled.
    pub(crate) fn listen(&mut self) {
        if Board::MANAGES && self.hub.node.identity().role() == Role::MUnit && self.address.is_some() && !self.stopped {
            let port = self.tcp_port;
            self.mail.connections.iter_mut().for_each(|line| line.listen(port));
        }
    }

    /// Queues an event for the application.
    pub(crate) fn notify(&mut self, event: UnitEvent) {
        self.events.put(event);
        // Lets the reader of events run, so that a short queue suffices for any number of events.
        self.yields |= self.wakers.events.occupied();
        self.wakers.events.wake();
        self.wakers.news.wake();
    }

    /// The runner has to look again.
    pub(crate) fn wake_runner(&mut self) {
        self.wakers.runner.wake();
    }

    /// What happened on all links, also those that have ended.
    pub(crate) fn counted(&self, counter: LinkCounter) -> u64 {
        let live = self.links.iter().filter_map(|link| link.session.as_ref());
        let live: u64 = live.map(|session| session.counters().value(counter)).sum();
        live.saturating_add(self.counters.value(counter))
    }
}
