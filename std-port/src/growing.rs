//! Parameters that grow, and what a call takes as its parameters.

use std::fmt;
use std::ops::{Deref, DerefMut};

use cara_core::distribution::function::{VariableSpec, VariableSpecs};
use cara_core::distribution::parameters::{ListWriter, Parameters, ParametersView, RecordWriter, Type};
use cara_core::error::{Error, Limit};
use cara_core::typed::Variables;

use crate::engine::worker::{arena_bytes, room};

/// Bytes of names and values that [`GrowingParameters`] may have.
const MOST: usize = arena_bytes(usize::MAX);

/// [`Parameters`] on the heap, which grow as variables are added and lists are set. A call takes them like any other, and
/// they have room for its results.
///
/// ```no_run
/// use cara_std::GrowingParameters;
/// # let depot = cara_std::CommunicationSystem::new("depot", 1)?;
///
/// let mut map = GrowingParameters::new();
/// map.add_string("hall", 32)?;
/// map.set_value("hall", "north")?;
/// map.add_bytes("picture", 20_000)?;
/// depot.s_unit("agv")?.block_request("draw", &mut map)?;
/// let picture: &[u8] = map.variable("picture")?;
/// # Ok::<(), cara_std::BuildError>(())
/// ```
///
/// They have at most 16 variables, as a function does, and 320 KiB of names and values: more than the longest message.
/// Beyond that adding and setting a variable return [`Error::TooLarge`], and change nothing. Only the methods here make room:
/// what has them as a `&mut ParametersView` does not.
pub struct GrowingParameters {
    view: Box<ParametersView>,
    /// Bytes of names and values that there is room for.
    bytes: usize,
}

impl GrowingParameters {
    /// Empty parameters.
    pub fn new() -> Self {
        Self::with_room(0)
    }

    fn with_room(bytes: usize) -> Self {
        let view = room(bytes);
        Self { bytes: view.remaining(), view }
    }

    /// As [`Parameters::add`].
    pub fn add(&mut self, name: &str, kind: Type, size: u32) -> Result<(), Error> {
        self.fit(|parameters| parameters.add(name, kind, size))
    }

    /// Adds `size` integers, all 0.
    pub fn add_int(&mut self, name: &str, size: u32) -> Result<(), Error> {
        self.add(name, Type::Int, size)
    }

    /// Adds `size` floating-point numbers, all 0.
    pub fn add_float(&mut self, name: &str, size: u32) -> Result<(), Error> {
        self.add(name, Type::Float, size)
    }

    /// Adds `size` truth values, all `false`.
    pub fn add_bool(&mut self, name: &str, size: u32) -> Result<(), Error> {
        self.add(name, Type::Bool, size)
    }

    /// Adds an empty text of at most `maximum` bytes.
    pub fn add_string(&mut self, name: &str, maximum: u32) -> Result<(), Error> {
        self.add(name, Type::String, maximum)
    }

    /// Adds an empty array of at most `maximum` bytes.
    pub fn add_bytes(&mut self, name: &str, maximum: u32) -> Result<(), Error> {
        self.add(name, Type::Bytes, maximum)
    }

    /// As [`Parameters::add_spec`].
    pub fn add_spec(&mut self, spec: VariableSpec<'_>) -> Result<(), Error> {
        self.fit(|parameters| parameters.add_spec(spec))
    }

