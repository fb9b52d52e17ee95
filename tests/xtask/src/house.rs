//! `cargo xtask house`: how much there is to read, to learn and to keep in step. Each figure says how it is counted.

use std::collections::BTreeSet;
use std::path::{Path, PathBuf};
use std::process::ExitCode;

use anyhow::{Context, Result};
use cara_processes::files;
use serde_json::{Map, Value};

use crate::layers;
use crate::source::{self, Token};
use crate::workspace;

mod circles;
mod request;

/// Product code: a name, and the folders in which it lies.
const PARTS: [(&str, &[&str]); 4] = [
    ("core, derive, secure", &["core/src", "core/derive/src", "core/secure/src"]),
    ("std-port/src", &["std-port/src"]),
    ("embassy-port", &["embassy-port/src", "embassy-port/board/src", "embassy-port/settings/src"]),
    (
        "cli",
        &[
            "std-port/cli/src",
            "std-port/cli/tools/src",
            "std-port/cli/doctor/src",
            "std-port/cli/keys/src",
            "std-port/cli/line/src",
            "std-port/cli/provision/src",
            "std-port/recording/src",
            "std-port/cli/web/src",
            "std-port/map/src",
        ],
    ),
];
/// Folders whose public items are counted, and the crates' names.
const CRATES: [(&str, &str); 3] =
    [("cara-std", "std-port/src"), ("cara-core", "core/src"), ("cara-embassy", "embassy-port/src")];
/// Where traits are that calls and services are made with; and those there that are for something else.
const CALL_TRAITS: [&str; 4] =
    ["core/src/services/typed.rs", "core/src/services/call.rs", "std-port/src", "embassy-port/src"];
const OTHER_TRAITS: [&str; 2] = ["Sealed", "Memory"];
/// What a call may fail with: types of these names.
const CALL_ERRORS: [&str; 6] = ["Error", "CallError", "Failed", "CallFailure", "Mismatch", "ServiceError"];
/// How the derive puts the methods of a function into its client.
const CLIENT_FORMS: [&str; 1] = ["fn #ident "];

/// A figure, and how it is counted.
struct Figure {
    name: String,
    value: usize,
    how: &'static str,
}

/// Counts, prints, and writes the same as JSON.
pub(crate) fn run(json: Option<&Path>) -> Result<ExitCode> {
    json.map_or(Ok(()), files::can_write)?;
    let product = product()?;
    let mut figures = lines(&product);
    figures.extend(calls(&product));
    figures.extend(items(&product));
    figures.push(conditions(&product));
    figures.extend(circles::figures(&product));
    figures.extend(words()?);
    figures.extend(request::figures()?);
    println!("| measure | value | counted |\n|---|---|---|");
    figures.iter().for_each(|Figure { name, value, how }| println!("| {name} | {value} | {how} |"));
    if let Some(path) = json {
        let all: Map<String, Value> = figures.into_iter().map(|figure| (figure.name, figure.value.into())).collect();
        std::fs::write(path, serde_json::to_string_pretty(&all)? + "\n")
            .with_context(|| format!("cannot write {}", path.display()))?;
    }
    Ok(ExitCode::SUCCESS)
}

/// A source file of the product, without files that are tests.
struct File {
    path: PathBuf,
    text: String,
}

impl File {
    fn is_below(&self, folder: &str) -> bool {
        self.path.starts_with(folder)
    }

    /// Its tokens without tests; a literal is one token.
    fn tokens(&self) -> Vec<Token<'_>> {
        source::without_tests(&source::tokens_and_literals(&self.text))
    }
}

fn product() -> Result<Vec<File>> {
    let folders = PARTS.iter().flat_map(|(_, folders)| folders.iter());
    let mut all = Vec::new();
    for folder in folders {
        let mut sources = Vec::new();
        for path in workspace::files_with("rs")?.into_iter().filter(|path| path.starts_with(folder)) {
            let text = workspace::read(&path)?;
            sources.push((path.strip_prefix(folder)?.to_owned(), text));
        }
        let tests = layers::test_files(&sources);
        let kept = sources.into_iter().filter(|(path, _)| !tests.contains(path));
        all.extend(kept.map(|(path, text)| File { path: Path::new(folder).join(path), text }));
    }
    Ok(all)
}

fn lines(product: &[File]) -> Vec<Figure> {
    let of = |folders: &[&str]| {
        let files = product.iter().filter(|file| folders.iter().any(|folder| file.is_below(folder)));
        files.map(|file| code_lines(&file.tokens())).sum()
    };
    let how = "lines with a token outside of tests; no comments, no blank lines";
    PARTS.iter().map(|(name, folders)| Figure { name: format!("lines of {name}"), value: of(folders), how }).collect()
}

