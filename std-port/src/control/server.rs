//! The socket of a running unit: one thread that accepts, and one for each open connection.

use std::cell::RefCell;
use std::collections::{BTreeMap, HashMap};
use std::io::{self, Write};
use std::net::Shutdown;
use std::ops::ControlFlow;
use std::os::unix::net::{UnixListener, UnixStream};
use std::path::{Path, PathBuf};
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::{Arc, Condvar, Mutex, PoisonError};
use std::time::{Duration, Instant};

use rustix::event::{PollFd, PollFlags, Timespec, poll};
use rustix::io::Errno;
use rustix::net::{SendFlags, send};

use super::answering::execute_for;
use super::audit::{Audit, Entry, Who};
use super::commands::Asked;
use super::lines::{Line, Lines};
use super::location::{Location, LocationError, own_uid, peer_uid};
use super::protocol::{Answer, CONTROL_VERSION, Failure, LONGEST_LINE, Question};
use super::role::{Operators, Role, names_of_users};
use crate::CommunicationSystem;
use crate::executor::OwnThread;
use crate::locks::lock;
use crate::seldom::warn_seldom;
use crate::sys::epoll::{Epoll, Events, Interest, Waker};

/// Connections at a time.
pub(super) const MOST_CONNECTIONS: usize = 8;
/// Those of one user other than the unit's own, so that none keeps the others out.
const MOST_OF_A_USER: usize = MOST_CONNECTIONS / 2;
/// Connections beyond them, on which a unit can only be stopped.
const RESERVED: usize = 4;
/// The name of the failure that anything else ends with there.
pub(super) const FULL: &str = "Full";

/// Why no more is done for a client.
pub(super) fn full() -> Failure {
    let text = format!("{MOST_CONNECTIONS} connections are open already, or {MOST_OF_A_USER} of this user: close one");
    Failure::resource(FULL, text)
}
/// A client that takes nothing for so long is cut off.
const WRITE_TIMEOUT: Duration = Duration::from_secs(2);
/// What a client may leave unread of answers that do not wait for it.
const MOST_UNREAD: usize = 2 * LONGEST_LINE;
/// A client that asks nothing for this long is disconnected. One that waits for an answer, as of a watch or a hold, is
/// not idle.
const IDLE_TIMEOUT: Duration = Duration::from_secs(600);
/// With all connections in use, one that has been idle for this long gives way to the next client.
const GIVES_WAY: Duration = Duration::from_secs(1);
/// Samples are batched for at most this long, so that writing them disturbs the measurement less.
const GATHER: Duration = Duration::from_millis(50);
/// Between two looks whether the socket is still there.
const BETWEEN_LOOKS: Duration = Duration::from_secs(1);
/// How long a stop waits for all threads together.
const PATIENCE: Duration = Duration::from_secs(1);
const WAKER: u64 = 0;
const LISTENER: u64 = 1;

/// The server of one unit. Dropping it ends nothing: [`Server::stop`] does.
pub(crate) struct Server {
    shared: Arc<Shared>,
}

struct Shared {
    waker: Waker,
    stopping: AtomicBool,
    idle_limit: Duration,
    /// Users besides the unit's own; none where the socket is not shared.
    operators: Option<Operators>,
    audit: Option<Arc<Audit>>,
    /// Of the host's users, as they were at the start.
    names: BTreeMap<u32, String>,
    connections: Mutex<Connections>,
    socket: Mutex<Socket>,
    /// Told when the unit stops.
    stopped: Condvar,
}

/// Where clients find the unit.
#[derive(Default)]
struct Socket {
    location: Option<Location>,
    /// One that was made again, for the thread that accepts.
    fresh: Option<UnixListener>,
}

#[derive(Default)]
struct Connections {
    next: u64,
    open: HashMap<u64, Open>,
    threads: Vec<OwnThread>,
}

/// A connection.
struct Open {
    stream: UnixStream,
    /// Which other user than the unit's own has it.
    uid: Option<u32>,
    /// Since when it is idle; `None` while a question is answered.
    idle: Arc<Mutex<Option<Instant>>>,
}

