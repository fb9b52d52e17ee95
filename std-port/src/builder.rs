//! Builder of a unit: identity first, then whatever differs from the defaults.

use std::fmt;
use std::marker::PhantomData;
use std::path::PathBuf;
use std::sync::Arc;

use cara_core::config::{Constraints, Mode};
use cara_core::distribution::connection_handler::{Node, NodeConfig, Target};
use cara_core::distribution::function_list::{Entry, FunctionList};
use cara_core::distribution::hello::Manager;
use cara_core::distribution::identity::{Epoch, Fleet, Identity, Role};
use cara_core::error::Error;
use cara_core::services::hub::Hub;
use cara_core::services::publications::Publications;
use cara_core::time::Duration;
use core::net::SocketAddr;

use crate::access::AccessTable;
#[cfg(feature = "access")]
use crate::access::{AccessError, watch::FileWatch};
use crate::authority::Authority;
use crate::config::{Capacities, check};
use crate::engine::claims::TakeOver;
use crate::engine::{Engine, EngineParts, HubCell, Keys, message_buffer_bytes, node_storage};
use crate::error::system_refused;
use crate::error::{CallError, StartError};
use crate::handle::{Handle, MUnit, Owner, SUnit};
use crate::keys::{KeyError, KeyRing, LiveRing};
use crate::pool::MessagePool;
use crate::storage::{filled, filled_with};
use crate::sys;
use crate::sys::datagram::Datagrams;
use crate::sys::interfaces::Interfaces;
use crate::sys::stream::Listener;
use crate::threads::Threads;

/// Message buffers that a unit keeps while it is idle.
const KEPT_BUFFERS: usize = 8;

/// Makes a [`CommunicationSystem`](crate::CommunicationSystem) or a [`Unit`](crate::Unit), by the role `R`.
///
/// What only an m_unit has, an s_unit's builder does not:
///
/// ```compile_fail
/// cara_std::Unit::builder("agv", 7, "depot", 1).unwrap().tcp_port(4000);
/// ```
pub struct Builder<T, R> {
    pub(crate) identity: Identity,
    pub(crate) target: Target<SocketAddr>,
    fleet: Fleet,
    /// What was set by hand.
    constraints: Option<Constraints>,
    capacities: Capacities,
    interfaces: Interfaces,
    keys: KeySource,
    discovery_port: Option<u16>,
    tcp_port: u16,
    threads: Option<Threads>,
    spin: Duration,
    /// The m_units that an m_unit connects to, if not all.
    m_units: Option<Box<[Identity]>>,
    #[cfg(feature = "control")]
    control: crate::control::Control,
    #[cfg(feature = "control")]
    audit: Option<Arc<crate::control::Audit>>,
    access: Option<AccessTable>,
    #[cfg(feature = "access")]
    access_file: Option<FileWatch>,
    asks_for_itself: bool,
    state_folder: Option<PathBuf>,
    take_over: TakeOver,
    stands_by: bool,
    authority: Option<Box<dyn Authority>>,
    starts_stopped: Option<u16>,
    core_recordings: Option<PathBuf>,
    state: T,
    role: PhantomData<fn() -> R>,
}

impl<T, R> fmt::Debug for Builder<T, R> {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.debug_struct("Builder").field("identity", &self.identity).field("fleet", &self.fleet).finish_non_exhaustive()
    }
}

impl<R> Builder<(), R> {
    pub(crate) fn new(identity: Identity, target: Target<SocketAddr>) -> Self {
        #[cfg(feature = "control")]
        let control = match identity.role() {
            Role::MUnit => crate::control::Control::Default,
            Role::SUnit => crate::control::Control::Off,
        };
        Self {
            identity,
            target,
            fleet: Fleet(0),
            constraints: None,
            capacities: Capacities::default(),
            interfaces: Interfaces::from_environment(),
            keys: KeySource::Found,
            discovery_port: None,
            tcp_port: 0,
            threads: None,
            spin: Duration::ZERO,
            m_units: None,
            #[cfg(feature = "control")]
            control,
            #[cfg(feature = "control")]
            audit: None,
            access: None,
            #[cfg(feature = "access")]
            access_file: None,
            asks_for_itself: true,
            state_folder: crate::claims::folder(),
            take_over: TakeOver::No,
            stands_by: false,
            authority: None,
            starts_stopped: None,
            core_recordings: None,
            state: (),
            role: PhantomData,
        }
    }
}

