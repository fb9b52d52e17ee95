//! Rust types as variables, and signatures that are made when compiling: what `#[derive(Variables)]` and `#[interface]`
//! write down.
//!
//! A view that was made from a signature holds its arguments first, then the results that are no arguments, in the
//! signature's order. So the place of each variable is known when compiling, and no name is compared when a call is served.

use core::fmt;

#[cfg(feature = "streams")]
use super::function::{Builder, Definition};
use super::function::{Signature, VariableSpec, VariableSpecs};
use super::name::is_name_byte;
use super::nested::{self, Bounds};
use super::parameters::{Elements, Fields, FromValue, Parameters, ParametersView, Slot, Type};
use super::value::{Element, Value};
use crate::config::{DEPTH, FAILURE_VALUES_BYTES, NAME_BYTES, SIGNATURE_BYTES, VARIABLES};
use crate::error::{Error, ServiceError};

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
#[cfg(feature = "streams")]
pub fn stream_of<V: Variables>(name: &str) -> Result<Definition, Error> {
    let mut stream = Builder::new(name)?;
    V::SPECS.iter().try_for_each(|spec| stream.result(*spec))?;
    Ok(stream.finish())
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

/// All variables of a function.
#[derive(Clone, Copy, Debug)]
pub struct Declared<'a> {
    /// What a caller must pass.
    pub arguments: &'a [VariableSpec<'a>],
    /// What it gets back.
    pub results: &'a [VariableSpec<'a>],
    /// What its calls tell while they run.
    pub progress: &'a [VariableSpec<'a>],
    /// The values of its failures.
    pub fails: &'a [VariableSpec<'a>],
}

impl Declared<'_> {
    /// Bytes that the signature of a function of this name takes.
    pub const fn encoded_bytes(&self, name: &str) -> usize {
        let fixed = name.len().saturating_add(3);
        let bytes = fixed.saturating_add(bytes_of_specs(self.arguments)).saturating_add(bytes_of_specs(self.results));
        bytes.saturating_add(bytes_of_section(self.progress)).saturating_add(bytes_of_section(self.fails))
    }
}

