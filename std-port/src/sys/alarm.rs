//! The timer that wakes a thread waiting in an epoll set, and that any other thread may put off meanwhile.

use std::io;
use std::os::fd::{AsFd, BorrowedFd, OwnedFd};

use cara_core::time::Duration;
use rustix::time::{Itimerspec, TimerfdClockId, TimerfdFlags, TimerfdTimerFlags, timerfd_create, timerfd_settime};

use super::timespec;

/// A timer as a descriptor; to be watched with [`Trigger::Edge`](super::epoll::Trigger::Edge), so that it is never read.
/// The time during which the system was suspended counts.
#[derive(Debug)]
pub(crate) struct Alarm {
    timer: OwnedFd,
}

impl Alarm {
    /// An alarm that is not set.
    pub(crate) fn new() -> io::Result<Self> {
        let flags = TimerfdFlags::CLOEXEC | TimerfdFlags::NONBLOCK;
        Ok(Self { timer: timerfd_create(TimerfdClockId::Boottime, flags)? })
    }

    /// Sets it to go off once at a time on the boot clock, instead of when it was set to before; at once if that has
    /// passed. A thread that is held up on its way here does not make it late.
    pub(crate) fn set(&self, boot_time: Duration) {
        // Zero would unset it.
        let it_value = timespec(boot_time.max(Duration::from_micros(1)));
        let once = Itimerspec { it_interval: timespec(Duration::ZERO), it_value };
        // The arguments are valid, and nothing else can fail here.
        let _ = timerfd_settime(&self.timer, TimerfdTimerFlags::ABSTIME, &once);
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
    use rustix::time::{ClockId, clock_gettime};

    /// So long from now, on the boot clock.
    fn after(span: Duration) -> Duration {
        let now = clock_gettime(ClockId::Boottime);
        Duration::from_micros(now.tv_sec as u64 * 1_000_000 + now.tv_nsec as u64 / 1_000) + span
    }

    #[test]
    fn it_goes_off_once_each_time_it_is_set_and_not_while_it_is_put_off() {
        let (set, alarm, mut events) = (Epoll::new().unwrap(), Alarm::new().unwrap(), Events::new(1));
        set.add(&alarm, 7, Interest::READ_EDGE).unwrap();
        for _ in 0..2 {
            alarm.set(after(Duration::from_millis(1)));
            set.wait(&mut events, Some(Duration::from_secs(20))).unwrap();
            assert_eq!(events.iter().map(|ready| ready.token).collect::<Vec<_>>(), [7]);
            set.wait(&mut events, Some(Duration::from_millis(10))).unwrap();
            assert!(events.is_empty(), "once");
        }
        alarm.set(after(Duration::from_secs(60)));
        alarm.set(after(Duration::from_secs(600)));
        set.wait(&mut events, Some(Duration::ZERO)).unwrap();
        assert!(events.is_empty());
    }

    /// The time was read before it passed, and the thread was held up before it set the alarm.
    #[test]
    fn a_time_that_has_passed_meanwhile_is_not_waited_for_again() {
        let (set, alarm, mut events) = (Epoll::new().unwrap(), Alarm::new().unwrap(), Events::new(1));
        set.add(&alarm, 7, Interest::READ_EDGE).unwrap();
        for passed in [after(Duration::ZERO), Duration::ZERO] {
            alarm.set(passed);
            set.wait(&mut events, Some(Duration::from_secs(20))).unwrap();
            assert!(!events.is_empty(), "{passed:?}");
        }
    }
}
