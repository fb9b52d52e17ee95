//! The text form of a signature, used by `show_functions`, the command line and the documentation, and its parser.
//!
//! `pos_info(position: int[2]) -> (position: int[2])`; `int`, `float` and `bool` alone have the size 1; a function without
//! results has no arrow. `progress (left: float)` and `fails (at: int[2])` may follow. A list of at most 8 `int` is `int[..8]`, a
//! record `{id: string[32], x: float}`. A list of at most one, `int[..1]`, is an optional value, `int?`. Spaces between words are
//! ignored.

use core::fmt;

use crate::bytes::rotate_up;
use crate::error::{Error, Limit};

use super::function::{Builder, Definition, VariableSpec};
use super::name::is_name_byte;
use super::value::Type;
use crate::ability::{DETAILS, NESTED};
use crate::config::{DEPTH, SIGNATURE_BYTES};

/// The position of a syntax error, and what is expected there.
#[derive(Clone, Copy, Debug, PartialEq, Eq, thiserror::Error)]
#[error("expected {expected} at byte {position}")]
pub struct ParseError {
    /// Bytes before the error.
    pub position: usize,
    /// What was expected there.
    pub expected: Expected,
}

/// What a [`ParseError`] expected at its position.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
#[non_exhaustive]
pub enum Expected {
    /// A name.
    Name,
    /// A name that is not too long.
    ShorterName,
    /// A name that the list doesn't have yet.
    NewName,
    /// The type and size of the argument of the same name.
    SameAsArgument,
    /// A type.
    Type,
    /// Fewer lists and records inside each other.
    ShallowerType,
    /// A size in 32 bits.
    Size,
    /// Fewer variables.
    FewerVariables,
    /// A signature that takes fewer bytes.
    ShorterSignature,
    /// This character.
    Character(char),
    /// A further variable or the end of the list.
    CommaOrParenthesis,
    /// A further field or the end of the record.
    CommaOrBrace,
    /// The results or the end of the text.
    ArrowOrEnd,
    /// The end of the text.
    End,
}

impl fmt::Display for Expected {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(match self {
            Self::Name => "a name",
            Self::ShorterName => "a shorter name",
            Self::NewName => "a name that is not in the list yet",
            Self::SameAsArgument => "the type and size of the argument of this name",
            Self::Type if NESTED => "a type: int, float, string, bool, bytes or {…}",
            Self::Type => "a type: int, float, string, bool or bytes",
            Self::ShallowerType => "at most 8 lists and records inside each other",
            Self::Size => "a size: a number of 32 bits",
            Self::FewerVariables => "fewer variables",
            Self::ShorterSignature => "a shorter signature",
            Self::Character(character) => return write!(f, "'{character}'"),
            Self::CommaOrParenthesis => "',' or ')'",
            Self::CommaOrBrace => "',' or '}'",
            Self::ArrowOrEnd => "'->' or the end",
            Self::End => "the end",
        })
    }
}

impl Definition {
    /// A function from its text form, as in `go_to(position: int[2]) -> (done: bool)`.
    ///
    /// ```
    /// let go_to = cara_core::Definition::parse("go_to(position: int[2]) -> (done: bool)").unwrap();
    /// assert_eq!((go_to.name(), go_to.signature().arguments().count()), ("go_to", 1));
    /// ```
    pub fn parse(text: &str) -> Result<Self, ParseError> {
        parse(text)
    }

    /// A stream from its text form, as in `pose(position: float[2])`: a function without arguments whose results are the values.
    ///
    /// ```
    /// let pose = cara_core::Definition::stream("pose(position: float[2])").unwrap();
    /// assert_eq!(pose.to_string(), "pose() -> (position: float[2])");
    /// ```
    pub fn stream(text: &str) -> Result<Self, ParseError> {
        parse_stream(text)
    }
}

impl core::str::FromStr for Definition {
    type Err = ParseError;
    fn from_str(text: &str) -> Result<Self, ParseError> {
        Self::parse(text)
    }
}

