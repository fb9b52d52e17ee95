//! Everything that can go wrong, sorted by who has to act. Errors are small and `Copy`; each text says what to do.

use core::fmt;

use crate::config::{VERSIONS, Versions};
use crate::time::Duration;

/// Who has to act on an [`Error`]. Complete: a `match` needs no other arm.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash)]
pub enum Cause {
    /// The program or its configuration must change; trying again does not help.
    Configuration,
    /// The other unit refused, failed or went away.
    Peer,
    /// A limit was reached: wait, or raise the limit.
    Resource,
    /// The network failed.
    Transport,
}

/// A limit of [`crate::config`] or of the memory that the port lent. The text names the setting that raises it; `Capacities` are
/// those of the Linux port, on a board they are the lengths of the lent slices.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash, thiserror::Error)]
#[repr(u8)]
#[non_exhaustive]
pub enum Limit {
    /// `Constraints::maximum_nodes`, or the table of nodes.
    #[error("as many nodes are connected as may be: raise maximum_nodes")]
    Nodes = 0,
    /// The table of links.
    #[error("every link is in use: raise maximum_nodes or Capacities::pending_links")]
    Links = 1,
    /// Calls in flight to one peer.
    #[error("too many calls to this peer wait for their replies: let one end, or raise Capacities::calls_in_flight")]
    Calls = 2,
    /// `Constraints::calls_per_peer`: calls of one peer that wait or run.
    #[error("too many calls of this peer run here: let one end, or raise Capacities::calls_running")]
    IncomingCalls = 3,
    /// The pool of message buffers.
    #[error("every message buffer is in use: try again later, or raise Capacities::message_buffers")]
    Buffers = 4,
    /// Messages that are queued for one peer.
    #[error("the peer reads more slowly than this unit sends: try again later, send less, or raise message_size here")]
    SendQueue = 5,
    /// The table of functions.
    #[error(
        "the list of functions is full: remove one, or raise Capacities::functions (published_to_one for one node)"
    )]
    Functions = 6,
    /// Bytes for signatures.
    #[error("the signatures are too long: use shorter or fewer names, or raise Capacities::signature_bytes")]
    SignatureBytes = 7,
    /// Variables in one `Parameters`.
    #[error("a Parameters, and the arguments or results of a function, have 16 variables at most: use arrays")]
    Variables = 8,
    /// Bytes in one `Parameters`.
    #[error("the Parameters has no room for this: make a larger one, as in Parameters::<20000>::sized()")]
    ParametersBytes = 9,
    /// Bytes in a name.
    #[error("a name has 32 bytes at most: use a shorter one")]
    NameBytes = 10,
    /// Leases held by one peer.
    #[error("a unit holds 4 leases at one peer at most: release one first")]
    Leases = 11,
    /// Handlers running at the same time.
    #[error("every thread for handlers is busy: try again later, or let handlers take less time")]
    Handlers = 12,
    /// The peer's `Constraints::subscriptions_per_peer`.
    #[error("the peer lets this unit subscribe to no more streams: end one, or raise subscriptions_per_peer there")]
    Subscriptions = 13,
    /// Nesting of lists and records.
    #[error("lists and records are at most 8 deep in each other: make the inner ones arguments of their own")]
    Depth = 14,
}

/// A constraint that needs more memory than a unit may have.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash)]
#[repr(u8)]
pub enum Constraint {
    /// `Constraints::maximum_nodes`.
    MaximumNodes,
    /// `Constraints::message_size`.
    MessageSize,
    /// `Constraints::calls_per_peer`.
    CallsPerPeer,
}

impl Constraint {
    /// The constraint, and the limit that bounds it.
    pub const fn needs(self) -> &'static str {
        match self {
            Self::MaximumNodes => "maximum_nodes needs links",
            Self::MessageSize => "message_size needs message_size",
            Self::CallsPerPeer => "calls_per_peer needs calls",
        }
    }
}