impl Connections {
    /// Ends the connection that has asked nothing for the longest time; `false` if all are in use.
    fn make_room(&mut self, of: impl Fn(&Open) -> bool) -> bool {
        let of = self.open.iter().filter(|(_, open)| of(open));
        let idle = of.filter_map(|(number, open)| Some((lock(&open.idle).as_ref()?.elapsed(), *number)));
        let Some((_, number)) = idle.filter(|(idle, _)| *idle >= GIVES_WAY).max() else { return false };
        self.open.remove(&number).is_some_and(|open| open.stream.shutdown(Shutdown::Both).is_ok())
    }
}

impl Server {
    /// Answers questions about `system` at the first of `paths`, and where that vanishes at the first that can be opened. The handle
    /// must not be one that keeps the unit running.
    pub(super) fn open<T: Send + 'static>(
        paths: Vec<PathBuf>,
        operators: Option<Operators>,
        audit: Option<Arc<Audit>>,
        system: CommunicationSystem<T>,
    ) -> Result<Self, LocationError> {
        let path = paths.first().cloned().unwrap_or_default();
        let (location, listener) = Location::open(&path, operators.is_some())?;
        let started = Shared::new(IDLE_TIMEOUT, operators, audit).and_then(|shared| {
            lock(&shared.socket).location = Some(location.clone());
            shared.keep_socket(paths)?;
            shared.accept_with(listener, system)
        });
        match started {
            Ok(shared) => Ok(Self { shared }),
            Err(error) => {
                location.remove();
                Err(LocationError::System { path, error })
            }
        }
    }

    pub(crate) fn path(&self) -> Option<PathBuf> {
        Some(lock(&self.shared.socket).location.as_ref()?.path().to_owned())
    }

    /// Ends all connections and threads except the calling one; waits only for a bounded time for a stuck one.
    pub(crate) fn stop(&self) {
        self.shared.stopping.store(true, Ordering::Release);
        let location = lock(&self.shared.socket).location.take();
        location.inspect(Location::remove);
        self.shared.stopped.notify_all();
        self.shared.waker.wake();
        let threads = {
            let mut connections = lock(&self.shared.connections);
            connections.open.values().for_each(|open| drop(open.stream.shutdown(Shutdown::Both)));
            std::mem::take(&mut connections.threads)
        };
        let end = Instant::now() + PATIENCE;
        threads.iter().for_each(|thread| thread.join(end.saturating_duration_since(Instant::now())));
    }
}

impl Shared {
    fn new(idle_limit: Duration, operators: Option<Operators>, audit: Option<Arc<Audit>>) -> io::Result<Arc<Self>> {
        let (waker, stopping, connections) = (Waker::new()?, AtomicBool::new(false), Mutex::default());
        let (socket, stopped) = (Mutex::default(), Condvar::new());
        let names = names_of_users();
        Ok(Arc::new(Self { waker, stopping, idle_limit, operators, audit, names, connections, socket, stopped }))
    }

    /// Makes the socket again when it has vanished, in a thread that nothing waits for: its directory may be on a disk that
    /// hangs.
    fn keep_socket(self: &Arc<Self>, paths: Vec<PathBuf>) -> io::Result<()> {
        let own = self.clone();
        let thread = std::thread::Builder::new().name("cara-socket".into()).spawn(move || own.look_after(&paths))?;
        lock(&self.connections).threads.push(thread.into());
        Ok(())
    }

    fn look_after(&self, paths: &[PathBuf]) {
        let mut is_reported = false;
        while let Some(location) = self.await_next_look() {
            if location.is_there() {
                continue;
            }
            // What stands above a folder of the system's is not ours to make.
            let is_below = |path: &PathBuf| path.ancestors().nth(2).is_some_and(Path::is_dir);
            let usable = paths.iter().enumerate().filter(|(number, path)| *number == 0 || is_below(path));
            let opened = usable.map(|(_, path)| Location::open(path, self.operators.is_some())).reduce(Result::or);
            match opened {
                Some(Ok((location, listener))) => {
                    is_reported = false;
                    self.moved_to(location, listener);
                }
                Some(Err(error)) if !is_reported => {
                    is_reported = true;
                    tracing::warn!(%error, "the control socket has vanished and cannot be made again yet: `cara` does not find this unit");
                }
                _ => {}
            }
        }
    }

