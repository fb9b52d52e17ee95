//! The encoding of a block of parameters: the values in the signature's order, without names, read in place.
//!
//! Every value starts at a multiple of 8 bytes from the block's start. Integers are 8 bytes each, little-endian; floats likewise
//! by their bits; truth values one byte each, 0 or 1, padded with zeros to 8; strings and bytes are their length as u32, four
//! zero bytes, then the bytes, padded with zeros to 8; [`nested`] has lists and records. The encoding is unique: anything else is
//! malformed.

use super::function::Signature;
use super::nested::{self, is_canonical, split};
use super::parameters::ParametersView;
use super::spec::{self, RawSpec, VariableSpecs, bytes_of_variable, padding_after};
use super::value::{Value, saturate};
use crate::bytes::copy;
use crate::config::VARIABLES;
use crate::error::{Error, Limit};

/// The target of a block. It has enough capacity, since the length is checked before.
pub trait Put {
    /// Appends `bytes`.
    fn put(&mut self, bytes: &[u8]);
}

/// Writes to a slice; drops what does not fit.
pub struct SliceWriter<'a> {
    slice: &'a mut [u8],
    written: usize,
}

impl<'a> SliceWriter<'a> {
    /// Writes from the start of `slice`.
    pub const fn new(slice: &'a mut [u8]) -> Self {
        Self { slice, written: 0 }
    }

    /// Bytes written so far.
    pub const fn written(&self) -> usize {
        self.written
    }
}

impl Put for SliceWriter<'_> {
    fn put(&mut self, bytes: &[u8]) {
        let end = self.written.saturating_add(bytes.len());
        if let Some(place) = self.slice.get_mut(self.written..end) {
            copy(bytes, place);
            self.written = end;
        }
    }
}

const ZEROS: [u8; 8] = [0; 8];

/// Checks `parameters` against `specs` and returns the length of their block in bytes.
///
/// Extra variables are allowed, and so are strings and bytes shorter than declared. The errors, with an index among the specs:
/// [`Error::MissingArgument`], [`Error::WrongType`] and [`Error::WrongSize`].
///
/// ```
/// use cara_core::distribution::{block, function::Definition, parameters::Parameters};
///
/// let go_to = Definition::parse("go_to(position: int[2])").unwrap();
/// let mut pos = Parameters::new();
/// pos.add_int("position", 2)?;
/// let arguments = go_to.signature().arguments();
/// assert_eq!(block::measure(arguments, &pos), Ok(16));
///
/// let mut bytes = [0; 16];
/// block::write(arguments, &pos, &mut block::SliceWriter::new(&mut bytes));
/// assert_eq!(block::check(arguments, &bytes), Ok(()));
/// # Ok::<(), cara_core::error::Error>(())
/// ```
pub fn measure(specs: VariableSpecs<'_>, parameters: &ParametersView) -> Result<usize, Error> {
    let mut length = 0_usize;
    for (position, spec) in specs.raw().enumerate() {
        let index = position as u8;
        let value = parameters.named(spec.name).ok_or(Error::MissingArgument { index })?;
        if value.kind() != spec.kind {
            return Err(Error::WrongType { index });
        }
        if spec.kind.is_nested() {
            length = length.saturating_add(nested::measure(spec, value, index)?);
            continue;
        }
        let found = if spec.kind.is_fixed() { value.size() } else { saturate(value.raw().len()) };
        if found > spec.size || (spec.kind.is_fixed() && found != spec.size) {
            return Err(Error::WrongSize { index, expected: spec.size, found });
        }
        length = length.saturating_add(encoded_length(value));
    }
    Ok(length)
}

/// Writes the block of `parameters`, which [`measure`] accepted.
pub fn write(specs: VariableSpecs<'_>, parameters: &ParametersView, to: &mut impl Put) {
    for spec in specs.raw() {
        let Some(value) = parameters.named(spec.name) else { continue };
        let bytes = value.raw();
        if !spec.kind.is_fixed() && !spec.kind.is_nested() {
            to.put(&u64::from(saturate(bytes.len())).to_le_bytes());
        }
        to.put(bytes);
        match padding_after(bytes.len()) {
            0 => {}
            padding => to.put(ZEROS.get(..padding).unwrap_or_default()),
        }
    }
}

/// The values of a block that [`write()`] has made, with their names, in place. Ends at bytes that are no such value.
pub fn values<'a>(specs: VariableSpecs<'a>, block: &'a [u8]) -> impl Iterator<Item = (&'a str, Value<'a>)> {
    let mut rest = block;
    specs.raw().enumerate().map_while(move |(index, spec)| {
        let bytes;
        (bytes, rest) = if spec.kind.is_nested() { nested::extent(spec, rest) } else { split(spec, rest) }?;
        let value = Value { index: index as u8, kind: spec.kind, size: spec.size, inner: spec.inner, bytes };
        Some((core::str::from_utf8(spec.name).ok()?, value))
    })
}

