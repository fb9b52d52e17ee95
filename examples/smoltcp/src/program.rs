//! What the program does for its unit: it serves calls, makes things safe, and hears news.

use cara_core::distribution::function_list::Slot;
use cara_core::distribution::parameters::ParametersView;
use cara_core::error::{Error, ServiceError};
use cara_core::services::requests::CallId;
use cara_core::services::session::{Event, Incoming, ReplyBlock};

/// The program around a unit, as [`SUnit::poll`](crate::SUnit::poll) sees it. Each method runs inside of `poll`, so each
/// returns soon: nothing is read and no keep-alive leaves meanwhile.
pub trait Program {
    /// Serves a call: the arguments are in `parameters`, and the results go there.
    fn serve(&mut self, call: &Incoming, parameters: &mut ParametersView) -> Outcome;

    /// The lease of this function has ended: stop what it started. Runs before anything else that is due.
    fn make_safe(&mut self, function: Slot);

    /// A call of this unit has ended; [`ReplyBlock::read_into`] gives the results.
    fn replied(&mut self, call: CallId, outcome: Result<ReplyBlock<'_>, Error>) {
        let _ = (call, outcome);
    }

    /// Something else has happened on the link: [`Event::Joined`] and what comes behind it, up to [`Event::Closed`].
    fn hear(&mut self, event: Event) {
        let _ = event;
    }
}

/// How a call is served.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Outcome {
    /// It is done, or has failed.
    Now(Result<(), ServiceError>),
    /// The program answers it with [`SUnit::answer`](crate::SUnit::answer) when it is done.
    Later,
}