/// Why a unit refuses a link; sent to the peer.
#[cfg_attr(feature = "defmt", derive(defmt::Format))]
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash, thiserror::Error)]
#[non_exhaustive]
pub enum Refusal {
    /// The two have no common protocol version; the peer speaks these.
    #[error("the peer speaks version {0} of the protocol, and this unit {VERSIONS}: update one of the two")]
    Version(Versions),
    /// The two belong to different fleets.
    #[error("the peer belongs to another fleet: set the same fleet on both")]
    Fleet,
    /// The s_unit belongs to another manager.
    #[error("the s_unit belongs to another manager: check the manager's name and id set in it")]
    WrongManager,
    /// `Constraints::maximum_nodes` is reached.
    #[error("the peer has as many nodes as it may: raise its maximum_nodes")]
    Full,
    /// Another live node has the same name, id and role.
    #[error("another live node has the same name and id: give each node its own, unless one stands by for the other")]
    DuplicateIdentity,
    /// Both ends are s_units.
    #[error("the two roles cannot be joined: make one of them an m_unit, which s_units join")]
    Role,
    /// The two are already connected.
    #[error("the two nodes are connected already by another link: nothing need be done")]
    AlreadyConnected,
    /// The hello could not be decoded.
    #[error("the peer's hello could not be read: is it a CARA unit?")]
    Malformed,
    /// One of the two is in plain mode, the other in secured mode.
    #[error("one of the two units is plain and the other one secured: give both keys, or start both in plain mode")]
    Mode,
    /// There is no key for these two units.
    #[error(
        "there is no key for this pair of units: one was revoked, or never added; if that is on purpose, do nothing"
    )]
    NoKey,
    /// The two have no common cipher suite.
    #[error("the two units have no cipher suite in common: update one of the two")]
    Suite,
    /// The vehicle obeys a higher claim of another manager of the same identity.
    #[error(
        "the vehicle is under another manager of this name and id: find out which of the two is to command; `--take-over` brings the vehicle here"
    )]
    Fenced,
    /// The vehicle has an order of another manager of the same identity, and will join this one when that ends.
    #[error("the vehicle has an order of another manager of this name and id: it joins when that has ended")]
    Driving,
    /// The manager is a standby.
    #[error("the manager stands by: another one of this name and id commands, and the link goes there")]
    Standby,
}

impl Refusal {
    /// The byte on the wire.
    pub const fn to_wire(self) -> u8 {
        match self {
            Self::Version(_) => 1,
            Self::Fleet => 2,
            Self::WrongManager => 3,
            Self::Full => 4,
            Self::DuplicateIdentity => 5,
            Self::Role => 6,
            Self::AlreadyConnected => 7,
            Self::Malformed => 8,
            Self::Mode => 9,
            Self::NoKey => 10,
            Self::Suite => 11,
            Self::Fenced => 12,
            Self::Driving => 13,
            Self::Standby => 14,
        }
    }

    /// Decodes the byte on the wire. A peer of other versions has sent them in its hello before; only version 1 did not.
    pub(crate) const fn from_wire(code: u8) -> Self {
        match code {
            1 => Self::Version(Versions { first: 1, last: 1 }),
            2 => Self::Fleet,
            3 => Self::WrongManager,
            4 => Self::Full,
            5 => Self::DuplicateIdentity,
            6 => Self::Role,
            7 => Self::AlreadyConnected,
            9 => Self::Mode,
            10 => Self::NoKey,
            11 => Self::Suite,
            12 => Self::Fenced,
            13 => Self::Driving,
            14 => Self::Standby,
            _ => Self::Malformed,
        }
    }
}

