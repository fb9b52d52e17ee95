//! Rust types as variables, and signatures that are made when compiling: what `#[derive(Variables)]` and `#[interface]`
//! write down.
//!
//! A view that was made from a signature holds its arguments first, then the results that are no arguments, in the
//! signature's order. So the place of each variable is known when compiling, and no name is compared when a call is served.

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

/// The code of [`ServiceError::Failed`] with which a typed service refuses an argument that its Rust type cannot hold, as
/// 300 for a `u8`, before any code of its own runs.
pub const BAD_ARGUMENT: u16 = u16::MAX;

/// A Rust type that is one variable: integers, floats and `bool`, arrays of them, strings and bytes of `heapless`, enums
/// without fields that derive it, and, with the feature `nested`, structs that derive [`Variables`], as records.
#[diagnostic::on_unimplemented(
    message = "`{Self}` cannot be a variable",
    label = "no type of a variable",
    note = "variables are integers, `f32`, `f64`, `bool`, arrays of them, `heapless::String<N>`, `heapless::Vec<u8, N>`, enums without fields that `#[derive(Variables)]`, and, with `#[size(N)]`, `String`, `&str`, `Vec<u8>` and `&[u8]`; where the core has the feature `nested`, also structs that `#[derive(Variables)]`, and `Vec`, `heapless::Vec` and `Option` of all of these"
)]
pub trait Field: Sized {
    /// The type of the IDL that holds it.
    const KIND: Type;
    /// The declared size: so many elements, or at most so many bytes of text or bytes.
    const SIZE: u32;
    /// What a record or list is made of, as it stands in a signature.
    const INNER: &'static [u8] = &[];
    /// Reads it; [`Error::WrongType`], [`Error::WrongSize`] or [`Error::OutOfRange`].
    fn from_field(value: Value<'_>) -> Result<Self, Error>;
    /// Sets the variable; the same errors, and then it is unchanged.
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

/// The names of variables, and their units.
pub type Units = &'static [(&'static str, &'static str)];

/// A struct whose fields are variables; `#[derive(Variables)]` writes it.
#[diagnostic::on_unimplemented(
    message = "`{Self}` does not say what its variables are called",
    label = "no struct with `#[derive(Variables)]`",
    note = "a result that is no such struct has its name in `#[returns(name)]` above the function"
)]
pub trait Variables: Sized {
    /// The variables in the order of the fields.
    const SPECS: &'static [VariableSpec<'static>];
    /// The units of variables, by name.
    const UNITS: Units = &[];
    /// A line of help for people: what a stream of these values is.
    const HELP: &'static str = "";

    /// Reads the fields from the variables in these places.
    #[doc(hidden)]
    fn read_places(parameters: &ParametersView, places: &[u8]) -> Result<Self, Error>;

    /// Sets the variables in these places from the fields.
    #[doc(hidden)]
    fn write_places(&self, parameters: &mut ParametersView, places: &[u8]) -> Result<(), Error>;

    /// Reads the fields from the variables of their names; [`Error::UnknownVariable`] where one is missing,
    /// [`Error::WrongType`], [`Error::WrongSize`] and [`Error::OutOfRange`].
    fn from_parameters(parameters: &ParametersView) -> Result<Self, Error> {
        let mut places = IN_ORDER;
        for (place, spec) in places.iter_mut().zip(Self::SPECS) {
            *place = parameters.find(spec.name.as_bytes()).ok_or(Error::UnknownVariable)? as u8;
        }
        Self::read_places(parameters, &places)
    }

    /// Lends the variables, with room for them and for nothing else.
    #[doc(hidden)]
    fn with_parameters<R>(&self, look: impl FnOnce(&ParametersView) -> R) -> Result<R, Error>;

    /// Sets the variables of the fields' names, and adds those that are missing. On an error some of them may be set.
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

/// The stream whose values are those of a struct. [`Error::BadName`], and [`Error::Full`] for too many variables.
pub fn stream_of<V: Variables>(name: &str) -> Result<Definition, Error> {
    let mut stream = Builder::new(name)?;
    V::SPECS.iter().try_for_each(|spec| stream.result(*spec))?;
    let stream = stream.finish();
    if !HELP {
        return Ok(stream);
    }
    // What there is no room for is the help.
    let reported = if V::HELP.is_empty() { Ok(stream.clone()) } else { stream.clone().help(V::HELP) };
    let mut units = V::UNITS.iter();
    let reported = reported
        .and_then(|reported| units.try_fold(reported, |reported, (variable, unit)| reported.unit(variable, unit)));
    Ok(reported.unwrap_or(stream))
}