/// The longest block of `specs` in bytes; `None` if that exceeds the address space.
pub fn longest(specs: VariableSpecs<'_>) -> Option<usize> {
    specs.raw().try_fold(0_usize, |sum, spec| {
        if spec.kind.is_nested() {
            return sum.checked_add(spec::longest(spec)?);
        }
        let head = if spec.kind.is_fixed() { 0 } else { 8 };
        sum.checked_add(head)?.checked_add(spec.kind.bytes_of(spec.size)?.checked_next_multiple_of(8)?)
    })
}

/// Validates all of a block, UTF-8 included; [`Error::Malformed`] for any block that [`write()`] can't have made.
pub fn check(specs: VariableSpecs<'_>, block: &[u8]) -> Result<(), Error> {
    each(specs, block, |_, _, _| Ok(()))
}

/// Updates `parameters` with a block of results (paper, section 2: "the request will update the `pos` object").
///
/// Variables of the same name take the new value; missing ones are added with their declared size. The whole block is validated
/// first. Errors leave the parameters unchanged: [`Error::ResultLost`] for a malformed block, since the service has run;
/// [`Error::ResultWouldNotFit`], [`Error::WrongType`], [`Error::WrongSize`] and [`Error::Full`] if the results do not fit.
pub fn read(specs: VariableSpecs<'_>, block: &[u8], parameters: &mut ParametersView) -> Result<(), Error> {
    let mut room = Room::of(parameters);
    let read = each(specs, block, |index, spec, value| {
        if spec.kind.is_nested() {
            return room.take_nested(parameters, index, spec, value);
        }
        let needed = if spec.kind.is_fixed() { spec.size } else { saturate(value.len()) };
        room.take(parameters, index, spec, needed)
    });
    read.map_err(|error| if error == Error::Malformed { Error::ResultLost } else { error })?;
    room.check()?;
    commit(specs, block, parameters)
}

/// Checks before a call is sent whether `parameters` can hold all possible results; errors as for [`read`]. Lists count as empty,
/// since their length is not known yet.
pub fn check_results_fit(specs: VariableSpecs<'_>, parameters: &ParametersView) -> Result<(), Error> {
    let mut room = Room::of(parameters);
    for (position, spec) in specs.raw().enumerate() {
        if spec.kind.is_nested() {
            room.take_any_nested(parameters, position as u8, spec)?;
            continue;
        }
        room.take(parameters, position as u8, spec, spec.size)?;
    }
    room.check()
}

/// Replaces the variables of `parameters` by the arguments in a block, each with its declared size, for a service.
///
/// [`Error::Malformed`], or [`Error::Full`] if the parameters are too small. They may be empty after an error.
pub fn read_arguments(specs: VariableSpecs<'_>, block: &[u8], parameters: &mut ParametersView) -> Result<(), Error> {
    parameters.clear();
    let read = each(specs, block, |_, spec, value| parameters.add_with(spec, value));
    if read.is_err() {
        parameters.clear();
    }
    read
}

/// Adds the results that are not in `parameters` yet, so that a service only has to set them.
///
/// [`Error::Full`] if the parameters are too small, [`Error::WrongType`] and [`Error::WrongSize`] if a variable with the name of
/// a result differs from it.
pub fn prepare_results(specs: VariableSpecs<'_>, parameters: &mut ParametersView) -> Result<(), Error> {
    for (position, spec) in specs.raw().enumerate() {
        let index = position as u8;
        let Some(value) = parameters.named(spec.name) else {
            parameters.add_checked(spec)?;
            continue;
        };
        if value.kind() != spec.kind || (spec.kind.is_nested() && value.inner != spec.inner) {
            return Err(Error::WrongType { index });
        }
        if value.size() != spec.size {
            return Err(Error::WrongSize { index, expected: spec.size, found: value.size() });
        }
    }
    Ok(())
}

/// The capacity left in some parameters while results are counted.
struct Room {
    variables: usize,
    bytes: usize,
    needed: usize,
}

impl Room {
    fn of(parameters: &ParametersView) -> Self {
        Self { variables: VARIABLES.saturating_sub(parameters.len()), bytes: parameters.remaining(), needed: 0 }
    }

