//! The functions of a node as the trait that `#[interface]` takes, and the values of its streams as structs.

use std::collections::BTreeMap;
use std::fmt::{self, Write};

use cara_std::control::protocol::FunctionInfo;
use cara_std::{Attributes, Definition, Priority, Type, VariableSpec, VariableSpecs, is_hidden};

/// Units of variables, by their names.
type Units = BTreeMap<String, String>;

/// Words that cannot be names of Rust, not even behind `r#`.
const NEVER: [&str; 5] = ["self", "Self", "super", "crate", "_"];
/// Words that can be, behind `r#`.
const KEYWORDS: [&str; 46] = [
    "abstract", "as", "async", "await", "become", "box", "break", "const", "continue", "do", "dyn", "else", "enum",
    "extern", "false", "final", "fn", "for", "gen", "if", "impl", "in", "let", "loop", "macro", "match", "mod", "move",
    "mut", "override", "priv", "pub", "ref", "return", "static", "struct", "trait", "true", "try", "type", "typeof",
    "unsafe", "unsized", "use", "virtual", "where",
];

/// The source of the trait and of the structs in it and of streams, or the first function whose signature cannot be read.
pub(crate) fn interface(node: &str, functions: &[FunctionInfo]) -> Result<String, String> {
    let name = trait_name(node);
    // A record is made of something, so it is none of these.
    let made = ["Server", "Client"].map(|what| format!("{name}{what}"));
    let used = [&*name, "ServiceError", "TypedCall", "Variables", "Result", "Option", "String", "Vec"];
    let known =
        used.into_iter().chain(made.iter().map(String::as_str)).map(|taken| (Vec::new(), taken.to_owned())).collect();
    let (mut methods, mut taken, mut structs) = (String::new(), Vec::new(), Structs { known, source: String::new() });
    let mut streams = String::new();
    for function in functions {
        let definition: Definition =
            function.signature.parse().map_err(|error| format!("{}: {error}", function.signature))?;
        if function.attributes.stream.is_some() {
            let results = definition.signature().results();
            let values = structs.of(results, definition.name(), &function.help, &function.units);
            streams += &format!("// Values of the stream `{}` are a `{values}`.\n", definition.name());
            continue;
        }
        if !methods.is_empty() {
            methods.push('\n');
        }
        method(&mut methods, &definition, function, &mut taken, &mut structs)
            .map_err(|_| String::from("the source cannot be written"))?;
    }
    let source = structs.source;
    let call = if methods.contains("TypedCall<") { "TypedCall, " } else { "" };
    let derive = if source.is_empty() { "" } else { "Variables, " };
    Ok(format!(
        "use cara_std::{{ServiceError, {call}{derive}interface}};\n\n{source}{streams}#[interface]\npub trait {name} {{\n{methods}}}\n"
    ))
}

/// The structs that records, progress and values of failures are printed as.
struct Structs {
    /// What each is made of, and its name. Other names that are taken are made of nothing.
    known: Vec<(Vec<u8>, String)>,
    source: String,
}

impl Structs {
    /// The struct with these fields: a new one, called like the way to it, or the one that has the same.
    fn of(&mut self, fields: VariableSpecs<'_>, way: &str, help: &str, units: &Units) -> String {
        let key = key(fields, units);
        if let Some((_, name)) = self.known.iter().find(|(known, _)| *known == key) {
            return name.clone();
        }
        let mut name = camel_case(way);
        if !name.starts_with(|first: char| first.is_ascii_alphabetic()) {
            name.insert_str(0, "Record");
        }
        while self.known.iter().any(|(_, taken)| *taken == name) {
            name.push('_');
        }
        self.known.push((key, name.clone()));
        let (mut source, mut taken) = (String::new(), Vec::new());
        for field in fields {
            let ident = identifier(field.name, &mut taken);
            if plain(&ident) != field.name {
                source += &format!("    #[name = \"{}\"]\n", field.name);
            }
            if let Some(size) = size(&field) {
                source += &format!("    {size}\n");
            }
            if let Some(unit) = units.get(field.name) {
                source += &format!("    #[unit = {unit:?}]\n");
            }
            let rust = rust_type(&field, false, &format!("{way} {}", field.name), self);
            source += &format!("    pub {ident}: {rust},\n");
        }
        self.source += &comment(help);
        self.source += &format!("#[derive(Variables, Clone, Debug, PartialEq)]\npub struct {name} {{\n{source}}}\n\n");
        name
    }
}

