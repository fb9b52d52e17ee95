//! What a node runs with: the file's values, checked against each other, and the command line's above them.

use std::net::{IpAddr, SocketAddr};
use std::ops::Range;
use std::path::PathBuf;

use cara_std::access::AccessTable;
use cara_std::control::{Control, Operators};
use cara_std::{Capacities, Constraints, Duration, Identity, Interfaces};

use super::black_box::Budget;
use super::file::{self, File, Maybe, Role};
use super::functions::{self, Service};
use super::limits;
use super::mistake::{Mistake, Mistakes, Source};
use cara_tools::keys::Keys;
use cara_tools::name_and_id::NameAndId;

/// A value, and its place if it comes from the file.
#[derive(Clone, Debug, PartialEq, Eq)]
pub(super) struct Placed<T> {
    pub(super) value: T,
    pub(super) span: Option<Range<usize>>,
}

/// Everything that a node needs to know.
#[derive(Clone, Debug)]
pub(super) struct Settings {
    pub(super) source: Source,
    pub(super) name: String,
    pub(super) id: u32,
    /// An s_unit's manager; none for an m_unit.
    pub(super) manager: Option<Manager>,
    /// The m_units that an m_unit connects to, if not all.
    pub(super) m_units: Option<Vec<NameAndId>>,
    pub(super) fleet: u32,
    pub(super) interfaces: Interfaces,
    pub(super) keys: Keys,
    pub(super) discovery_port: Option<Placed<u16>>,
    pub(super) tcp_port: Option<Placed<u16>>,
    /// How long a thread polls before it sleeps.
    pub(super) spin: Duration,
    /// It offers to tell its clock.
    pub(super) tells_clock: bool,
    pub(super) constraints: Constraints,
    pub(super) capacities: Capacities,
    pub(super) control: Control,
    /// Where it notes what operators have it do.
    pub(super) audit: Option<PathBuf>,
    /// It starts although a live one has its identity.
    pub(super) takes_over: bool,
    pub(super) forces: bool,
    /// It waits until no live one has its identity.
    pub(super) stands_by: bool,
    /// Where it keeps its claims and black boxes.
    pub(super) state: Option<PathBuf>,
    pub(super) metrics: Option<Placed<SocketAddr>>,
    /// The file of the access table.
    pub(super) access: Option<PathBuf>,
    /// The file's level of the log.
    pub(super) file_log: Option<String>,
    /// Its manager gets the log as a stream; that of an m_unit is shown to its operators.
    pub(super) streams_log: bool,
    pub(super) black_box: Budget,
    /// Streams of the nodes that are in an m_unit's black box.
    pub(super) boxed_streams: Vec<String>,
    pub(super) services: Vec<Service>,
}

/// Which manager an s_unit joins.
#[derive(Clone, Debug, PartialEq, Eq)]
pub(super) struct Manager {
    pub(super) name: String,
    pub(super) id: u32,
    pub(super) address: Option<SocketAddr>,
}

/// What the command line says instead of the file.
#[derive(Clone, Debug, Default)]
pub(super) struct Overrides {
    pub(super) name: Option<String>,
    pub(super) id: Option<u32>,
    pub(super) fleet: Option<u32>,
    pub(super) interfaces: Option<Interfaces>,
    pub(super) keys: Option<Keys>,
    pub(super) discovery_port: Option<u16>,
    pub(super) m_units: Vec<NameAndId>,
    pub(super) tcp_port: Option<u16>,
    pub(super) takes_over: bool,
    pub(super) forces: bool,
    pub(super) stands_by: bool,
    pub(super) state: Option<PathBuf>,
    pub(super) metrics: Option<SocketAddr>,
    pub(super) metrics_anywhere: bool,
    pub(super) access: Option<PathBuf>,
    pub(super) log: Option<String>,
}

