//! A call as it is written, against the function's signature.

use std::ops::Range;

use cara_std::control::json::is_optional;
use cara_std::control::protocol::{Argument, ArgumentValue, Number};
use cara_std::{Signature, Type, VariableSpec};
use serde_json::Value as Json;

use super::read::{Literal, Placed, Value, Written};
use super::{Mistake, print};
use cara_tools::close_names;

/// The arguments of a call in the signature's order.
pub(crate) fn bind(written: &Written, signature: &Signature) -> Result<Vec<Argument>, Mistake> {
    check_names(written, signature)?;
    signature.arguments().map(|spec| argument(written, spec)).collect()
}

fn check_names(written: &Written, signature: &Signature) -> Result<(), Mistake> {
    let names = || signature.arguments().map(|spec| spec.name);
    for (index, (name, _)) in written.arguments.iter().enumerate() {
        let place = name.at.clone();
        if !names().any(|known| known == name.value) {
            let what = format!("{} has no argument `{}`", signature.name(), name.value);
            return Err(Mistake::new(place, what, close_names::either(name.value, names())));
        }
        if written.arguments.iter().take(index).any(|(earlier, _)| earlier.value == name.value) {
            return Err(Mistake::new(place, format!("`{}` is there twice", name.value), "each argument once"));
        }
    }
    Ok(())
}

fn argument(written: &Written, spec: VariableSpec) -> Result<Argument, Mistake> {
    let found = written.arguments.iter().find(|(name, _)| name.value == spec.name);
    let Some((_, value)) = found else {
        if is_optional(spec) {
            return Ok(Argument { name: spec.name.to_owned(), size: 1, value: ArgumentValue::List(Json::Null) });
        }
        let what = format!("the argument `{}` is missing", spec.name);
        let example = format!("{}: {}", spec.name, example(spec));
        let expected = if written.text.contains('(') { example } else { format!("({example})") };
        return Err(Mistake::new(written.end..written.end, what, expected));
    };
    Ok(Argument { name: spec.name.to_owned(), size: spec.size, value: bound(value, spec)? })
}

fn bound(value: &Placed<Value>, spec: VariableSpec) -> Result<ArgumentValue, Mistake> {
    let at = &value.at;
    Ok(match spec.kind {
        Type::Int => ArgumentValue::Int(elements(value, spec, int)?),
        Type::Float => ArgumentValue::Float(elements(value, spec, float)?),
        Type::Bool => ArgumentValue::Bool(elements(value, spec, truth)?),
        Type::String => match &value.value {
            Value::One(Literal::Text(text)) => {
                check_length(text.len(), at, spec)?;
                ArgumentValue::String(text.clone())
            }
            _ => return Err(wrong_type(at, spec)),
        },
        Type::Bytes => match &value.value {
            // As it stands in JSON.
            Value::One(Literal::Text(digits)) if hexadecimal(&format!("0x{digits}")).is_some() => {
                check_length(digits.len() / 2, at, spec)?;
                ArgumentValue::Bytes(digits.to_ascii_lowercase())
            }
            Value::One(Literal::Number(digits)) => {
                let digits = hexadecimal(digits).ok_or_else(|| wrong_type(at, spec))?;
                check_length(digits.len() / 2, at, spec)?;
                ArgumentValue::Bytes(digits.to_ascii_lowercase())
            }
            _ => return Err(wrong_type(at, spec)),
        },
        Type::List => ArgumentValue::List(nested(value, spec)?),
        Type::Record => ArgumentValue::Record(nested(value, spec)?),
    })
}

