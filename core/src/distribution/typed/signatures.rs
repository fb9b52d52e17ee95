//! Signatures that are made at compile time, and the rules that they obey.

use super::Units;
use crate::ability::{HELP, NESTED};
use crate::config::{DEPTH, FAILURE_VALUES_BYTES, HELP_BYTES, NAME_BYTES, SIGNATURE_BYTES, UNIT_BYTES, VARIABLES};
use crate::distribution::function::{HELP_SECTION, Signature, VariableSpec};
use crate::distribution::name::is_name_byte;
use crate::distribution::parameters::Type;
use crate::distribution::{help, spec};

/// All variables of a function.
#[derive(Clone, Copy, Debug)]
pub struct Declared<'a> {
    /// The arguments.
    pub arguments: &'a [VariableSpec<'a>],
    /// The results.
    pub results: &'a [VariableSpec<'a>],
    /// The variables of progress reports.
    pub progress: &'a [VariableSpec<'a>],
    /// The values of failures.
    pub fails: &'a [VariableSpec<'a>],
    /// One line of help: what the function does.
    pub help: &'a str,
    /// Units of variables, from the function and from its structs.
    pub units: &'a [Units],
}

impl Declared<'_> {
    /// Bytes of the signature of a function with this name.
    pub const fn encoded_bytes(&self, name: &str) -> usize {
        let fixed = name.len().saturating_add(3);
        let bytes = fixed.saturating_add(bytes_of_specs(self.arguments)).saturating_add(bytes_of_specs(self.results));
        let bytes = bytes.saturating_add(bytes_of_section(self.progress)).saturating_add(bytes_of_section(self.fails));
        let with_help = bytes.saturating_add(self.bytes_of_help());
        // If the signature would become too long, leave out the help.
        if with_help > SIGNATURE_BYTES { bytes } else { with_help }
    }

    /// 0 if the core is built without help.
    const fn bytes_of_help(&self) -> usize {
        let mut bytes = if self.help.is_empty() { 0 } else { self.help.len().saturating_add(6) };
        let mut units = EachUnit { now: &[], later: self.units };
        while let Some((variable, unit)) = units.next() {
            bytes = bytes.saturating_add(variable.len()).saturating_add(unit.len()).saturating_add(7);
        }
        if bytes == 0 || !HELP { 0 } else { bytes.saturating_add(2) }
    }
}

/// The units of several lists, one after the other.
struct EachUnit<'a> {
    now: Units,
    later: &'a [Units],
}

impl EachUnit<'_> {
    const fn next(&mut self) -> Option<(&'static str, &'static str)> {
        loop {
            if let Some((unit, rest)) = self.now.split_first() {
                self.now = rest;
                return Some(*unit);
            }
            let Some((next, rest)) = self.later.split_first() else { return None };
            (self.now, self.later) = (*next, rest);
        }
    }
}

/// 0 without variables: then the section is left out.
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

/// Capacity in bytes that a variable takes in a `Parameters` beside its name. A list or record counts twice, since the old value
/// stays until the new one is complete: once at its shortest, once at its longest.
const fn bytes_of_value(spec: VariableSpec<'_>) -> usize {
    if !spec.kind.is_nested() {
        return (spec.size as usize).saturating_mul(spec.kind.width());
    }
    let inner = Insides::of(spec.kind, spec.size, spec.inner, 0);
    inner.least.saturating_add(inner.longest).saturating_add(spec.inner.len())
}