impl Overrides {
    /// What is wrong with the command line's values, and what to do.
    pub(super) fn check(&self) -> Result<(), String> {
        if self.name.as_ref().is_some_and(|name| Identity::m_unit(name, 0).is_err()) {
            return Err("--name: a node's name has 1 to 32 bytes and no control characters".into());
        }
        if self.m_units.iter().any(|m_unit| Identity::m_unit(&m_unit.name, m_unit.id).is_err()) {
            return Err("--m-unit: a node's name has 1 to 32 bytes and no control characters".into());
        }
        if self.discovery_port == Some(0) {
            return Err("--discovery-port: units cannot meet on port 0: write the port that all use".into());
        }
        if let Some(Err(error)) = self.log.as_deref().map(super::logging::filter) {
            return Err(format!("--log: {error}; write error, warn, info, debug or trace"));
        }
        if let Some(Err(error)) = self.access.as_ref().map(AccessTable::read) {
            return Err(format!("--access: {error}"));
        }
        let reached = self.metrics.filter(|address| !address.ip().is_loopback());
        match reached {
            Some(address) if !self.metrics_anywhere => Err(format!(
                "--metrics: other hosts reach {address}, and could read the metrics: add --metrics-anywhere if that is wanted"
            )),
            _ => Ok(()),
        }
    }
}

impl Settings {
    /// Reads and checks a file; all mistakes of meaning are told at once.
    pub(super) fn of(source: Source, over: &Overrides) -> Result<Self, Mistakes> {
        let file = file::read(&source).map_err(|mistakes| Mistakes::new(&source, mistakes))?;
        let mut mistakes = Vec::new();
        let settings = checked(source, &file, over, &mut mistakes);
        if mistakes.is_empty() { Ok(settings) } else { Err(Mistakes::new(&settings.source, mistakes)) }
    }

    /// A mistake that shows only when the node starts, such as a port in use.
    pub(super) fn mistake(&self, span: Range<usize>, what: &str, help: &str) -> Mistakes {
        Mistakes::new(&self.source, vec![Mistake::new(span, what, help)])
    }
}

fn checked(source: Source, file: &File, over: &Overrides, mistakes: &mut Vec<Mistake>) -> Settings {
    let role = file.role.as_ref().map_or(Role::MUnit, |role| *role.get_ref());
    let capacities = limits::capacities(&file.capacities, mistakes);
    Settings {
        name: own_name(file, over, mistakes),
        id: own_id(file, over, mistakes),
        manager: manager(file, role, mistakes),
        m_units: m_units(file, role, over, mistakes),
        takes_over: over.takes_over,
        forces: over.forces,
        stands_by: over.stands_by,
        state: over.state.clone(),
        fleet: over.fleet.or(file.fleet).unwrap_or(0),
        interfaces: over
            .interfaces
            .or_else(|| file.interfaces.map(Interfaces::from))
            .unwrap_or_else(Interfaces::from_environment),
        keys: keys(file, over, mistakes),
        discovery_port: discovery_port(file, over, mistakes),
        tcp_port: tcp_port(file, role, over, mistakes),
        spin: limits::spin(&file.spin, mistakes),
        tells_clock: file.clock.unwrap_or_default(),
        constraints: limits::constraints(&file.constraints, limits::defaults(role, over.stands_by), mistakes),
        control: control(&file.control, role, mistakes),
        audit: audit(&file.control, mistakes),
        metrics: metrics(file, over, mistakes),
        access: access(file, over, mistakes),
        file_log: log(file, mistakes),
        // An m_unit's goes no further than its control socket.
        streams_log: file.log.stream.as_ref().map_or(role == Role::MUnit, |stream| *stream.get_ref()),
        black_box: limits::black_box(&file.black_box, mistakes),
        boxed_streams: boxed_streams(file, role, mistakes),
        services: functions::services(&source, &file.functions, capacities.functions, mistakes),
        capacities,
        source,
    }
}

