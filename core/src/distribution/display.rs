//! Values as text. Not linked into firmware that shows no values, nor is the formatting of floats.

use core::fmt::{Display, Formatter, Result, Write};

use super::parameters::{Elements, ParametersInner, ParametersView, Variable};
use super::value::{Type, Value};

impl Display for Value<'_> {
    fn fmt(&self, f: &mut Formatter<'_>) -> Result {
        match self.kind() {
            Type::Int => elements(f, self.size(), self.ints()),
            Type::Float => elements(f, self.size(), self.floats()),
            Type::Bool => elements(f, self.size(), self.bools()),
            Type::String => f.write_str(self.text().unwrap_or_default()),
            Type::List => bracketed(f, self.elements()),
            Type::Record => {
                f.write_char('{')?;
                separated(f, self.fields(), variable)?;
                f.write_char('}')
            }
            Type::Bytes => self.raw().iter().try_for_each(|byte| write!(f, "{byte:02x}")),
        }
    }
}

/// `3`, or `[3, 4]` if there are several.
fn elements<E: Display>(f: &mut Formatter<'_>, size: u32, elements: impl Iterator<Item = E>) -> Result {
    let is_list = size != 1;
    if is_list {
        f.write_char('[')?;
    }
    separated(f, elements, |f, element| element.fmt(f))?;
    if is_list {
        f.write_char(']')?;
    }
    Ok(())
}

fn bracketed(f: &mut Formatter<'_>, elements: Elements<'_>) -> Result {
    f.write_char('[')?;
    separated(f, elements, |f, element| quoted(f, &element))?;
    f.write_char(']')
}

/// `name: value`.
fn variable(f: &mut Formatter<'_>, variable: Variable<'_>) -> Result {
    write!(f, "{}: ", variable.name)?;
    quoted(f, &variable.value)
}

/// The value, text in quotes.
fn quoted(f: &mut Formatter<'_>, value: &Value<'_>) -> Result {
    match value.text() {
        Some(text) => write!(f, "{text:?}"),
        None => Display::fmt(value, f),
    }
}

fn separated<E>(
    f: &mut Formatter<'_>,
    elements: impl Iterator<Item = E>,
    mut write: impl FnMut(&mut Formatter<'_>, E) -> Result,
) -> Result {
    for (index, element) in elements.enumerate() {
        if index > 0 {
            f.write_str(", ")?;
        }
        write(f, element)?;
    }
    Ok(())
}

/// Names and values in order; text is quoted.
///
/// ```
/// let mut pose = cara_core::Parameters::new();
/// pose.add_int("position", 2)?;
/// pose.set_value("position", [3, 4])?;
/// pose.add_string("place", 16)?;
/// pose.set_value("place", "dock")?;
/// assert_eq!(pose.to_string(), r#"position: [3, 4], place: "dock""#);
/// # Ok::<(), cara_core::Error>(())
/// ```
impl Display for ParametersView {
    fn fmt(&self, f: &mut Formatter<'_>) -> Result {
        separated(f, self.iter(), variable)
    }
}

impl<const BYTES: usize> Display for ParametersInner<[u8; BYTES]> {
    fn fmt(&self, f: &mut Formatter<'_>) -> Result {
        Display::fmt(&**self, f)
    }
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used)]
    use std::string::ToString;

    use crate::distribution::parameters::Parameters;

    #[test]
    fn every_type_is_shown() {
        let mut all = Parameters::new();
        assert_eq!(all.to_string(), "");
        all.add_int("one", 1).unwrap();
        all.add_int("none", 0).unwrap();
        all.add_float("charge", 2).unwrap();
        all.set_value("charge", [0.5, -1.0]).unwrap();
        all.add_bool("done", 1).unwrap();
        all.add_bytes("mark", 4).unwrap();
        all.set_value("mark", &[1_u8, 0xff][..]).unwrap();
        all.add_string("text", 8).unwrap();
        all.set_value("text", "a\"b").unwrap();
        let shown = r#"one: 0, none: [], charge: [0.5, -1], done: false, mark: 01ff, text: "a\"b""#;
        assert_eq!(all.to_string(), shown);
        assert_eq!(all.value("text").unwrap().to_string(), "a\"b");
    }
}
