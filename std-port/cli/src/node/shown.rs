//! A configuration that is shown to others: members that a node reads alone, and of programs no arguments.

use serde::de::value::Error;
use serde::de::{Deserialize, Deserializer, Error as _, Visitor};
use toml::{Table, Value};

use super::file::{BlackBox, Capacities, Constraints, Control, File, Function, Log, Manager, Metrics};

/// Stands for arguments, in which a token may be.
const HIDDEN: &str = "…";

/// Takes the other members out of a file's table, and arguments of programs; the names of the members.
pub(crate) fn take_out(table: &mut Table) -> Vec<String> {
    let mut names = Vec::new();
    keep(members::<File>(), table, "", &mut names);
    names.sort();
    names.dedup();
    names
}

fn keep(members: &[&str], table: &mut Table, within: &str, names: &mut Vec<String>) {
    table.retain(|key, value| {
        let name = if within.is_empty() { key.to_owned() } else { format!("{within}.{key}") };
        let is_kept = members.contains(&key) && is_shown(&name, value, names);
        if !is_kept {
            names.push(name);
        }
        is_kept
    });
}

/// Whether a member that is known has a value of its form, without what is taken out of it.
fn is_shown(name: &str, value: &mut Value, names: &mut Vec<String>) -> bool {
    match (name, value) {
        ("functions.run" | "functions.at_lease_end", value) => hide_arguments(value),
        ("functions", Value::Array(functions)) => functions.iter_mut().all(|function| match function {
            Value::Table(function) => {
                keep(members::<Function>(), function, name, names);
                true
            }
            _ => false,
        }),
        ("control.operators", Value::Table(operators)) => operators.iter().all(|(_, role)| role.is_str()),
        (_, Value::Table(table)) => match members_of(name) {
            Some(members) => {
                keep(members, table, name, names);
                true
            }
            None => false,
        },
        (_, Value::Array(values)) => !values.iter().any(|value| value.is_table() || value.is_array()),
        _ => true,
    }
}

/// Leaves the program.
fn hide_arguments(command: &mut Value) -> bool {
    let words = command.as_array().map(Vec::as_slice);
    let first = words.and_then(|words| words.first()?.as_str());
    // A first word with blanks may be a whole command by mistake.
    let program = first.and_then(|first| first.split_whitespace().next());
    let is_all = match words {
        Some([]) => true,
        Some([_]) => first.is_some() && first == program,
        _ => false,
    };
    let shown = program.into_iter().chain((!is_all).then_some(HIDDEN));
    *command = Value::Array(shown.map(Value::from).collect());
    true
}

fn members_of(table: &str) -> Option<&'static [&'static str]> {
    match table {
        "manager" => Some(members::<Manager>()),
        "constraints" => Some(members::<Constraints>()),
        "capacities" => Some(members::<Capacities>()),
        "control" => Some(members::<Control>()),
        "metrics" => Some(members::<Metrics>()),
        "log" => Some(members::<Log>()),
        "black_box" => Some(members::<BlackBox>()),
        _ => None,
    }
}

/// The names that a struct of a file is read from.
fn members<'de, T: Deserialize<'de>>() -> &'static [&'static str] {
    let mut found: &'static [&'static str] = &[];
    let _ = T::deserialize(Asked(&mut found));
    found
}

/// Has nothing to read, and remembers what is looked for.
struct Asked<'a>(&'a mut &'static [&'static str]);

impl<'de> Deserializer<'de> for Asked<'_> {
    type Error = Error;

    fn deserialize_struct<V: Visitor<'de>>(
        self,
        _: &'static str,
        fields: &'static [&'static str],
        visitor: V,
    ) -> Result<V::Value, Error> {
        *self.0 = fields;
        self.deserialize_any(visitor)
    }

    fn deserialize_any<V: Visitor<'de>>(self, _: V) -> Result<V::Value, Error> {
        Err(Error::custom(""))
    }

    serde::forward_to_deserialize_any! {
        bool i8 i16 i32 i64 u8 u16 u32 u64 f32 f64 char str string bytes byte_buf option unit unit_struct newtype_struct
        seq tuple tuple_struct map enum identifier ignored_any
    }
}