/// What is known of an encoded type at compile time.
struct Insides<'a> {
    /// Bytes of the shortest and of the longest value in a block.
    least: usize,
    longest: usize,
    /// The bytes that follow.
    rest: &'a [u8],
    /// The rule that it breaks; empty if none.
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
        if !NESTED {
            return Self::wrong("lists and structs in structs need the feature `nested` of the core");
        }
        if depth >= DEPTH {
            return Self::wrong("lists and structs are in each other at most 8 deep");
        }
        if matches!(kind, Type::List) { Self::of_list(size, rest, depth) } else { Self::of_record(size, rest, depth) }
    }

    const fn of_list(size: u32, rest: &'a [u8], depth: usize) -> Self {
        let Some((kind, element_size, rest)) = spec::split_element(rest) else {
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

/// The rule that the inner types of a variable break; empty if none.
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

/// Bytes of the inner types of a list with such elements.
pub const fn element_bytes(element: VariableSpec<'_>) -> usize {
    element.inner.len().saturating_add(5)
}

/// The inner types of a list with such elements, in [`element_bytes`] bytes.
pub const fn element<const BYTES: usize>(element: VariableSpec<'_>) -> [u8; BYTES] {
    let mut bytes = [0; BYTES];
    let rest = put(&mut bytes, &[element.kind as u8]);
    put(put(rest, &element.size.to_le_bytes()), element.inner);
    bytes
}

/// Bytes of the inner types of a record with such fields.
pub const fn fields_bytes(fields: &[VariableSpec<'_>]) -> usize {
    bytes_of_specs(fields)
}

/// The inner types of a record with such fields, in [`fields_bytes`] bytes. Fails if two fields have the same name.
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

/// Capacity in bytes of a `Parameters` with all arguments and results of a function.
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

/// A signature that was encoded at compile time.
#[derive(Debug)]
pub struct Encoded<const BYTES: usize> {
    bytes: [u8; BYTES],
}

impl<const BYTES: usize> Encoded<BYTES> {
    /// Encodes a signature, in [`Declared::encoded_bytes`] bytes, or returns the rule that it breaks.
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
        let rest = if rest.is_empty() { rest } else { put_help(rest, &declared) };
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

/// Checks the rules of a [`Definition`](super::function::Definition).
const fn check(name: &str, declared: &Declared<'_>) -> Result<(), &'static str> {
    let Declared { arguments, results, progress, fails, help, units } = *declared;
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
    if help.len() > HELP_BYTES {
        return Err("a line of help has at most `HELP_BYTES` bytes");
    }
    let mut units = EachUnit { now: &[], later: units };
    while let Some((variable, unit)) = units.next() {
        if unit.len() > UNIT_BYTES {
            return Err("a unit has at most `UNIT_BYTES` bytes");
        }
        let mut others = EachUnit { now: units.now, later: units.later };
        while let Some((other, theirs)) = others.next() {
            if is_same(variable, other) && !is_same(unit, theirs) {
                return Err("variables of one name have one unit");
            }
        }
    }
    if declared.encoded_bytes(name) > SIGNATURE_BYTES {
        return Err(
            "the names of a function, its arguments and its results are too long together: `SIGNATURE_BYTES` bytes with 6 for each",
        );
    }
    Ok(())
}

/// Checks the rules of one list of variables.
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

pub(super) const fn position(specs: &[VariableSpec<'_>], name: &str) -> Option<u8> {
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

/// Writes `bytes`, and returns the rest of `to`.
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

const fn put_help<'a>(to: &'a mut [u8], declared: &Declared<'_>) -> &'a mut [u8] {
    if declared.bytes_of_help() == 0 {
        return to;
    }
    let (mut lines, mut units) = (!declared.help.is_empty() as u8, EachUnit { now: &[], later: declared.units });
    while units.next().is_some() {
        lines = lines.saturating_add(1);
    }
    let mut to = put(to, &[HELP_SECTION, lines]);
    if !declared.help.is_empty() {
        to = put(put(to, &help::head(false, declared.help.len())), declared.help.as_bytes());
    }
    units = EachUnit { now: &[], later: declared.units };
    while let Some((variable, unit)) = units.next() {
        to = put(to, &help::head(true, variable.len().saturating_add(unit.len()).saturating_add(1)));
        to = put(put(put(to, variable.as_bytes()), b" "), unit.as_bytes());
    }
    to
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