/// Reads a signature; see [`Definition::parse`].
fn parse(text: &str) -> Result<Definition, ParseError> {
    let mut parser = Parser { text: text.as_bytes(), position: 0 };
    let (at, name) = parser.name()?;
    let mut builder = Builder::new(name).map_err(|error| explain(at, error))?;
    parser.list(|spec| builder.argument(spec))?;
    parser.skip_spaces();
    let mut expected = Expected::ArrowOrEnd;
    if parser.take(b"->") {
        parser.list(|spec| builder.result(spec))?;
        expected = Expected::End;
    }
    for (section, word) in super::function::Section::ALL.into_iter().filter(|_| DETAILS) {
        parser.skip_spaces();
        if parser.take(word.as_bytes()) {
            parser.list(|spec| builder.declare(section, spec))?;
            expected = Expected::End;
        }
    }
    parser.skip_spaces();
    if parser.rest().is_empty() { Ok(builder.finish()) } else { Err(parser.error(expected)) }
}

/// Reads a stream; see [`Definition::stream`].
fn parse_stream(text: &str) -> Result<Definition, ParseError> {
    let mut parser = Parser { text: text.as_bytes(), position: 0 };
    let (at, name) = parser.name()?;
    let mut builder = Builder::new(name).map_err(|error| explain(at, error))?;
    parser.list(|spec| builder.result(spec))?;
    parser.skip_spaces();
    if parser.rest().is_empty() { Ok(builder.finish()) } else { Err(parser.error(Expected::End)) }
}

const IS_NESTED: bool = Type::List.is_nested();

/// Inner types of a list or record, as encoded in a signature.
type Inner = heapless::Vec<u8, { if IS_NESTED { SIGNATURE_BYTES } else { 0 } }>;

/// Inserts `bytes` at offset `at`.
fn insert(inner: &mut Inner, at: usize, bytes: &[u8]) -> Result<(), ()> {
    inner.extend_from_slice(bytes).map_err(|_| ())?;
    if let Some(tail) = inner.get_mut(at..) {
        rotate_up(tail, bytes.len());
    }
    Ok(())
}

const fn too_long(position: usize) -> ParseError {
    ParseError { position, expected: Expected::ShorterSignature }
}

struct Parser<'a> {
    text: &'a [u8],
    position: usize,
}