    /// As [`Parameters::set_list`]. Where the elements do not fit, `write` is called again with more room.
    pub fn set_list(
        &mut self,
        name: &str,
        mut write: impl FnMut(&mut ListWriter<'_>) -> Result<(), Error>,
    ) -> Result<(), Error> {
        self.fit(|parameters| parameters.set_list(name, &mut write))
    }

    /// As [`Parameters::set_record`]. Where the fields do not fit, `write` is called again with more room.
    pub fn set_record(
        &mut self,
        name: &str,
        mut write: impl FnMut(&mut RecordWriter<'_>) -> Result<(), Error>,
    ) -> Result<(), Error> {
        self.fit(|parameters| parameters.set_record(name, &mut write))
    }

    /// As [`Variables::to_parameters`]: on an error some of them may be set.
    pub fn set_variables(&mut self, values: &impl Variables) -> Result<(), Error> {
        self.fit(|parameters| values.to_parameters(parameters))
    }

    /// As [`Parameters::copy_from`].
    pub fn copy_from(&mut self, other: &ParametersView) -> Result<(), Error> {
        self.fit(|parameters| parameters.copy_from(other))
    }

    /// Tries again with more room for as long as there is not enough.
    pub(crate) fn fit(
        &mut self,
        mut attempt: impl FnMut(&mut ParametersView) -> Result<(), Error>,
    ) -> Result<(), Error> {
        loop {
            match attempt(&mut self.view) {
                Err(Error::Full(Limit::ParametersBytes)) if self.bytes < MOST => self.grow(self.bytes + 1),
                Err(Error::Full(Limit::ParametersBytes)) => return Err(Error::TooLarge { limit: MOST as u32 }),
                result => return result,
            }
        }
    }

    /// Has room for `bytes` beside what is there, or as much as there may be.
    fn reserve(&mut self, bytes: usize) {
        let used = self.bytes - self.view.remaining();
        self.grow(used.saturating_add(bytes));
    }

    fn grow(&mut self, bytes: usize) {
        if bytes <= self.bytes || self.bytes == MOST {
            return;
        }
        let mut larger = Self::with_room(bytes);
        let copied = larger.view.copy_from(&self.view);
        debug_assert_eq!(copied, Ok(()), "it is larger");
        *self = larger;
    }
}

impl Default for GrowingParameters {
    fn default() -> Self {
        Self::new()
    }
}

impl Clone for GrowingParameters {
    fn clone(&self) -> Self {
        let mut same = Self::with_room(self.bytes);
        let copied = same.view.copy_from(&self.view);
        debug_assert_eq!(copied, Ok(()), "it is as large");
        same
    }
}

impl Deref for GrowingParameters {
    type Target = ParametersView;
    fn deref(&self) -> &ParametersView {
        &self.view
    }
}

impl DerefMut for GrowingParameters {
    fn deref_mut(&mut self) -> &mut ParametersView {
        &mut self.view
    }
}

impl PartialEq for GrowingParameters {
    fn eq(&self, other: &Self) -> bool {
        self.view == other.view
    }
}

impl fmt::Debug for GrowingParameters {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        fmt::Debug::fmt(&self.view, f)
    }
}

/// What a call takes its arguments from and puts its results into: [`Parameters`] of any size, a [`ParametersView`], a box of
/// one, or [`GrowingParameters`].
pub trait CallParameters: sealed::Sealed {
    #[doc(hidden)]
    fn view(&self) -> &ParametersView;

    #[doc(hidden)]
    fn view_mut(&mut self) -> &mut ParametersView;

    /// Makes room for so many bytes of results, if it can. They are asked for only then.
    #[doc(hidden)]
    fn make_room(&mut self, _results: impl FnOnce() -> Option<usize>) {}
}

/// What a handler takes and returns by value: [`Parameters`] of any size, or [`GrowingParameters`].
#[doc(hidden)]
pub trait HandlerParameters: CallParameters + Sized {
    fn empty() -> Self;
    fn fill(&mut self, arguments: &ParametersView) -> Result<(), Error>;
}

impl<const BYTES: usize> HandlerParameters for Parameters<BYTES> {
    fn empty() -> Self {
        Self::sized()
    }

    fn fill(&mut self, arguments: &ParametersView) -> Result<(), Error> {
        self.copy_from(arguments)
    }
}

impl HandlerParameters for GrowingParameters {
    fn empty() -> Self {
        Self::new()
    }

    fn fill(&mut self, arguments: &ParametersView) -> Result<(), Error> {
        self.copy_from(arguments)
    }
}

mod sealed {
    pub trait Sealed {}
}

impl sealed::Sealed for ParametersView {}
impl<const BYTES: usize> sealed::Sealed for Parameters<BYTES> {}
impl<P: CallParameters + ?Sized> sealed::Sealed for Box<P> {}
impl sealed::Sealed for GrowingParameters {}

impl CallParameters for ParametersView {
    fn view(&self) -> &ParametersView {
        self
    }

    fn view_mut(&mut self) -> &mut ParametersView {
        self
    }
}

impl<const BYTES: usize> CallParameters for Parameters<BYTES> {
    fn view(&self) -> &ParametersView {
        self
    }

    fn view_mut(&mut self) -> &mut ParametersView {
        self
    }
}

impl<P: CallParameters + ?Sized> CallParameters for Box<P> {
    fn view(&self) -> &ParametersView {
        (**self).view()
    }

    fn view_mut(&mut self) -> &mut ParametersView {
        (**self).view_mut()
    }

