//! The timer that wakes a thread waiting in an epoll set, and that any other thread may put off meanwhile.

use std::io;
use std::os::fd::{AsFd, BorrowedFd, OwnedFd};

use cara_core::time::Duration;
use rustix::time::{Itimerspec, TimerfdClockId, TimerfdFlags, TimerfdTimerFlags, timerfd_create, timerfd_settime};

use super::timespec;

/// A timer as a descriptor; to be watched with [`Trigger::Edge`](super::epoll::Trigger::Edge), so that it is never read.
/// The time during which the system was suspended counts.
#[derive(Debug)]
pub struct Alarm {
    timer: OwnedFd,
}

impl Alarm {
    /// An alarm that is not set.
    pub fn new() -> io::Result<Self> {
        let flags = TimerfdFlags::CLOEXEC | TimerfdFlags::NONBLOCK;
        Ok(Self { timer: timerfd_create(TimerfdClockId::Boottime, flags)? })
    }

    /// Sets it to go off once after `span`, at least a microsecond, instead of when it was set to before.
    pub fn set(&self, span: Duration) {
        let it_value = timespec(span.max(Duration::from_micros(1)));
        let once = Itimerspec { it_interval: timespec(Duration::ZERO), it_value };
        // The arguments are valid, and nothing else can fail here.
        let _ = timerfd_settime(&self.timer, TimerfdTimerFlags::empty(), &once);
    }
}

impl AsFd for Alarm {
    fn as_fd(&self) -> BorrowedFd<'_> {
        self.timer.as_fd()
    }
}

#[cfg(test)]
mod tests {
    use super::super::epoll::{Epoll, Events, Interest};
    use super::*;

    #[test]
    fn it_goes_off_once_each_time_it_is_set_and_not_while_it_is_put_off() {
        let (set, alarm, mut events) = (Epoll::new().unwrap(), Alarm::new().unwrap(), Events::new(1));
        set.add(&alarm, 7, Interest::READ_EDGE).unwrap();
        for _ in 0..2 {
            alarm.set(Duration::from_millis(1));
            set.wait(&mut events, Some(Duration::from_secs(20))).unwrap();
            assert_eq!(events.iter().map(|ready| ready.token).collect::<Vec<_>>(), [7]);
            set.wait(&mut events, Some(Duration::from_millis(10))).unwrap();
            assert!(events.is_empty(), "once");
        }
        alarm.set(Duration::from_secs(60));
        alarm.set(Duration::from_secs(600));
        set.wait(&mut events, Some(Duration::ZERO)).unwrap();
        assert!(events.is_empty());
    }
}