/// Why a link ended.
#[cfg_attr(feature = "defmt", derive(defmt::Format))]
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash, thiserror::Error)]
#[repr(u8)]
#[non_exhaustive]
pub enum CloseReason {
    /// The peer was stopped in an orderly way.
    #[error("the peer was stopped: start it again if it is wanted")]
    Stopped = 1,
    /// The connection was reset or closed by the transport.
    #[error("the connection was closed below: the peer's process ended, or the network reset it; it is opened again")]
    Reset = 2,
    /// Nothing was received for three keep-alives.
    #[error("nothing was heard from the peer: check power, cable and manager")]
    Silent = 3,
    /// The same identity has returned with a new boot epoch.
    #[error("the peer restarted: it is connected again, repeat the request")]
    PeerRestarted = 4,
    /// The peer violated the protocol.
    #[error("the peer broke the protocol: check its version")]
    Protocol = 5,
    /// A frame or message exceeded the limit that this unit advertises.
    #[error("the peer sent more than the limit that it was told: check its version, or raise message_size here")]
    Oversize = 6,
    /// No hello, or no proof after it, came in time.
    #[error("no hello or no proof came in time: the other end is silent, or no CARA unit of this mode")]
    HelloTimeout = 7,
    /// One of the two units refused the link.
    #[error("{0}")]
    Refused(Refusal) = 8,
    /// The connection could not be opened.
    #[error("the connection could not be opened: is the peer's port reachable?")]
    DialFailed = 9,
    /// Request ids ran out, or keys that are not renewed; the link is opened anew.
    #[error("request ids or keys ran out: the link is opened again, repeat the request")]
    Exhausted = 10,
    /// The peer ended the link before it had proven its identity, so its reason is not believed.
    #[error("the other end left before it proved its identity: has it the key of this pair, and the same version?")]
    Unproven = 11,
    /// The peer has another key for this pair, or a message was changed in transit.
    #[error(
        "the two have different keys for this pair, or what they sent was changed: compare their fingerprints; if one was revoked on purpose, do nothing"
    )]
    BadProof = 12,
    /// This unit was stopped in an orderly way. Its peer gets [`Stopped`](Self::Stopped).
    #[error("this unit was stopped")]
    StoppedHere = 13,
    /// The stream brought nothing to one of the ends for 8 s, while the peer was alive and did not hold back reading.
    #[error(
        "the stream is dead though the peer is heard: {}; it is opened again",
        if *.long { "look for a part of the path that drops long packets (its MTU)" }
        else { "look for a firewall or a NAT that forgets or drops TCP sessions" }
    )]
    StreamDead {
        /// More than one segment of 536 bytes was outstanding: the link is dialled again with segments of that size.
        long: bool,
    } = 14,
}

/// What a handler returns instead of results. With the feature `details`, a `Failure` adds text and values.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash, thiserror::Error)]
#[non_exhaustive]
pub enum ServiceError {
    /// The service failed with its own code.
    #[error("the service failed with code {0}: see the peer's documentation for its meaning")]
    Failed(u16),
    /// The handler panicked; the unit continues.
    #[error("the service's handler panicked: see the peer's log")]
    Panicked,
    /// The service cannot do its work now.
    #[error("the service is not ready: try again later")]
    NotReady,
    /// The handler set results that do not match the signature.
    #[error("the service's results do not match its published signature: correct its handler")]
    BadResults,
}

/// The part of a signature that declares a variable.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash)]
pub enum Part {
    /// The arguments.
    Argument,
    /// The results.
    Result,
    /// The progress of running calls.
    Progress,
    /// The values of failures.
    Failure,
}

impl fmt::Display for Part {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(match self {
            Self::Argument => "argument",
            Self::Result => "result",
            Self::Progress => "progress",
            Self::Failure => "failure's",
        })
    }
}