/// A value inside a list or record, whose name is its path: `nodes[3].x`.
fn nested(value: &Placed<Value>, spec: VariableSpec) -> Result<Json, Mistake> {
    Ok(match (spec.kind, &value.value) {
        (Type::List, written) if is_optional(spec) => {
            let Some(element) = spec.element() else { return Err(wrong_type(&value.at, spec)) };
            let element = VariableSpec { name: spec.name, ..element };
            match (written, nested(value, element)) {
                (Value::One(Literal::Null), _) => Json::Null,
                // A list of at most one, unless it is itself the value.
                (Value::Several(list), Err(_)) if list.len() <= 1 => {
                    list.first().map_or(Ok(Json::Null), |one| nested(one, element))?
                }
                (_, one) => one?,
            }
        }
        (Type::List, Value::Several(several)) => {
            let Some(element) = spec.element() else { return Err(wrong_type(&value.at, spec)) };
            if several.len() > spec.size as usize {
                let most = print::plural(spec.size as usize, "element");
                let what = format!("`{}` takes at most {most}, and this has {}", spec.name, several.len());
                return Err(Mistake::new(value.at.clone(), what, describe(spec)));
            }
            let elements = several.iter().enumerate().map(|(index, value)| {
                nested(value, VariableSpec { name: &format!("{}[{index}]", spec.name), ..element })
            });
            elements.collect::<Result<_, _>>()?
        }
        (Type::Record, Value::Fields(written)) => {
            let names = || spec.fields().map(|field| field.name);
            for (index, (name, _)) in written.iter().enumerate() {
                if !names().any(|known| known == name.value) {
                    let what = format!("`{}` has no field `{}`", spec.name, name.value);
                    return Err(Mistake::new(name.at.clone(), what, close_names::either(name.value, names())));
                }
                if written.iter().take(index).any(|(earlier, _)| earlier.value == name.value) {
                    let what = format!("`{}.{}` is there twice", spec.name, name.value);
                    return Err(Mistake::new(name.at.clone(), what, "each field once"));
                }
            }
            let is_written = |name: &str| written.iter().any(|(written, _)| written.value == name);
            let needed = spec.fields().filter(|field| !is_optional(*field) || is_written(field.name));
            let fields = needed.map(|field| {
                let path = format!("{}.{}", spec.name, field.name);
                let Some((_, value)) = written.iter().find(|(name, _)| name.value == field.name) else {
                    let end = value.at.end.saturating_sub(1)..value.at.end;
                    return Err(Mistake::new(end, format!("`{path}` is missing"), describe(field)));
                };
                Ok((field.name.to_owned(), nested(value, VariableSpec { name: &path, ..field })?))
            });
            Json::Object(fields.collect::<Result<_, _>>()?)
        }
        (Type::List | Type::Record, _) => return Err(wrong_type(&value.at, spec)),
        _ => match bound(value, spec)? {
            ArgumentValue::Int(ints) => several(ints, spec),
            ArgumentValue::Float(floats) => several(floats.iter().map(print::json_of).collect(), spec),
            ArgumentValue::Bool(truths) => several(truths, spec),
            ArgumentValue::String(text) | ArgumentValue::Bytes(text) => text.into(),
            ArgumentValue::List(json) | ArgumentValue::Record(json) => json,
        },
    })
}

fn several<T: Into<Json>>(values: Vec<T>, spec: VariableSpec) -> Json {
    let mut values: Vec<Json> = values.into_iter().map(Into::into).collect();
    if spec.size == 1 { values.pop().unwrap_or_default() } else { Json::Array(values) }
}

/// Text and bytes have at most the signature's size.
fn check_length(length: usize, at: &Range<usize>, spec: VariableSpec) -> Result<(), Mistake> {
    if length <= spec.size as usize {
        return Ok(());
    }
    let what = format!("`{}` takes at most {} bytes, and this has {length}", spec.name, spec.size);
    Err(Mistake::new(at.clone(), what, describe(spec)))
}

/// As many elements as the signature's size, each read by `element`.
fn elements<T>(
    value: &Placed<Value>,
    spec: VariableSpec,
    element: impl Fn(&Literal, &Range<usize>, VariableSpec) -> Result<T, Mistake>,
) -> Result<Vec<T>, Mistake> {
    let (count, read) = match &value.value {
        Value::One(literal) => (1, element(literal, &value.at, spec).map(|one| vec![one])),
        Value::Several(several) => {
            let each = several.iter().map(|one| match &one.value {
                Value::One(literal) => element(literal, &one.at, spec),
                _ => Err(wrong_type(&one.at, spec)),
            });
            (several.len(), each.collect())
        }
        Value::Fields(_) => return Err(wrong_type(&value.at, spec)),
    };
    let read = read?;
    if count == spec.size as usize {
        return Ok(read);
    }
    let what = format!("`{}` has {}, and this has {count}", spec.name, print::plural(spec.size as usize, "element"));
    Err(Mistake::new(value.at.clone(), what, describe(spec)))
}