    /// The place after the next pause; `None` once the unit stops.
    fn await_next_look(&self) -> Option<Location> {
        let socket = lock(&self.socket);
        let waited = self.stopped.wait_timeout_while(socket, BETWEEN_LOOKS, |_| !self.is_stopping());
        waited.unwrap_or_else(PoisonError::into_inner).0.location.clone()
    }

    fn moved_to(&self, location: Location, listener: UnixListener) {
        let mut socket = lock(&self.socket);
        if self.is_stopping() {
            return location.remove();
        }
        tracing::warn!(path = %location.path().display(), "the control socket had vanished and was made again");
        *socket = Socket { location: Some(location), fresh: Some(listener) };
        self.waker.wake();
    }

    fn accept_with<T: Send + 'static>(
        self: Arc<Self>,
        listener: UnixListener,
        system: CommunicationSystem<T>,
    ) -> io::Result<Arc<Self>> {
        let epoll = Epoll::new()?;
        epoll.add(&self.waker, WAKER, Interest::READ_LEVEL)?;
        epoll.add(&listener, LISTENER, Interest::READ_LEVEL)?;
        let own = self.clone();
        let thread = std::thread::Builder::new().name("cara-control".into());
        let thread = thread.spawn(move || own.accept(listener, &epoll, &system))?;
        lock(&self.connections).threads.push(thread.into());
        Ok(self)
    }

    fn is_stopping(&self) -> bool {
        self.stopping.load(Ordering::Acquire)
    }

    fn accept<T: Send + 'static>(
        self: &Arc<Self>,
        mut listener: UnixListener,
        epoll: &Epoll,
        system: &CommunicationSystem<T>,
    ) {
        let mut events = Events::new(2);
        while !self.is_stopping() {
            if let Err(error) = epoll.wait(&mut events, None) {
                tracing::error!(%error, "waiting for control connections failed");
                return;
            }
            if self.waker.reset()
                && let Some(fresh) = lock(&self.socket).fresh.take()
            {
                // The set forgets the old one when it is closed.
                if let Err(error) = epoll.add(&fresh, LISTENER, Interest::READ_LEVEL) {
                    tracing::error!(%error, "the control socket that was made again cannot be watched");
                }
                listener = fresh;
                continue;
            }
            if events.iter().all(|ready| ready.token == WAKER) {
                continue;
            }
            match listener.accept() {
                Ok((stream, _)) => self.accepted(stream, system),
                Err(error) if error.kind() == io::ErrorKind::WouldBlock => {}
                Err(error) => {
                    warn_seldom!(%error, "a control connection could not be taken");
                    std::thread::sleep(Duration::from_millis(100));
                }
            }
        }
    }

    /// Serves a connection in a thread of its own, or says why not.
    fn accepted<T: Send + 'static>(self: &Arc<Self>, stream: UnixStream, system: &CommunicationSystem<T>) {
        // Everything that is refused is small enough for an empty socket's buffer.
        let refuse = |failure| drop(write(&mut &stream, &Answer::Failed(failure)));
        if let Err(failure) = self.role_of(&stream) {
            return refuse(failure);
        }
        let mut connections = lock(&self.connections);
        // A stop ends those that it finds.
        if self.is_stopping() {
            return;
        }
        connections.threads.retain(|thread| !thread.is_finished());
        // Root could end the unit as well.
        let uid = peer_uid(&stream).ok().filter(|uid| ![own_uid(), 0].contains(uid));
        let is_of_user = |open: &Open| uid.is_some() && open.uid == uid;
        let of_user = |connections: &Connections| connections.open.values().filter(|open| is_of_user(open)).count();
        let is_full = of_user(&connections) >= MOST_OF_A_USER && !connections.make_room(is_of_user)
            || connections.open.len() >= MOST_CONNECTIONS && !connections.make_room(|_| true);
        let of_others = connections.open.values().filter(|open| open.uid.is_some()).count();
        // Half of what is for stopping is for the unit's own user and root alone.
        let may_not_stop = of_user(&connections) >= MOST_OF_A_USER + RESERVED / 2
            || uid.is_some() && of_others >= MOST_CONNECTIONS + RESERVED / 2
            || connections.open.len() >= MOST_CONNECTIONS + RESERVED;
        if is_full && may_not_stop {
            return refuse(full());
        }
        let Ok(kept) = stream.try_clone() else { return };
        let number = connections.next;
        let (own, system) = (self.clone(), system.clone());
        let idle = Arc::new(Mutex::new(Some(Instant::now())));
        let open = Open { stream: kept, uid, idle: idle.clone() };
        let thread = std::thread::Builder::new().name("cara-control".into());
        let thread = thread.spawn(move || {
            // The end of a connection is not logged: the client knows.
            let _ = own.serve(stream, &idle, is_full, &system);
            lock(&own.connections).open.remove(&number);
        });
        if let Ok(thread) = thread {
            connections.next += 1;
            connections.open.insert(number, open);
            connections.threads.push(thread.into());
        }
    }

    fn role_of(&self, stream: &UnixStream) -> Result<Role, Failure> {
        let uid = peer_uid(stream).ok();
        let nobody_else = Operators::default();
        let operators = self.operators.as_ref().unwrap_or(&nobody_else);
        uid.and_then(|uid| operators.role_of(uid)).ok_or_else(|| {
            // Not in the audit log: whoever may only try must not be able to fill it.
            warn_seldom!(?uid, "a user who is no operator has tried to connect to the control socket");
            let text =
                "only the user that runs the unit may ask it, and those in its `operators`: have yours added there";
            Failure::configuration("NotAllowed", text)
        })
    }

    fn serve<T: Send + 'static>(
        &self,
        stream: UnixStream,
        idle: &Mutex<Option<Instant>>,
        full_when_opened: bool,
        system: &CommunicationSystem<T>,
    ) -> io::Result<()> {
        stream.set_nonblocking(false)?;
        // Between questions alone is anything read.
        stream.set_read_timeout(Some(self.idle_limit))?;
        stream.set_write_timeout(Some(WRITE_TIMEOUT))?;
        let mut lines = Lines::new(&stream);
        let role = self.role_of(&stream).map_err(|failure| io::Error::other(failure.text))?;
        let mut who = Who::of(&stream, role, &self.names)?;
        let outcome = self.converse(&mut lines, idle, full_when_opened, &mut who, system);
        if let Some(audit) = &self.audit {
            // It is given up; what was sent before can still be read.
            let _ = stream.shutdown(Shutdown::Both);
            self.note_rest(&mut lines, audit, who, system.is_stopped());
        }
        outcome
    }

    /// What a client has asked for that was never looked at, since it had gone: while the process was stopped it may have been
    /// asked for much, and none of it is carried out.
    fn note_rest(&self, lines: &mut Lines<&UnixStream>, audit: &Audit, mut who: Who, unit_stops: bool) {
        while let Ok(Some(line)) = lines.next() {
            let Ok(question) = question(line) else { continue };
            if let Some(mut entry) = Entry::of(audit, &who, &question) {
                entry.give_up(unit_stops || self.is_stopping());
            }
            if let Question::As { name, role } = question {
                // Where it may not, it asked for the rest in its own name.
                let _ = who.act_as(name, role);
            }
        }
    }

    fn converse<T: Send + 'static>(
        &self,
        lines: &mut Lines<&UnixStream>,
        idle: &Mutex<Option<Instant>>,
        full_when_opened: bool,
        who: &mut Who,
        system: &CommunicationSystem<T>,
    ) -> io::Result<()> {
        let stream = *lines.source();
        let writer = RefCell::new(Answers::new(stream, Instant::now()));
        let unit = system.identity();
        writer.borrow_mut().give(&Answer::Hello {
            control_version: CONTROL_VERSION,
            unit: unit.to_string(),
            fleet: system.fleet().0,
            full: full_when_opened,
        })?;
        while !self.is_stopping()
            && let Some(line) = lines.next()?
        {
            // A sign of life that came when what it was for had ended.
            if matches!(line, Line::Text([])) {
                continue;
            }
            *lock(idle) = None;
            match question(line) {
                Ok(Question::As { name, role }) => {
                    let outcome = who.act_as(name, role).map_or_else(Answer::Failed, |()| Answer::Done);
                    let _ = writer.borrow_mut().sink(&outcome);
                }
                Ok(question) => {
                    let client = RefCell::new(Beats { stream, lines, last: Instant::now() });
                    let lives = || {
                        writer.borrow_mut().send_what_fits();
                        client.borrow_mut().lives().filter(|_| !self.is_stopping())
                    };
                    writer.borrow_mut().waits = !question.waits_for_no_reader();
                    let mut entry = self.audit.as_ref().and_then(|audit| Entry::of(audit, who, &question));
                    let mut asked = Asked::of(system.engine().commands(), who, &question);
                    let mut sink = |answer| {
                        asked.iter_mut().for_each(|asked| asked.note(&answer));
                        entry.iter_mut().for_each(|entry| entry.note(&answer));
                        writer.borrow_mut().sink(&answer)
                    };
                    if full_when_opened && !question.is_of_a_stop() {
                        let _ = sink(Answer::Failed(full()));
                    } else if let Err(failure) = who.role().permit(system, &question) {
                        let _ = sink(Answer::Failed(failure));
                    } else if !question.needs_its_client() || lives().is_some() {
                        execute_for(system, &question, &mut sink, &lives);
                    }
                    let unit_stops = system.is_stopped() || self.is_stopping();
                    entry.iter_mut().for_each(|entry| entry.give_up(unit_stops));
                }
                Err(failure) => drop(writer.borrow_mut().sink(&Answer::Failed(failure))),
            }
            writer.borrow_mut().outcome()?;
            *lock(idle) = Some(Instant::now());
        }
        Ok(())
    }
}