/// An error of any operation.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash, thiserror::Error)]
// A 32-bit tag lets the compiler copy errors by words instead of bytes.
#[repr(u32)]
#[non_exhaustive]
pub enum Error {
    // --- configuration
    /// The peer has published no function of this name to this unit.
    #[error(
        "the peer has not published this function to this unit: check the name against its list, and publish it there"
    )]
    UnknownFunction,
    /// The peer's version of the function differs from this program's interface; nothing was sent.
    #[error("the peer's function is of another version: its {0} differs: update one of the two")]
    Mismatch(Part),
    /// The function was removed or changed since its list was received; the new list follows.
    #[error("the function was removed or changed: look at the new list and call again")]
    StaleFunction,
    /// Argument `index` of the signature is not among the parameters.
    #[error("argument {index} of the signature is missing: add it by its name")]
    MissingArgument {
        /// Position in the signature, from 0.
        index: u8,
    },
    /// A variable has another type than the one requested.
    #[error("variable {index} has another type than is asked for: use the type of the signature")]
    WrongType {
        /// Position in the signature (or table), from 0.
        index: u8,
    },
    /// A variable has another size than the one requested.
    #[error("variable {index} has size {found}, and {expected} is needed: give it that size")]
    WrongSize {
        /// Position in the signature (or table), from 0.
        index: u8,
        /// The size that the signature or variable declares.
        expected: u32,
        /// The size that was found.
        found: u32,
    },
    /// No variable of this name.
    #[error("there is no variable of this name: add it first, or check its name")]
    UnknownVariable,
    /// A variable, function or node of this name exists already.
    #[error("the name is taken already: choose another, or replace what has it")]
    NameTaken,
    /// A function's or variable's name is empty or has other characters than letters, digits, `_`, `-`, `.`, `/`; or a node's
    /// name is empty, longer than 32 bytes, or has control characters.
    #[error("a name has letters, digits, '_', '-', '.' or '/'; a node's has 1 to 32 bytes and no control characters")]
    BadName,
    /// Several nodes have this name; `ids` are those of two of them.
    #[error(
        "several nodes are meant, with the ids {} and {}: ask for one of them by name and id", ids[0], ids[1]
    )]
    Ambiguous {
        /// The ID numbers of two of the nodes.
        ids: [u32; 2],
    },
    /// A number does not fit the Rust type that it is read as, or the variable that it is written to.
    #[error("the number does not fit the type it was asked as: use a wider one")]
    OutOfRange,
    /// The caller's parameters cannot hold the results.
    #[error("the result needs {need} bytes, and the parameters have room for {have}: make them larger")]
    ResultWouldNotFit {
        /// Bytes that the result needs.
        need: u32,
        /// Bytes that are free.
        have: u32,
    },
    /// The message is longer than the receiver accepts, or than the sender's buffers.
    #[error(
        "the message is longer than the {limit} bytes that one of the two units holds: send less, or raise its message_size"
    )]
    TooLarge {
        /// The limit in bytes.
        limit: u32,
    },
    /// A blocking request that would wait for itself.
    #[error("the request would wait for itself: answer first, or request without blocking")]
    WouldDeadlock,
    /// A constraint is outside of what its type or the lent memory allows.
    #[error("a constraint or option is outside what this unit can do: compare it with the bounds in its documentation")]
    BadConstraint,
    /// A constraint needs more memory than the unit has.
    #[error("{} = {need}, and the resources have {have}: ask for less, or raise the limit", constraint.needs())]
    DoesNotFit {
        /// The constraint.
        constraint: Constraint,
        /// The limit that it needs.
        need: u32,
        /// The limit that there is.
        have: u32,
    },
    /// The heart that a call names beats too slowly: the function's lease could end between two beats.
    #[error("the heart beats every {have} ms, and the function's lease needs it every {need} ms: let it beat as often")]
    SlowHeart {
        /// Half of the lease in milliseconds, the longest period allowed.
        need: u32,
        /// The heart's period in milliseconds.
        have: u32,
    },
    /// A service of the emergency class was given a handler that needs the application's state, or a task.
    #[error(
        "an emergency service waits for nothing, and this handler may wait for the application's state or a task: give it the form without the state"
    )]
    EmergencyWaits,

    // --- peer
    /// No node of this name, id or index is connected.
    #[error("the node is not connected: wait until it has joined, or check its name, power and network")]
    NotConnected,
    /// No answer within the deadline; the service may have run.
    #[error(
        "no answer came in time, and the service may have run: ask for its state, or wait longer (request_timeout)"
    )]
    TimedOut,
    /// The caller gave the call up; the service may have run.
    #[error("the call was given up here, and the service may have run: ask for its state")]
    Cancelled,
    /// The link ended while the call was in flight; the service may have run.
    #[error("the link ended during the call, and the service may have run: ask for its state when the peer is back")]
    Interrupted,
    /// The request's remaining time was over when the callee received it; it was not run.
    #[error("the request arrived too late and was not run: ask again, or allow more time")]
    Expired,
    /// The callee has seen this id, or a much newer one; it did not run the request again.
    #[error("the request is older than 64 others and was not run: ask again")]
    Stale,
    /// The service ran, but its results cannot be read: the function was replaced or removed meanwhile, or the reply does not
    /// match the published signature.
    #[error("the service ran, and its results are lost: it was replaced meanwhile, or answers other than it publishes")]
    ResultLost,
    /// The callee has its limit of this unit's calls; it did not run the request.
    #[error("the peer is busy and did not run the request: try again later")]
    Busy,
    /// The callee could not decode the message; it did not run the request.
    #[error("the peer could not read the request: check its version")]
    Malformed,
    /// The callee's version does not know something that the request depends on; it did not run the request.
    #[error("the peer's version does not know what the request asks for: update the peer, or ask without it")]
    Unsupported,
    /// Another holder has the actuator: the unit with this ID number, or an operator of it. A unit's program and its operators
    /// are different holders. The callee did not run the request.
    #[error(
        "what this function moves is held by {}unit {by}: wait until it is released, or take it over",
        if *operator { "an operator of " } else { "" }
    )]
    Held {
        /// The ID number of the holder.
        by: u32,
        /// An operator holds it, not the unit's program.
        operator: bool,
    },
    /// The actuator was stopped, by the unit with this ID number or, with 0, by the vehicle itself, and was not reset. The callee
    /// did not run the request.
    #[error(
        "what it moves was stopped by {}, reason {reason}: look why, then call its function that resets", Stopper(*by)
    )]
    Inhibited {
        /// The ID number of the unit that stopped it; 0 for the vehicle itself.
        by: u32,
        /// The vehicle's own number of the reason; 0 for a function that stops.
        reason: u16,
    },
    /// The callee has begun a later call of this unit for the same actuator, so it did not run this one.
    #[error("a later call of this unit has what this function moves: if it is still wanted, call it again")]
    Replaced,
    /// The callee's access table does not let this unit call the function.
    #[error(
        "the peer's access table does not let this unit call the function: change the table, or ask with another unit"
    )]
    NotAllowed,
    /// The service answered with an error.
    #[error("{0}")]
    Service(ServiceError),
    /// The peer refused the link.
    #[error("{0}")]
    Refused(Refusal),

    // --- resource
    /// A table or queue of this unit is full.
    #[error("no room: {0}")]
    Full(Limit),
    /// The minimum interval between requests to this node has not passed, or the rate in its access table is used up.
    #[error("too soon after the last request: wait {} us, or lower minimum_interval, or raise the rate in the peer's access table", wait.as_micros())]
    TooSoon {
        /// How long to wait.
        wait: Duration,
    },

    // --- transport
    /// The link ended.
    #[error("{0}")]
    Closed(CloseReason),
    /// The network refused a datagram or a connection.
    #[error("the network refused: is the interface up, and are there descriptors left (ulimit -n)?")]
    Network,
    /// Another process owns the port.
    #[error("the port is in use by a program that does not share it: choose another port, or end that program")]
    PortInUse,
    /// An m_unit lacks its key with itself, with which it makes its claims.
    #[error(
        "the keys of this m_unit lack its key with itself, without which it can claim no vehicle: provision it anew"
    )]
    NoOwnKey,
    /// The system does not let this user open the port.
    #[error(
        "the system does not permit this port: below 1024 it takes root or CAP_NET_BIND_SERVICE; choose another one"
    )]
    PortNotPermitted,
    /// The call was to be made only while this unit leads, and it does not. Nothing was sent.
    #[error("this manager does not lead, and the call is for one that does: wait for `Leading`, or call without that")]
    NoAuthority,
    /// The unit has been stopped, or cannot be started (again).
    #[error("the unit does not run: it was stopped or runs already; make a new one")]
    NotRunning,
}

