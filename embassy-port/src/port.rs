//! Boards with embassy-net, as the core sees them.

use core::net::SocketAddrV4;

use cara_core::counters::Counters;
use cara_core::host::connections::LinkCounter;
use cara_core::services::session::Session;
use cara_core::services::{Context, Port};
use cara_core::storage::Lent;

use crate::security::LinkCipher;

/// Boards with embassy-net, as the core's port.
pub(crate) enum Board {}

impl Port for Board {
    type Storage = Lent;
    type Cipher = LinkCipher;
    type Endpoint = SocketAddrV4;
    const MANAGES: bool = cfg!(feature = "manager");
    const STANDS_BY: bool = false;
    const CALLS: bool = cfg!(feature = "call");
    const DISCOVERS: bool = cfg!(feature = "discover");
    const HAS_ACCESS: bool = cfg!(feature = "access");
    const RENEWS_KEYS: bool = cfg!(feature = "rekey");
    const TAKES_DATAGRAM_REQUESTS: bool = cfg!(feature = "datagram-requests");
}

/// Whether a unit can be handed over to another manager.
pub(crate) const HANDS_OVER: bool = cfg!(feature = "hand-over");

pub(crate) type LinkSession = Session<Board>;
pub(crate) type LinkContext<'c> = Context<'c, Board>;
pub(crate) type LinkCounters = Counters<LinkCounter, { LinkCounter::COUNT }>;
