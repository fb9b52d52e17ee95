//! Programs that serve calls: started without a shell, given their arguments, bounded in time and output, and ended
//! with all that they started.

use std::fs::File;
use std::io::{self, Read, Seek, Write};
use std::os::fd::OwnedFd;
use std::os::unix::process::{CommandExt, ExitStatusExt};
use std::process::{Child, ChildStdout, Command, ExitStatus, Stdio};
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};
use std::time::{Duration, Instant};

use cara_std::{LeaseWatch, ServiceError};
use rustix::event::{PollFd, PollFlags, Timespec, poll};
use rustix::fs::MemfdFlags;
use rustix::process::{Pid, PidfdFlags, Signal, kill_process_group, pidfd_open};

/// Calls that run a program at the same time. Each holds a thread of the unit and one of its caller's places, of which
/// there are eight, and other functions must go on being served.
pub(super) const CALLS: usize = 6;
/// Longest output in bytes.
pub(super) const OUTPUT_BYTES: usize = 1024 * 1024;

/// Why a program gave no output.
#[derive(Debug, thiserror::Error)]
pub(super) enum Failure {
    #[error("it could not be started: {0}")]
    NotStarted(#[source] io::Error),
    #[error("it was not started: {CALLS} calls run programs already")]
    TooMany,
    #[error("it was not started: the lease of the call has ended, or the node ends")]
    NotWanted,
    #[error("it was ended: its time was up")]
    TimedOut,
    #[error("it was ended: it printed more than {OUTPUT_BYTES} bytes")]
    TooMuchOutput,
    #[error("it ended with {0}")]
    Ended(ExitStatus),
    #[error("it could not be followed: {0}")]
    Lost(#[source] io::Error),
}

impl Failure {
    /// What the caller is told: codes as shells and `timeout` use them.
    pub(super) fn to_service_error(&self) -> ServiceError {
        match self {
            Self::NotStarted(error) if error.kind() == io::ErrorKind::NotFound => ServiceError::Failed(127),
            Self::NotStarted(_) | Self::Lost(_) => ServiceError::Failed(126),
            Self::TooMany | Self::NotWanted => ServiceError::NotReady,
            Self::TimedOut => ServiceError::Failed(124),
            Self::TooMuchOutput => ServiceError::BadResults,
            Self::Ended(status) => ServiceError::Failed(code(*status)),
        }
    }
}

/// An exit code, or 128 and the signal.
fn code(status: ExitStatus) -> u16 {
    let code = status.code().or(status.signal().map(|signal| signal + 128));
    code.and_then(|code| u16::try_from(code).ok()).unwrap_or(u16::MAX)
}

/// What a program is told.
pub(super) struct Task<'a> {
    /// The program and its arguments.
    pub(super) command: &'a [String],
    /// Added to the environment.
    pub(super) environment: [(&'static str, String); 2],
    /// On standard input.
    pub(super) input: &'a [u8],
}

/// The programs of a node that run now.
#[derive(Default)]
pub(super) struct Programs {
    state: Mutex<State>,
}

#[derive(Default)]
struct State {
    /// Of calls: the service's number, and the program's process group.
    calls: Vec<(usize, Pid)>,
    /// The node is about to end.
    ending: bool,
    /// Threads that wait for what makes safe.
    guards: Vec<std::thread::JoinHandle<()>>,
}

impl Programs {
    /// Runs a program for a call and returns its output.
    pub(super) fn serve(
        self: &Arc<Self>,
        service: usize,
        task: &Task<'_>,
        timeout: Duration,
        lease: Option<&LeaseWatch>,
    ) -> Result<Vec<u8>, Failure> {
        let deadline = Instant::now() + timeout;
        let mut running = {
            let mut state = self.lock();
            // Looked at under the lock: what ends a lease ends the programs that are listed, and then makes safe.
            if state.ending || lease.is_some_and(|lease| !lease.is_live()) {
                return Err(Failure::NotWanted);
            }
            if state.calls.len() >= CALLS {
                return Err(Failure::TooMany);
            }
            let running = Running::start(task)?;
            state.calls.push((service, running.group));
            running
        };
        let output = running.output(deadline);
        let group = running.group;
        // The process is not reaped yet, so that its pid cannot be reused while it is listed.
        self.lock().calls.retain(|(_, listed)| *listed != group);
        let status = running.end()?;
        let output = output?;
        if status.success() { Ok(output) } else { Err(Failure::Ended(status)) }
    }

    /// Ends the programs of a service's calls, and starts the one that makes safe what they began.
    pub(super) fn make_safe(&self, service: usize, task: &Task<'_>, timeout: Duration) {
        let mut state = self.lock();
        state.calls.iter().filter(|(of, _)| *of == service).for_each(|(_, group)| end_group(*group));
        let (name, deadline) = (task.command.join(" "), Instant::now() + timeout);
        match Running::start(task) {
            Ok(running) => state.guards.push(std::thread::spawn(move || guard(running, &name, deadline))),
            Err(error) => tracing::error!(program = name, %error, "what makes safe at the end of a lease failed"),
        }
        state.guards.retain(|guard| !guard.is_finished());
    }

    /// Ends the programs of all calls, and lets no other begin.
    pub(super) fn end_calls(&self) {
        let mut state = self.lock();
        state.ending = true;
        state.calls.iter().for_each(|(_, group)| end_group(*group));
    }

    /// Waits for what makes safe.
    pub(super) fn finish(&self) {
        let guards = std::mem::take(&mut self.lock().guards);
        // A guard that panicked has told so itself.
        guards.into_iter().for_each(|guard| drop(guard.join()));
    }

    fn lock(&self) -> MutexGuard<'_, State> {
        self.state.lock().unwrap_or_else(PoisonError::into_inner)
    }
}

fn guard(mut running: Running, name: &str, deadline: Instant) {
    let output = running.output(deadline);
    let ended = running.end().and_then(|status| output.map(|_| status));
    match ended {
        Ok(status) if status.success() => tracing::info!(program = name, "made safe at the end of a lease"),
        Ok(status) => tracing::error!(program = name, %status, "what makes safe at the end of a lease failed"),
        Err(error) => tracing::error!(program = name, %error, "what makes safe at the end of a lease failed"),
    }
}

/// A program that has been started.
struct Running {
    child: Child,
    group: Pid,
    ended: OwnedFd,
    stdout: Option<ChildStdout>,
}

impl Running {
    fn start(task: &Task<'_>) -> Result<Self, Failure> {
        let (program, arguments) = task.command.split_first().ok_or_else(missing)?;
        let input = as_file(task.input).map_err(Failure::NotStarted)?;
        let mut command = Command::new(program);
        command.args(arguments).envs(task.environment.iter().map(|(name, value)| (name, value)));
        command.stdin(input).stdout(Stdio::piped()).process_group(0);
        let mut child = command.spawn().map_err(Failure::NotStarted)?;
        let group = Pid::from_child(&child);
        match pidfd_open(group, PidfdFlags::empty()) {
            Ok(ended) => Ok(Self { stdout: child.stdout.take(), child, group, ended }),
            Err(error) => {
                end_group(group);
                let _ = child.wait();
                Err(Failure::NotStarted(error.into()))
            }
        }
    }

    /// What it prints until it ends.
    fn output(&mut self, deadline: Instant) -> Result<Vec<u8>, Failure> {
        let mut output = Vec::new();
        loop {
            let left = deadline.saturating_duration_since(Instant::now());
            if left.is_zero() {
                return Err(Failure::TimedOut);
            }
            let (ended, readable) = self.wait(left).map_err(Failure::Lost)?;
            if readable {
                self.read(&mut output)?;
            } else if ended {
                return Ok(output);
            }
        }
    }

    /// Whether it has ended, and whether it has printed something, after `time` at the latest.
    fn wait(&self, time: Duration) -> io::Result<(bool, bool)> {
        let time = Timespec::try_from(time).map_err(|_| io::ErrorKind::InvalidInput)?;
        let ended = PollFd::new(&self.ended, PollFlags::IN);
        let ready = |fd: &PollFd<'_>| !fd.revents().is_empty();
        let polled = match &self.stdout {
            None => {
                let mut fds = [ended];
                poll(&mut fds, Some(&time)).map(|_| (ready(&fds[0]), false))
            }
            Some(stdout) => {
                let mut fds = [ended, PollFd::new(stdout, PollFlags::IN)];
                poll(&mut fds, Some(&time)).map(|_| (ready(&fds[0]), ready(&fds[1])))
            }
        };
        match polled {
            Err(rustix::io::Errno::INTR) => Ok((false, false)),
            polled => Ok(polled?),
        }
    }

    fn read(&mut self, output: &mut Vec<u8>) -> Result<(), Failure> {
        let Some(stdout) = &mut self.stdout else { return Ok(()) };
        let mut buffer = [0; 8192];
        let count = stdout.read(&mut buffer).map_err(Failure::Lost)?;
        if count == 0 {
            self.stdout = None;
        }
        if output.len() + count > OUTPUT_BYTES {
            return Err(Failure::TooMuchOutput);
        }
        output.extend_from_slice(buffer.get(..count).unwrap_or_default());
        Ok(())
    }

    /// Ends whatever of its group still runs.
    fn end(mut self) -> Result<ExitStatus, Failure> {
        end_group(self.group);
        self.child.wait().map_err(Failure::Lost)
    }
}

fn missing() -> Failure {
    Failure::NotStarted(io::ErrorKind::NotFound.into())
}

/// Everything in the group of a process that is not reaped yet.
fn end_group(group: Pid) {
    // An empty group is what is wanted.
    let _ = kill_process_group(group, Signal::KILL);
}

/// Bytes as a file in memory: unlike a pipe, it does not block when the program does not read.
fn as_file(bytes: &[u8]) -> io::Result<File> {
    let mut file = File::from(rustix::fs::memfd_create("arguments", MemfdFlags::CLOEXEC)?);
    file.write_all(bytes)?;
    file.rewind()?;
    Ok(file)
}

#[cfg(test)]
mod tests {
    use cara_std::{CommunicationSystem, Definition, Interfaces, ParametersView, Served, ServiceOptions};

    use super::*;

    const LONG: Duration = Duration::from_secs(30);

    fn serve(programs: &Arc<Programs>, script: &str, lease: Option<&LeaseWatch>) -> Result<Vec<u8>, Failure> {
        let command = ["sh", "-c", script].map(String::from);
        let environment = [("CARA_FUNCTION", "f".into()), ("CARA_CALLER", "a/1".into())];
        programs.serve(0, &Task { command: &command, environment, input: b"{}" }, LONG, lease)
    }

    #[test]
    fn a_program_reads_its_input_and_environment() {
        let programs = Arc::default();
        let output = serve(&programs, "cat; echo \" $CARA_FUNCTION $CARA_CALLER\"", None).unwrap();
        assert_eq!(output, b"{} f a/1\n");
        assert!(programs.lock().calls.is_empty());
    }

    #[test]
    fn nothing_is_started_for_a_lease_that_has_ended_or_a_node_that_ends() {
        let system = CommunicationSystem::builder("program", 1).unwrap().interfaces(Interfaces::Loopback).insecure();
        let system = system.build().unwrap();
        let nothing = |_: &Served, _: &mut ParametersView| Ok(());
        let options = ServiceOptions::new().lease(LONG, || {});
        let dead = system.my_function_list().add_service(&Definition::parse("f()").unwrap(), options, nothing).unwrap();
        let programs = Arc::default();
        assert!(matches!(serve(&programs, ":", Some(&dead)), Err(Failure::NotWanted)));
        assert!(serve(&programs, ":", None).is_ok());
        programs.end_calls();
        assert!(matches!(serve(&programs, ":", None), Err(Failure::NotWanted)));
    }
}