/// Each argument where it stands in the signature.
pub const IN_ORDER: [u8; VARIABLES] = [0, 1, 2, 3, 4, 5, 6, 7, 8, 9, 10, 11, 12, 13, 14, 15];

/// Where the results are in a view that was made from a signature.
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

/// The place that stands at `index`; one where nothing is for an index beyond them.
#[inline]
pub fn place(places: &[u8], index: usize) -> usize {
    places.get(index).map_or(usize::MAX, |place| usize::from(*place))
}

/// What an argument is, for the service that is to get it.
pub fn argument<T: Field>(parameters: &ParametersView, place: usize) -> Result<T, ServiceError> {
    parameters.value_of(place).and_then(T::from_field).map_err(refused)
}

/// The same of text and bytes, borrowed.
pub fn borrowed<'p, T: FromValue<'p>>(parameters: &'p ParametersView, place: usize) -> Result<T, ServiceError> {
    parameters.value_of(place).and_then(T::from_value).map_err(refused)
}

/// What a service answers where an argument does not fit its Rust type.
pub fn refused(_: Error) -> ServiceError {
    ServiceError::Failed(BAD_ARGUMENT)
}

/// The elements of a list; [`Error::WrongType`] for another type.
pub fn elements(value: Value<'_>) -> Result<Elements<'_>, Error> {
    if value.kind() == Type::List { Ok(value.elements()) } else { Err(Error::WrongType { index: value.index }) }
}

/// The element of a list that has one at most; [`Error::OutOfRange`] if it has more.
pub fn optional(value: Value<'_>) -> Result<Option<Value<'_>>, Error> {
    let mut elements = elements(value)?;
    if elements.len() > 1 { Err(Error::OutOfRange) } else { Ok(elements.next()) }
}

/// The fields of a record, which are taken in their order.
#[derive(Clone, Debug)]
pub struct Record<'a>(Fields<'a>);

impl<'a> Record<'a> {
    /// [`Error::WrongType`] for another type.
    pub fn of(value: Value<'a>) -> Result<Self, Error> {
        if value.kind() == Type::Record {
            Ok(Self(value.fields()))
        } else {
            Err(Error::WrongType { index: value.index })
        }
    }

    /// The next field; [`Error::UnknownVariable`] where that has another name.
    pub fn take(&mut self, name: &str) -> Result<Value<'a>, Error> {
        self.0.next().filter(|field| field.name == name).map(|field| field.value).ok_or(Error::UnknownVariable)
    }
}

/// Passes on what needs lists and records; nothing of it where the core does not have them.
#[cfg(feature = "nested")]
#[doc(hidden)]
#[macro_export]
macro_rules! __nested {
    ($($item:item)*) => { $($item)* };
}

/// Passes on what needs lists and records; nothing of it where the core does not have them.
#[cfg(not(feature = "nested"))]
#[doc(hidden)]
#[macro_export]
macro_rules! __nested {
    ($($item:item)*) => {};
}

/// Passes a list on, which cannot be where the core does not have them.
#[cfg(feature = "nested")]
#[doc(hidden)]
#[macro_export]
macro_rules! __list {
    ($list:expr) => {
        $list
    };
}

/// Passes a list on, which cannot be where the core does not have them.
#[cfg(not(feature = "nested"))]
#[doc(hidden)]
#[macro_export]
macro_rules! __list {
    ($list:expr) => {
        ::core::compile_error!("lists and `Option` need the feature `nested` of the core")
    };
}

pub use crate::{__list, __nested};

/// Longest way to a variable; of a longer one the innermost names are left out, so that the error can be returned by value.
const PATH_BYTES: usize = 40;

/// The peer's function of a name is another one than that of the interface here: nothing was sent.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
pub struct Mismatch {
    /// The function.
    pub function: heapless::String<NAME_BYTES>,
    /// The argument or result in which they differ, as `position`; in lists and records the way to it, as `nodes[].x`, as far as
    /// there is room.
    pub variable: heapless::String<PATH_BYTES>,
    /// What it is.
    pub part: Part,
    /// Its type and size here; `None` where the interface does not have it.
    pub ours: Option<(Type, u32)>,
    /// Its type and size at the peer; `None` where the peer does not have it.
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
    /// Compares a function of an interface with what the peer has published under its name. What the peer wants must be there,
    /// with its type and size, and what is wanted of it must be given. Of text and bytes an argument's length is looked at when
    /// it is sent, and a result must not become longer than is declared here. Progress and values of failures the peer need not have.
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
