//! The functions of a node as the trait that `#[interface]` takes.

use std::fmt::{self, Write};

use cara_std::control::protocol::FunctionInfo;
use cara_std::{Attributes, Definition, Priority, Type, VariableSpec};

/// Words that cannot be names of Rust, not even behind `r#`.
const NEVER: [&str; 5] = ["self", "Self", "super", "crate", "_"];
/// Words that can be, behind `r#`.
const KEYWORDS: [&str; 46] = [
    "abstract", "as", "async", "await", "become", "box", "break", "const", "continue", "do", "dyn", "else", "enum",
    "extern", "false", "final", "fn", "for", "gen", "if", "impl", "in", "let", "loop", "macro", "match", "mod", "move",
    "mut", "override", "priv", "pub", "ref", "return", "static", "struct", "trait", "true", "try", "type", "typeof",
    "unsafe", "unsized", "use", "virtual", "where",
];

/// The source of the trait, or the first function whose signature cannot be read.
pub(crate) fn interface(node: &str, functions: &[FunctionInfo]) -> Result<String, String> {
    let mut source = String::from("use cara_std::{ServiceError, interface};\n\n#[interface]\n");
    let mut write = || -> Result<(), String> {
        let told = |_: fmt::Error| String::from("the source cannot be written");
        writeln!(source, "pub trait {} {{", trait_name(node)).map_err(told)?;
        let mut taken = Vec::new();
        for (index, function) in functions.iter().enumerate() {
            let definition: Definition =
                function.signature.parse().map_err(|error| format!("{}: {error}", function.signature))?;
            if index > 0 {
                source.push('\n');
            }
            method(&mut source, &definition, &function.attributes, &mut taken).map_err(told)?;
        }
        source.push_str("}\n");
        Ok(())
    };
    write()?;
    Ok(source)
}

fn method(
    source: &mut String,
    definition: &Definition,
    attributes: &Attributes,
    taken: &mut Vec<String>,
) -> fmt::Result {
    let (name, signature) = (definition.name(), definition.signature());
    let ident = identifier(name, taken);
    if plain(&ident) != name {
        writeln!(source, "    #[name = \"{name}\"]")?;
    }
    if attributes.priority != Priority::Normal {
        writeln!(source, "    #[priority({})]", attributes.priority.word())?;
    }
    match (attributes.actuator, attributes.lease) {
        (0, None) => {}
        (0, Some(_)) => writeln!(source, "    #[actuator({ident})]")?,
        (number, _) => writeln!(source, "    #[actuator(actuator_{number})]")?,
    }
    if let Some(lease) = attributes.lease {
        writeln!(source, "    #[lease(ms = {})]", lease.as_millis())?;
    }
    let flags = [(attributes.stop, "stop"), (attributes.reset, "reset"), (attributes.idempotent, "idempotent")];
    for (_, flag) in flags.iter().filter(|(is_set, _)| *is_set) {
        writeln!(source, "    #[{flag}]")?;
    }
    let results: Vec<VariableSpec<'_>> = signature.results().collect();
    if !results.is_empty() {
        let names: Vec<String> = results.iter().map(result_name).collect();
        writeln!(source, "    #[returns({})]", names.join(", "))?;
    }
    let mut inputs = Vec::new();
    // An emergency waits for nothing, and so does not get the state.
    if attributes.priority != Priority::Emergency {
        inputs.push(String::from("&mut self"));
    }
    let mut arguments = Vec::new();
    for argument in signature.arguments() {
        let ident = identifier(argument.name, &mut arguments);
        let name =
            if plain(&ident) == argument.name { String::new() } else { format!("#[name = \"{}\"] ", argument.name) };
        inputs.push(format!("{name}{}{ident}: {}", size(&argument), rust_type(&argument, true)));
    }
    let types: Vec<String> = results.iter().map(|result| rust_type(result, false)).collect();
    let returned = match types.as_slice() {
        [only] => only.clone(),
        several => format!("({})", several.join(", ")),
    };
    writeln!(source, "    fn {ident}({}) -> Result<{returned}, ServiceError>;", inputs.join(", "))
}

fn result_name(result: &VariableSpec<'_>) -> String {
    let ident = identifier(result.name, &mut Vec::new());
    let name = if plain(&ident) == result.name { ident } else { format!("\"{}\"", result.name) };
    format!("{}{name}", size(result))
}

fn size(spec: &VariableSpec<'_>) -> String {
    if spec.kind.is_fixed() { String::new() } else { format!("#[size({})] ", spec.size) }
}

fn rust_type(spec: &VariableSpec<'_>, is_argument: bool) -> String {
    let element = match (spec.kind, is_argument) {
        (Type::Int, _) => "i64",
        (Type::Float, _) => "f64",
        (Type::Bool, _) => "bool",
        (Type::String, true) => "&str",
        (Type::String, false) => "String",
        (Type::Bytes, true) => "&[u8]",
        (Type::Bytes, false) => "Vec<u8>",
    };
    if spec.kind.is_fixed() && spec.size != 1 { format!("[{element}; {}]", spec.size) } else { element.to_owned() }
}

/// `agv-17` as `Agv17`.
fn trait_name(node: &str) -> String {
    let name = node.split('/').next().unwrap_or_default();
    let words = name.split(|character: char| !character.is_ascii_alphanumeric()).map(|word| {
        let mut letters = word.chars();
        letters.next().map_or(String::new(), |first| first.to_ascii_uppercase().to_string() + letters.as_str())
    });
    let joined: String = words.collect();
    if joined.starts_with(|first: char| first.is_ascii_alphabetic()) { joined } else { format!("Node{joined}") }
}

/// A name of Rust that is like the name of a function or variable, and no other one's.
fn identifier(name: &str, taken: &mut Vec<String>) -> String {
    let mut ident: String =
        name.chars().map(|character| if character.is_ascii_alphanumeric() { character } else { '_' }).collect();
    if !ident.starts_with(|first: char| first.is_ascii_alphabetic() || first == '_') {
        ident.insert(0, '_');
    }
    if NEVER.contains(&ident.as_str()) {
        ident.push('_');
    }
    while taken.contains(&ident) {
        ident.push('_');
    }
    taken.push(ident.clone());
    if KEYWORDS.contains(&ident.as_str()) { format!("r#{ident}") } else { ident }
}

fn plain(ident: &str) -> &str {
    ident.strip_prefix("r#").unwrap_or(ident)
}

#[cfg(test)]
mod tests;