impl<T: Send + 'static> Builder<T, MUnit> {
    /// Records each link's session with all that it takes in a file of this folder, so that [`rerun`](crate::rerun) does the same
    /// again: for a fault that is hard to repeat. The files have the arguments and results of calls in the clear, none is written
    /// over, and recording takes time: a disk that hangs holds up the unit, and its stops. Only in plain mode, [`BuildError::CoreRecordingWithKeys`] otherwise; a recording ends early, and
    /// says why, where the unit offers functions of its own, has an access table, or renews a call by a [heart](crate::Heart).
    pub fn record_core(mut self, folder: impl Into<PathBuf>) -> Self {
        self.core_recordings = Some(folder.into());
        self
    }

    /// The TCP port on which the m_unit takes connections; one that is free unless set. For s_units that are told a
    /// [`manager_address`](Self::manager_address).
    pub fn tcp_port(mut self, port: u16) -> Self {
        self.tcp_port = port;
        self
    }

    /// It starts without asking whether a live one has its name and id. Two of one identity take s_units from
    /// each other: for tests of that.
    pub fn beside_another(mut self) -> Self {
        self.asks_for_itself = false;
        self
    }

    /// It starts although a live one of its name and id answers, with a higher [claim](crate::Claim): the other one steps down, its
    /// orders end, and its s_units come to this one. Until it has had the highest claim once, it raises its claim above any other. A
    /// decision of the operator's, refused where another one has taken over within the last minute.
    pub fn take_over(mut self, takes_over: bool) -> Self {
        self.take_over = if takes_over { TakeOver::Yes } else { TakeOver::No };
        self
    }

    /// The same also where another one has taken over within the last minute.
    pub fn force_take_over(mut self) -> Self {
        self.take_over = TakeOver::Forced;
        self
    }

    /// The m_unit starts as a standby: it waits, connected to nobody, until no manager of its name and id answers any more and no
    /// vehicle has heard one for three keep-alives. Then it commands, and its s_units come to it. Where another one commands with a
    /// higher [claim](crate::Claim) it stands by again, in place of [`UnitEvent::Fenced`](crate::UnitEvent::Fenced). It
    /// takes nothing over by [`take_over`](Self::take_over). Two of them on two hosts, each with a [folder of
    /// state](Self::state_folder) of its own and the same `keep_alive`, are one manager that outlives a host. It has a
    /// [control socket](crate::control) while it commands. It takes keys and such a folder: [`BuildError::StandbyWithoutKeys`] in
    /// plain mode, [`BuildError::StandbyWithoutState`].
    ///
    /// ```no_run
    /// use cara_std::{CommunicationSystem, UnitEvent};
    ///
    /// let depot = CommunicationSystem::builder("depot", 1)?.standby().build()?;
    /// let events = depot.events();
    /// depot.start()?;
    /// for event in events {
    ///     match event {
    ///         UnitEvent::TookCommand { claim } => println!("commands with the claim {claim}"),
    ///         UnitEvent::StandsBy { .. } => println!("waits"),
    ///         _ => {}
    ///     }
    /// }
    /// # Ok::<(), cara_std::BuildError>(())
    /// ```
    pub fn standby(mut self) -> Self {
        self.stands_by = true;
        self
    }

    /// The m_unit claims its vehicles only while this [`Authority`] has given it a key, which one manager of its name, id and fleet
    /// has at a time: it starts with the key, or does not start ([`StartError::NoAuthority`]); a [standby](Self::standby) asks for
    /// it when it is to command. With the key it leads ([`UnitEvent::Leading`](crate::UnitEvent::Leading),
    /// [`is_leading`](crate::CommunicationSystem::is_leading)). Where it loses the key, or the authority does not answer in time, its links
    /// and orders go on ([`UnitEvent::NotLeading`](crate::UnitEvent::NotLeading)); it raises its claim no more, and calls that are
    /// [only for a leader](crate::Call::only_while_leading) fail with [`Error::NoAuthority`]. When it has the key again it raises its
    /// claim, and leads. It takes keys: [`BuildError::AuthorityWithoutKeys`] in plain mode.
    pub fn authority(mut self, authority: impl Authority) -> Self {
        self.authority = Some(Box::new(authority));
        self
    }

    /// Of all m_units an m_unit connects to these alone, by name and ID number; to every one of its fleet unless set,
    /// and to none with none named. Two m_units connect only if each selects the other. An s_unit connects to its
    /// manager, whatever is set here.
    ///
    /// ```no_run
    /// use cara_std::CommunicationSystem;
    ///
    /// let hall = CommunicationSystem::builder("hall", 2)?.m_units([("depot", 1), ("gate", 3)])?.build()?;
    /// # Ok::<(), cara_std::BuildError>(())
    /// ```
    pub fn m_units<N: AsRef<str>>(mut self, m_units: impl IntoIterator<Item = (N, u32)>) -> Result<Self, Error> {
        let identities = m_units.into_iter().map(|(name, id)| Identity::m_unit(name.as_ref(), id));
        self.m_units = Some(identities.collect::<Result<_, _>>()?);
        Ok(self)
    }

    /// Where an m_unit answers its operator once it is started; in the default directory unless set.
    #[cfg(feature = "control")]
    pub fn control(mut self, control: crate::control::Control) -> Self {
        self.control = control;
        self
    }

    /// Notes what operators have it do, and what this program moves, stops and resets: one line of JSON at the end of this file
    /// for each order, stop, reset and refusal, with who asked (`docs/cara.md`, "Audit log"). A thread of
    /// its own writes them; what its disk does not take in time is dropped and counted (`AuditLinesLost`). A file of 4 MiB is put aside under the name with `.1` behind it.
    #[cfg(feature = "control")]
    pub fn audit(mut self, path: impl AsRef<std::path::Path>) -> std::io::Result<Self> {
        self.audit = Some(Arc::new(crate::control::Audit::open(path.as_ref())?));
        Ok(self)
    }
}