impl From<file::Interfaces> for Interfaces {
    fn from(interfaces: file::Interfaces) -> Self {
        match interfaces {
            file::Interfaces::All => Self::All,
            file::Interfaces::Lo => Self::Loopback,
        }
    }
}

fn own_name(file: &File, over: &Overrides, mistakes: &mut Vec<Mistake>) -> String {
    file.name.iter().for_each(|name| check_name(name, mistakes));
    if file.name.is_none() && over.name.is_none() {
        mistakes.push(Mistake::new(0..0, "the node has no name", "write name = \"AGV_manager\" in the first lines"));
    }
    let written = || file.name.as_ref().map(|name| name.get_ref().clone());
    over.name.clone().or_else(written).unwrap_or_default()
}

fn own_id(file: &File, over: &Overrides, mistakes: &mut Vec<Mistake>) -> u32 {
    let id = over.id.or(file.id.as_ref().map(|id| *id.get_ref()));
    if id.is_none() {
        mistakes.push(Mistake::new(0..0, "the node has no ID number", "write id = 1 in the first lines"));
    }
    id.unwrap_or_default()
}

fn check_name(name: &toml::Spanned<String>, mistakes: &mut Vec<Mistake>) {
    if Identity::m_unit(name.get_ref(), 0).is_err() {
        let help = "a node's name has 1 to 32 bytes and no control characters";
        mistakes.push(Mistake::new(name.span(), "this cannot be a node's name", help));
    }
}

fn manager(file: &File, role: Role, mistakes: &mut Vec<Mistake>) -> Option<Manager> {
    match (role, &file.manager) {
        (Role::MUnit, None) => None,
        (Role::MUnit, Some(table)) => {
            let help = "write role = \"s_unit\" in the first lines, or take [manager] out";
            mistakes.push(Mistake::new(table.span(), "an m_unit has no manager", help));
            None
        }
        (Role::SUnit, None) => {
            let span = file.role.as_ref().map_or(0..0, toml::Spanned::span);
            let help = "write below a line [manager] its name and id";
            mistakes.push(Mistake::new(span, "an s_unit needs a manager", help));
            None
        }
        (Role::SUnit, Some(table)) => Some(named_manager(table, mistakes)),
    }
}

fn named_manager(table: &toml::Spanned<file::Manager>, mistakes: &mut Vec<Mistake>) -> Manager {
    let file::Manager { name, id, address } = table.get_ref();
    name.iter().for_each(|name| check_name(name, mistakes));
    if name.is_none() || id.is_none() {
        let help = "write its name = \"AGV_manager\" and its id = 1";
        mistakes.push(Mistake::new(table.span(), "a manager has a name and an id", help));
    }
    Manager {
        name: name.as_ref().map(|name| name.get_ref().clone()).unwrap_or_default(),
        id: id.as_ref().map_or(0, |id| *id.get_ref()),
        address: manager_address(address, mistakes),
    }
}

/// One that can be dialled: an IPv4 address of one host, and a port.
fn manager_address(text: &Maybe<String>, mistakes: &mut Vec<Mistake>) -> Option<SocketAddr> {
    let address = address_of(text, mistakes)?;
    let is_of_a_host = match address.ip() {
        IpAddr::V4(ip) => !ip.is_unspecified() && !ip.is_broadcast() && !ip.is_multicast(),
        IpAddr::V6(_) => false,
    };
    if !is_of_a_host || address.port() == 0 {
        let span = text.as_ref().map_or(0..0, toml::Spanned::span);
        let help = "write the manager's own IPv4 address and its TCP port, as \"192.168.1.5:21971\"; IPv6 is not used";
        mistakes.push(Mistake::new(span, "no manager can be reached at this address", help));
    }
    Some(address)
}