    fn make_room(&mut self, results: impl FnOnce() -> Option<usize>) {
        (**self).make_room(results);
    }
}

impl CallParameters for GrowingParameters {
    fn view(&self) -> &ParametersView {
        self
    }

    fn view_mut(&mut self) -> &mut ParametersView {
        self
    }

    fn make_room(&mut self, results: impl FnOnce() -> Option<usize>) {
        if let Some(bytes) = results() {
            self.reserve(bytes);
        }
    }
}

/// Bytes that the parameters of a call need for results. How long lists get is not known before: together they are no
/// longer than a message, of `longest` bytes.
pub(crate) fn bytes_of_results(results: VariableSpecs<'_>, longest: u32) -> usize {
    let has_nested = results.into_iter().any(|spec| spec.kind.is_nested());
    results.into_iter().fold(if has_nested { longest as usize } else { 0 }, |sum, spec| {
        let value = if spec.kind.is_nested() { Some(spec.inner.len()) } else { spec.kind.bytes_of(spec.size) };
        sum.saturating_add(spec.name.len()).saturating_add(value.unwrap_or(usize::MAX))
    })
}

#[cfg(test)]
mod tests {
    use cara_core::distribution::function::Definition;

    use super::*;

    fn with_list() -> GrowingParameters {
        let definition = Definition::parse("f(name: string[8], list: int[..40000], last: int)").unwrap();
        let mut parameters = GrowingParameters::new();
        for spec in definition.signature().arguments() {
            parameters.add_spec(spec).unwrap();
        }
        parameters.set_value("name", "first").unwrap();
        parameters.set_value("last", 7).unwrap();
        parameters
    }

    fn fill(parameters: &mut GrowingParameters, elements: i64) -> Result<(), Error> {
        parameters.set_list("list", |list| (0..elements).try_for_each(|element| list.push(element)))
    }

    #[test]
    fn adding_and_setting_make_room_and_keep_what_is_there() {
        let mut parameters = GrowingParameters::new();
        for (name, size) in [("a", 5_000), ("b", 10_000), ("c", 60_000), ("d", 200_000)] {
            parameters.add_string(name, size).unwrap();
            parameters.set_value(name, "y".repeat(size as usize).as_str()).unwrap();
        }
        for (name, size) in [("a", 5_000), ("b", 10_000), ("c", 60_000), ("d", 200_000)] {
            assert_eq!(parameters.variable::<&str>(name).unwrap().len(), size);
        }
        let mut list = with_list();
        for elements in [10, 30_000, 2, 30_000] {
            fill(&mut list, elements).unwrap();
            assert!(list.list("list").unwrap().map(|value| value.read::<i64>().unwrap()).eq(0..elements));
            assert_eq!((list.variable("name"), list.variable("last")), (Ok("first"), Ok(7)));
        }
        assert_eq!(list.clone(), list);
    }

    #[test]
    fn what_is_larger_than_any_message_is_a_typed_error() {
        let too_large = Err(Error::TooLarge { limit: 320 * 1024 });
        let mut parameters = GrowingParameters::new();
        parameters.add_bytes("most", 320 * 1024 - 5).unwrap();
        assert_eq!((parameters.add_bool("b", 1), parameters.len()), (too_large, 1));
        assert_eq!(GrowingParameters::new().add_int("i", u32::MAX), too_large);
        let mut list = with_list();
        fill(&mut list, 3).unwrap();
        assert_eq!(fill(&mut list, 40_000 + 1), Err(Error::WrongSize { index: 1, expected: 40_000, found: 40_001 }));
        list.add_bytes("rest", 100_000).unwrap();
        assert_eq!(fill(&mut list, 40_000), too_large);
        assert_eq!(list.list("list").unwrap().len(), 3, "the old value stays");
    }

    #[test]
    fn a_reserve_comes_beside_what_is_there_once_and_saturates() {
        let mut parameters = with_list();
        let (small, used) = (parameters.bytes, parameters.bytes - parameters.remaining());
        // Alone it fits into the next size; with what is there it takes the one behind that.
        parameters.reserve(arena_bytes(20_000) - used + 1);
        let reserved = parameters.bytes;
        assert_eq!((small, reserved), (arena_bytes(0), arena_bytes(40_000)));
        parameters.reserve(parameters.remaining());
        assert_eq!((parameters.bytes, parameters.clone().bytes), (reserved, reserved));
        parameters.reserve(usize::MAX);
        assert_eq!((parameters.bytes, parameters.variable("last")), (MOST, Ok(7)));
    }
}