impl Error {
    /// Whether the service may have run if its call ended with this error. `false` is certain.
    pub const fn may_have_run(&self) -> bool {
        matches!(
            self,
            Self::TimedOut
                | Self::Cancelled
                | Self::Interrupted
                | Self::ResultLost
                | Self::ResultWouldNotFit { .. }
                | Self::TooLarge { .. }
                | Self::WrongType { .. }
                | Self::WrongSize { .. }
                | Self::OutOfRange
                | Self::Service(ServiceError::Failed(_) | ServiceError::Panicked | ServiceError::BadResults)
        )
    }

    /// Who has to act.
    pub const fn cause(&self) -> Cause {
        match self {
            Self::UnknownFunction
            | Self::Mismatch(_)
            | Self::StaleFunction
            | Self::MissingArgument { .. }
            | Self::WrongType { .. }
            | Self::WrongSize { .. }
            | Self::UnknownVariable
            | Self::NameTaken
            | Self::BadName
            | Self::Ambiguous { .. }
            | Self::OutOfRange
            | Self::ResultWouldNotFit { .. }
            | Self::TooLarge { .. }
            | Self::WouldDeadlock
            | Self::BadConstraint
            | Self::NoOwnKey
            | Self::DoesNotFit { .. }
            | Self::SlowHeart { .. }
            | Self::EmergencyWaits => Cause::Configuration,
            Self::NotConnected
            | Self::TimedOut
            | Self::Cancelled
            | Self::Interrupted
            | Self::Expired
            | Self::Stale
            | Self::ResultLost
            | Self::Busy
            | Self::Malformed
            | Self::Unsupported
            | Self::Held { .. }
            | Self::Inhibited { .. }
            | Self::Replaced
            | Self::NotAllowed
            | Self::Service(_)
            | Self::Refused(_) => Cause::Peer,
            Self::Full(_) | Self::TooSoon { .. } | Self::NoAuthority => Cause::Resource,
            Self::Closed(_) | Self::Network | Self::PortInUse | Self::PortNotPermitted | Self::NotRunning => {
                Cause::Transport
            }
        }
    }
}

