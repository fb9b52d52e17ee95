//! A unit's own list of functions (paper: `my_function_list`).

use core::fmt;
use core::future::poll_fn;
use core::task::Poll;

use cara_core::config::Priority;
use cara_core::distribution::function::{Definition, Signature};
use cara_core::distribution::function_list::{FunctionList, Slot};
use cara_core::error::Error;
use cara_core::storage::Lent;

use crate::handle::Handle;
use crate::handler::{Handler, Listed, ServiceOptions};
use crate::machine::Machine;
use crate::time::now;

pub(crate) type Put<T> = fn(
    &mut FunctionList<Lent, Listed<T>>,
    Signature<'_>,
    cara_core::distribution::function::Attributes,
    Listed<T>,
) -> Result<Slot, Error>;

impl<T> Handle<T> {
    /// Makes the unit's functions visible to all nodes, also to those that come later (paper, listing line 24).
    pub fn publish_my_function_list(&self) -> Result<(), Error> {
        self.act(Machine::publish)
    }

    /// As [`publish_my_function_list`](Self::publish_my_function_list), and returns when every node that is connected
    /// now has read the list or left. Cancelling loses nothing. Join it with a timer to bound it.
    pub async fn publish_and_wait(&self) -> Result<(), Error> {
        self.publish_my_function_list()?;
        for link in 0..self.links() {
            let Some((serial, reported)) = self.look(|machine| machine.reported(link)) else { continue };
            poll_fn(|cx| {
                self.lend(|machine| {
                    if machine.has_read(link, serial, reported) {
                        return Poll::Ready(());
                    }
                    machine.wakers.news.register(cx);
                    Poll::Pending
                })
            })
            .await;
        }
        Ok(())
    }

    /// The unit's own functions, one in a line.
    pub fn my_function_list(&self) -> MyFunctionList<T> {
        MyFunctionList { unit: *self }
    }
}

/// The functions that a unit offers, looked at now. Adding one makes nothing visible: that is what publishing
/// is for.
pub struct MyFunctionList<T: 'static> {
    pub(crate) unit: Handle<T>,
}

impl<T> fmt::Debug for MyFunctionList<T> {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.debug_struct("MyFunctionList").finish_non_exhaustive()
    }
}

impl<T> MyFunctionList<T> {
    /// Adds a service, which is invisible to peers before it is published. The signature is in the text form, as in
    /// `go_to(position: int[2])`.
    ///
    /// [`Error::BadName`] for a signature that cannot be read, [`Error::TooLarge`] when arguments and results are
    /// declared larger than what services have room for, [`Error::Full`] when the list is full,
    /// [`Error::EmergencyWaits`] for a handler of an emergency service that takes the application's state, or is a task.
    #[doc(alias = "add_function")]
    pub fn add_service(&self, signature: &str, options: ServiceOptions<T>, handler: Handler<T>) -> Result<(), Error> {
        self.put(parsed(signature)?.signature(), options, handler, FunctionList::add_signature)
    }

    /// Changes a service. A caller that knows the old one gets [`Error::StaleFunction`] until it is published again.
    pub fn replace(&self, signature: &str, options: ServiceOptions<T>, handler: Handler<T>) -> Result<(), Error> {
        self.put(parsed(signature)?.signature(), options, handler, FunctionList::replace_signature)
    }

    pub(crate) fn put(
        &self,
        signature: Signature<'_>,
        options: ServiceOptions<T>,
        handler: Handler<T>,
        put: Put<T>,
    ) -> Result<(), Error> {
        let ServiceOptions { attributes, lease, safe, then } = options;
        if attributes.priority == Priority::Emergency && handler.waits() {
            return Err(Error::EmergencyWaits);
        }
        let stop = self.unit.act(|machine| {
            let limit = machine.limits.arguments;
            if signature.parameters_bytes() as usize > limit {
                return Err(Error::TooLarge { limit: u32::try_from(limit).unwrap_or(u32::MAX) });
            }
            let listed = Listed {
                handler,
                lease,
                safe,
                then,
                #[cfg(feature = "streams")]
                stream: None,
            };
            let known = machine.functions.find(signature.name());
            let moves = known.is_some_and(|slot| machine.moves_by(slot));
            let replaced = known.and_then(|slot| machine.functions.function(slot)).map(|function| *function.handler);
            put(&mut machine.functions, signature, attributes, listed)?;
            if let Some(slot) = known {
                machine.refuse_calls_of(slot);
            }
            // What a call of the service before started would go on to the end of its lease.
            let stop = replaced.filter(|_| moves).and_then(Listed::clear);
            // Another service that had this lease may have left it dead, and no call would begin.
            let shares =
                |listed: &Listed<T>| listed.lease.zip(lease).is_some_and(|(one, other)| core::ptr::eq(one, other));
            let sharing = machine.functions.iter().filter(|function| shares(function.handler)).count();
            lease.filter(|_| sharing == 1).map(|lease| lease.clear(now()));
            machine.wakers.leases.wake();
            Ok(stop)
        })?;
        stop.into_iter().for_each(|safe| safe());
        Ok(())
    }

    /// Removes a service; peers that saw it are told.
    pub fn remove(&self, name: &str) -> Result<(), Error> {
        let stop = self.unit.act(|machine| {
            let (slot, removed) = machine.functions.remove(name)?;
            // What a call of it started would go on to the lease's end; what one of another service started may.
            let stop = if machine.moves_by(slot) { removed.clear() } else { None };
            machine.wakers.leases.wake();
            machine.refuse_calls_of(slot);
            machine.hub.publications.withdraw(slot);
            machine.each_link(|session, cx| {
                session.withdraw(cx, slot);
            });
            Ok::<_, Error>(stop)
        })?;
        stop.into_iter().for_each(|safe| safe());
        Ok(())
    }

    /// How many functions there are.
    pub fn len(&self) -> usize {
        self.unit.look(|machine| machine.functions.len())
    }

    /// Whether there are none.
    pub fn is_empty(&self) -> bool {
        self.len() == 0
    }
}

fn parsed(signature: &str) -> Result<Definition, Error> {
    Definition::parse(signature).map_err(|_| Error::BadName)
}

impl<T> fmt::Display for MyFunctionList<T> {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        self.unit.look(|machine| write!(f, "{}", machine.functions.show_functions()))
    }
}
