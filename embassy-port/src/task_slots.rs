//! Room for calls that a task takes: they wait here until it does, and answers wait here that could not be kept.

use cara_core::distribution::function_list::Slot;
use cara_core::distribution::identity::Identity;
use cara_core::distribution::parameters::ParametersView;
use cara_core::error::Error;
use cara_core::services::Ticket;
use cara_core::services::session::Incoming;
use cara_core::time::Instant;

use crate::port::{LinkContext, LinkSession};

/// Names a call of a peer that runs here.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) struct Running {
    pub(crate) link: u16,
    pub(crate) serial: u32,
    pub(crate) ticket: Ticket,
    /// The caller waits for the answer until then.
    pub(crate) deadline: Instant,
}

/// Room for one call.
pub(crate) struct TaskSlot {
    pub(crate) parameters: &'static mut ParametersView,
    pub(crate) holds: Holds,
}

pub(crate) enum Holds {
    Nothing,
    /// Its arguments wait for a task. The oldest of a function, by `number`, is taken first.
    Call {
        running: Running,
        call: Incoming,
        caller: Identity,
        number: u32,
    },
    /// Its results wait for room on the link.
    Answer {
        running: Running,
        result: Result<(), Error>,
    },
}

impl TaskSlot {
    pub(crate) fn new(parameters: &'static mut ParametersView) -> Self {
        Self { parameters, holds: Holds::Nothing }
    }

    pub(crate) fn is_free(&self) -> bool {
        matches!(self.holds, Holds::Nothing)
    }

    pub(crate) fn running(&self) -> Option<Running> {
        match self.holds {
            Holds::Nothing => None,
            Holds::Call { running, .. } | Holds::Answer { running, .. } => Some(running),
        }
    }

    /// The number of a call of this function that waits.
    pub(crate) fn number_of(&self, function: Slot) -> Option<u32> {
        match &self.holds {
            Holds::Call { call, number, .. } if call.slot == function => Some(*number),
            _ => None,
        }
    }

    /// Refuses the call that waits, as soon as there is room for that.
    pub(crate) fn refuse(&mut self, error: Error) {
        if let Holds::Call { running, .. } = self.holds {
            self.holds = Holds::Answer { running, result: Err(error) };
        }
    }
}

/// Answers a call, or gives up once its deadline has passed; `false` if the answer cannot be queued now.
#[inline(never)]
pub(crate) fn answer(
    session: &mut LinkSession,
    cx: &mut LinkContext<'_>,
    running: &Running,
    result: Result<&ParametersView, Error>,
) -> bool {
    let kept = session.answer(cx, running.ticket, result).is_ok();
    let late = cx.now >= running.deadline;
    if !kept && late {
        session.drop_answer(running.ticket);
    }
    kept || late
}
