//! What the network tells its user, and a hash over all of it.

use std::net::SocketAddr;
use std::sync::Arc;

use cara_core::time::Instant;

/// Names a host of the network, which is one unit's process with its sockets.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord, Hash)]
pub struct HostId(pub(crate) u16);

impl HostId {
    /// Its number, counted from 0 in the order of adding.
    pub const fn index(self) -> usize {
        self.0 as usize
    }
}

/// Names one end of a stream; the other end has a name of its own. Never used again for another stream.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord, Hash)]
pub struct StreamId(pub(crate) u32);

impl StreamId {
    pub(crate) const fn index(self) -> usize {
        self.0 as usize
    }

    pub(crate) const fn peer(self) -> Self {
        Self(self.0 ^ 1)
    }
}

/// Something that a host must look at. Each names the host, and most one of its streams.
#[derive(Clone, Debug, PartialEq, Eq)]
#[non_exhaustive]
pub enum NetEvent {
    /// The stream that this host dialled is open.
    Connected {
        /// The host that dialled.
        host: HostId,
        /// Its end.
        stream: StreamId,
    },
    /// The stream that this host dialled cannot be opened; the end is gone.
    Refused {
        /// The host that dialled.
        host: HostId,
        /// Its end.
        stream: StreamId,
        /// The dial timed out, rather than being refused by the other host.
        timed_out: bool,
    },
    /// Another host opened a stream to a listening port of this one.
    Accepted {
        /// The host that listens.
        host: HostId,
        /// Its port.
        port: u16,
        /// Its end of the new stream.
        stream: StreamId,
        /// The dialling end.
        from: SocketAddr,
    },
    /// Bytes can be read.
    Readable {
        /// The reader.
        host: HostId,
        /// Its end.
        stream: StreamId,
    },
    /// A write was short, and there is room again.
    Writable {
        /// The writer.
        host: HostId,
        /// Its end.
        stream: StreamId,
    },
    /// The other end closed, and all its bytes were lent to the reader.
    Closed {
        /// The reader.
        host: HostId,
        /// Its end, which can still write until it is closed as well.
        stream: StreamId,
    },
    /// The stream was reset; the end is gone.
    Reset {
        /// The host that had the end.
        host: HostId,
        /// The end.
        stream: StreamId,
    },
    /// A datagram arrived.
    Datagram {
        /// The receiver.
        host: HostId,
        /// The sender's address and port.
        from: SocketAddr,
        /// The port that it was sent to: the host's own or the discovery port.
        port: u16,
        /// Its bytes.
        bytes: Arc<[u8]>,
    },
    /// A timer went off.
    Timer {
        /// The host that set it.
        host: HostId,
        /// What it said when it set it.
        token: u64,
    },
    /// The host lost power or its process was killed: its state is gone.
    Crashed {
        /// The host.
        host: HostId,
    },
    /// The host is back, without listeners and without state.
    Restarted {
        /// The host.
        host: HostId,
    },
    /// The host has another address, and its streams lead nowhere; or its interface went down or came up.
    AddressChanged {
        /// The host.
        host: HostId,
    },
}

impl NetEvent {
    /// The host that must look at it.
    pub const fn host(&self) -> HostId {
        match self {
            Self::Connected { host, .. }
            | Self::Refused { host, .. }
            | Self::Accepted { host, .. }
            | Self::Readable { host, .. }
            | Self::Writable { host, .. }
            | Self::Closed { host, .. }
            | Self::Reset { host, .. }
            | Self::Datagram { host, .. }
            | Self::Timer { host, .. }
            | Self::Crashed { host }
            | Self::Restarted { host }
            | Self::AddressChanged { host } => *host,
        }
    }

    const fn code(&self) -> u8 {
        match self {
            Self::Connected { .. } => 1,
            Self::Refused { .. } => 2,
            Self::Accepted { .. } => 3,
            Self::Readable { .. } => 4,
            Self::Writable { .. } => 5,
            Self::Closed { .. } => 6,
            Self::Reset { .. } => 7,
            Self::Datagram { .. } => 8,
            Self::Timer { .. } => 9,
            Self::Crashed { .. } => 10,
            Self::Restarted { .. } => 11,
            Self::AddressChanged { .. } => 12,
        }
    }
}

/// A running hash (FNV-1a).
#[derive(Clone, Copy, Debug)]
pub(crate) struct Trace(u64);

impl Trace {
    pub(crate) const fn new() -> Self {
        Self(0xCBF2_9CE4_8422_2325)
    }

    pub(crate) const fn hash(&self) -> u64 {
        self.0
    }

    pub(crate) fn note(&mut self, bytes: &[u8]) {
        for byte in bytes {
            self.0 = (self.0 ^ u64::from(*byte)).wrapping_mul(0x0000_0100_0000_01B3);
        }
    }

    /// Everything but how a unit reads, writes and sets its timers.
    pub(crate) fn note_event(&mut self, now: Instant, event: &NetEvent) {
        if matches!(event, NetEvent::Readable { .. } | NetEvent::Writable { .. } | NetEvent::Timer { .. }) {
            return;
        }
        self.note_at(now, &[event.code()]);
        match event {
            NetEvent::Connected { stream, .. }
            | NetEvent::Refused { stream, .. }
            | NetEvent::Accepted { stream, .. }
            | NetEvent::Closed { stream, .. }
            | NetEvent::Reset { stream, .. } => self.note(&stream.0.to_le_bytes()),
            NetEvent::Datagram { bytes, .. } => self.note(bytes),
            _ => (),
        }
    }

    pub(crate) fn note_at(&mut self, now: Instant, what: &[u8]) {
        self.note(&now.as_micros().to_le_bytes());
        self.note(what);
    }
}
