//! Rust types as variables, and signatures made at compile time, for code that `#[derive(Variables)]` and `#[interface]`
//! generate.
//!
//! Parameters made from a signature have its arguments first, then the results that are not arguments, in the signature's order.
//! So the index of each variable is a constant, and serving a call compares no names.

use core::fmt;

use super::function::{Builder, Definition};
use super::function::{Signature, VariableSpec, VariableSpecs};
use super::parameters::{Elements, Fields, FromValue, Parameters, ParametersView, Slot, Type};
use super::spec::{self, Bounds};
use super::value::{Element, Value};
use crate::ability::{DETAILS, HELP};
use crate::bytes::are_same;
use crate::config::{NAME_BYTES, VARIABLES};
pub use crate::error::Part;
use crate::error::{Error, ServiceError};

mod signatures;

use signatures::position;
pub use signatures::{Declared, Encoded, element, element_bytes, fields, fields_bytes, parameters_bytes};

/// The code of [`ServiceError::Failed`] for an argument that its Rust type cannot hold, as 300 for a `u8`; the service has not
/// run.
pub const BAD_ARGUMENT: u16 = u16::MAX;

/// A Rust type that is one variable: integers, floats and `bool`, arrays of them, strings and bytes of `heapless`, enums without
/// fields that derive it, and, with the feature `nested`, structs that derive [`Variables`], as records.
#[diagnostic::on_unimplemented(
    message = "`{Self}` cannot be a variable",
    label = "no type of a variable",
    note = "variables are integers, `f32`, `f64`, `bool`, arrays of them, `heapless::String<N>`, `heapless::Vec<u8, N>`, enums without fields that `#[derive(Variables)]`, and, with `#[size(N)]`, `String`, `&str`, `Vec<u8>` and `&[u8]`; where the core has the feature `nested`, also structs that `#[derive(Variables)]`, and `Vec`, `heapless::Vec` and `Option` of all of these"
)]
pub trait Field: Sized {
    /// The type of the variable.
    const KIND: Type;
    /// Its declared size: the number of elements, or the longest text or bytes.
    const SIZE: u32;
    /// The inner types of a record or list, as encoded in a signature.
    const INNER: &'static [u8] = &[];
    /// Reads the variable. Errors: [`Error::WrongType`], [`Error::WrongSize`], [`Error::OutOfRange`].
    fn from_field(value: Value<'_>) -> Result<Self, Error>;
    /// Sets the variable. The same errors leave it unchanged.
    fn to_field(&self, slot: Slot<'_>) -> Result<(), Error>;
}

impl<T: Element> Field for T {
    const KIND: Type = T::KIND;
    const SIZE: u32 = 1;

    fn from_field(value: Value<'_>) -> Result<Self, Error> {
        T::from_value(value)
    }

    fn to_field(&self, slot: Slot<'_>) -> Result<(), Error> {
        slot.set(*self)
    }
}

impl<T: Element, const N: usize> Field for [T; N] {
    const KIND: Type = T::KIND;
    const SIZE: u32 = N as u32;

    fn from_field(value: Value<'_>) -> Result<Self, Error> {
        Self::from_value(value)
    }

    fn to_field(&self, slot: Slot<'_>) -> Result<(), Error> {
        slot.set(self)
    }
}

impl<const N: usize> Field for heapless::String<N> {
    const KIND: Type = Type::String;
    const SIZE: u32 = N as u32;

    fn from_field(value: Value<'_>) -> Result<Self, Error> {
        Self::try_from(<&str>::from_value(value)?).map_err(|_| Error::OutOfRange)
    }

    fn to_field(&self, slot: Slot<'_>) -> Result<(), Error> {
        slot.set(self.as_str())
    }
}

impl<const N: usize> Field for heapless::Vec<u8, N> {
    const KIND: Type = Type::Bytes;
    const SIZE: u32 = N as u32;

    fn from_field(value: Value<'_>) -> Result<Self, Error> {
        Self::from_slice(<&[u8]>::from_value(value)?).map_err(|_| Error::OutOfRange)
    }

    fn to_field(&self, slot: Slot<'_>) -> Result<(), Error> {
        slot.set(self.as_slice())
    }
}

/// Names of variables, each with its unit.
pub type Units = &'static [(&'static str, &'static str)];

/// A struct whose fields are variables. Derive it with `#[derive(Variables)]`.
#[diagnostic::on_unimplemented(
    message = "`{Self}` does not say what its variables are called",
    label = "no struct with `#[derive(Variables)]`",
    note = "a result that is no such struct has its name in `#[returns(name)]` above the function"
)]
pub trait Variables: Sized {
    /// The variables, in the order of the fields.
    const SPECS: &'static [VariableSpec<'static>];
    /// The units of variables, by name.
    const UNITS: Units = &[];
    /// One line of help, for a stream of these values.
    const HELP: &'static str = "";

    /// Reads the fields from the variables at these indexes.
    #[doc(hidden)]
    fn read_places(parameters: &ParametersView, places: &[u8]) -> Result<Self, Error>;

    /// Sets the variables at these indexes from the fields.
    #[doc(hidden)]
    fn write_places(&self, parameters: &mut ParametersView, places: &[u8]) -> Result<(), Error>;

    /// Reads the fields from the variables with their names. Errors: [`Error::UnknownVariable`] if one is missing,
    /// [`Error::WrongType`], [`Error::WrongSize`], [`Error::OutOfRange`].
    fn from_parameters(parameters: &ParametersView) -> Result<Self, Error> {
        let mut places = IN_ORDER;
        for (place, spec) in places.iter_mut().zip(Self::SPECS) {
            *place = parameters.find(spec.name.as_bytes()).ok_or(Error::UnknownVariable)? as u8;
        }
        Self::read_places(parameters, &places)
    }

    /// Lends parameters with these variables and no further capacity.
    #[doc(hidden)]
    fn with_parameters<R>(&self, look: impl FnOnce(&ParametersView) -> R) -> Result<R, Error>;

    /// Sets the variables with the fields' names, and adds those that are missing. On an error some of them may be set.
    fn to_parameters(&self, parameters: &mut ParametersView) -> Result<(), Error> {
        let mut places = IN_ORDER;
        for (place, spec) in places.iter_mut().zip(Self::SPECS) {
            let index = match parameters.find(spec.name.as_bytes()) {
                Some(index) => index,
                None => {
                    parameters.add_spec(*spec)?;
                    parameters.len().saturating_sub(1)
                }
            };
            *place = index as u8;
        }
        self.write_places(parameters, &places)
    }
}