impl<T: Send + 'static> Builder<T, SUnit> {
    /// The manager is at this address: it is dialled, and nothing is broadcast.
    pub fn manager_address(mut self, address: SocketAddr) -> Self {
        if let Target::Manager(manager) = self.target {
            self.target = Target::Fixed(manager, address);
        }
        self
    }
}

impl<T: Send + 'static, R> Builder<T, R> {
    /// Units of different fleets on one network never connect; 0 unless set.
    pub fn fleet(mut self, fleet: u32) -> Self {
        self.fleet = Fleet(fleet);
        self
    }

    /// The limits to begin with: [`Constraints::M_UNIT`] unless set, of a [standby](Builder::standby) [`Constraints::STANDBY`]; of an
    /// s_unit [`Constraints::S_UNIT`] with messages as long as an m_unit's.
    pub fn constraints(mut self, constraints: Constraints) -> Self {
        self.constraints = Some(constraints);
        self
    }

    /// The sizes of the unit's tables.
    pub fn capacities(mut self, capacities: Capacities) -> Self {
        self.capacities = capacities;
        self
    }

    /// All IPv4 interfaces, or loopback alone; the environment's `CARA_INTERFACES=lo` unless set.
    pub fn interfaces(mut self, interfaces: Interfaces) -> Self {
        self.interfaces = interfaces;
        self
    }

    /// The file with the unit's keys, instead of where [`location`](crate::keys::location) looks, which is the default.
    pub fn key_file(mut self, path: impl Into<PathBuf>) -> Self {
        self.keys = KeySource::File(path.into());
        self
    }

    /// The unit's keys, which follow no file.
    pub fn keys(mut self, ring: KeyRing) -> Self {
        self.keys = KeySource::Ring(Box::new(ring));
        self
    }

    /// Plain mode: every host on the network can read what the unit says, and speak as any unit. It has a port of its
    /// own, does not connect to units with keys, and warns in the log when it starts.
    pub fn insecure(mut self) -> Self {
        self.keys = KeySource::Insecure;
        self
    }

    /// The folder in which the unit stores its [claims](crate::Claim) and whether it is stopped, made if it is not there; what `CARA_STATE` names unless set,
    /// or systemd's `STATE_DIRECTORY`. Without one, an m_unit begins with the first term again, and an s_unit forgets with its end
    /// which managers it has to refuse. A unit in plain mode stores nothing that it obeys.
    pub fn state_folder(mut self, folder: impl Into<PathBuf>) -> Self {
        self.state_folder = Some(folder.into());
        self
    }

    /// All that the unit moves starts stopped, for this reason ([`Error::Inhibited`](crate::Error::Inhibited)), until a service
    /// resets it: for one without a folder of state. With one it starts stopped where it was stopped when it ended.
    pub fn starts_stopped(mut self, reason: u16) -> Self {
        self.starts_stopped = Some(reason);
        self
    }

    /// The UDP port of broadcasts, the same for all units of a fleet. Unless set, the port of the unit's mode.
    pub fn discovery_port(mut self, port: u16) -> Self {
        self.discovery_port = Some(port);
        self
    }

    /// The unit shares these threads with others of its process; unless set, it has threads of its own.
    pub fn threads(mut self, threads: &Threads) -> Self {
        self.threads = Some(threads.clone());
        self
    }

    /// A thread that waits for a reply, or for the next of calls that follow each other at once, polls the link for so long before
    /// it sleeps: a round trip saves the time of waking it, and a CPU is busy meanwhile (`docs/performance.md`, "Spinning"). At
    /// most 1 ms; zero, which is not at all, unless set. On a link where that was in vain ever fewer waits spin, down to one in 256.
    pub fn spin(mut self, at_most: impl Into<Duration>) -> Self {
        self.spin = at_most.into();
        self
    }

    /// The application's state, which methods get (paper, section 2: "the object class to be passed as a template
    /// parameter").
    pub fn state<U: Send + 'static>(self, state: U) -> Builder<U, R> {
        Builder {
            identity: self.identity,
            target: self.target,
            fleet: self.fleet,
            constraints: self.constraints,
            capacities: self.capacities,
            interfaces: self.interfaces,
            keys: self.keys,
            discovery_port: self.discovery_port,
            tcp_port: self.tcp_port,
            threads: self.threads,
            spin: self.spin,
            m_units: self.m_units,
            #[cfg(feature = "control")]
            control: self.control,
            #[cfg(feature = "control")]
            audit: self.audit,
            access: self.access,
            #[cfg(feature = "access")]
            access_file: self.access_file,
            asks_for_itself: self.asks_for_itself,
            state_folder: self.state_folder,
            take_over: self.take_over,
            stands_by: self.stands_by,
            authority: self.authority,
            starts_stopped: self.starts_stopped,
            core_recordings: self.core_recordings,
            state,
            role: PhantomData,
        }
    }

    /// The initial access table: see [`access`](crate::access). Without one, a joined node may do everything.
    pub fn access(mut self, table: AccessTable) -> Self {
        self.access = Some(table);
        self
    }

    /// As [`access`](Self::access), from a file: see `docs/access.md`. What is written to it while the unit runs is taken
    /// over within a second or two; a mistake keeps the table that is in force, and is told in the log and counted.
    #[cfg(feature = "access")]
    pub fn access_file(mut self, path: impl Into<PathBuf>) -> Result<Self, AccessError> {
        let (watch, table) = FileWatch::open(path.into())?;
        self.access_file = Some(watch);
        Ok(self.access(table))
    }

    /// The unit; it does nothing until it is started.
    pub fn build(self) -> Result<Handle<T, R>, BuildError> {
        #[cfg(feature = "control")]
        let (control, audit) = (self.control.clone(), self.audit.clone());
        let engine = self.engine()?;
        Ok(Handle::of(Owner::new(
            engine,
            #[cfg(feature = "control")]
            control,
            #[cfg(feature = "control")]
            audit,
        )))
    }

    fn engine(self) -> Result<Arc<Engine<T>>, BuildError> {
        let constraints = self.constraints.unwrap_or_else(|| defaults(self.identity.role(), self.stands_by));
        check(&constraints)?;
        let keys = self.keys.open(&self.identity, &self.target, self.fleet)?;
        if self.stands_by && keys.mode() == Mode::Plain {
            return Err(BuildError::StandbyWithoutKeys);
        }
        if self.stands_by && self.state_folder.is_none() {
            return Err(BuildError::StandbyWithoutState);
        }
        if self.authority.is_some() && keys.mode() == Mode::Plain {
            return Err(BuildError::AuthorityWithoutKeys);
        }
        if self.core_recordings.is_some() && keys.mode() == Mode::Secured {
            return Err(BuildError::CoreRecordingWithKeys);
        }
        let discovery_port = self.discovery_port.unwrap_or(keys.mode().port());
        let own_threads = self.threads.is_none();
        let threads = self.threads.map_or_else(Threads::of_one, Ok)?;
        let datagrams = Datagrams::open(self.interfaces, discovery_port)?;
        let listener = match self.identity.role() {
            Role::MUnit => Some(Listener::open(self.interfaces.bind_address(), self.tcp_port).map_err(listen_error)?),
            Role::SUnit => None,
        };
        let capacities = self.capacities;
        let nodes = usize::from(constraints.maximum_nodes);
        let maximum_links = nodes + capacities.pending_links;
        crate::sys::limits::make_room_for(maximum_links);
        let config = NodeConfig {
            identity: self.identity,
            fleet: self.fleet,
            epoch: Epoch(sys::random()),
            target: self.target,
            tcp_port: listener.as_ref().map_or(0, Listener::port),
            udp_port: datagrams.own_port(),
            constraints,
            seed: sys::random(),
        };
        let mut node = Node::new(threads.thread_pool().clock.now(), config, node_storage(nodes, maximum_links));
        if let Some(m_units) = self.m_units {
            node.choose(m_units);
        }
        if self.authority.is_some() {
            node.claims_by_key();
        }
        if let Keys::Ring(live) = &keys {
            node.expect(live.ring().nodes());
        }
        let publications =
            Publications::new(filled(capacities.functions, false), filled(capacities.published_to_one, None));
        let functions =
            FunctionList::new(filled_with(capacities.functions, Entry::empty), filled(capacities.signature_bytes, 0));
        let size = message_buffer_bytes(&constraints, keys.mode());
        let parts = EngineParts {
            threads,
            own_threads,
            capacities,
            keys,
            hub: HubCell::new(Hub { node, publications }),
            functions,
            pool: MessagePool::new(size, capacities.message_buffers, KEPT_BUFFERS),
            spin: self.spin,
            state: self.state,
            datagrams,
            listener,
            maximum_links,
            // A standby asks for as long as it waits.
            asks_for_itself: self.asks_for_itself && !self.stands_by,
            state_folder: self.state_folder,
            take_over: if self.stands_by { TakeOver::No } else { self.take_over },
            stands_by: self.stands_by,
            authority: self.authority,
            starts_stopped: self.starts_stopped,
            core_recordings: self.core_recordings,
            #[cfg(feature = "control")]
            audit: self.audit,
        };
        let engine = Engine::new(parts);
        if self.access.is_some() {
            engine.set_access(self.access);
        }
        #[cfg(feature = "access")]
        if let Some(watch) = self.access_file {
            engine.follow(watch)?;
        }
        Ok(engine)
    }
}