impl<'a> Parser<'a> {
    fn list(&mut self, mut add: impl FnMut(VariableSpec<'_>) -> Result<(), Error>) -> Result<(), ParseError> {
        self.character('(')?;
        self.skip_spaces();
        if self.take(b")") {
            return Ok(());
        }
        loop {
            let (at, name) = self.name()?;
            self.character(':')?;
            let mut inner = Inner::new();
            let (kind, size) = self.whole_type(&mut inner, 0)?;
            add(VariableSpec { name, kind, size, inner: &inner }).map_err(|error| explain(at, error))?;
            self.skip_spaces();
            if self.take(b")") {
                return Ok(());
            }
            if !self.take(b",") {
                return Err(self.error(Expected::CommaOrParenthesis));
            }
        }
    }

    /// A type with its inner types, which are appended to `inner`.
    fn whole_type(&mut self, inner: &mut Inner, depth: usize) -> Result<(Type, u32), ParseError> {
        if !IS_NESTED {
            return self.type_and_size();
        }
        let start = inner.len();
        self.skip_spaces();
        let at = self.position;
        let (mut kind, mut size) =
            if self.take(b"{") { (Type::Record, self.fields(inner, depth)?) } else { self.type_and_size()? };
        loop {
            self.skip_spaces();
            let most = if self.take(b"?") {
                1
            } else if self.take(b"[..") {
                let most = self.size()?;
                self.character(']')?;
                most
            } else {
                return Ok((kind, size));
            };
            insert(inner, start, &[kind as u8]).map_err(|()| too_long(at))?;
            insert(inner, start.saturating_add(1), &size.to_le_bytes()).map_err(|()| too_long(at))?;
            (kind, size) = (Type::List, most);
        }
    }

    /// The fields of a record and its closing brace. Returns their number.
    fn fields(&mut self, inner: &mut Inner, depth: usize) -> Result<u32, ParseError> {
        if depth >= DEPTH {
            return Err(self.error(Expected::ShallowerType));
        }
        let mut count = 0_u32;
        loop {
            let (at, name) = self.name()?;
            self.character(':')?;
            let start = inner.len();
            let (kind, size) = self.whole_type(inner, depth.saturating_add(1))?;
            let length =
                u8::try_from(name.len()).map_err(|_| ParseError { position: at, expected: Expected::ShorterName })?;
            let head = [&[kind as u8, length][..], &size.to_le_bytes(), name.as_bytes()];
            let mut to = start;
            for part in head {
                insert(inner, to, part).map_err(|()| too_long(at))?;
                to = to.saturating_add(part.len());
            }
            count = count.saturating_add(1);
            self.skip_spaces();
            if self.take(b"}") {
                return Ok(count);
            }
            if !self.take(b",") {
                return Err(self.error(Expected::CommaOrBrace));
            }
        }
    }

    fn type_and_size(&mut self) -> Result<(Type, u32), ParseError> {
        self.skip_spaces();
        let at = self.position;
        let word = self.word();
        let kind = Type::FLAT.into_iter().find(|kind| kind.word() == word);
        let kind = kind.ok_or(ParseError { position: at, expected: Expected::Type })?;
        self.skip_spaces();
        let is_alone = self.rest().first() != Some(&b'[') || (IS_NESTED && self.rest().starts_with(b"[.."));
        if kind.is_fixed() && is_alone {
            return Ok((kind, 1));
        }
        self.character('[')?;
        let size = self.size()?;
        self.character(']')?;
        Ok((kind, size))
    }

    fn size(&mut self) -> Result<u32, ParseError> {
        self.skip_spaces();
        let at = self.position;
        let size = self.take_while(|byte| byte.is_ascii_digit()).parse();
        size.map_err(|_| ParseError { position: at, expected: Expected::Size })
    }

    fn name(&mut self) -> Result<(usize, &'a str), ParseError> {
        self.skip_spaces();
        let at = self.position;
        let name = self.word();
        if name.is_empty() { Err(self.error(Expected::Name)) } else { Ok((at, name)) }
    }

    fn word(&mut self) -> &'a str {
        self.take_while(is_name_byte)
    }

    fn character(&mut self, character: char) -> Result<(), ParseError> {
        self.skip_spaces();
        if self.take(character.encode_utf8(&mut [0; 4]).as_bytes()) {
            return Ok(());
        }
        Err(self.error(Expected::Character(character)))
    }

    fn skip_spaces(&mut self) {
        self.take_while(|byte| byte.is_ascii_whitespace());
    }

    /// The longest prefix of ASCII bytes that `belongs` accepts.
    fn take_while(&mut self, belongs: impl Fn(u8) -> bool) -> &'a str {
        let rest = self.rest();
        let length = rest.iter().position(|&byte| !belongs(byte)).unwrap_or(rest.len());
        self.position = self.position.saturating_add(length);
        rest.get(..length).and_then(|run| core::str::from_utf8(run).ok()).unwrap_or_default()
    }

    fn take(&mut self, token: &[u8]) -> bool {
        let found = self.rest().starts_with(token);
        if found {
            self.position = self.position.saturating_add(token.len());
        }
        found
    }

    fn rest(&self) -> &'a [u8] {
        self.text.get(self.position..).unwrap_or_default()
    }

    const fn error(&self, expected: Expected) -> ParseError {
        ParseError { position: self.position, expected }
    }
}

/// The syntax error for a variable that breaks a rule about signatures.
const fn explain(position: usize, error: Error) -> ParseError {
    let expected = match error {
        Error::NameTaken => Expected::NewName,
        Error::WrongType { .. } | Error::WrongSize { .. } => Expected::SameAsArgument,
        Error::Full(Limit::NameBytes) => Expected::ShorterName,
        Error::Full(Limit::Variables) => Expected::FewerVariables,
        Error::Full(Limit::Depth) => Expected::ShallowerType,
        Error::Full(_) => Expected::ShorterSignature,
        _ => Expected::Name,
    };
    ParseError { position, expected }
}

#[cfg(test)]
mod tests;