/// No results.
impl Variables for () {
    const SPECS: &'static [VariableSpec<'static>] = &[];

    fn read_places(_: &ParametersView, _: &[u8]) -> Result<Self, Error> {
        Ok(())
    }

    fn write_places(&self, _: &mut ParametersView, _: &[u8]) -> Result<(), Error> {
        Ok(())
    }

    fn with_parameters<R>(&self, look: impl FnOnce(&ParametersView) -> R) -> Result<R, Error> {
        Ok(look(&Parameters::<0>::sized()))
    }
}

/// Declares a stream of the values of a struct. Errors: [`Error::BadName`], [`Error::Full`] for too many variables.
pub fn stream_of<V: Variables>(name: &str) -> Result<Definition, Error> {
    let mut stream = Builder::new(name)?;
    V::SPECS.iter().try_for_each(|spec| stream.result(*spec))?;
    let stream = stream.finish();
    if !HELP {
        return Ok(stream);
    }
    // If the signature would become too long, leave out the help.
    let reported = if V::HELP.is_empty() { Ok(stream.clone()) } else { stream.clone().help(V::HELP) };
    let mut units = V::UNITS.iter();
    let reported = reported
        .and_then(|reported| units.try_fold(reported, |reported, (variable, unit)| reported.unit(variable, unit)));
    Ok(reported.unwrap_or(stream))
}