fn question(line: Line<'_>) -> Result<Question, Failure> {
    match line {
        Line::Text(text) => serde_json::from_slice(text).map_err(|error| {
            let text = format!("the line is no question: {error}");
            Failure::configuration("BadQuestion", text)
        }),
        Line::TooLong => {
            let text = format!("the line is longer than {LONGEST_LINE} bytes");
            Err(Failure::configuration("TooLong", text))
        }
    }
}

/// The signs of life of a client whose question is being answered.
struct Beats<'b, 's> {
    stream: &'s UnixStream,
    lines: &'b mut Lines<&'s UnixStream>,
    last: Instant,
}

impl Beats<'_, '_> {
    /// When the client last sent an empty line, or asked; `None` once it has closed its end altogether, as opposed to: asks
    /// nothing more. Behind its next question no empty line is seen.
    fn lives(&mut self) -> Option<Instant> {
        let mut fds = [PollFd::new(self.stream, PollFlags::IN)];
        let now = Timespec { tv_sec: 0, tv_nsec: 0 };
        let came = if poll(&mut fds, Some(&now)).is_ok() { fds[0].revents() } else { PollFlags::empty() };
        if came.intersects(PollFlags::HUP | PollFlags::ERR) {
            return None;
        }
        // Reading waits for nothing where something has come.
        if (self.lines.has_more() || came.contains(PollFlags::IN)) && self.lines.skip_empty().unwrap_or(false) {
            self.last = Instant::now();
        }
        Some(self.last)
    }
}

