//! The paper's `Function`: a name with its arguments and results.
//!
//! A signature has one encoding, in memory and on the wire (docs/wire.md): name length u8, name, number of arguments u8,
//! arguments, number of results u8, results; then, if declared, a section u8, number of variables u8 and variables for the
//! progress of calls (1) and for the values of failures (2), and last the help. Each variable: type u8, name length u8, size u32
//! little-endian, name, and the inner types of a list or record. [`Definition`] owns a signature, [`Signature`] borrows one.

use core::fmt;

use crate::ability::{DETAILS, HELP};
use crate::config::{SIGNATURE_BYTES, VARIABLES};
use crate::error::{Error, Limit};

pub use super::attributes::{Attributes, Flag};
use super::name::check_name;
use super::parameters::ParametersView;
pub use super::spec::{VariableSpec, VariableSpecs};
use super::spec::{bytes_of_variable, check_inner};
use super::value::saturate;

/// An own function's signature.
///
/// ```
/// use cara_core::distribution::function::Definition;
/// use cara_core::distribution::parameters::Parameters;
///
/// let mut pos = Parameters::new();
/// pos.add_int("position", 2)?;
/// let pos_info = Definition::new("pos_info")?.results(&pos)?;
/// assert_eq!(pos_info, Definition::parse("pos_info() -> (position: int[2])").unwrap());
/// # Ok::<(), cara_core::error::Error>(())
/// ```
#[derive(Clone, PartialEq, Eq)]
pub struct Definition {
    pub(super) bytes: heapless::Vec<u8, SIGNATURE_BYTES>,
}

/// A signature in borrowed bytes; `Display` is its text form.
#[derive(Clone, Copy, PartialEq, Eq)]
pub struct Signature<'a> {
    /// Validated on construction, so that look-ups need not parse all of it.
    bytes: &'a [u8],
}

impl Definition {
    /// A function without arguments and results.
    pub fn new(name: &str) -> Result<Self, Error> {
        Builder::new(name).map(Builder::finish)
    }

    /// The same function with the variables of `parameters` as its arguments; their values don't matter.
    pub fn arguments(self, parameters: &ParametersView) -> Result<Self, Error> {
        let signature = self.signature();
        let mut builder = Builder::of(signature.name(), specs_of(parameters), signature.results())?;
        builder.sections_of(signature)?;
        Ok(builder.finish())
    }

    /// The same function with the variables of `parameters` as its results; their values don't matter.
    ///
    /// A result with the name of an argument is the same variable, so it has the same type and size.
    pub fn results(self, parameters: &ParametersView) -> Result<Self, Error> {
        let signature = self.signature();
        let mut builder = Builder::of(signature.name(), signature.arguments(), specs_of(parameters))?;
        builder.sections_of(signature)?;
        Ok(builder.finish())
    }

    /// The function's name.
    pub fn name(&self) -> &str {
        self.signature().name()
    }

    /// The signature.
    pub fn signature(&self) -> Signature<'_> {
        Signature::of_checked(&self.bytes)
    }

    /// The encoded signature.
    pub fn as_bytes(&self) -> &[u8] {
        &self.bytes
    }

    /// The same function with the variables of `parameters` as the progress of its calls; their values don't matter.
    ///
    /// ```
    /// # use cara_core::{Definition, distribution::parameters::Parameters};
    /// let mut left = Parameters::new();
    /// left.add_float("left", 1)?;
    /// let go_to = Definition::new("go_to")?.progress(&left)?;
    /// assert_eq!(go_to.to_string(), "go_to() progress (left: float)");
    /// # Ok::<(), cara_core::error::Error>(())
    /// ```
    pub fn progress(self, parameters: &ParametersView) -> Result<Self, Error> {
        self.declaring(specs_of(parameters), self.signature().failure())
    }

    /// The same function with the variables of `parameters` as the values of its failures; their values don't matter.
    pub fn failure(self, parameters: &ParametersView) -> Result<Self, Error> {
        self.declaring(self.signature().progress(), specs_of(parameters))
    }

    fn declaring<'a>(
        &self,
        mut progress: impl Iterator<Item = VariableSpec<'a>>,
        mut failure: impl Iterator<Item = VariableSpec<'a>>,
    ) -> Result<Self, Error> {
        let signature = self.signature();
        let mut builder = Builder::of(signature.name(), signature.arguments(), signature.results())?;
        progress.try_for_each(|spec| builder.declare(Section::Progress, spec))?;
        failure.try_for_each(|spec| builder.declare(Section::Failure, spec))?;
        Ok(builder.finish())
    }
}