/// Each argument at its index in the signature.
pub const IN_ORDER: [u8; VARIABLES] = [0, 1, 2, 3, 4, 5, 6, 7, 8, 9, 10, 11, 12, 13, 14, 15];

/// The indexes of the results in parameters that were made from a signature.
pub const fn places_of_results(arguments: &[VariableSpec<'_>], results: &[VariableSpec<'_>]) -> [u8; VARIABLES] {
    let mut places = [0; VARIABLES];
    let (mut unset, mut rest, mut next): (&mut [u8], _, _) = (&mut places, results, arguments.len() as u8);
    while let (Some((place, later)), Some((result, others))) = (unset.split_first_mut(), rest.split_first()) {
        *place = match position(arguments, result.name) {
            Some(index) => index,
            None => {
                next = next.saturating_add(1);
                next.saturating_sub(1)
            }
        };
        (unset, rest) = (later, others);
    }
    places
}

/// The index at position `index`; `usize::MAX`, where there is no variable, beyond the end.
#[inline]
pub fn place(places: &[u8], index: usize) -> usize {
    places.get(index).map_or(usize::MAX, |place| usize::from(*place))
}

/// Reads an argument for a service.
pub fn argument<T: Field>(parameters: &ParametersView, place: usize) -> Result<T, ServiceError> {
    parameters.value_of(place).and_then(T::from_field).map_err(refused)
}

/// Reads an argument that is text or bytes, borrowed.
pub fn borrowed<'p, T: FromValue<'p>>(parameters: &'p ParametersView, place: usize) -> Result<T, ServiceError> {
    parameters.value_of(place).and_then(T::from_value).map_err(refused)
}

/// The error for an argument that does not fit its Rust type.
pub fn refused(_: Error) -> ServiceError {
    ServiceError::Failed(BAD_ARGUMENT)
}

/// The elements of a list; [`Error::WrongType`] for other types.
pub fn elements(value: Value<'_>) -> Result<Elements<'_>, Error> {
    if value.kind() == Type::List { Ok(value.elements()) } else { Err(Error::WrongType { index: value.index }) }
}

/// The element of a list of at most one; [`Error::OutOfRange`] if there are more.
pub fn optional(value: Value<'_>) -> Result<Option<Value<'_>>, Error> {
    let mut elements = elements(value)?;
    if elements.len() > 1 { Err(Error::OutOfRange) } else { Ok(elements.next()) }
}

/// The fields of a record, to be taken in order.
#[derive(Clone, Debug)]
pub struct Record<'a>(Fields<'a>);

impl<'a> Record<'a> {
    /// [`Error::WrongType`] for other types.
    pub fn of(value: Value<'a>) -> Result<Self, Error> {
        if value.kind() == Type::Record {
            Ok(Self(value.fields()))
        } else {
            Err(Error::WrongType { index: value.index })
        }
    }

    /// The next field; [`Error::UnknownVariable`] if it has another name.
    pub fn take(&mut self, name: &str) -> Result<Value<'a>, Error> {
        self.0.next().filter(|field| field.name == name).map(|field| field.value).ok_or(Error::UnknownVariable)
    }
}

/// Expands to code for lists and records, or to nothing if the core is built without them.
#[cfg(feature = "nested")]
#[doc(hidden)]
#[macro_export]
macro_rules! __nested {
    ($($item:item)*) => { $($item)* };
}

/// Expands to code for lists and records, or to nothing if the core is built without them.
#[cfg(not(feature = "nested"))]
#[doc(hidden)]
#[macro_export]
macro_rules! __nested {
    ($($item:item)*) => {};
}

/// Expands to code for a list, or to an error if the core is built without lists.
#[cfg(feature = "nested")]
#[doc(hidden)]
#[macro_export]
macro_rules! __list {
    ($list:expr) => {
        $list
    };
}

/// Expands to code for a list, or to an error if the core is built without lists.
#[cfg(not(feature = "nested"))]
#[doc(hidden)]
#[macro_export]
macro_rules! __list {
    ($list:expr) => {
        ::core::compile_error!("lists and `Option` need the feature `nested` of the core")
    };
}