fn write(writer: &mut impl Write, answer: &Answer) -> io::Result<()> {
    serde_json::to_writer(&mut *writer, answer)?;
    writer.write_all(b"\n")
}

/// Answers on their way to one client.
struct Answers<'s> {
    stream: &'s UnixStream,
    unsent: Vec<u8>,
    flushed: Instant,
    error: Option<io::Error>,
    /// Whether a full socket is waited for.
    waits: bool,
}

impl<'s> Answers<'s> {
    const fn new(stream: &'s UnixStream, now: Instant) -> Self {
        Self { stream, unsent: Vec::new(), flushed: now, error: None, waits: true }
    }

    fn give(&mut self, answer: &Answer) -> io::Result<()> {
        write(&mut self.unsent, answer)?;
        if matches!(answer, Answer::Sample { .. }) && self.flushed.elapsed() < GATHER {
            return Ok(());
        }
        self.flushed = Instant::now();
        self.send()
    }

    fn send(&mut self) -> io::Result<()> {
        if self.waits {
            self.stream.write_all(&self.unsent)?;
            self.unsent = Vec::new();
            return Ok(());
        }
        while !self.unsent.is_empty() {
            match send(self.stream, &self.unsent, SendFlags::DONTWAIT | SendFlags::NOSIGNAL) {
                Ok(count) => drop(self.unsent.drain(..count)),
                Err(Errno::WOULDBLOCK) if self.unsent.len() <= MOST_UNREAD => break,
                Err(errno) => return Err(errno.into()),
            }
        }
        Ok(())
    }