/// The variables of `parameters`, as specs.
fn specs_of(parameters: &ParametersView) -> impl Iterator<Item = VariableSpec<'_>> {
    parameters.iter().map(|variable| VariableSpec {
        name: variable.name,
        kind: variable.kind,
        size: variable.size,
        inner: variable.value.inner,
    })
}

/// The section with help. Sections with greater numbers follow it.
pub(super) const HELP_SECTION: u8 = 3;

/// Sections of a signature behind its results.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Section {
    Progress = 1,
    Failure = 2,
}

impl Section {
    pub(super) const ALL: [(Self, &'static str); 2] = [(Self::Progress, "progress"), (Self::Failure, "fails")];
}

impl<'a> Signature<'a> {
    /// Checks an encoded signature; [`Error::Malformed`] if [`Definition`] could not have made it.
    ///
    /// Drops the help if the feature `help` is off, or if the signature would be too long with it.
    pub fn decode(bytes: &'a [u8]) -> Result<Self, Error> {
        let (name, arguments, results) = Self::split(bytes).ok_or(Error::Malformed)?;
        let whole = Self { bytes };
        // Drop sections of later versions.
        let with_help = whole.in_front_of(HELP_SECTION.saturating_add(1));
        let has_room = HELP && with_help.bytes.len() <= SIGNATURE_BYTES;
        let this = if has_room { with_help } else { whole.without_help() };
        if this.bytes.len() > SIGNATURE_BYTES {
            return Err(Error::Malformed);
        }
        let rebuilt = Builder::of(name, arguments, results).and_then(|mut builder| builder.sections_of(this));
        rebuilt.map(|()| this).map_err(|_| Error::Malformed)
    }

    /// The function's name.
    pub fn name(&self) -> &'a str {
        let name = self.behind_length().and_then(|(length, rest)| rest.get(..length));
        name.and_then(|name| core::str::from_utf8(name).ok()).unwrap_or_default()
    }

    /// The arguments that a caller must pass.
    #[cfg_attr(not(target_os = "none"), inline)]
    pub fn arguments(&self) -> VariableSpecs<'a> {
        VariableSpecs::of_checked(self.behind_length().and_then(|(length, rest)| rest.get(length..)))
    }

