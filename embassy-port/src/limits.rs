//! The limits of a unit: a constant of the program, from which the type of its memory and its constraints follow.

use cara_core::config::{CHUNK_BYTES, Constraints, LONGEST_KEEP_ALIVE, MINIMUM_CHUNK_BYTES, SHORTEST_KEEP_ALIVE};
use cara_core::error::{Constraint, Error};
use cara_core::host::secure::DATAGRAM_OVERHEAD;
use cara_core::services::session::buffer_bytes;

use crate::security::OVERHEAD;

/// How much a unit has room for. Bytes are those of a 32-bit processor, of a unit with keys and the limits of
/// [`S_UNIT`](Self::S_UNIT); [`Resources::BYTES`](crate::Resources::BYTES) tells the sum.
///
/// The memory has the type [`resources!`](crate::resources), and the unit the constraints that fit:
///
/// ```
/// use cara_core::config::Constraints;
/// use cara_core::time::Duration;
/// use cara_embassy::{Limits, resources};
///
/// struct Agv;
/// const LIMITS: Limits = Limits { message_size: 512, ..Limits::S_UNIT };
/// type AgvResources = resources!(Agv, LIMITS);
/// const { assert!(AgvResources::BYTES <= 27 * 1024) };
///
/// // Only for a unit that wants others than these.
/// const CONSTRAINTS: Constraints =
///     LIMITS.check(Constraints { keep_alive: Duration::from_millis(500), ..LIMITS.constraints() });
/// assert_eq!((CONSTRAINTS.message_size, CONSTRAINTS.calls_per_peer), (512, 8));
/// ```
///
/// What does not fit does not compile. Here the error is "calls_per_peer needs calls = 9, and the resources have 4":
///
/// ```compile_fail,E0080
/// # use cara_core::config::Constraints;
/// # use cara_embassy::Limits;
/// const LIMITS: Limits = Limits { calls_waiting: 0, ..Limits::S_UNIT };
/// const CONSTRAINTS: Constraints = LIMITS.check(Constraints { calls_per_peer: 8, ..LIMITS.constraints() });
/// ```
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Limits {
    /// Connections: one for an s_unit; for an m_unit one more than its nodes, so that it can refuse a node by name. 7,300
    /// bytes each, and twice `stream`. While all are in use, a unit that dials is not answered, and tries again.
    pub links: usize,
    /// Longest message received, in bytes of its block of parameters. 1 byte for each buffer, and 4 with `datagram` and
    /// `reply` as they are. Peers do not send a longer one: [`Error::TooLarge`].
    pub message_size: u32,
    /// Message buffers that all links share, 2 or more. `message_size` and about 190 bytes each. When all are in use,
    /// reading pauses, and what is sent is [`Error::Full`].
    pub message_buffers: usize,
    /// Bytes that TCP keeps in each direction of each link. When they are full, the sender waits.
    pub stream: usize,
    /// Functions of this unit. 216 bytes each, 64 of them for its signature; a list shares those. One more is
    /// [`Error::Full`].
    pub functions: usize,
    /// Functions kept of each peer's list. 104 bytes each, for each link. Others are skipped, which an event tells.
    pub their_functions: usize,
    /// Calls in flight to one peer, and calls of one peer that run; one is kept for an emergency. 136 bytes each, for
    /// each link. One more is [`Error::Full`]; one more of the peer's waits.
    pub calls: usize,
    /// Calls of one peer that wait for those that run. They lie in message buffers, of which 2 are left free: with
    /// fewer than 3 none can wait. The next one is told [`Error::Busy`].
    pub calls_waiting: usize,
    /// Calls that wait for a task of the application, and answers that wait for room. `arguments` and 370 bytes each. The
    /// next call is told [`Error::Busy`].
    pub tasks: usize,
    /// Bytes of the arguments and results of a service, with their names. A service that needs more is not added:
    /// [`Error::TooLarge`].
    pub arguments: usize,
    /// Bytes of the longest datagram, 512 or more; `None` is as much as a message takes. 3 bytes each. Best-effort
    /// requests that are longer are lost.
    pub datagram: Option<usize>,
    /// Bytes of the longest results that come back from a peer, encoded; `None` is as much as a message takes. 1 byte each.
    /// Longer ones are [`Error::TooLarge`].
    pub reply: Option<usize>,
}