    /// What a slow reader has made room for. An error shows at the next answer.
    fn send_what_fits(&mut self) {
        if !self.waits && self.error.is_none() {
            self.error = self.send().err();
        }
    }

    fn sink(&mut self, answer: &Answer) -> ControlFlow<()> {
        let given = self.error.take().map_or_else(|| self.give(answer), Err);
        match given {
            Ok(()) => ControlFlow::Continue(()),
            Err(error) => {
                self.error = Some(error);
                ControlFlow::Break(())
            }
        }
    }

    /// Behind the last answer. Nothing is watched any more, so the rest may wait for the client.
    fn outcome(&mut self) -> io::Result<()> {
        self.waits = true;
        self.error.take().map_or_else(|| self.send(), Err)
    }
}

#[cfg(test)]
mod tests {
    use std::io::{BufRead, BufReader, Read};

    use cara_core::config::Constraints;

    use super::*;
    use crate::UnitEvent;
    use crate::testing::{fleet, manager};

    fn written(shared: &Shared) {
        shared.audit.iter().for_each(|audit| audit.flush(Duration::from_secs(20)));
    }

    #[test]
    fn what_a_client_has_done_is_noted_with_who_asked() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("audit");
        let system = manager(fleet(), Constraints::M_UNIT);
        let shared = Shared::new(IDLE_TIMEOUT, None, Some(Arc::new(Audit::open(&path).unwrap()))).unwrap();
        let (mut client, served) = UnixStream::pair().unwrap();
        client.write_all(b"{\"ask\":\"retire\",\"node\":\"agv/1\"}\n{\"ask\":\"nodes\"}\n").unwrap();
        client.shutdown(Shutdown::Write).unwrap();
        let _ = shared.serve(served, &Mutex::default(), false, &system);
        written(&shared);
        let line: serde_json::Value = serde_json::from_str(&std::fs::read_to_string(&path).unwrap()).unwrap();
        assert_eq!(
            (&line["ask"], &line["node"], &line["pid"]),
            (&"retire".into(), &"agv/1".into(), &std::process::id().into())
        );
        assert_eq!(line["outcome"], "UnknownNode");
    }

    /// As while the process was stopped: what was asked by a client that has gone is noted, and moves nothing.
    #[test]
    fn what_a_client_asked_that_has_gone_is_noted_and_moves_nothing() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("audit");
        let system = manager(fleet(), Constraints::M_UNIT);
        let shared = Shared::new(IDLE_TIMEOUT, None, Some(Arc::new(Audit::open(&path).unwrap()))).unwrap();
        let asked = [
            r#"{"ask":"stop","node":null}"#,
            r#"{"ask":"reset","node":"agv/1"}"#,
            r#"{"ask":"nodes","offering":null}"#,
            r#"{"ask":"stop","node":"agv/2"}"#,
        ];
        let acting = r#"{"ask":"as","name":"bert","role":"see"}"#;
        let recorded = |from: usize| {
            written(&shared);
            let text = std::fs::read_to_string(&path).unwrap();
            let lines: Vec<serde_json::Value> = text.lines().map(|line| serde_json::from_str(line).unwrap()).collect();
            let word = |value: &serde_json::Value| value.as_str().unwrap_or("-").to_owned();
            let reported = lines[from..].iter().map(|line| ["ask", "node", "outcome"].map(|key| word(&line[key])));
            reported.map(|words| words.join(" ")).collect::<Vec<_>>()
        };
        // It has gone before it was greeted.
        let (mut client, served) = UnixStream::pair().unwrap();
        client.write_all(format!("{}\n{acting}\n{}\n", asked[..3].join("\n"), asked[3]).as_bytes()).unwrap();
        drop(client);
        assert!(shared.serve(served, &Mutex::default(), false, &system).is_err());
        assert_eq!(recorded(0), ["stop - gone", "reset agv/1 gone", "stop agv/2 gone"]);
        let text = std::fs::read_to_string(&path).unwrap();
        let in_his_name: Vec<_> = text.lines().map(|line| line.contains(r#""name":"bert""#)).collect();
        assert_eq!(in_his_name, [false, false, true]);
        // It goes behind what it asked, which is looked at all the same: a stop is carried out.
        let (mut client, served) = UnixStream::pair().unwrap();
        client.write_all(format!("{{\"ask\":\"watch\"}}\n{}\n{}\n", asked[1], asked[3]).as_bytes()).unwrap();
        std::thread::scope(|scope| {
            let serving = scope.spawn(|| shared.serve(served, &Mutex::default(), false, &system));
            let mut client = BufReader::new(client);
            for _ in ["hello", "watching"] {
                client.read_line(&mut String::new()).unwrap();
            }
            drop(client);
            let _ = serving.join().unwrap();
        });
        assert_eq!(recorded(3), ["reset agv/1 gone", "stop agv/2 UnknownNode"]);
    }

    #[test]
    fn answers_that_wait_for_no_reader_are_kept_up_to_a_limit_and_sent_when_there_is_room() {
        let (client, served) = UnixStream::pair().unwrap();
        let mut answers = Answers { waits: false, ..Answers::new(&served, Instant::now()) };
        let line = Answer::Metrics { text: "x".repeat(64 * 1024) };
        let mut given = 0;
        while answers.sink(&line).is_continue() {
            given += 1;
            assert!(given < MOST_UNREAD / 1024, "there is no limit");
        }
        assert!(answers.unsent.len() > MOST_UNREAD && answers.outcome().is_err());
        answers.unsent.truncate(MOST_UNREAD);
        std::thread::scope(|scope| {
            let read = scope.spawn(|| BufReader::new(client).lines().map_while(Result::ok).count());
            answers.outcome().unwrap();
            assert!(answers.unsent.is_empty());
            served.shutdown(Shutdown::Both).unwrap();
            assert!(read.join().unwrap() > 0);
        });
    }

    /// Each client has asked before it is served, so that its time to ask is no race.
    #[test]
    fn a_client_that_asks_nothing_is_ended_and_one_that_waits_for_an_answer_is_not() {
        let system = manager(fleet(), Constraints::M_UNIT);
        let shared = Shared::new(Duration::from_millis(20), None, None).unwrap();
        std::thread::scope(|scope| {
            let client = |asks: &[u8]| {
                let (client, served) = UnixStream::pair().unwrap();
                client.set_read_timeout(Some(Duration::from_secs(20))).unwrap();
                (&client).write_all(asks).unwrap();
                let (shared, system) = (&shared, &system);
                scope.spawn(move || drop(shared.serve(served, &Mutex::default(), false, system)));
                BufReader::new(client)
            };
            let next = |client: &mut BufReader<UnixStream>| {
                let mut line = String::new();
                client.read_line(&mut line).unwrap();
                serde_json::from_str::<Answer>(&line).unwrap()
            };
            let mut watching = client(b"{\"ask\":\"watch\"}\n");
            assert!(matches!(next(&mut watching), Answer::Hello { .. }));
            assert!(matches!(next(&mut watching), Answer::Event { .. }));
            for (asks, answers) in [(&b""[..], 1), (b"{\"ask\":\"search\"}\n", 2)] {
                let mut reported = String::new();
                client(asks).read_to_string(&mut reported).unwrap();
                assert_eq!(reported.lines().count(), answers, "{reported}");
            }
            system.engine().notify(UnitEvent::NetworkChanged { up: Vec::new() });
            assert!(matches!(next(&mut watching), Answer::Event { .. }));
        });
    }
}
