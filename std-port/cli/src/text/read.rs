//! From characters to a call as it is written, before its types are known.

use std::ops::Range;

use cara_std::DEPTH;

use super::Mistake;

const A_VALUE: &str = "a number, true, false, null, \"text\", 0x…, [ … ] or { … }";

/// Lists and records inside each other that are read: one more than a signature has, for the arguments themselves and for
/// arrays of a fixed size.
const DEEPEST: usize = DEPTH + 2;
const A_NAME: &str = "a name of letters, digits, '_', '-', '.' or '/'";

/// A piece of the text.
#[derive(Clone, Debug, PartialEq)]
pub(crate) struct Placed<T> {
    pub(crate) at: Range<usize>,
    pub(crate) value: T,
}

/// A call as it is written.
#[derive(Clone, Debug, PartialEq)]
pub(crate) struct Written<'t> {
    pub(crate) text: &'t str,
    pub(crate) function: Placed<&'t str>,
    pub(crate) arguments: Vec<Argument<'t>>,
    /// Where another argument could be put.
    pub(crate) end: usize,
}

/// A name and its value.
pub(crate) type Argument<'t> = (Placed<&'t str>, Placed<Value<'t>>);

/// An argument's value.
#[derive(Clone, Debug, PartialEq)]
pub(crate) enum Value<'t> {
    One(Literal<'t>),
    Several(Vec<Placed<Value<'t>>>),
    Fields(Vec<Argument<'t>>),
}

/// A single value. Whether a number is whole, has a fraction or is a row of bytes is the signature's to say.
#[derive(Clone, Debug, PartialEq)]
pub(crate) enum Literal<'t> {
    Number(&'t str),
    Truth(bool),
    Text(String),
    /// An optional value that is absent.
    Null,
}

/// Reads a call.
pub(crate) fn read(text: &str) -> Result<Written<'_>, Mistake> {
    let mut reader = Reader { text, at: 0, depth: 0 };
    let function = reader.name("the function's name is missing")?;
    let mut arguments = Vec::new();
    let mut end = text.len();
    for (opening, closing) in [('(', ')'), ('{', '}')] {
        if reader.takes(opening) {
            arguments = reader.arguments(closing)?;
            end = reader.at - 1;
            break;
        }
    }
    match reader.peek() {
        None => Ok(Written { text, function, arguments, end }),
        Some(_) => Err(Mistake::new(reader.at..text.len(), "the call has ended before this", "nothing more")),
    }
}

struct Reader<'t> {
    text: &'t str,
    at: usize,
    /// Brackets and braces that are open.
    depth: usize,
}