fn int(literal: &Literal, at: &Range<usize>, spec: VariableSpec) -> Result<i64, Mistake> {
    let Literal::Number(text) = literal else { return Err(wrong_type(at, spec)) };
    let (sign, unsigned) = match text.strip_prefix('-') {
        Some(unsigned) => (-1, unsigned),
        None => (1, text.strip_prefix('+').unwrap_or(text)),
    };
    let (digits, radix) = match unsigned.strip_prefix("0x") {
        Some(digits) => (digits, 16),
        None => (unsigned, 10),
    };
    if digits.is_empty() || !digits.chars().all(|c| c.is_digit(radix)) {
        return Err(wrong_type(at, spec));
    }
    let value = i128::from_str_radix(digits, radix).ok().and_then(|value| i64::try_from(value * sign).ok());
    value.ok_or_else(|| {
        let what = format!("`{text}` does not fit `{}`", spec.name);
        Mistake::new(at.clone(), what, format!("a whole number from {} to {}", i64::MIN, i64::MAX))
    })
}

fn float(literal: &Literal, at: &Range<usize>, spec: VariableSpec) -> Result<Number, Mistake> {
    let text = match literal {
        Literal::Number(text) => *text,
        // As it stands in JSON.
        Literal::Text(text) if matches!(text.as_str(), "NaN" | "inf" | "-inf") => text,
        _ => return Err(wrong_type(at, spec)),
    };
    let value: f64 = match text.parse() {
        Ok(value) => value,
        // Hexadecimal is for whole numbers, which a float takes as well.
        Err(_) => int(literal, at, spec)? as f64,
    };
    if value.is_infinite() && !text.ends_with("inf") {
        let what = format!("`{text}` does not fit `{}`", spec.name);
        return Err(Mistake::new(at.clone(), what, "a number of at most 1.7976931348623157e308, or inf"));
    }
    Ok(print::number(value))
}

fn truth(literal: &Literal, at: &Range<usize>, spec: VariableSpec) -> Result<bool, Mistake> {
    match literal {
        Literal::Truth(value) => Ok(*value),
        _ => Err(wrong_type(at, spec)),
    }
}

/// The digits of `0x…`, two for each byte.
fn hexadecimal(text: &str) -> Option<&str> {
    let digits = text.strip_prefix("0x")?;
    (digits.len().is_multiple_of(2) && digits.chars().all(|c| c.is_ascii_hexdigit())).then_some(digits)
}

fn wrong_type(at: &Range<usize>, spec: VariableSpec) -> Mistake {
    let what = format!("`{}` is {}, and this is not", spec.name, article(spec.kind));
    Mistake::new(at.clone(), what, describe(spec))
}

const fn article(kind: Type) -> &'static str {
    match kind {
        Type::Int => "an int",
        Type::Float => "a float",
        Type::String => "a string",
        Type::Bool => "a bool",
        Type::Bytes => "of the type bytes",
        Type::List => "a list",
        Type::Record => "a record",
    }
}

/// What a variable takes, with an example.
fn describe(spec: VariableSpec) -> String {
    let size = spec.size as usize;
    let count = |one: &str| if size == 1 { format!("a {one}") } else { print::plural(size, one) };
    let takes = match spec.kind {
        Type::Int => count("whole number"),
        Type::Float => count("number"),
        Type::Bool => {
            if size == 1 {
                "true or false".into()
            } else {
                count("truth value")
            }
        }
        Type::String => format!("text of at most {}", print::plural(size, "byte")),
        Type::Bytes => format!("at most {}, two hexadecimal digits each", print::plural(size, "byte")),
        Type::List if is_optional(spec) => "a value or null".into(),
        Type::List => format!("at most {}", print::plural(size, "element")),
        Type::Record => print::plural(size, "field"),
    };
    format!("{takes}, as in {}: {}", spec.name, example(spec))
}

fn example(spec: VariableSpec) -> String {
    let one = match spec.kind {
        Type::Int => "1",
        Type::Float => "0.5",
        Type::Bool => "true",
        Type::String => return "\"text\"".into(),
        Type::Bytes => return "0x01ff".into(),
        Type::List => {
            let element = spec.element().map_or_else(String::new, self::example);
            return if is_optional(spec) { element } else { format!("[{element}]") };
        }
        Type::Record => {
            let fields = spec.fields().map(|field| format!("{}: {}", field.name, self::example(field)));
            return format!("{{{}}}", fields.collect::<Vec<_>>().join(", "));
        }
    };
    match spec.size as usize {
        1 => one.into(),
        size if size <= 4 => format!("[{}]", vec![one; size].join(", ")),
        _ => format!("[{one}, {one}, …]"),
    }
}
