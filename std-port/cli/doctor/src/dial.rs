//! Whether a connection to an m_unit can be opened: it is, and is closed again at once.

use std::io;
use std::net::{SocketAddr, TcpStream};
use std::sync::mpsc::{Receiver, Sender, channel};
use std::thread;
use std::time::Duration;

/// How long a connection may take: the first repetition of a lost packet comes after one second.
const PATIENCE: Duration = Duration::from_millis(2_500);
/// Most m_units that are dialled.
const MOST: usize = 32;

/// A connection that was tried.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) struct Dial {
    pub(crate) to: SocketAddr,
    /// `None` as long as it is under way.
    pub(crate) outcome: Option<Outcome>,
}

/// How a connection that was tried ended.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum Outcome {
    Open,
    Refused,
    TimedOut,
    Failed(io::ErrorKind),
}

impl Outcome {
    /// What was seen, if it was not opened.
    pub(crate) fn trouble(self) -> Option<String> {
        match self {
            Self::Open => None,
            Self::Refused => Some("is refused".into()),
            Self::TimedOut => Some(format!("is not answered within {} s", PATIENCE.as_secs_f32())),
            Self::Failed(kind) => Some(format!("fails ({kind})")),
        }
    }
}

/// Connections under way.
pub(crate) struct Dials {
    list: Vec<Dial>,
    sender: Sender<Dial>,
    ended: Receiver<Dial>,
}

impl Dials {
    pub(crate) fn new() -> Self {
        let (sender, ended) = channel();
        Self { list: Vec::new(), sender, ended }
    }

    /// Tries an address once, beside whatever else goes on.
    pub(crate) fn try_once(&mut self, to: SocketAddr) {
        if self.list.len() >= MOST || self.list.iter().any(|dial| dial.to == to) {
            return;
        }
        self.list.push(Dial { to, outcome: None });
        let sender = self.sender.clone();
        thread::spawn(move || sender.send(Dial { to, outcome: Some(outcome(to)) }));
    }

    /// All that were tried, as far as they have come.
    pub(crate) fn all(&mut self) -> Vec<Dial> {
        for ended in self.ended.try_iter() {
            if let Some(dial) = self.list.iter_mut().find(|dial| dial.to == ended.to) {
                *dial = ended;
            }
        }
        self.list.clone()
    }
}

fn outcome(to: SocketAddr) -> Outcome {
    match TcpStream::connect_timeout(&to, PATIENCE) {
        Ok(_) => Outcome::Open,
        Err(error) => match error.kind() {
            io::ErrorKind::ConnectionRefused => Outcome::Refused,
            io::ErrorKind::TimedOut | io::ErrorKind::WouldBlock => Outcome::TimedOut,
            kind => Outcome::Failed(kind),
        },
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use std::net::{Ipv4Addr, TcpListener};

    #[test]
    fn an_open_port_and_a_closed_one_are_told_apart() {
        let listener = TcpListener::bind((Ipv4Addr::LOCALHOST, 0)).unwrap();
        let open = listener.local_addr().unwrap();
        assert_eq!(outcome(open), Outcome::Open);
        drop(listener);
        let mut dials = Dials::new();
        dials.try_once(open);
        dials.try_once(open);
        while dials.all().iter().any(|dial| dial.outcome.is_none()) {
            thread::sleep(Duration::from_millis(1));
        }
        assert_eq!(dials.all(), [Dial { to: open, outcome: Some(Outcome::Refused) }]);
        assert!(Outcome::Open.trouble().is_none() && Outcome::Refused.trouble().is_some());
    }
}
