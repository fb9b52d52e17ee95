//! Streams of a board: named values that change, which any task publishes without allocation.

use core::fmt;
use core::marker::PhantomData;

use cara_core::config::Priority;
use cara_core::distribution::block;
use cara_core::distribution::function::{Attributes, Definition};
use cara_core::distribution::function_list::Slot;
use cara_core::distribution::parameters::ParametersView;
use cara_core::error::{Error, ServiceError};
use cara_core::time::Duration;
use cara_core::typed::{self, Variables};

use crate::functions::MyFunctionList;
use crate::handle::Handle;
use crate::handler::{Handler, Listed};
use crate::stream_cell::{Cell, StreamCell};

/// A stream of this unit.
pub struct Stream<T: 'static> {
    unit: Handle<T>,
    slot: Slot,
    cell: &'static dyn Cell,
}

impl<T> Clone for Stream<T> {
    fn clone(&self) -> Self {
        *self
    }
}

impl<T> Copy for Stream<T> {}

impl<T> fmt::Debug for Stream<T> {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.debug_struct("Stream").field("slot", &self.slot).finish_non_exhaustive()
    }
}

impl<T> Stream<T> {
    /// Publishes a new value: the newest one goes to each subscriber as often as that one wants it. It does not wait.
    ///
    /// [`Error::MissingArgument`], [`Error::WrongType`] and [`Error::WrongSize`] where `values` are not what the stream
    /// declares, and [`Error::UnknownFunction`] where it has been removed.
    pub fn publish(&self, values: &ParametersView) -> Result<(), Error> {
        self.unit.act(|machine| {
            let function = machine.functions.function(self.slot).ok_or(Error::UnknownFunction)?;
            let is_same = function.handler.stream.is_some_and(|cell| core::ptr::addr_eq(cell, self.cell));
            if !is_same {
                return Err(Error::UnknownFunction);
            }
            self.cell.publish(function.signature, values)?;
            machine.each_link(|session, cx| {
                session.stream_changed(cx.now);
            });
            Ok(())
        })
    }
}

/// A stream of this unit whose values are those of a struct.
pub struct Publisher<V, T: 'static> {
    stream: Stream<T>,
    values: PhantomData<fn(&V)>,
}

impl<V, T> Clone for Publisher<V, T> {
    fn clone(&self) -> Self {
        *self
    }
}

impl<V, T> Copy for Publisher<V, T> {}

impl<V, T> fmt::Debug for Publisher<V, T> {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        self.stream.fmt(f)
    }
}

impl<V: Variables, T> Publisher<V, T> {
    /// As [`Stream::publish`].
    pub fn publish(&self, value: &V) -> Result<(), Error> {
        value.with_parameters(|values| self.stream.publish(values))?
    }
}

impl<T> MyFunctionList<T> {
    /// Adds a stream in its text form, as in `pose(position: float[2])`. A subscriber gets its values at least
    /// `least_interval` apart, in whole milliseconds, up to 65 s. Like a function it is seen by those to which the list is
    /// published.
    ///
    /// [`Error::BadName`] for a text that cannot be read, [`Error::TooLarge`] for a cell that is too small,
    /// [`Error::NameTaken`], [`Error::Full`].
    pub fn add_stream<const BYTES: usize>(
        &self,
        stream: &str,
        least_interval: Duration,
        cell: &'static StreamCell<BYTES>,
    ) -> Result<Stream<T>, Error> {
        self.add_defined(&Definition::stream(stream).map_err(|_| Error::BadName)?, least_interval, BYTES, cell)
    }

    /// The same for a stream of a struct that derives [`Variables`].
    ///
    /// ```
    /// use cara_core::time::Duration;
    /// use cara_embassy::{Handle, StreamCell, Variables};
    ///
    /// #[derive(Variables)]
    /// struct Pose {
    ///     position: [f64; 2],
    /// }
    ///
    /// fn tell<T>(agv: Handle<T>, cell: &'static StreamCell<16>) -> Result<(), cara_core::error::Error> {
    ///     let pose = agv.my_function_list().add_stream_of::<Pose, _>("pose", Duration::from_millis(20), cell)?;
    ///     agv.publish_my_function_list()?;
    ///     pose.publish(&Pose { position: [3.0, 4.0] })
    /// }
    /// ```
    pub fn add_stream_of<V: Variables, const BYTES: usize>(
        &self,
        name: &str,
        least_interval: Duration,
        cell: &'static StreamCell<BYTES>,
    ) -> Result<Publisher<V, T>, Error> {
        let stream = self.add_defined(&typed::stream_of::<V>(name)?, least_interval, BYTES, cell)?;
        Ok(Publisher { stream, values: PhantomData })
    }

    pub(crate) fn add_defined(
        &self,
        definition: &Definition,
        least_interval: Duration,
        bytes: usize,
        cell: &'static dyn Cell,
    ) -> Result<Stream<T>, Error> {
        if block::longest(definition.signature().results()).is_none_or(|longest| longest > bytes) {
            return Err(Error::TooLarge { limit: u32::try_from(bytes).unwrap_or(u32::MAX) });
        }
        let least = u16::try_from(least_interval.as_millis()).unwrap_or(u16::MAX);
        let attributes = Attributes { priority: Priority::Low, stream: Some(least), ..Attributes::NORMAL };
        // Never run: a call of a stream is refused before.
        let handler = Handler::free(&|_, _| Err(ServiceError::NotReady));
        let listed = Listed { handler, lease: None, safe: None, then: None, stream: Some(cell) };
        let slot = self.unit.act(|machine| machine.functions.add_function(definition, attributes, listed))?;
        Ok(Stream { unit: self.unit, slot, cell })
    }
}

impl<T> Handle<T> {
    /// A stream of this unit, as [added](MyFunctionList::add_stream) before.
    pub fn stream(&self, name: &str) -> Option<Stream<T>> {
        let (slot, cell) = self.look(|machine| {
            let slot = machine.functions.find(name)?;
            Some((slot, machine.functions.function(slot)?.handler.stream?))
        })?;
        Some(Stream { unit: *self, slot, cell })
    }
}