    /// The results that a caller gets.
    #[cfg_attr(not(target_os = "none"), inline)]
    pub fn results(&self) -> VariableSpecs<'a> {
        VariableSpecs::of_checked(self.arguments().behind())
    }

    /// The variables of progress reports.
    pub fn progress(&self) -> VariableSpecs<'a> {
        self.section(Section::Progress as u8)
    }

    /// The values of failures.
    pub fn failure(&self) -> VariableSpecs<'a> {
        self.section(Section::Failure as u8)
    }

    /// The signature without help.
    pub(crate) fn without_help(self) -> Self {
        self.in_front_of(HELP_SECTION)
    }

    /// The signature up to the section `end`, and without those that follow it.
    fn in_front_of(self, end: u8) -> Self {
        let mut rest = self.results().behind();
        while let Some((&section, behind)) = rest.and_then(<[u8]>::split_first) {
            if section >= end {
                break;
            }
            rest = VariableSpecs::of_checked(Some(behind)).behind();
        }
        let length = self.bytes.len().saturating_sub(rest.map_or(0, <[u8]>::len));
        Self { bytes: self.bytes.get(..length).unwrap_or(self.bytes) }
    }

    pub(super) fn section(&self, wanted: u8) -> VariableSpecs<'a> {
        let mut rest = self.results().behind();
        while let Some((&section, behind)) = rest.and_then(<[u8]>::split_first) {
            let specs = VariableSpecs::of_checked(Some(behind));
            if section == wanted {
                return specs;
            }
            rest = specs.behind();
        }
        VariableSpecs::of_checked(None)
    }

    /// The length of the name, and the bytes that follow the length.
    #[inline]
    fn behind_length(&self) -> Option<(usize, &'a [u8])> {
        self.bytes.split_first().map(|(length, rest)| (usize::from(*length), rest))
    }

    /// The encoded signature.
    pub const fn as_bytes(&self) -> &'a [u8] {
        self.bytes
    }

    /// An owned copy.
    pub fn to_definition(&self) -> Definition {
        // Cannot fail: a checked signature is no longer than a definition.
        Definition { bytes: heapless::Vec::from_slice(self.bytes).unwrap_or_default() }
    }

    /// Capacity in bytes of a `Parameters` with all arguments and results, as the callee's has; lists count as empty.
    pub fn parameters_bytes(&self) -> u32 {
        let arguments = self.arguments();
        let only_results = self.results().raw().filter(|result| arguments.raw().all(|known| known.name != result.name));
        let bytes = arguments
            .raw()
            .chain(only_results)
            .try_fold(0_usize, |sum, spec| sum.checked_add(bytes_of_variable(spec)?));
        bytes.map_or(u32::MAX, saturate)
    }

    /// A signature from bytes that were checked when they were stored. Only for those of [`as_bytes`](Self::as_bytes): what reads
    /// others may recurse as deep as they say.
    #[doc(hidden)]
    pub const fn of_checked(bytes: &'a [u8]) -> Self {
        Self { bytes }
    }

    /// Name, arguments and results, all of which are well-formed.
    fn split(bytes: &'a [u8]) -> Option<(&'a str, VariableSpecs<'a>, VariableSpecs<'a>)> {
        let (&length, rest) = bytes.split_first()?;
        let (name, rest) = rest.split_at_checked(usize::from(length))?;
        let name = core::str::from_utf8(name).ok()?;
        let (arguments, rest) = VariableSpecs::split(rest)?;
        let (results, mut rest) = VariableSpecs::split(rest)?;
        let mut last = 0;
        while let Some((&section, behind)) = rest.split_first() {
            let specs;
            (specs, rest) = VariableSpecs::split(behind)?;
            if section <= core::mem::replace(&mut last, section) || specs.left == 0 {
                return None;
            }
        }
        Some((name, arguments, results))
    }
}

/// Builds a signature variable by variable, and checks all rules about signatures.
pub(super) struct Builder {
    bytes: heapless::Vec<u8, SIGNATURE_BYTES>,
    arguments_at: usize,
    results_at: Option<usize>,
    /// The present section, and the offset of its count.
    section: Option<(Section, usize)>,
}

