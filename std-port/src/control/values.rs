//! Values between the control socket's form and parameters.

use cara_core::distribution::block;
use cara_core::distribution::function::VariableSpecs;
use cara_core::distribution::parameters::{ParametersView, Type, Value};

use super::json;
use super::protocol::{Argument, ArgumentValue, Failure, Number};
use crate::growing::GrowingParameters;

/// Parameters with the arguments of a function. What a list or record is made of, its function says.
pub(super) fn parameters(arguments: &[Argument], specs: VariableSpecs<'_>) -> Result<GrowingParameters, Failure> {
    let mut made = GrowingParameters::new();
    for argument in arguments {
        put(&mut made, specs, argument)
            .map_err(|failure| failure.and(format_args!("the argument is '{}'", argument.name)))?;
    }
    let is_given = |name: &str| arguments.iter().any(|argument| argument.name == name);
    specs.filter(|spec| json::is_optional(*spec) && !is_given(spec.name)).try_for_each(|spec| made.add_spec(spec))?;
    Ok(made)
}

fn put(parameters: &mut GrowingParameters, specs: VariableSpecs<'_>, argument: &Argument) -> Result<(), Failure> {
    let name = &argument.name;
    if let ArgumentValue::List(json) | ArgumentValue::Record(json) = &argument.value {
        let Some(spec) = specs.named(name) else {
            return Err(Failure::configuration("UnknownVariable", format!("the function has no argument '{name}'")));
        };
        json::check(spec, json).map_err(|bad| Failure::configuration("WrongType", bad.to_string()))?;
        parameters.add_spec(spec)?;
        return Ok(parameters.fit(|parameters| json::set_checked(parameters, spec, json))?);
    }
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
        // Those are set above.
        ArgumentValue::List(_) | ArgumentValue::Record(_) => {}
    }
    Ok(())
}

/// The variables of `specs` that are among the parameters.
pub(super) fn arguments(specs: VariableSpecs<'_>, parameters: &ParametersView) -> Vec<Argument> {
    specs.filter_map(|spec| Some(argument(spec.name, &parameters.value(spec.name).ok()?))).collect()
}

/// The values of a block.
pub(super) fn in_block(specs: VariableSpecs<'_>, block: &[u8]) -> Vec<Argument> {
    block::values(specs, block).map(|(name, value)| argument(name, &value)).collect()
}

fn argument(name: &str, value: &Value<'_>) -> Argument {
    Argument { name: name.to_owned(), size: value.size(), value: read(value) }
}

fn read(value: &Value<'_>) -> ArgumentValue {
    match value.kind() {
        Type::Int => ArgumentValue::Int(value.ints().collect()),
        Type::Float => ArgumentValue::Float(value.floats().map(number).collect()),
        Type::String => ArgumentValue::String(value.text().unwrap_or_default().to_owned()),
        Type::Bool => ArgumentValue::Bool(value.bools().collect()),
        Type::List => ArgumentValue::List(json::to_json(value)),
        Type::Record => ArgumentValue::Record(json::to_json(value)),
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
            Self::List(_) => Type::List,
            Self::Record(_) => Type::Record,
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
            argument("l", 3, ArgumentValue::List(serde_json::json!([{ "a": 1 }, { "a": -2 }]))),
            argument("r", 3, ArgumentValue::Record(serde_json::json!({ "z": i64::MAX, "a": true, "k": 0.5 }))),
        ]
    }

    #[test]
    fn every_type_survives_both_ways_through_text() {
        let text = serde_json::to_string(&every_type()).unwrap();
        let read_back: Vec<Argument> = serde_json::from_str(&text).unwrap();
        let signature = Definition::parse(
            "f(l: {a: int}[..3], r: {z: int, a: bool, k: float}) -> (i: int[2], f: float[4], s: string[20], b: bool[2], y: bytes[8],
             l: {a: int}[..3], r: {z: int, a: bool, k: float})",
        );
        let signature = signature.unwrap();
        let parameters = parameters(&read_back, signature.signature().arguments()).unwrap();
        let specs = signature.signature().results();
        let results = arguments(specs, &parameters);
        assert_eq!(results, every_type());
        let mut block = vec![0; block::measure(specs, &parameters).unwrap()];
        block::write(specs, &parameters, &mut block::SliceWriter::new(&mut block));
        assert_eq!(in_block(specs, &block), every_type());
        assert_eq!(in_block(specs, &block[..16]), every_type()[..1], "what is no block ends it");
        assert_eq!(serde_json::to_string(&results).unwrap(), text);
        let in_order = r#"{"z":9223372036854775807,"a":true,"k":0.5}"#;
        assert!(text.contains(in_order), "members stand as in the signature: {text}");
    }

    #[test]
    fn what_is_no_value_is_refused_with_its_name() {
        let definition = Definition::parse("f(v: {x: int}[..2])").unwrap();
        let specs = definition.signature().arguments();
        let failure = |value, size| parameters(&[argument("v", size, value)], specs).unwrap_err();
        let wrong = failure(ArgumentValue::List(serde_json::json!([{ "x": 1 }, { "x": "a" }])), 2);
        assert!(wrong.error == "WrongType" && wrong.text.contains("v[1].x: expected int, got string"), "{wrong:?}");
        assert_eq!(failure(ArgumentValue::Bytes("0".into()), 4).error, "BadBytes");
        assert_eq!(failure(ArgumentValue::Bytes("0g".into()), 4).error, "BadBytes");
        assert_eq!(failure(ArgumentValue::Float(vec![Number::Other("nan".into())]), 1).error, "BadNumber");
        assert_eq!(failure(ArgumentValue::Int(vec![1]), 2).error, "WrongSize");
        assert_eq!(failure(ArgumentValue::String("four".into()), 3).error, "WrongSize");
        assert_eq!(failure(ArgumentValue::Int(Vec::new()), u32::MAX).error, "TooLarge");
        assert!(failure(ArgumentValue::Int(vec![1]), 2).text.contains("'v'"));
    }
}