pub use crate::{__list, __nested};

/// Longest path to a variable. A longer one loses its innermost names: the error is returned by value, so must be small.
const PATH_BYTES: usize = 40;

/// The peer's version of a function differs from this unit's interface, so the call was not sent.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
pub struct Mismatch {
    /// The function.
    pub function: heapless::String<NAME_BYTES>,
    /// The argument or result that differs, as `position`; inside lists and records its path, as `nodes[].x`, cut to fit.
    pub variable: heapless::String<PATH_BYTES>,
    /// Whether it is an argument or a result.
    pub part: Part,
    /// Its type and size here; `None` if this unit's interface lacks it.
    pub ours: Option<(Type, u32)>,
    /// Its type and size at the peer; `None` if the peer's version lacks it.
    pub theirs: Option<(Type, u32)>,
}

impl fmt::Display for Mismatch {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let Self { function, variable, part, ours, theirs } = self;
        write!(f, "the peer's {function} is of another version: its {part} {variable} is ")?;
        show(f, *theirs)?;
        f.write_str(" there and ")?;
        show(f, *ours)?;
        f.write_str(" here: update one of the two")
    }
}

fn show(f: &mut fmt::Formatter<'_>, shape: Option<(Type, u32)>) -> fmt::Result {
    match shape {
        Some((kind, size)) if kind.is_fixed() && size == 1 => f.write_str(kind.word()),
        Some((Type::List, size)) => write!(f, "a list of at most {size}"),
        Some((Type::Record, size)) => write!(f, "a record of {size}"),
        Some((kind, size)) => write!(f, "{kind}[{size}]"),
        None => f.write_str("missing"),
    }
}

impl Mismatch {
    /// Compares a function of an interface with the peer's version. All arguments that the peer needs must exist here, all
    /// results of the interface must exist there, with equal types and sizes. The length of text and bytes in an argument is
    /// checked when it is sent; in a result it must not be declared longer than here. The peer need not have the progress and
    /// failure values.
    pub fn check(ours: Signature<'_>, theirs: Signature<'_>) -> Result<(), Self> {
        if are_same(ours.as_bytes(), theirs.as_bytes()) || ours.without_help() == theirs.without_help() {
            return Ok(());
        }
        let found = |name: &str, part, here: Option<VariableSpec<'_>>, there: Option<VariableSpec<'_>>| {
            let mut variable = heapless::String::try_from(name).unwrap_or_default();
            let bounds = if part == Part::Argument { Bounds::Free } else { Bounds::Fit };
            let (here, there) = spec::difference(here, there, bounds, &mut variable);
            let function = heapless::String::try_from(ours.name()).unwrap_or_default();
            Self { function, variable, part, ours: here, theirs: there }
        };
        for wanted in theirs.arguments() {
            let here = ours.arguments().named(wanted.name);
            if !here.is_some_and(|here| spec::can_be(here.raw(), wanted.raw(), Bounds::Free)) {
                return Err(found(wanted.name, Part::Argument, here, Some(wanted)));
            }
        }
        let given = |ours: VariableSpecs<'_>, theirs: VariableSpecs<'_>, part| {
            for value in ours {
                let there = theirs.named(value.name);
                if !there.is_some_and(|there| spec::can_be(there.raw(), value.raw(), Bounds::Fit)) {
                    return Err(found(value.name, part, Some(value), there));
                }
            }
            Ok(())
        };
        given(ours.results(), theirs.results(), Part::Result)?;
        let details =
            [(ours.progress(), theirs.progress(), Part::Progress), (ours.failure(), theirs.failure(), Part::Failure)];
        for (ours, theirs, part) in details.into_iter().filter(|_| DETAILS) {
            if theirs.raw().next().is_some() {
                given(ours, theirs, part)?;
            }
        }
        Ok(())
    }
}

#[cfg(test)]
mod tests;