impl Builder {
    /// Starts with the arguments and results of a function.
    fn of<'a>(
        name: &str,
        mut arguments: impl Iterator<Item = VariableSpec<'a>>,
        mut results: impl Iterator<Item = VariableSpec<'a>>,
    ) -> Result<Self, Error> {
        let mut builder = Self::new(name)?;
        arguments.try_for_each(|argument| builder.argument(argument))?;
        results.try_for_each(|result| builder.result(result))?;
        Ok(builder)
    }

    /// Adds the sections of a signature. Units without the feature `details` skip them.
    fn sections_of(&mut self, signature: Signature<'_>) -> Result<(), Error> {
        if !DETAILS {
            return Ok(());
        }
        let mut all = Section::ALL.into_iter();
        all.try_for_each(|(section, _)| {
            signature.section(section as u8).try_for_each(|spec| self.declare(section, spec))
        })
    }

    /// Adds a variable to a section; sections follow the results, in ascending order.
    pub(super) fn declare(&mut self, section: Section, spec: VariableSpec<'_>) -> Result<(), Error> {
        self.begin_results()?;
        let at = match self.section {
            Some((started, at)) if started == section => at,
            _ => {
                self.push(&[section as u8, 0])?;
                self.bytes.len().saturating_sub(1)
            }
        };
        self.section = Some((section, at));
        self.check_free(at, spec.name)?;
        if self.list(at).count() >= VARIABLES {
            return Err(Error::Full(Limit::Variables));
        }
        self.variable(at, spec)
    }

    pub(super) fn new(name: &str) -> Result<Self, Error> {
        check_name(name)?;
        let mut builder = Self { bytes: heapless::Vec::new(), arguments_at: 0, results_at: None, section: None };
        builder.push(&[name.len() as u8])?;
        builder.push(name.as_bytes())?;
        builder.arguments_at = builder.bytes.len();
        // Reserve a byte for the number of results, so that `finish` cannot fail.
        builder.push(&[0])?;
        Ok(builder)
    }

    /// Adds an argument; the arguments come before the results.
    pub(super) fn argument(&mut self, spec: VariableSpec<'_>) -> Result<(), Error> {
        self.check_free(self.arguments_at, spec.name)?;
        if self.list(self.arguments_at).count() >= VARIABLES {
            return Err(Error::Full(Limit::Variables));
        }
        self.variable(self.arguments_at, spec)
    }

    /// Adds a result. A result with the name of an argument is the same variable; all others count towards the limit, since one
    /// `Parameters` must hold both.
    pub(super) fn result(&mut self, spec: VariableSpec<'_>) -> Result<(), Error> {
        let results_at = self.begin_results()?;
        self.check_free(results_at, spec.name)?;
        let arguments = self.list(self.arguments_at);
        let results = self.list(results_at);
        match arguments.named(spec.name) {
            Some(argument) => check_same(argument, spec, results.count())?,
            None => {
                let others = results.filter(|result| arguments.named(result.name).is_none()).count();
                if arguments.count().saturating_add(others) >= VARIABLES {
                    return Err(Error::Full(Limit::Variables));
                }
            }
        }
        self.variable(results_at, spec)
    }

    pub(super) fn finish(mut self) -> Definition {
        // `variable` has kept a byte free for this.
        let _ = self.begin_results();
        Definition { bytes: self.bytes }
    }

    fn begin_results(&mut self) -> Result<usize, Error> {
        if let Some(results_at) = self.results_at {
            return Ok(results_at);
        }
        let results_at = self.bytes.len();
        self.push(&[0])?;
        self.results_at = Some(results_at);
        Ok(results_at)
    }

    fn variable(&mut self, list_at: usize, spec: VariableSpec<'_>) -> Result<(), Error> {
        check_name(spec.name)?;
        check_inner(spec.raw())?;
        let end = self.bytes.len().saturating_add(spec.name.len()).saturating_add(spec.inner.len()).saturating_add(6);
        let count_of_results = usize::from(self.results_at.is_none());
        if end.saturating_add(count_of_results) > SIGNATURE_BYTES {
            return Err(Error::Full(Limit::SignatureBytes));
        }
        self.push(&[spec.kind as u8, spec.name.len() as u8])?;
        self.push(&spec.size.to_le_bytes())?;
        self.push(spec.name.as_bytes())?;
        self.push(spec.inner)?;
        if let Some(count) = self.bytes.get_mut(list_at) {
            *count = count.saturating_add(1);
        }
        Ok(())
    }

    fn check_free(&self, list_at: usize, name: &str) -> Result<(), Error> {
        if self.list(list_at).named(name).is_some() { Err(Error::NameTaken) } else { Ok(()) }
    }

    fn list(&self, at: usize) -> VariableSpecs<'_> {
        let bytes = self.bytes.get(at..).unwrap_or_default();
        VariableSpecs::split(bytes).map_or(VariableSpecs { left: 0, rest: &[] }, |(list, _)| list)
    }

    fn push(&mut self, bytes: &[u8]) -> Result<(), Error> {
        self.bytes.extend_from_slice(bytes).map_err(|_| Error::Full(Limit::SignatureBytes))
    }
}

fn check_same(argument: VariableSpec<'_>, result: VariableSpec<'_>, position: usize) -> Result<(), Error> {
    let index = position as u8;
    if argument.kind != result.kind || argument.inner != result.inner {
        return Err(Error::WrongType { index });
    }
    if argument.size != result.size {
        return Err(Error::WrongSize { index, expected: argument.size, found: result.size });
    }
    Ok(())
}

impl fmt::Display for Signature<'_> {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let results = self.results();
        write!(f, "{}{}", self.name(), self.arguments())?;
        if results.left > 0 {
            write!(f, " -> {results}")?;
        }
        for (section, word) in Section::ALL.iter().filter(|_| DETAILS) {
            let specs = self.section(*section as u8);
            if specs.left > 0 {
                write!(f, " {word} {specs}")?;
            }
        }
        Ok(())
    }
}

impl fmt::Debug for Signature<'_> {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        fmt::Display::fmt(self, f)
    }
}

impl fmt::Display for Definition {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        fmt::Display::fmt(&self.signature(), f)
    }
}

impl fmt::Debug for Definition {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        fmt::Display::fmt(self, f)
    }
}

#[cfg(test)]
pub(super) mod tests;