/// The type of the memory that an application with this state has within these [`Limits`]: `resources!(Agv, LIMITS)`.
#[macro_export]
macro_rules! resources {
    ($state:ty, $limits:expr) => {
        $crate::Resources<
            $state,
            { $limits.links },
            { $limits.message_size },
            { $limits.buffer_bytes() },
            { $limits.message_buffers },
            { $limits.stream },
            { $limits.functions },
            { $limits.their_functions },
            { $limits.calls },
            { $limits.calls_waiting },
            { $limits.tasks },
            { $limits.arguments },
            { $limits.or_buffer_bytes($limits.datagram) },
            { $limits.or_buffer_bytes($limits.reply) },
        >
    };
}

impl Limits {
    /// Of an s_unit that is called by one manager.
    pub const S_UNIT: Self = Self {
        links: 1,
        message_size: 1024,
        message_buffers: 3,
        stream: 1536,
        functions: 8,
        their_functions: 8,
        calls: 4,
        calls_waiting: 5,
        tasks: 1,
        arguments: 512,
        datagram: None,
        reply: None,
    };
    /// Of an m_unit with four nodes.
    pub const M_UNIT: Self = Self { links: 5, message_buffers: 6, ..Self::S_UNIT };

    /// Sockets that embassy-net's `StackResources` needs: for each link, for datagrams and for DHCP. An application with
    /// sockets of its own, or with DNS, adds those. With fewer than these [`new`](crate::new) fails the build.
    pub const fn sockets(&self) -> usize {
        self.links + 2
    }

    /// What a unit within these limits promises unless it is told others: defaults of an s_unit, and as many nodes, bytes
    /// and calls as there is room for.
    pub const fn constraints(&self) -> Constraints {
        Constraints {
            maximum_nodes: if self.links > 1 { self.links as u16 - 1 } else { 1 },
            message_size: self.message_size,
            calls_per_peer: (self.calls - 1 + self.calls_waiting) as u16,
            ..Constraints::S_UNIT
        }
    }

    /// The same constraints, if they fit. For a `const`: what does not fit does not compile then.
    ///
    /// # Panics
    /// When they do not fit.
    #[expect(clippy::panic, reason = "when compiling")]
    pub const fn check(&self, constraints: Constraints) -> Constraints {
        match self.fit(&constraints) {
            Ok(()) => constraints,
            Err(Error::DoesNotFit { constraint, need, have }) => {
                let text = Text::EMPTY.text(constraint.needs().as_bytes()).text(b" = ").number(need);
                panic!("{}", text.text(b", and the resources have ").number(have).as_str())
            }
            Err(_) => {
                panic!("a constraint is zero, or chunk_size or keep_alive outside their bounds in cara_core::config")
            }
        }
    }