fn code_lines(tokens: &[Token<'_>]) -> usize {
    let lines: BTreeSet<usize> =
        tokens.iter().flat_map(|token| token.line..=token.line + token.text.matches('\n').count()).collect();
    lines.len()
}

fn calls(product: &[File]) -> [Figure; 4] {
    let std: BTreeSet<String> = public(product, "std-port/src", &["fn"]).into_iter().collect();
    let is_call = |name: &&String| {
        let name = name.strip_prefix("block_").unwrap_or(name);
        ["call", "request", "hold"].iter().any(|verb| name == *verb || name.starts_with(&format!("{verb}_")))
    };
    let client: String =
        product.iter().filter(|file| file.is_below("core/derive/src/client.rs")).map(|file| &*file.text).collect();
    let forms = CLIENT_FORMS.iter().map(|form| client.matches(form).count()).sum();
    let traits = CALL_TRAITS.iter().flat_map(|folder| public(product, folder, &["trait"]));
    let traits = traits.filter(|name| !OTHER_TRAITS.contains(&&**name)).count();
    let types: BTreeSet<String> =
        CRATES.iter().flat_map(|(_, folder)| public(product, folder, &["struct", "enum"])).collect();
    [
        Figure {
            name: "ways to make a call, Linux".into(),
            value: std.iter().filter(is_call).count(),
            how: "names of public functions of std-port: call…, request…, block_request…, hold…",
        },
        Figure {
            name: "ways to make a call, typed clients".into(),
            value: forms,
            how: "methods of one function in its client",
        },
        Figure {
            name: "public call traits".into(),
            value: traits,
            how: "public traits of the core's typed.rs and call.rs and of both ports, without Sealed and Memory",
        },
        Figure {
            name: "error types of a call".into(),
            value: CALL_ERRORS.iter().filter(|name| types.contains(**name)).count(),
            how: "public types named Error, CallError, Failed, CallFailure, Mismatch, ServiceError",
        },
    ]
}

fn items(product: &[File]) -> Vec<Figure> {
    let kinds = ["fn", "struct", "enum", "trait", "type"];
    let count = |folder| public(product, folder, &kinds).len();
    let how = "pub fn, struct, enum, trait and type outside of tests, also hidden ones; no constants, no re-exports";
    CRATES
        .iter()
        .map(|(name, folder)| Figure { name: format!("public items of {name}"), value: count(folder), how })
        .collect()
}

/// The names of public items of these kinds.
fn public(product: &[File], folder: &str, kinds: &[&str]) -> Vec<String> {
    product.iter().filter(|file| file.is_below(folder)).flat_map(|file| public_in(&file.tokens(), kinds)).collect()
}

fn public_in(tokens: &[Token<'_>], kinds: &[&str]) -> Vec<String> {
    let mut names = Vec::new();
    for at in (0..tokens.len()).filter(|at| tokens[*at].text == "pub") {
        let mut rest = tokens[at + 1..].iter().map(|token| token.text);
        let kind = rest.by_ref().find(|word| !["const", "async", "unsafe"].contains(word));
        if let (Some(kind), Some(name)) = (kind, rest.next())
            && kinds.contains(&kind)
        {
            names.push(name.to_owned());
        }
    }
    names
}

fn conditions(product: &[File]) -> Figure {
    let count =
        |file: &File| file.tokens().windows(2).filter(|two| two[0].text == "feature" && two[1].text == "=").count();
    Figure {
        name: "conditions on features in the core".into(),
        value: product.iter().filter(|file| file.is_below("core/src")).map(count).sum(),
        how: "`feature = …` in core/src outside of tests",
    }
}

fn words() -> Result<[Figure; 2]> {
    let texts = workspace::files_with("md")?;
    let mut words = 0;
    for path in &texts {
        words += workspace::read(path)?.split_whitespace().count();
    }
    let how = "Markdown of the repository";
    Ok([
        Figure { name: "words of documents".into(), value: words, how },
        Figure { name: "documents".into(), value: texts.len(), how },
    ])
}

#[cfg(test)]
mod tests {
    use super::{code_lines, public_in};
    use crate::source::{tokens_and_literals, without_tests};

    #[test]
    fn comments_blank_lines_and_tests_are_no_lines_of_code() {
        let text = "//! A file.\n\n/// One.\nfn f() {\n    g(\"a\n b\"); // why\n}\n#[cfg(test)]\nmod tests {\n}\n";
        assert_eq!(code_lines(&without_tests(&tokens_and_literals(text))), 4);
    }

    #[test]
    fn only_what_is_public_everywhere_is_an_item() {
        let text = "pub fn a() {} pub(crate) fn b() {} pub const fn c() {} pub const D: u8 = 0; pub struct E; fn f() {} pub use g;";
        assert_eq!(public_in(&tokens_and_literals(text), &["fn", "struct"]), ["a", "c", "E"]);
    }
}