fn method(
    source: &mut String,
    definition: &Definition,
    FunctionInfo { attributes, help, units, .. }: &FunctionInfo,
    taken: &mut Vec<String>,
    structs: &mut Structs,
) -> fmt::Result {
    let (name, signature) = (definition.name(), definition.signature());
    let ident = identifier(name, taken);
    if !help.is_empty() {
        writeln!(source, "    #[help = {help:?}]")?;
    }
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
    for flag in Attributes::FLAGS.iter().filter(|flag| flag.is_set(attributes)) {
        writeln!(source, "    #[{}]", flag.word())?;
    }
    let results: Vec<VariableSpec<'_>> = signature.results().collect();
    if !results.is_empty() {
        let names: Vec<String> = results.iter().map(|result| result_name(result, units)).collect();
        writeln!(source, "    #[returns({})]", names.join(", "))?;
    }
    let mut inputs = Vec::new();
    // An emergency waits for nothing, and so does not get the state.
    if attributes.priority != Priority::Emergency {
        inputs.push(String::from("&mut self"));
    }
    let mut arguments = Vec::new();
    let (progress, failure) = (signature.progress(), signature.failure());
    if progress.clone().next().is_some() || failure.clone().next().is_some() {
        arguments.push(String::from("call"));
        inputs.push(format!("call: &impl TypedCall<{}>", reported(structs, name, progress, failure, units)));
    }
    let way = |variable: &VariableSpec<'_>| format!("{name} {}", variable.name);
    for argument in signature.arguments() {
        let ident = identifier(argument.name, &mut arguments);
        let name =
            if plain(&ident) == argument.name { String::new() } else { format!("#[name = \"{}\"] ", argument.name) };
        let rust = rust_type(&argument, true, &way(&argument), structs);
        inputs.push(format!("{name}{}{ident}: {rust}", said(&argument, units)));
    }
    let types: Vec<String> = results.iter().map(|result| rust_type(result, false, &way(result), structs)).collect();
    let returned = match types.as_slice() {
        [only] => only.clone(),
        several => format!("({})", several.join(", ")),
    };
    writeln!(source, "    fn {ident}({}) -> Result<{returned}, ServiceError>;", inputs.join(", "))
}

/// The types of what a call tells, and of its failures.
fn reported(
    structs: &mut Structs,
    name: &str,
    progress: VariableSpecs<'_>,
    failure: VariableSpecs<'_>,
    units: &Units,
) -> String {
    let mut of = |specs: VariableSpecs<'_>, what: &str| match specs.clone().next() {
        Some(_) => structs.of(specs, &format!("{name} {what}"), "", units),
        None => String::from("()"),
    };
    let progress = of(progress, "progress");
    match of(failure, "failure").as_str() {
        "()" => progress,
        failure => format!("{progress}, {failure}"),
    }
}

/// What two structs have in common that are the same.
fn key(fields: VariableSpecs<'_>, units: &Units) -> Vec<u8> {
    let mut key = Vec::new();
    for VariableSpec { name, kind, size, inner } in fields {
        key.extend([kind as u8, name.len() as u8]);
        key.extend(size.to_le_bytes());
        key.extend(name.as_bytes());
        key.extend(inner);
        let unit = units.get(name).map_or("", String::as_str);
        key.push(unit.len() as u8);
        key.extend(unit.bytes());
    }
    key
}

fn result_name(result: &VariableSpec<'_>, units: &Units) -> String {
    let ident = identifier(result.name, &mut Vec::new());
    let name = if plain(&ident) == result.name { ident } else { format!("\"{}\"", result.name) };
    format!("{}{name}", said(result, units))
}

/// The attributes of what has a bound or a unit, each with a space.
fn said(spec: &VariableSpec<'_>, units: &Units) -> String {
    let unit = units.get(spec.name).map(|unit| format!("#[unit = {unit:?}]"));
    size(spec).into_iter().chain(unit).map(|attribute| attribute + " ").collect()
}

/// A line of help as a comment. It is no documentation, whose code rustdoc would run, and has no line breaks: a node says what
/// it likes.
fn comment(help: &str) -> String {
    let shown: String = help.chars().map(|character| if is_hidden(character) { ' ' } else { character }).collect();
    if shown.is_empty() { shown } else { format!("// {shown}\n") }
}

/// `#[size(50, 32)]` of a list of 50 texts of 32 bytes. That of one at most is an `Option`, which has no size.
fn size(spec: &VariableSpec<'_>) -> Option<String> {
    let (mut sizes, mut spec) = (Vec::new(), *spec);
    while let Some(element) = spec.element() {
        if spec.size != 1 {
            sizes.push(spec.size.to_string());
        }
        spec = element;
    }
    if matches!(spec.kind, Type::String | Type::Bytes) {
        sizes.push(spec.size.to_string());
    }
    if sizes.is_empty() { None } else { Some(format!("#[size({})]", sizes.join(", "))) }
}

fn rust_type(spec: &VariableSpec<'_>, is_argument: bool, way: &str, structs: &mut Structs) -> String {
    let element = match (spec.kind, is_argument) {
        (Type::Int, _) => "i64",
        (Type::Float, _) => "f64",
        (Type::Bool, _) => "bool",
        (Type::String, true) => "&str",
        (Type::String, false) => "String",
        (Type::Bytes, true) => "&[u8]",
        (Type::Bytes, false) => "Vec<u8>",
        (Type::Record, _) => return structs.of(spec.fields(), way, "", &Units::new()),
        (Type::List, _) => {
            let holder = if spec.size == 1 { "Option" } else { "Vec" };
            let element = spec.element().map(|element| rust_type(&element, false, way, structs));
            return format!("{holder}<{}>", element.unwrap_or_default());
        }
    };
    if spec.kind.is_fixed() && spec.size != 1 { format!("[{element}; {}]", spec.size) } else { element.to_owned() }
}

/// `agv-17` as `Agv17`.
fn trait_name(node: &str) -> String {
    let name = node.split('/').next().unwrap_or_default();
    let joined = camel_case(name);
    if joined.starts_with(|first: char| first.is_ascii_alphabetic()) { joined } else { format!("Node{joined}") }
}

fn camel_case(name: &str) -> String {
    let words = name.split(|character: char| !character.is_ascii_alphanumeric()).map(|word| {
        let mut letters = word.chars();
        letters.next().map_or(String::new(), |first| first.to_ascii_uppercase().to_string() + letters.as_str())
    });
    words.collect()
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