fn m_units(file: &File, role: Role, over: &Overrides, mistakes: &mut Vec<Mistake>) -> Option<Vec<NameAndId>> {
    if let Some(written) = file.m_units.as_ref().filter(|_| role == Role::SUnit) {
        let help = "take the line out; [manager] says which one it is";
        mistakes.push(Mistake::new(written.span(), "an s_unit connects to its manager alone", help));
    }
    let written = file
        .m_units
        .as_ref()
        .map(|m_units| m_units.get_ref().iter().filter_map(|text| named_m_unit(text, mistakes)).collect());
    if over.m_units.is_empty() { written } else { Some(over.m_units.clone()) }
}

fn named_m_unit(text: &toml::Spanned<String>, mistakes: &mut Vec<Mistake>) -> Option<NameAndId> {
    let named = text.get_ref().parse().ok();
    let named = named.filter(|named: &NameAndId| Identity::m_unit(&named.name, named.id).is_ok());
    if named.is_none() {
        let help = "write NAME/ID, as in \"AGV_manager/1\"";
        mistakes.push(Mistake::new(text.span(), "this is no m_unit", help));
    }
    named
}

fn address_of(text: &Maybe<String>, mistakes: &mut Vec<Mistake>) -> Option<SocketAddr> {
    let text = text.as_ref()?;
    let address = text.get_ref().parse().ok();
    if address.is_none() {
        let help = "write an IP address and a port, as \"192.168.1.5:21971\" or \"127.0.0.1:9464\"";
        mistakes.push(Mistake::new(text.span(), "this is no address", help));
    }
    address
}

fn keys(file: &File, over: &Overrides, mistakes: &mut Vec<Mistake>) -> Keys {
    let insecure = file.insecure.as_ref().filter(|insecure| *insecure.get_ref());
    if let (Some(insecure), Some(_)) = (insecure, &file.keys) {
        let help = "take one of the two lines out: a node has keys, or is in plain mode";
        mistakes.push(Mistake::new(insecure.span(), "this contradicts `keys`", help));
    }
    let written = file.keys.as_ref().map(|path| Keys::File(path.into()));
    over.keys.clone().or(written).or(insecure.map(|_| Keys::Insecure)).unwrap_or_default()
}

fn discovery_port(file: &File, over: &Overrides, mistakes: &mut Vec<Mistake>) -> Option<Placed<u16>> {
    if let Some(port) = file.discovery_port.as_ref().filter(|port| *port.get_ref() == 0) {
        let help = "write the port that all units use, 21971 for instance";
        mistakes.push(Mistake::new(port.span(), "units cannot meet on port 0", help));
    }
    placed(over.discovery_port, &file.discovery_port)
}

fn tcp_port(file: &File, role: Role, over: &Overrides, mistakes: &mut Vec<Mistake>) -> Option<Placed<u16>> {
    if let Some(port) = file.tcp_port.as_ref().filter(|_| role == Role::SUnit) {
        let help = "take the line out";
        mistakes.push(Mistake::new(port.span(), "an s_unit takes no connections: it connects to its manager", help));
    }
    placed(over.tcp_port, &file.tcp_port)
}

fn placed<T: Copy>(over: Option<T>, written: &Maybe<T>) -> Option<Placed<T>> {
    let written = || written.as_ref().map(|value| Placed { value: *value.get_ref(), span: Some(value.span()) });
    over.map(|value| Placed { value, span: None }).or_else(written)
}

fn control(table: &file::Control, role: Role, mistakes: &mut Vec<Mistake>) -> Control {
    let off = table.off.as_ref().is_some_and(|off| *off.get_ref());
    if role == Role::SUnit {
        let help = "take the line out; operators reach the vehicle through its manager";
        for path in [&table.path, &table.audit].into_iter().flatten() {
            mistakes.push(Mistake::new(path.span(), "an s_unit has no control socket", help));
        }
    }
    if let Some(operators) = table.operators.as_ref().filter(|_| table.path.is_none()) {
        let help =
            "write path = \"/run/cara-plant/plant.sock\", in a directory of yours that the operators' group enters";
        mistakes.push(Mistake::new(
            operators.span(),
            "other users cannot reach the control socket in its usual place",
            help,
        ));
    }
    let Some(path) = &table.path else { return if off { Control::Off } else { Control::Default } };
    if off || path.get_ref().is_empty() || path.get_ref().contains('\0') {
        let help = "write a path, or off = true, or neither for the usual place";
        mistakes.push(Mistake::new(path.span(), "there is no control socket at this path", help));
    }
    let path = PathBuf::from(path.get_ref());
    operators(table, mistakes)
        .map_or_else(|| Control::Path(path.clone()), |operators| Control::Shared(path.clone(), operators))
}

