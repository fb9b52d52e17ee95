//! The asynchronous face, for tokio or any other executor: what waits is a future or a stream, and holds no thread. A call is
//! awaited without it.
//!
//! The unit's own threads read its links, and its clock ends what takes too long; both wake the task that waits. No method
//! whose name ends in `_async`, and no awaited call, blocks the thread that polls it: a poll takes locks that other threads hold for as long as a
//! frame takes to be encoded, and never while they wait for the network.
//!
//! | waits for | method | dropped before it has ended |
//! |---|---|---|
//! | a reply | [`Peer::call`] | the call is given up, and what it started, or would start, stops if its service has a lease |
//! | the end of what was kept | [`Hold::release_async`] | it is released all the same |
//! | replies of all nodes | [`CommunicationSystem::call_all`] | those calls that have not ended are given up |
//! | a round trip | [`Peer::ping_async`] | the answer is not measured; another caller has its turn |
//! | a node | [`CommunicationSystem::wait_for_s_unit_async`], [`Unit::wait_for_manager_async`] | nothing |
//! | a function | [`Peer::wait_for_function_async`] | nothing |
//! | anything else that events tell of | [`Handle::wait_until_async`] | nothing |
//! | readers of the published list | [`CommunicationSystem::publish_and_wait_async`], [`Peer::publish_and_wait_async`] | the list is published all the same |
//! | an event | [`Handle::events_async`], [`EventStream::next`] | no event is lost |
//! | a value of a stream of a node | [`TheirStream::subscribe_async`], [`SampleStream::next`] | no value is lost; dropping the stream ends the subscription |
//! | the application's state | [`Handle::with_state_async`] | the turn is given up |
//! | the end of a lease | [`LeaseWatch::ended`], [`Served::lease_ended`] | nothing |
//! | the start and the end of the unit | [`Handle::start_async`], [`Handle::stop_async`] | it starts, or stops, all the same |
//!
//! What does not wait has no form of its own: [`Peer::request`], [`Peer::release`], [`Peer::flush`] and everything that
//! tells how it is now return at once. [`Hold`] and [`Heart`](crate::Heart) release when they are dropped, without waiting.
//! Dropping the last handle of a unit that runs stops it, and waits for its threads: [`Handle::stop_async`] before does not.
//!
//! Services may be `async` as well: [`MyFunctionList::add_service`](crate::MyFunctionList::add_service) takes them, and
//! [`Handle::run_services_on`] tells which executor runs them. So may functions of an interface be, which get the
//! state for moments, and not while they wait:
//!
//! ```no_run
//! use std::time::Duration;
//!
//! use cara_std::{AsyncState, ServiceError, TypedCall, Unit, Variables, interface};
//!
//! #[derive(Variables)]
//! struct Charged { percent: f32 }
//!
//! #[interface]
//! trait Charger {
//!     async fn charge(
//!         state: &impl AsyncState<Self>,
//!         call: &impl TypedCall<Charged>,
//!         percent: f32,
//!     ) -> Result<(), ServiceError>;
//! }
//!
//! struct Agv { battery: f32 }
//!
//! impl Charger for Agv {
//!     async fn charge(
//!         state: &impl AsyncState<Self>,
//!         call: &impl TypedCall<Charged>,
//!         percent: f32,
//!     ) -> Result<(), ServiceError> {
//!         loop {
//!             let charged = state.with(|agv| agv.battery).await?;
//!             if charged >= percent {
//!                 return Ok(());
//!             }
//!             call.progress(&Charged { percent: charged })?;
//!             tokio::time::sleep(Duration::from_secs(1)).await;
//!         }
//!     }
//! }
//!
//! # async fn serve() -> Result<(), cara_std::BuildError> {
//! let agv = Unit::builder("agv", 7, "depot", 1)?.state(Agv { battery: 20.0 }).build()?;
//! let runtime = tokio::runtime::Handle::current();
//! agv.run_services_on(move |task| drop(runtime.spawn(task)));
//! agv.my_function_list().serve(ChargerServer)?;
//! # Ok(())
//! # }
//! ```
//!
//! When nothing wants such a call any more, it is dropped at its next `await`, as without
//! [`ServiceOptions::runs_to_its_end`](crate::ServiceOptions::runs_to_its_end). With a lease it changes what moves by
//! `state.commit`, which does nothing once the call's order has ended. What it asks of `call` it asks outside of `with`.
//!
//! A call that has to wait for the minimum interval, or for room, does so within its deadline. A method that holds the
//! application's state and waits for such a call, as in `block_on`, counts as waiting for its peer: the peer's calls that
//! need the state are refused with [`Error::WouldDeadlock`] meanwhile, as around a
//! [`block_request`]. An `async` service holds no state while it waits, so that its peer may call back.
//!
//! [`Served::lease_ended`]: crate::Served::lease_ended
//! [`CommunicationSystem::publish_and_wait_async`]: crate::CommunicationSystem::publish_and_wait_async
//! [`CommunicationSystem::call_all`]: crate::CommunicationSystem::call_all
//! [`CommunicationSystem::wait_for_s_unit_async`]: crate::CommunicationSystem::wait_for_s_unit_async
//! [`Error::WouldDeadlock`]: crate::Error::WouldDeadlock
//! [`Handle::events_async`]: crate::Handle::events_async
//! [`Handle::run_services_on`]: crate::Handle::run_services_on
//! [`Handle::start_async`]: crate::Handle::start_async
//! [`Handle::stop_async`]: crate::Handle::stop_async
//! [`Handle::wait_until_async`]: crate::Handle::wait_until_async
//! [`Handle::with_state_async`]: crate::Handle::with_state_async
//! [`Hold`]: crate::Hold
//! [`Hold::release_async`]: crate::Hold::release_async
//! [`LeaseWatch::ended`]: crate::LeaseWatch::ended
//! [`Peer::call`]: crate::Peer::call
//! [`Peer::flush`]: crate::Peer::flush
//! [`Peer::ping_async`]: crate::Peer::ping_async
//! [`Peer::publish_and_wait_async`]: crate::Peer::publish_and_wait_async
//! [`Peer::release`]: crate::Peer::release
//! [`Peer::request`]: crate::Peer::request
//! [`Peer::wait_for_function_async`]: crate::Peer::wait_for_function_async
//! [`TheirStream::subscribe_async`]: crate::TheirStream::subscribe_async
//! [`Unit::wait_for_manager_async`]: crate::Unit::wait_for_manager_async
//! [`block_request`]: crate::Peer::block_request

mod calls;
mod elsewhere;
mod events;
mod looking;
mod samples;
mod services;
mod waiting;

pub(crate) use events::EventQueue;
pub use events::{EventStream, EventsLost};
pub use samples::SampleStream;
pub use services::{CallGivenUp, StateOfTasks};