/// Why a unit is not made, or not started. `Debug` is the sentence too, which is what a `main` that returns it prints.
#[derive(thiserror::Error)]
#[non_exhaustive]
pub enum BuildError {
    /// Something about the unit itself, or what the system refuses.
    #[error(transparent)]
    Unit(#[from] Error),
    /// It has no keys, or none that can be used.
    #[error(transparent)]
    Keys(#[from] KeyError),
    /// It does not start.
    #[error(transparent)]
    Start(#[from] StartError),
    /// A standby in plain mode, in which nobody can prove that the manager is there.
    #[error("a standby needs keys: in plain mode anybody could keep it waiting, or answer in its manager's name")]
    StandbyWithoutKeys,
    /// A standby that cannot store its claim: after a restart it could not be sure to claim more than it did before.
    #[error(
        "a standby needs a folder of state, in which it stores its claim: set CARA_STATE, or --state of `cara node`"
    )]
    StandbyWithoutState,
    /// A recording of the core in secured mode, which would have what the keys protect, and what leads to them.
    #[error("sessions of the core are recorded in plain mode only: leave `record_core` out, or call `insecure`")]
    CoreRecordingWithKeys,
    /// A manager with an authority in plain mode, in which vehicles refuse nobody.
    #[error("an authority needs keys: in plain mode no vehicle refuses the claim of another manager")]
    AuthorityWithoutKeys,
}

/// So that a `main` which builds a unit and calls others needs one error.
impl<F> From<CallError<F>> for BuildError {
    fn from(error: CallError<F>) -> Self {
        Self::Unit(error.error)
    }
}

/// Where the keys of a unit are to come from.
enum KeySource {
    /// Where files with keys are looked for.
    Found,
    File(PathBuf),
    Ring(Box<KeyRing>),
    Insecure,
}

impl KeySource {
    fn open(self, identity: &Identity, target: &Target<SocketAddr>, fleet: Fleet) -> Result<Keys, BuildError> {
        Ok(Keys::Ring(match self {
            Self::Found => LiveRing::find(identity, manager_of(target)?.as_ref(), fleet)?,
            Self::File(path) => LiveRing::open(&path, identity, fleet)?,
            Self::Ring(ring) => LiveRing::fixed(*ring),
            Self::Insecure => return Ok(Keys::Insecure),
        }))
    }
}

/// The manager that an s_unit joins.
fn manager_of(target: &Target<SocketAddr>) -> Result<Option<Identity>, Error> {
    match target {
        Target::Everybody => Ok(None),
        Target::Manager(manager) | Target::Fixed(manager, _) => Identity::m_unit(&manager.name, manager.id).map(Some),
    }
}

fn listen_error(error: std::io::Error) -> Error {
    match error.kind() {
        std::io::ErrorKind::AddrInUse => Error::PortInUse,
        std::io::ErrorKind::PermissionDenied => Error::PortNotPermitted,
        _ => system_refused(error),
    }
}

/// The constraints of a unit that says nothing about them.
const fn defaults(role: Role, stands_by: bool) -> Constraints {
    let Constraints { message_size, chunk_size, .. } = Constraints::M_UNIT;
    match role {
        Role::MUnit if stands_by => Constraints::STANDBY,
        Role::MUnit => Constraints::M_UNIT,
        Role::SUnit => Constraints { message_size, chunk_size, ..Constraints::S_UNIT },
    }
}

pub(crate) fn manager(name: &str, id: u32) -> Result<Target<SocketAddr>, Error> {
    Manager::new(name, id).map(Target::Manager)
}