impl<'t> Reader<'t> {
    fn rest(&self) -> &'t str {
        self.text.get(self.at..).unwrap_or_default()
    }

    /// The next character that is no white space; the reader is placed before it.
    fn peek(&mut self) -> Option<char> {
        self.at = self.text.len() - self.rest().trim_start().len();
        self.rest().chars().next()
    }

    fn takes(&mut self, wanted: char) -> bool {
        let found = self.peek() == Some(wanted);
        self.at += if found { wanted.len_utf8() } else { 0 };
        found
    }

    /// The place of the next character, or of the end.
    fn here(&mut self) -> Range<usize> {
        let length = self.peek().map_or(0, char::len_utf8);
        self.at..self.at + length
    }

    fn word(&mut self, belongs: impl Fn(char) -> bool) -> Placed<&'t str> {
        self.peek();
        let rest = self.rest();
        let value = &rest[..rest.find(|c| !belongs(c)).unwrap_or(rest.len())];
        let at = self.at..self.at + value.len();
        self.at = at.end;
        Placed { at, value }
    }

    /// A name, which may stand in quotes, as in JSON.
    fn name(&mut self, missing: &str) -> Result<Placed<&'t str>, Mistake> {
        if self.peek() == Some('"') {
            let Placed { at, .. } = self.string()?;
            return Ok(Placed { value: &self.text[at.start + 1..at.end - 1], at });
        }
        let name = self.word(|c| c.is_ascii_alphanumeric() || matches!(c, '_' | '-' | '.' | '/'));
        if name.value.is_empty() { Err(Mistake::new(self.here(), missing, A_NAME)) } else { Ok(name) }
    }

    /// What follows the opening parenthesis or brace, up to and with the closing one.
    fn arguments(&mut self, closing: char) -> Result<Vec<Argument<'t>>, Mistake> {
        let mut arguments = Vec::new();
        while !self.takes(closing) {
            let name = self.name("an argument begins with its name")?;
            if !self.takes(':') {
                return Err(Mistake::new(self.here(), "an argument's name and value are parted by a colon", "':'"));
            }
            arguments.push((name, self.value()?));
            self.next_or(closing, if closing == ')' { "',' or ')'" } else { "',' or '}'" })?;
        }
        Ok(arguments)
    }

    /// A comma, or the closing bracket, which stays.
    fn next_or(&mut self, closing: char, expected: &str) -> Result<(), Mistake> {
        if self.takes(',') || self.peek() == Some(closing) {
            return Ok(());
        }
        let what =
            if self.peek().is_none() { "the text ends too early" } else { "two values need a comma between them" };
        Err(Mistake::new(self.here(), what, expected))
    }

    fn value(&mut self) -> Result<Placed<Value<'t>>, Mistake> {
        let start = self.here().start;
        if matches!(self.peek(), Some('[' | '{')) && self.depth >= DEEPEST {
            let expected = format!("at most {DEPTH} lists and records inside each other");
            return Err(Mistake::new(self.here(), "this is too deep inside others", expected));
        }
        self.depth += 1;
        let value = if self.takes('[') {
            let mut several = Vec::new();
            while !self.takes(']') {
                several.push(self.value()?);
                self.next_or(']', "',' or ']'")?;
            }
            Value::Several(several)
        } else if self.takes('{') {
            Value::Fields(self.arguments('}')?)
        } else {
            Value::One(self.literal()?.value)
        };
        self.depth -= 1;
        Ok(Placed { at: start..self.at, value })
    }

    fn literal(&mut self) -> Result<Placed<Literal<'t>>, Mistake> {
        if self.peek() == Some('"') {
            return self.string();
        }
        let word = self.word(|c| c.is_alphanumeric() || matches!(c, '_' | '-' | '.' | '+' | '/'));
        let value = match word.value {
            "" => return Err(Mistake::new(self.here(), "a value is missing", A_VALUE)),
            "true" => Literal::Truth(true),
            "false" => Literal::Truth(false),
            "null" => Literal::Null,
            number if looks_like_a_number(number) => Literal::Number(number),
            other => {
                let what = format!("`{other}` is no value; text goes in double quotes");
                return Err(Mistake::new(word.at, what, A_VALUE));
            }
        };
        Ok(Placed { at: word.at, value })
    }

    /// A string, from its opening quote on.
    fn string(&mut self) -> Result<Placed<Literal<'t>>, Mistake> {
        let start = self.at;
        let mut escaped = true; // The opening quote closes nothing.
        let length = self.rest().find(|c| {
            let closes = c == '"' && !escaped;
            escaped = c == '\\' && !escaped;
            closes
        });
        let Some(length) = length else {
            return Err(Mistake::new(start..self.text.len(), "the text's closing quote is missing", "'\"' at its end"));
        };
        let at = start..start + length + 1;
        self.at = at.end;
        let raw = &self.text[at.clone()];
        let value = serde_json::from_str(raw).map_err(|_| wrong_escape(raw, start))?;
        Ok(Placed { at, value: Literal::Text(value) })
    }
}

/// The first character or escape of a string that JSON does not allow.
fn wrong_escape(raw: &str, start: usize) -> Mistake {
    let expected = r#"\" \\ \/ \b \f \n \r \t or \u and four hexadecimal digits"#;
    let control = raw.find(|c| c < ' ');
    if let Some(at) = control {
        let what = "control characters are written as escapes in a text";
        return Mistake::new(start + at..start + at + 1, what, expected);
    }
    let mut at = 0;
    while let Some(found) = raw[at..].find('\\') {
        at += found;
        let escape: String = raw[at..].chars().take(if raw[at + 1..].starts_with('u') { 6 } else { 2 }).collect();
        let pair: String = raw[at..].chars().take(12).collect();
        let good = |text: &str| serde_json::from_str::<String>(&format!("\"{text}\"")).is_ok();
        match (good(&escape), good(&pair)) {
            (true, _) => at += escape.len(),
            (false, true) if escape.starts_with("\\u") => at += pair.len(),
            _ => {
                return Mistake::new(start + at..start + at + escape.len(), "this escape is not one of JSON", expected);
            }
        }
    }
    Mistake::new(start..start + raw.len(), "this is no text", expected)
}

fn looks_like_a_number(word: &str) -> bool {
    let unsigned = word.strip_prefix(['-', '+']).unwrap_or(word);
    unsigned.starts_with(|c: char| c.is_ascii_digit() || c == '.') || matches!(unsigned, "NaN" | "inf")
}