/// Displays who stopped an actuator, by ID number.
struct Stopper(u32);

impl fmt::Display for Stopper {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self.0 {
            0 => f.write_str("the vehicle itself"),
            id => write!(f, "the unit with the ID {id}"),
        }
    }
}

impl From<ServiceError> for Error {
    fn from(error: ServiceError) -> Self {
        Self::Service(error)
    }
}

/// Lets a service use `?` on operations on its parameters and on calls of other units. An error of the called service is passed
/// on; a mistake of the service's own program becomes [`ServiceError::BadResults`], and any other error, such as a peer that does
/// not answer, [`ServiceError::NotReady`]: the service cannot do its work now.
///
/// ```
/// use cara_core::{ParametersView, ServiceError};
///
/// fn double(parameters: &mut ParametersView) -> Result<(), ServiceError> {
///     let number: i64 = parameters.variable("number")?;
///     parameters.set_value("number", number.checked_mul(2).ok_or(ServiceError::Failed(1))?)?;
///     Ok(())
/// }
/// # let mut parameters = cara_core::Parameters::new();
/// # parameters.add_int("number", 1).unwrap();
/// # parameters.set_value("number", 21).unwrap();
/// # assert_eq!(double(&mut parameters), Ok(()));
/// # assert_eq!(parameters.variable("number"), Ok(42));
/// assert_eq!(double(&mut cara_core::Parameters::new()), Err(ServiceError::BadResults));
/// ```
impl From<Error> for ServiceError {
    fn from(error: Error) -> Self {
        match (error, error.cause()) {
            (Error::Service(error), _) => error,
            (_, Cause::Configuration) => Self::BadResults,
            (_, Cause::Peer | Cause::Resource | Cause::Transport) => Self::NotReady,
        }
    }
}

impl From<Refusal> for Error {
    fn from(refusal: Refusal) -> Self {
        Self::Refused(refusal)
    }
}

#[cfg(test)]
mod tests {
    use std::string::ToString as _;

    use super::*;

    #[test]
    fn a_stop_is_told_with_what_stopped() {
        let text = |by| Error::Inhibited { by, reason: 3 }.to_string();
        assert!(
            text(0).starts_with("what it moves was stopped by the vehicle itself, reason 3: look why"),
            "{}",
            text(0)
        );
        assert!(
            text(12).starts_with("what it moves was stopped by the unit with the ID 12, reason 3: look why"),
            "{}",
            text(12)
        );
    }

    #[test]
    fn an_orderly_end_is_told_with_what_was_stopped() {
        assert_eq!(CloseReason::StoppedHere.to_string(), "this unit was stopped");
        assert!(CloseReason::Stopped.to_string().starts_with("the peer was stopped:"));
    }
}
