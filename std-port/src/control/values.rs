//! Values between the control socket's form and [`Parameters`].

use cara_core::distribution::function::VariableSpecs;
use cara_core::distribution::parameters::{Parameters, ParametersView, Type, Value};
use cara_core::error::{Error, Limit};

use super::protocol::{Argument, ArgumentValue, Failure, Number};

/// Sizes of parameters that are made, in bytes of names and values.
const SMALL: usize = 8 * 1024;
const MIDDLE: usize = 48 * 1024;
const LARGE: usize = 320 * 1024;

/// Parameters with the arguments, and with room for `results` more bytes.
pub(super) fn parameters(arguments: &[Argument], results: usize) -> Result<Box<ParametersView>, Failure> {
    let own = arguments.iter().try_fold(0_usize, |sum, argument| {
        let bytes = argument.value.kind().bytes_of(argument.size)?;
        sum.checked_add(bytes)?.checked_add(argument.name.len())
    });
    let bytes = own.and_then(|own| own.checked_add(results));
    let mut made = bytes.and_then(sized).ok_or(Error::TooLarge { limit: LARGE as u32 })?;
    for argument in arguments {
        put(&mut made, argument).map_err(|failure| failure.and(format_args!("the argument is '{}'", argument.name)))?;
    }
    Ok(made)
}

fn sized(bytes: usize) -> Option<Box<ParametersView>> {
    match bytes {
        bytes if bytes <= SMALL => Some(Box::new(Parameters::<SMALL>::sized())),
        bytes if bytes <= MIDDLE => Some(Box::new(Parameters::<MIDDLE>::sized())),
        bytes if bytes <= LARGE => Some(Box::new(Parameters::<LARGE>::sized())),
        _ => None,
    }
}

fn put(parameters: &mut ParametersView, argument: &Argument) -> Result<(), Failure> {
    let name = &argument.name;
    parameters.add(name, argument.value.kind(), argument.size)?;
    match &argument.value {
        ArgumentValue::Int(numbers) => parameters.set_value(name, &numbers[..])?,
        ArgumentValue::Float(numbers) => {
            let numbers: Vec<f64> = numbers.iter().map(float).collect::<Result<_, _>>()?;
            parameters.set_value(name, &numbers[..])?;
        }
        ArgumentValue::String(text) => parameters.set_value(name, text.as_str())?,
        ArgumentValue::Bool(values) => parameters.set_value(name, &values[..])?,
        ArgumentValue::Bytes(digits) => parameters.set_value(name, &bytes(digits)?[..])?,
    }
    Ok(())
}

/// The variables of `specs` that are among the parameters.
pub(super) fn arguments(specs: VariableSpecs<'_>, parameters: &ParametersView) -> Vec<Argument> {
    let values = specs.filter_map(|spec| {
        let value = parameters.value(spec.name).ok()?;
        Some(Argument { name: spec.name.to_owned(), size: value.size(), value: read(&value) })
    });
    values.collect()
}

fn read(value: &Value<'_>) -> ArgumentValue {
    match value.kind() {
        Type::Int => ArgumentValue::Int(value.ints().collect()),
        Type::Float => ArgumentValue::Float(value.floats().map(number).collect()),
        Type::String => ArgumentValue::String(value.text().unwrap_or_default().to_owned()),
        Type::Bool => ArgumentValue::Bool(value.bools().collect()),
        Type::Bytes => ArgumentValue::Bytes(value.raw().iter().map(|byte| format!("{byte:02x}")).collect()),
    }
}

impl ArgumentValue {
    /// The type of the variable that holds it.
    pub const fn kind(&self) -> Type {
        match self {
            Self::Int(_) => Type::Int,
            Self::Float(_) => Type::Float,
            Self::String(_) => Type::String,
            Self::Bool(_) => Type::Bool,
            Self::Bytes(_) => Type::Bytes,
        }
    }
}

fn number(value: f64) -> Number {
    if value.is_finite() {
        return Number::Finite(value);
    }
    let text = if value.is_nan() {
        "NaN"
    } else if value > 0.0 {
        "inf"
    } else {
        "-inf"
    };
    Number::Other(text.to_owned())
}