/// The users besides the node's own.
fn operators(table: &file::Control, mistakes: &mut Vec<Mistake>) -> Option<Operators> {
    let mut operators = Operators::default();
    for (user, role) in table.operators.as_ref()?.get_ref() {
        if let Err(error) = operators.add(user, *role.get_ref()) {
            let help =
                "write users of this host with stop, see, operate or reset, as operators = { anna = \"operate\" }";
            mistakes.push(Mistake::new(role.span(), error.to_string(), help));
        }
    }
    Some(operators)
}

fn audit(table: &file::Control, mistakes: &mut Vec<Mistake>) -> Option<PathBuf> {
    let path = table.audit.as_ref()?;
    let is_asked = table.off.as_ref().is_none_or(|off| !*off.get_ref());
    if !is_asked || path.get_ref().is_empty() || path.get_ref().contains('\0') {
        let help = "write a file's path, and leave the control socket on: what comes through it is noted";
        mistakes.push(Mistake::new(path.span(), "there is no audit log at this path", help));
    }
    Some(path.get_ref().into())
}

fn metrics(file: &File, over: &Overrides, mistakes: &mut Vec<Mistake>) -> Option<Placed<SocketAddr>> {
    let listen = &file.metrics.listen;
    let written = address_of(listen, mistakes);
    if over.metrics.is_some() {
        return placed(over.metrics, &None);
    }
    let (value, span) = (written?, listen.as_ref().map(toml::Spanned::span));
    if !value.ip().is_loopback() && !over.metrics_anywhere {
        let help = "write \"127.0.0.1:9464\", or start with --metrics-anywhere: every host that reaches it can read it";
        mistakes.push(Mistake::new(span.clone().unwrap_or(0..0), "metrics are read on this host only", help));
    }
    Some(Placed { value, span })
}

/// The table is looked at already here, so that `--check` finds its mistakes.
fn access(file: &File, over: &Overrides, mistakes: &mut Vec<Mistake>) -> Option<PathBuf> {
    if over.access.is_some() {
        return over.access.clone();
    }
    let written = file.access.as_ref()?;
    if let Err(error) = AccessTable::read(written.get_ref()) {
        let help = "`cara access check FILE` checks the table alone";
        mistakes.push(Mistake::new(written.span(), format!("the access table is wrong: {error}"), help));
    }
    Some(written.get_ref().into())
}

fn boxed_streams(file: &File, role: Role, mistakes: &mut Vec<Mistake>) -> Vec<String> {
    let Some(streams) = &file.black_box.streams else { return Vec::new() };
    if role == Role::SUnit {
        let help = "leave it out: it is for an m_unit, which reads the streams of its nodes";
        mistakes.push(Mistake::new(streams.span(), "an s_unit reads no streams", help));
    }
    streams.get_ref().clone()
}

fn log(file: &File, mistakes: &mut Vec<Mistake>) -> Option<String> {
    let level = file.log.level.as_ref()?;
    if let Err(error) = super::logging::filter(level.get_ref()) {
        let help = "write error, warn, info, debug or trace, or with a part: \"info,cara_std=debug\"";
        mistakes.push(Mistake::new(level.span(), format!("this is no level: {error}"), help));
    }
    Some(level.get_ref().clone())
}
