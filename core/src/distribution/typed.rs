//! Rust types as variables, and signatures that are made when compiling: what `#[derive(Variables)]` and `#[interface]`
//! write down.
//!
//! A view that was made from a signature holds its arguments first, then the results that are no arguments, in the
//! signature's order. So the place of each variable is known when compiling, and no name is compared when a call is served.

use core::fmt;

use super::function::{Signature, VariableSpec};
use super::name::is_name_byte;
use super::parameters::{FromValue, IntoValue, ParametersView, Type};
use super::value::{Element, Target, Value};
use crate::config::{NAME_BYTES, SIGNATURE_BYTES, VARIABLES};
use crate::error::{Error, ServiceError};

/// The code of [`ServiceError::Failed`] with which a typed service refuses an argument that its Rust type cannot hold, as
/// 300 for a `u8`, before any code of its own runs.
pub const BAD_ARGUMENT: u16 = u16::MAX;

/// A Rust type that is one variable: integers, floats and `bool`, arrays of them, strings and bytes of `heapless`, and
/// enums without fields that derive it.
#[diagnostic::on_unimplemented(
    message = "`{Self}` cannot be a variable",
    label = "no type of a variable",
    note = "variables are integers, `f32`, `f64`, `bool`, arrays of them, `heapless::String<N>`, `heapless::Vec<u8, N>`, enums without fields that `#[derive(Variables)]`, and, with `#[size(N)]`, `String`, `&str`, `Vec<u8>` and `&[u8]`"
)]
pub trait Field: Sized {
    /// The type of the IDL that holds it.
    const KIND: Type;
    /// The declared size: so many elements, or at most so many bytes of text or bytes.
    const SIZE: u32;
    /// Reads it; [`Error::WrongType`], [`Error::WrongSize`] or [`Error::OutOfRange`].
    fn from_field(value: Value<'_>) -> Result<Self, Error>;
    /// Sets the variable; the same errors, and then it is unchanged.
    fn to_field(&self, target: Target<'_>) -> Result<(), Error>;
}

impl<T: Element> Field for T {
    const KIND: Type = T::KIND;
    const SIZE: u32 = 1;

    fn from_field(value: Value<'_>) -> Result<Self, Error> {
        T::from_value(value)
    }

    fn to_field(&self, target: Target<'_>) -> Result<(), Error> {
        (*self).into_value(target)
    }
}

impl<T: Element, const N: usize> Field for [T; N] {
    const KIND: Type = T::KIND;
    const SIZE: u32 = N as u32;

    fn from_field(value: Value<'_>) -> Result<Self, Error> {
        Self::from_value(value)
    }

    fn to_field(&self, target: Target<'_>) -> Result<(), Error> {
        self.into_value(target)
    }
}

impl<const N: usize> Field for heapless::String<N> {
    const KIND: Type = Type::String;
    const SIZE: u32 = N as u32;

    fn from_field(value: Value<'_>) -> Result<Self, Error> {
        Self::try_from(<&str>::from_value(value)?).map_err(|_| Error::OutOfRange)
    }

    fn to_field(&self, target: Target<'_>) -> Result<(), Error> {
        self.as_str().into_value(target)
    }
}

impl<const N: usize> Field for heapless::Vec<u8, N> {
    const KIND: Type = Type::Bytes;
    const SIZE: u32 = N as u32;

    fn from_field(value: Value<'_>) -> Result<Self, Error> {
        Self::from_slice(<&[u8]>::from_value(value)?).map_err(|_| Error::OutOfRange)
    }

    fn to_field(&self, target: Target<'_>) -> Result<(), Error> {
        self.as_slice().into_value(target)
    }
}

/// A struct whose fields are variables; `#[derive(Variables)]` writes it.
#[diagnostic::on_unimplemented(
    message = "`{Self}` does not say what its variables are called",
    label = "no struct with `#[derive(Variables)]`",
    note = "a result that is no such struct has its name in `#[returns(name)]` above the function"
)]
pub trait Variables: Sized {
    /// The variables in the order of the fields.
    const SPECS: &'static [VariableSpec<'static>];

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

    /// Sets the variables of the fields' names, and adds those that are missing. On an error some of them may be set.
    fn to_parameters(&self, parameters: &mut ParametersView) -> Result<(), Error> {
        let mut places = IN_ORDER;
        for (place, spec) in places.iter_mut().zip(Self::SPECS) {
            let index = match parameters.find(spec.name.as_bytes()) {
                Some(index) => index,
                None => {
                    parameters.add(spec.name, spec.kind, spec.size)?;
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

/// Bytes that an encoded signature takes.
pub const fn encoded_bytes(name: &str, arguments: &[VariableSpec<'_>], results: &[VariableSpec<'_>]) -> usize {
    let fixed = name.len().saturating_add(3);
    fixed.saturating_add(bytes_of_specs(arguments)).saturating_add(bytes_of_specs(results))
}

const fn bytes_of_specs(mut specs: &[VariableSpec<'_>]) -> usize {
    let mut bytes = 0_usize;
    while let Some((spec, rest)) = specs.split_first() {
        bytes = bytes.saturating_add(spec.name.len()).saturating_add(6);
        specs = rest;
    }
    bytes
}

/// Bytes of a `Parameters` that holds all arguments and results of a function.
pub const fn parameters_bytes(arguments: &[VariableSpec<'_>], results: &[VariableSpec<'_>]) -> usize {
    let (mut bytes, mut rest, mut is_argument) = (0_usize, arguments, true);
    loop {
        let Some((spec, others)) = rest.split_first() else {
            if !is_argument {
                return bytes;
            }
            (rest, is_argument) = (results, false);
            continue;
        };
        if is_argument || position(arguments, spec.name).is_none() {
            let size = (spec.size as usize).saturating_mul(spec.kind.width());
            bytes = bytes.saturating_add(spec.name.len()).saturating_add(size);
        }
        rest = others;
    }
}

/// A signature that is encoded when compiling.
#[derive(Debug)]
pub struct Encoded<const BYTES: usize> {
    bytes: [u8; BYTES],
}

impl<const BYTES: usize> Encoded<BYTES> {
    /// Encodes a signature of [`encoded_bytes`], or says which rule it breaks.
    pub const fn new(
        name: &str,
        arguments: &[VariableSpec<'_>],
        results: &[VariableSpec<'_>],
    ) -> Result<Self, &'static str> {
        if let Err(rule) = check(name, arguments, results) {
            return Err(rule);
        }
        let mut bytes = [0; BYTES];
        let rest = put(&mut bytes, &[name.len() as u8]);
        let rest = put(rest, name.as_bytes());
        let rest = put_specs(rest, arguments);
        let rest = put_specs(rest, results);
        if rest.is_empty() && BYTES == encoded_bytes(name, arguments, results) {
            Ok(Self { bytes })
        } else {
            Err("the signature has another length")
        }
    }

    /// The signature.
    pub const fn signature(&self) -> Signature<'_> {
        Signature::of_checked(&self.bytes)
    }
}

/// The rules of a [`Definition`](super::function::Definition).
const fn check(name: &str, arguments: &[VariableSpec<'_>], results: &[VariableSpec<'_>]) -> Result<(), &'static str> {
    if !is_name(name) {
        return Err("a function's name has 1 to 32 letters, digits, '_', '-', '.' or '/'");
    }
    let mut only_results = 0_usize;
    let mut rest = arguments;
    while let Some((argument, others)) = rest.split_first() {
        if !is_name(argument.name) {
            return Err("an argument's name has 1 to 32 letters, digits, '_', '-', '.' or '/'");
        }
        if position(others, argument.name).is_some() {
            return Err("two arguments have one name");
        }
        rest = others;
    }
    rest = results;
    while let Some((result, others)) = rest.split_first() {
        if !is_name(result.name) {
            return Err("a result's name has 1 to 32 letters, digits, '_', '-', '.' or '/'");
        }
        if position(others, result.name).is_some() {
            return Err("two results have one name");
        }
        match named(arguments, result.name) {
            Some(argument) if argument.kind as u8 != result.kind as u8 || argument.size != result.size => {
                return Err("a result with the name of an argument has its type and size, since both are one variable");
            }
            Some(_) => {}
            None => only_results = only_results.saturating_add(1),
        }
        rest = others;
    }
    if arguments.len().saturating_add(only_results) > VARIABLES {
        return Err("a function has at most 16 arguments and results");
    }
    if encoded_bytes(name, arguments, results) > SIGNATURE_BYTES {
        return Err(
            "the names of a function, its arguments and its results are too long together: 384 bytes with 6 for each",
        );
    }
    Ok(())
}

const fn is_name(name: &str) -> bool {
    let mut rest = name.as_bytes();
    while let Some((byte, others)) = rest.split_first() {
        if !is_name_byte(*byte) {
            return false;
        }
        rest = others;
    }
    !name.is_empty() && name.len() <= NAME_BYTES
}

const fn position(specs: &[VariableSpec<'_>], name: &str) -> Option<u8> {
    let (mut rest, mut index) = (specs, 0_u8);
    while let Some((spec, others)) = rest.split_first() {
        if is_same(spec.name, name) {
            return Some(index);
        }
        (rest, index) = (others, index.saturating_add(1));
    }
    None
}

const fn named<'s>(specs: &'s [VariableSpec<'s>], name: &str) -> Option<&'s VariableSpec<'s>> {
    let mut rest = specs;
    while let Some((spec, others)) = rest.split_first() {
        if is_same(spec.name, name) {
            return Some(spec);
        }
        rest = others;
    }
    None
}

const fn is_same(one: &str, other: &str) -> bool {
    let (mut one, mut other) = (one.as_bytes(), other.as_bytes());
    while let (Some((a, rest)), Some((b, others))) = (one.split_first(), other.split_first()) {
        if *a != *b {
            return false;
        }
        (one, other) = (rest, others);
    }
    one.is_empty() && other.is_empty()
}

/// Writes `bytes`, and returns what is free behind them.
const fn put<'a>(mut to: &'a mut [u8], mut bytes: &[u8]) -> &'a mut [u8] {
    while let Some((byte, rest)) = bytes.split_first() {
        match to.split_first_mut() {
            Some((place, free)) => {
                *place = *byte;
                to = free;
            }
            None => return &mut [],
        }
        bytes = rest;
    }
    to
}

const fn put_specs<'a>(to: &'a mut [u8], mut specs: &[VariableSpec<'_>]) -> &'a mut [u8] {
    let mut to = put(to, &[specs.len() as u8]);
    while let Some((spec, rest)) = specs.split_first() {
        to = put(to, &[spec.kind as u8, spec.name.len() as u8]);
        to = put(to, &spec.size.to_le_bytes());
        to = put(to, spec.name.as_bytes());
        specs = rest;
    }
    to
}

/// The peer's function of a name is another one than that of the interface here: nothing was sent.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
pub struct Mismatch {
    /// The function.
    pub function: heapless::String<NAME_BYTES>,
    /// The argument or result in which they differ.
    pub variable: heapless::String<NAME_BYTES>,
    /// It is a result.
    pub is_result: bool,
    /// Its type and size here; `None` where the interface does not have it.
    pub ours: Option<(Type, u32)>,
    /// Its type and size at the peer; `None` where the peer does not have it.
    pub theirs: Option<(Type, u32)>,
}

impl fmt::Display for Mismatch {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let Self { function, variable, is_result, ours, theirs } = self;
        let what = if *is_result { "result" } else { "argument" };
        write!(f, "the peer's {function} is of another version: its {what} {variable} is ")?;
        show(f, *theirs)?;
        f.write_str(" there and ")?;
        show(f, *ours)?;
        f.write_str(" here: update one of the two")
    }
}

fn show(f: &mut fmt::Formatter<'_>, shape: Option<(Type, u32)>) -> fmt::Result {
    match shape {
        Some((kind, size)) if kind.is_fixed() && size == 1 => f.write_str(kind.word()),
        Some((kind, size)) => write!(f, "{kind}[{size}]"),
        None => f.write_str("missing"),
    }
}

impl Mismatch {
    /// Compares a function of an interface with what the peer has published under its name. What the peer wants must be there,
    /// with its type and size, and what is wanted of it must be given. Of text and bytes an argument's length is looked at when
    /// it is sent, and a result must not become longer than is declared here.
    pub fn check(ours: Signature<'_>, theirs: Signature<'_>) -> Result<(), Self> {
        if ours.as_bytes() == theirs.as_bytes() {
            return Ok(());
        }
        let found =
            |spec: VariableSpec<'_>, is_result, here: Option<VariableSpec<'_>>, there: Option<VariableSpec<'_>>| {
                let shape = |spec: VariableSpec<'_>| (spec.kind, spec.size);
                let text = |text: &str| heapless::String::try_from(text).unwrap_or_default();
                let (function, variable) = (text(ours.name()), text(spec.name));
                Self { function, variable, is_result, ours: here.map(shape), theirs: there.map(shape) }
            };
        for wanted in theirs.arguments() {
            let here = ours.arguments().named(wanted.name);
            if !here.is_some_and(|here| can_be(here, wanted)) {
                return Err(found(wanted, false, here, Some(wanted)));
            }
        }
        for result in ours.results() {
            let there = theirs.results().named(result.name);
            if !there.is_some_and(|there| can_be(there, result) && there.size <= result.size) {
                return Err(found(result, true, Some(result), there));
            }
        }
        Ok(())
    }
}

/// Whether the one variable can be put into the other, as long as it is no text or bytes that are too long.
fn can_be(one: VariableSpec<'_>, other: VariableSpec<'_>) -> bool {
    one.kind == other.kind && (!one.kind.is_fixed() || one.size == other.size)
}

#[cfg(test)]
mod tests;