fn float(number: &Number) -> Result<f64, Failure> {
    match number {
        Number::Finite(value) => Ok(*value),
        Number::Other(text) => match text.as_str() {
            "NaN" => Ok(f64::NAN),
            "inf" => Ok(f64::INFINITY),
            "-inf" => Ok(f64::NEG_INFINITY),
            _ => Err(Failure::configuration(
                "BadNumber",
                format!("'{text}' is no number: write a JSON number, \"NaN\", \"inf\" or \"-inf\""),
            )),
        },
    }
}

fn bytes(digits: &str) -> Result<Vec<u8>, Failure> {
    let wrong = || Failure::configuration("BadBytes", "bytes are written as hexadecimal digits, two for each byte");
    let nibble = |digit: &u8| char::from(*digit).to_digit(16).ok_or_else(wrong);
    let (pairs, rest) = digits.as_bytes().as_chunks::<2>();
    if !rest.is_empty() {
        return Err(wrong());
    }
    pairs.iter().map(|[high, low]| Ok((nibble(high)? << 4 | nibble(low)?) as u8)).collect()
}

/// Bytes that the parameters of a call need beyond its arguments: those of every result.
pub(super) fn bytes_of(specs: VariableSpecs<'_>) -> Result<usize, Error> {
    let full = Error::Full(Limit::ParametersBytes);
    specs.map(|spec| (spec.name.len(), spec.kind.bytes_of(spec.size))).try_fold(0_usize, |sum, (name, value)| {
        value.and_then(|value| sum.checked_add(name)?.checked_add(value)).ok_or(full)
    })
}

#[cfg(test)]
mod tests {
    use cara_core::distribution::function::Definition;

    use super::*;

    fn argument(name: &str, size: u32, value: ArgumentValue) -> Argument {
        Argument { name: name.to_owned(), size, value }
    }

    fn every_type() -> Vec<Argument> {
        let numbers =
            vec![Number::Finite(-0.0), Number::Finite(0.1), Number::Other("NaN".into()), Number::Other("-inf".into())];
        vec![
            argument("i", 2, ArgumentValue::Int(vec![i64::MIN, i64::MAX])),
            argument("f", 4, ArgumentValue::Float(numbers)),
            argument("s", 20, ArgumentValue::String("Fähre \"7\"\n".into())),
            argument("b", 2, ArgumentValue::Bool(vec![true, false])),
            argument("y", 8, ArgumentValue::Bytes("00ff7f".into())),
        ]
    }

    #[test]
    fn every_type_survives_both_ways_through_text() {
        let text = serde_json::to_string(&every_type()).unwrap();
        let read_back: Vec<Argument> = serde_json::from_str(&text).unwrap();
        let parameters = parameters(&read_back, 0).unwrap();
        let signature =
            Definition::parse("f() -> (i: int[2], f: float[4], s: string[20], b: bool[2], y: bytes[8])").unwrap();
        let results = arguments(signature.signature().results(), &parameters);
        assert_eq!(results, every_type());
        assert_eq!(serde_json::to_string(&results).unwrap(), text);
    }

    #[test]
    fn what_is_no_value_is_refused_with_its_name() {
        let failure = |value, size| parameters(&[argument("v", size, value)], 0).unwrap_err();
        assert_eq!(failure(ArgumentValue::Bytes("0".into()), 4).error, "BadBytes");
        assert_eq!(failure(ArgumentValue::Bytes("0g".into()), 4).error, "BadBytes");
        assert_eq!(failure(ArgumentValue::Float(vec![Number::Other("nan".into())]), 1).error, "BadNumber");
        assert_eq!(failure(ArgumentValue::Int(vec![1]), 2).error, "WrongSize");
        assert_eq!(failure(ArgumentValue::String("four".into()), 3).error, "WrongSize");
        assert_eq!(failure(ArgumentValue::Int(Vec::new()), u32::MAX).error, "TooLarge");
        assert!(failure(ArgumentValue::Int(vec![1]), 2).text.contains("'v'"));
    }
}