    /// Counts one result of `size` elements; an existing variable of its name must be able to hold it.
    fn take(&mut self, parameters: &ParametersView, index: u8, spec: RawSpec<'_>, size: u32) -> Result<(), Error> {
        let Some(value) = parameters.named(spec.name) else {
            self.variables = self.variables.checked_sub(1).ok_or(Error::Full(Limit::Variables))?;
            let bytes = bytes_of_variable(spec).unwrap_or(usize::MAX);
            self.needed = self.needed.saturating_add(bytes);
            return Ok(());
        };
        if value.kind() != spec.kind {
            return Err(Error::WrongType { index });
        }
        if size > value.size() {
            let [need, have] = [size, value.size()].map(|size| size.saturating_mul(spec.kind.width() as u32));
            return Err(Error::ResultWouldNotFit { need, have });
        }
        if spec.kind.is_fixed() && size != value.size() {
            return Err(Error::WrongSize { index, expected: value.size(), found: size });
        }
        Ok(())
    }

    /// Counts a list or record. Its new value is written after all others before the old one is removed.
    fn take_nested(&mut self, to: &ParametersView, index: u8, spec: RawSpec<'_>, bytes: &[u8]) -> Result<(), Error> {
        let Some(own) = to.named(spec.name) else {
            self.take(to, index, spec, spec.size)?;
            self.needed = self.needed.saturating_add(bytes.len().saturating_sub(spec::least(spec)));
            return Ok(());
        };
        let value = Value { index, kind: spec.kind, size: spec.size, inner: spec.inner, bytes };
        nested::measure(own.raw_spec(), value, index)?;
        self.needed = self.needed.saturating_add(bytes.len());
        Ok(())
    }

    /// The same while the value is not known.
    fn take_any_nested(&mut self, to: &ParametersView, index: u8, spec: RawSpec<'_>) -> Result<(), Error> {
        match to.named(spec.name) {
            Some(own) if spec::can_be(spec, own.raw_spec(), spec::Bounds::Free) => Ok(()),
            Some(_) => Err(Error::WrongType { index }),
            None => self.take(to, index, spec, spec.size),
        }
    }

    /// Whether all new values fit together.
    fn check(&self) -> Result<(), Error> {
        if self.needed > self.bytes {
            return Err(Error::ResultWouldNotFit { need: saturate(self.needed), have: saturate(self.bytes) });
        }
        Ok(())
    }
}

/// Validates a block, including UTF-8, and passes each value to `visit`.
fn each<'s>(
    specs: VariableSpecs<'s>,
    block: &[u8],
    mut visit: impl FnMut(u8, RawSpec<'s>, &[u8]) -> Result<(), Error>,
) -> Result<(), Error> {
    let mut rest = block;
    let mut refusal = Ok(());
    for (index, spec) in specs.raw().enumerate() {
        let found = if spec.kind.is_nested() { nested::check(spec, rest) } else { split(spec, rest) };
        let Some((value, behind)) = found else { return Err(Error::Malformed) };
        if !is_canonical(spec.kind, value) {
            return Err(Error::Malformed);
        }
        rest = behind;
        refusal = refusal.and_then(|()| visit(index as u8, spec, value));
    }
    // If the block is malformed, report that, and not an error of a value in it.
    if rest.is_empty() { refusal } else { Err(Error::Malformed) }
}

/// Stores the values of a validated block.
fn commit(specs: VariableSpecs<'_>, block: &[u8], parameters: &mut ParametersView) -> Result<(), Error> {
    let mut rest = block;
    for spec in specs.raw() {
        let value;
        (value, rest) = if spec.kind.is_nested() { nested::extent(spec, rest) } else { split(spec, rest) }
            .ok_or(Error::Malformed)?;
        let index = match parameters.find(spec.name) {
            Some(index) => index,
            None if spec.kind.is_nested() => {
                parameters.add_with(spec, value)?;
                continue;
            }
            None => {
                parameters.add_checked(spec)?;
                parameters.len().saturating_sub(1)
            }
        };
        if spec.kind.is_nested() {
            parameters.set_nested(index, value)?;
        } else {
            parameters.set_checked(index, value);
        }
    }
    Ok(())
}

#[inline]
fn encoded_length(value: Value<'_>) -> usize {
    let head = if value.kind().is_fixed() { 0 } else { 8 };
    let bytes = value.raw().len();
    bytes.saturating_add(head).saturating_add(padding_after(bytes))
}

impl ParametersView {
    /// Replaces all variables by the arguments of a function, then its other results, each 0, `false` or empty, in the order in
    /// which a service gets them.
    #[doc(hidden)]
    pub fn lay_out(&mut self, function: Signature<'_>) -> Result<(), Error> {
        self.clear();
        for spec in function.arguments().raw() {
            self.add_checked(spec)?;
        }
        prepare_results(function.results(), self)
    }
}

#[cfg(test)]
mod tests;