/// A section without variables is not there.
const fn bytes_of_section(specs: &[VariableSpec<'_>]) -> usize {
    if specs.is_empty() { 0 } else { bytes_of_specs(specs).saturating_add(2) }
}

const fn bytes_of_specs(mut specs: &[VariableSpec<'_>]) -> usize {
    let mut bytes = 0_usize;
    while let Some((spec, rest)) = specs.split_first() {
        bytes = bytes.saturating_add(spec.name.len()).saturating_add(spec.inner.len()).saturating_add(6);
        specs = rest;
    }
    bytes
}

/// Bytes that a variable takes in a `Parameters` beside its name. A list or record is there twice while it is set, the old
/// one as short as it can be, and lists are as long as they may become.
const fn bytes_of_value(spec: VariableSpec<'_>) -> usize {
    if !spec.kind.is_nested() {
        return (spec.size as usize).saturating_mul(spec.kind.width());
    }
    let inner = Insides::of(spec.kind, spec.size, spec.inner, 0);
    inner.least.saturating_add(inner.longest).saturating_add(spec.inner.len())
}

/// What the bytes of a signature say of a type, when compiling.
struct Insides<'a> {
    /// Bytes of the shortest and of the longest value in a block.
    least: usize,
    longest: usize,
    /// What is behind them.
    rest: &'a [u8],
    /// The rule that is broken, or nothing.
    wrong: &'static str,
}

impl<'a> Insides<'a> {
    const fn wrong(wrong: &'static str) -> Self {
        Self { least: 0, longest: 0, rest: &[], wrong }
    }

    const fn of(kind: Type, size: u32, rest: &'a [u8], depth: usize) -> Self {
        if !matches!(kind, Type::List | Type::Record) {
            let head = if kind.is_fixed() { 0 } else { 8 };
            let bytes = (size as usize).saturating_mul(kind.width());
            let longest = match bytes.checked_next_multiple_of(8) {
                Some(padded) => padded.saturating_add(head),
                None => usize::MAX,
            };
            return Self { least: if kind.is_fixed() { longest } else { head }, longest, rest, wrong: "" };
        }
        if !cfg!(feature = "nested") {
            return Self::wrong("lists and structs in structs need the feature `nested` of the core");
        }
        if depth >= DEPTH {
            return Self::wrong("lists and structs are in each other at most 4 deep");
        }
        if matches!(kind, Type::List) { Self::of_list(size, rest, depth) } else { Self::of_record(size, rest, depth) }
    }

    const fn of_list(size: u32, rest: &'a [u8], depth: usize) -> Self {
        let Some((kind, element_size, rest)) = nested::split_element(rest) else {
            return Self::wrong("a list has no element");
        };
        let element = Self::of(kind, element_size, rest, depth.saturating_add(1));
        if !element.wrong.is_empty() {
            return element;
        }
        if element.least == 0 {
            return Self::wrong("an element of a list takes bytes");
        }
        let longest = element.longest.saturating_mul(size as usize).saturating_add(8);
        Self { least: 8, longest, rest: element.rest, wrong: "" }
    }

    const fn of_record(size: u32, mut rest: &'a [u8], depth: usize) -> Self {
        if size == 0 || size > u8::MAX as u32 {
            return Self::wrong("a struct in another one or in a list has 1 to 255 fields");
        }
        let (mut left, mut least, mut longest) = (size, 0_usize, 0_usize);
        while left > 0 {
            left = left.saturating_sub(1);
            let Some((&[kind, length, a, b, c, d], named)) = rest.split_first_chunk::<6>() else {
                return Self::wrong("a struct has not all of its fields");
            };
            let (Some(kind), Some((name, inner))) = (Type::from_wire(kind), named.split_at_checked(length as usize))
            else {
                return Self::wrong("a struct has not all of its fields");
            };
            if !is_name_of(name) {
                return Self::wrong("a field's name has 1 to 32 letters, digits, '_', '-', '.' or '/'");
            }
            let field = Self::of(kind, u32::from_le_bytes([a, b, c, d]), inner, depth.saturating_add(1));
            if !field.wrong.is_empty() {
                return field;
            }
            least = least.saturating_add(field.least);
            longest = longest.saturating_add(field.longest);
            rest = field.rest;
        }
        Self { least, longest, rest, wrong: "" }
    }
}

/// The rule that a variable breaks by what it is made of, or nothing.
const fn wrong_inside(spec: VariableSpec<'_>) -> &'static str {
    let inside = Insides::of(spec.kind, spec.size, spec.inner, 0);
    if !inside.wrong.is_empty() {
        inside.wrong
    } else if inside.rest.is_empty() {
        ""
    } else {
        "a type has more behind it than it is made of"
    }
}

/// Bytes of what a list of such elements is made of.
pub const fn element_bytes(element: VariableSpec<'_>) -> usize {
    element.inner.len().saturating_add(5)
}

/// What a list of such elements is made of, in [`element_bytes`].
pub const fn element<const BYTES: usize>(element: VariableSpec<'_>) -> [u8; BYTES] {
    let mut bytes = [0; BYTES];
    let rest = put(&mut bytes, &[element.kind as u8]);
    put(put(rest, &element.size.to_le_bytes()), element.inner);
    bytes
}

/// Bytes of what a record with such fields is made of.
pub const fn fields_bytes(fields: &[VariableSpec<'_>]) -> usize {
    bytes_of_specs(fields)
}

/// What a record with such fields is made of, in [`fields_bytes`]; two fields of one name are a rule that is broken.
pub const fn fields<const BYTES: usize>(fields: &[VariableSpec<'_>]) -> Result<[u8; BYTES], &'static str> {
    let mut rest = fields;
    while let Some((field, others)) = rest.split_first() {
        if position(others, field.name).is_some() {
            return Err("two fields have one name");
        }
        rest = others;
    }
    let mut bytes = [0; BYTES];
    put_all(&mut bytes, fields);
    Ok(bytes)
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
            bytes = bytes.saturating_add(spec.name.len()).saturating_add(bytes_of_value(*spec));
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
    /// Encodes a signature of [`Declared::encoded_bytes`], or says which rule it breaks.
    pub const fn new(name: &str, declared: Declared<'_>) -> Result<Self, &'static str> {
        if let Err(rule) = check(name, &declared) {
            return Err(rule);
        }
        let mut bytes = [0; BYTES];
        let rest = put(&mut bytes, &[name.len() as u8]);
        let rest = put(rest, name.as_bytes());
        let rest = put_specs(rest, declared.arguments);
        let rest = put_specs(rest, declared.results);
        let rest = put_section(rest, 1, declared.progress);
        let rest = put_section(rest, 2, declared.fails);
        if rest.is_empty() && BYTES == declared.encoded_bytes(name) {
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
const fn check(name: &str, declared: &Declared<'_>) -> Result<(), &'static str> {
    let Declared { arguments, results, progress, fails } = *declared;
    if !is_name(name) {
        return Err("a function's name has 1 to 32 letters, digits, '_', '-', '.' or '/'");
    }
    if let Err(rule) = check_list(
        arguments,
        "an argument's name has 1 to 32 letters, digits, '_', '-', '.' or '/'",
        "two arguments have one name",
    ) {
        return Err(rule);
    }
    if let Err(rule) = check_list(
        results,
        "a result's name has 1 to 32 letters, digits, '_', '-', '.' or '/'",
        "two results have one name",
    ) {
        return Err(rule);
    }
    let named_wrongly =
        "a value of progress or of a failure has a name of 1 to 32 letters, digits, '_', '-', '.' or '/'";
    let twice = "two values of progress or of a failure have one name";
    if let Err(rule) = check_list(progress, named_wrongly, twice) {
        return Err(rule);
    }
    if let Err(rule) = check_list(fails, named_wrongly, twice) {
        return Err(rule);
    }
    if parameters_bytes(fails, &[]) > FAILURE_VALUES_BYTES {
        return Err("the values of a failure take at most `FAILURE_VALUES_BYTES` bytes with their names");
    }
    let mut only_results = 0_usize;
    let mut rest = results;
    while let Some((result, others)) = rest.split_first() {
        match named(arguments, result.name) {
            Some(argument)
                if argument.kind as u8 != result.kind as u8
                    || argument.size != result.size
                    || !are_same(argument.inner, result.inner) =>
            {
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
    if progress.len() > VARIABLES || fails.len() > VARIABLES {
        return Err("progress and failures have at most 16 values each");
    }
    if declared.encoded_bytes(name) > SIGNATURE_BYTES {
        return Err(
            "the names of a function, its arguments and its results are too long together: `SIGNATURE_BYTES` bytes with 6 for each",
        );
    }
    Ok(())
}

/// The rules of variables that stand side by side.
const fn check_list(
    list: &[VariableSpec<'_>],
    named_wrongly: &'static str,
    twice: &'static str,
) -> Result<(), &'static str> {
    let mut rest = list;
    while let Some((variable, others)) = rest.split_first() {
        if !is_name(variable.name) {
            return Err(named_wrongly);
        }
        if position(others, variable.name).is_some() {
            return Err(twice);
        }
        let wrong = wrong_inside(*variable);
        if !wrong.is_empty() {
            return Err(wrong);
        }
        rest = others;
    }
    Ok(())
}

const fn is_name(name: &str) -> bool {
    is_name_of(name.as_bytes())
}

const fn is_name_of(name: &[u8]) -> bool {
    let mut rest = name;
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
    are_same(one.as_bytes(), other.as_bytes())
}

const fn are_same(mut one: &[u8], mut other: &[u8]) -> bool {
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

const fn put_specs<'a>(to: &'a mut [u8], specs: &[VariableSpec<'_>]) -> &'a mut [u8] {
    put_all(put(to, &[specs.len() as u8]), specs)
}

const fn put_section<'a>(to: &'a mut [u8], section: u8, specs: &[VariableSpec<'_>]) -> &'a mut [u8] {
    if specs.is_empty() { to } else { put_specs(put(to, &[section]), specs) }
}

const fn put_all<'a>(mut to: &'a mut [u8], mut specs: &[VariableSpec<'_>]) -> &'a mut [u8] {
    while let Some((spec, rest)) = specs.split_first() {
        to = put(to, &[spec.kind as u8, spec.name.len() as u8]);
        to = put(to, &spec.size.to_le_bytes());
        to = put(to, spec.name.as_bytes());
        to = put(to, spec.inner);
        specs = rest;
    }
    to
}

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

/// What a variable is in a signature.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Part {
    /// What a caller passes.
    Argument,
    /// What it gets back.
    Result,
    /// What it is told meanwhile.
    Progress,
    /// What it is told of a failure.
    Failure,
}

impl fmt::Display for Mismatch {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let Self { function, variable, part, ours, theirs } = self;
        let what = match part {
            Part::Argument => "argument",
            Part::Result => "result",
            Part::Progress => "progress",
            Part::Failure => "failure's",
        };
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
        if ours.as_bytes() == theirs.as_bytes() {
            return Ok(());
        }
        let found = |name: &str, part, here: Option<VariableSpec<'_>>, there: Option<VariableSpec<'_>>| {
            let mut variable = heapless::String::try_from(name).unwrap_or_default();
            let bounds = if part == Part::Argument { Bounds::Free } else { Bounds::Fit };
            let (here, there) = nested::difference(here, there, bounds, &mut variable);
            let function = heapless::String::try_from(ours.name()).unwrap_or_default();
            Self { function, variable, part, ours: here, theirs: there }
        };
        for wanted in theirs.arguments() {
            let here = ours.arguments().named(wanted.name);
            if !here.is_some_and(|here| nested::can_be(here.raw(), wanted.raw(), Bounds::Free)) {
                return Err(found(wanted.name, Part::Argument, here, Some(wanted)));
            }
        }
        let given = |ours: VariableSpecs<'_>, theirs: VariableSpecs<'_>, part| {
            for value in ours {
                let there = theirs.named(value.name);
                if !there.is_some_and(|there| nested::can_be(there.raw(), value.raw(), Bounds::Fit)) {
                    return Err(found(value.name, part, Some(value), there));
                }
            }
            Ok(())
        };
        given(ours.results(), theirs.results(), Part::Result)?;
        #[cfg(feature = "details")]
        for (ours, theirs, part) in
            [(ours.progress(), theirs.progress(), Part::Progress), (ours.failure(), theirs.failure(), Part::Failure)]
        {
            if theirs.raw().next().is_some() {
                given(ours, theirs, part)?;
            }
        }
        Ok(())
    }
}

#[cfg(test)]
mod tests;