    /// [`Error::DoesNotFit`] for constraints that need more memory, [`Error::BadConstraint`] for those that no memory holds.
    pub(crate) const fn fit(&self, constraints: &Constraints) -> Result<(), Error> {
        let Constraints { maximum_nodes, message_size, chunk_size, keep_alive, calls_per_peer, .. } = *constraints;
        let (chunk, keep_alive) = (chunk_size as usize, keep_alive.as_micros());
        if maximum_nodes == 0
            || calls_per_peer == 0
            || chunk < MINIMUM_CHUNK_BYTES
            || chunk > CHUNK_BYTES
            || keep_alive < SHORTEST_KEEP_ALIVE.as_micros()
            || keep_alive > LONGEST_KEEP_ALIVE.as_micros()
        {
            return Err(Error::BadConstraint);
        }
        // One call is kept for an emergency.
        let calls = (calls_per_peer as usize + 1).saturating_sub(self.calls_waiting);
        let (constraint, need, have) = if maximum_nodes as usize > self.links {
            (Constraint::MaximumNodes, maximum_nodes as u32, self.links as u32)
        } else if message_size > self.message_size {
            (Constraint::MessageSize, message_size, self.message_size)
        } else if calls > self.calls {
            (Constraint::CallsPerPeer, calls as u32, self.calls as u32)
        } else {
            return Ok(());
        };
        Err(Error::DoesNotFit { constraint, need, have })
    }

    /// Bytes of a message buffer, for a message that is sealed if the crate has its feature `secure`.
    #[doc(hidden)]
    pub const fn buffer_bytes(&self) -> usize {
        // A session datagram may add more than chunks do.
        let datagram = 8 + if cfg!(feature = "secure") { DATAGRAM_OVERHEAD } else { 0 };
        buffer_bytes(self.message_size, OVERHEAD) + datagram
    }

    /// The bytes of a buffer for which a limit may say how many.
    #[doc(hidden)]
    pub const fn or_buffer_bytes(&self, bytes: Option<usize>) -> usize {
        match bytes {
            Some(bytes) => bytes,
            None => self.buffer_bytes(),
        }
    }
}

/// Fails the build if a stack has too few sockets, with both numbers.
#[expect(clippy::panic, reason = "when compiling")]
pub(crate) const fn check_sockets(need: usize, have: usize) {
    if have < need {
        let text = Text::EMPTY.text(b"Limits::sockets() = ").number(need as u32);
        panic!("{}", text.text(b", and StackResources has ").number(have as u32).as_str())
    }
}

/// A text that is made when compiling.
struct Text {
    bytes: [u8; 96],
    length: usize,
}

impl Text {
    const EMPTY: Self = Self { bytes: [0; 96], length: 0 };

    const fn text(mut self, text: &[u8]) -> Self {
        let (_, free) = self.bytes.split_at_mut(self.length);
        free.split_at_mut(text.len()).0.copy_from_slice(text);
        self.length += text.len();
        self
    }

    const fn number(self, number: u32) -> Self {
        let text = if number < 10 { self } else { self.number(number / 10) };
        text.text(&[b'0' + (number % 10) as u8])
    }

    const fn as_str(&self) -> &str {
        match core::str::from_utf8(self.bytes.split_at(self.length).0) {
            Ok(text) => text,
            Err(_) => "",
        }
    }
}

#[cfg(test)]
mod tests {
    use super::{DATAGRAM_OVERHEAD, Limits, check_sockets};
    use cara_core::distribution::datagram::SESSION_HEADER_BYTES;
    use cara_core::distribution::message::{REQUEST_BYTES, SessionBody};

    #[test]
    fn a_message_in_one_datagram_fits_the_buffers_of_datagrams() {
        let sealed = if cfg!(feature = "secure") { DATAGRAM_OVERHEAD } else { 0 };
        let around = SESSION_HEADER_BYTES + SessionBody::message_prefix(0).len() + REQUEST_BYTES + sealed;
        for message_size in 0..2_000 {
            let limits = Limits { message_size, ..Limits::S_UNIT };
            assert!(limits.buffer_bytes() >= around + message_size as usize, "{message_size}");
        }
    }

    #[test]
    fn as_many_sockets_as_needed_are_enough() {
        check_sockets(Limits::S_UNIT.sockets(), 3);
    }

    #[test]
    #[should_panic(expected = "Limits::sockets() = 12, and StackResources has 10")]
    fn too_few_sockets_are_told_with_both_numbers() {
        check_sockets(Limits { links: 10, ..Limits::S_UNIT }.sockets(), 10);
    }
}
