//! Rust source as far as the checks need it: tokens without comments and texts, paths, and what is test code.
//!
//! Plain text parsing on purpose: it must work on files that do not compile yet. It does not see through macros.

/// A token: a word (identifier, keyword or number), `::`, or one other character.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) struct Token<'t> {
    pub(crate) text: &'t str,
    pub(crate) line: usize,
}

/// A path such as `crate::host::frame`, with the line on which it stands.
#[derive(Clone, Debug, PartialEq, Eq)]
pub(crate) struct Path<'t> {
    pub(crate) segments: Vec<&'t str>,
    pub(crate) line: usize,
}

/// The tokens of `text` outside of comments, character and text literals.
pub(crate) fn tokens(text: &str) -> Vec<Token<'_>> {
    let mut tokens = tokens_and_literals(text);
    tokens.retain(|token| skipped(token.text).is_none());
    tokens
}

/// The tokens of `text` outside of comments; a character or text literal is one.
pub(crate) fn tokens_and_literals(text: &str) -> Vec<Token<'_>> {
    let mut tokens = Vec::new();
    let (mut rest, mut line) = (text, 1);
    while let Some(first) = rest.chars().next() {
        let skipped = skipped(rest);
        let length = skipped.unwrap_or_else(|| token_length(rest, first));
        let is_blank = rest.starts_with(char::is_whitespace) || rest.starts_with("//") || rest.starts_with("/*");
        if !is_blank {
            tokens.push(Token { text: &rest[..length], line });
        }
        line += rest[..length].matches('\n').count();
        rest = &rest[length..];
    }
    tokens
}

/// The tokens that remain once every item behind `#[cfg(test)]` is taken out.
pub(crate) fn without_tests<'t>(tokens: &[Token<'t>]) -> Vec<Token<'t>> {
    let mut kept = Vec::with_capacity(tokens.len());
    let mut at = 0;
    while at < tokens.len() {
        if starts_with(&tokens[at..], &CFG_TEST) {
            at = item_end(tokens, at + CFG_TEST.len());
        } else {
            kept.push(tokens[at]);
            at += 1;
        }
    }
    kept
}

/// Names of the modules that `#[cfg(test)] mod name;` declares in files of their own.
pub(crate) fn test_modules<'t>(tokens: &[Token<'t>]) -> Vec<&'t str> {
    let mut names = Vec::new();
    for at in 0..tokens.len() {
        if !starts_with(&tokens[at..], &CFG_TEST) {
            continue;
        }
        let item = &tokens[at + CFG_TEST.len()..item_end(tokens, at + CFG_TEST.len())];
        if let [.., kind, name, end] = item
            && kind.text == "mod"
            && end.text == ";"
        {
            names.push(name.text);
        }
    }
    names
}

/// Every path of the tokens: each leaf of a `use`, and each `a::b::c` elsewhere.
pub(crate) fn paths<'t>(tokens: &[Token<'t>]) -> Vec<Path<'t>> {
    let mut found = Vec::new();
    let mut at = 0;
    while at < tokens.len() {
        at = if is_word(tokens[at].text) { tree(tokens, at, &[], &mut found) } else { at + 1 };
    }
    found.retain(|path| path.segments.len() > 1);
    found
}

const CFG_TEST: [&str; 7] = ["#", "[", "cfg", "(", "test", ")", "]"];

/// Reads one path, or a tree of them behind braces, and returns where the next token stands.
fn tree<'t>(tokens: &[Token<'t>], start: usize, prefix: &[&'t str], found: &mut Vec<Path<'t>>) -> usize {
    let mut segments = prefix.to_vec();
    let mut at = start;
    while let Some(token) = tokens.get(at) {
        match token.text {
            "{" if at > start && !segments.is_empty() => return braces(tokens, at + 1, &segments, found),
            "*" if at > start => segments.push("*"),
            word if is_word(word) => segments.push(word),
            _ => break,
        }
        at += 1;
        if tokens.get(at).is_none_or(|next| next.text != "::") {
            break;
        }
        at += 1;
    }
    found.push(Path { segments, line: tokens[start].line });
    at.max(start + 1)
}

fn braces<'t>(tokens: &[Token<'t>], start: usize, prefix: &[&'t str], found: &mut Vec<Path<'t>>) -> usize {
    let mut at = start;
    while let Some(token) = tokens.get(at) {
        at = match token.text {
            "}" => return at + 1,
            "as" => at + 2,
            "*" => {
                found.push(Path { segments: prefix.to_vec(), line: token.line });
                at + 1
            }
            word if is_word(word) => tree(tokens, at, prefix, found),
            _ => at + 1,
        };
    }
    at
}

/// Where the item that starts at `start` ends: behind its `;`, or behind the braces that close it.
fn item_end(tokens: &[Token<'_>], start: usize) -> usize {
    let mut depth = 0_usize;
    for (at, token) in tokens.iter().enumerate().skip(start) {
        match token.text {
            "{" | "(" | "[" => depth += 1,
            "}" | ")" | "]" => {
                depth = depth.saturating_sub(1);
                if depth == 0 && token.text == "}" {
                    return at + 1;
                }
            }
            ";" | "," if depth == 0 => return at + 1,
            _ => {}
        }
    }
    tokens.len()
}

fn starts_with(tokens: &[Token<'_>], texts: &[&str]) -> bool {
    tokens.len() >= texts.len() && tokens.iter().zip(texts).all(|(token, text)| token.text == *text)
}

fn is_word(text: &str) -> bool {
    text.starts_with(|first: char| first.is_alphanumeric() || first == '_')
}

fn token_length(rest: &str, first: char) -> usize {
    if rest.starts_with("::") {
        return 2;
    }
    if !is_word(rest) {
        return first.len_utf8();
    }
    rest.find(|c: char| !c.is_alphanumeric() && c != '_').unwrap_or(rest.len())
}

/// The length of the white space, comment or literal at the start of `rest`.
fn skipped(rest: &str) -> Option<usize> {
    if rest.starts_with(char::is_whitespace) {
        return Some(rest.len() - rest.trim_start().len());
    }
    if rest.starts_with("//") {
        return Some(rest.find('\n').unwrap_or(rest.len()));
    }
    if rest.starts_with("/*") {
        return Some(block_comment(rest));
    }
    if rest.starts_with('"') {
        return Some(escaped(rest, '"'));
    }
    if rest.starts_with('\'') {
        return character(rest);
    }
    raw_text(rest).or_else(|| prefixed_text(rest))
}

fn block_comment(rest: &str) -> usize {
    let (mut depth, mut at) = (0_usize, 0);
    while at < rest.len() {
        if rest[at..].starts_with("/*") {
            (depth, at) = (depth + 1, at + 2);
        } else if rest[at..].starts_with("*/") {
            (depth, at) = (depth - 1, at + 2);
            if depth == 0 {
                return at;
            }
        } else {
            at += rest[at..].chars().next().map_or(1, char::len_utf8);
        }
    }
    rest.len()
}

/// The length of a literal between two `quote`s, the first of which starts `rest`.
fn escaped(rest: &str, quote: char) -> usize {
    let mut backslash = false;
    for (at, c) in rest.char_indices().skip(1) {
        match c {
            _ if backslash => backslash = false,
            '\\' => backslash = true,
            c if c == quote => return at + 1,
            _ => {}
        }
    }
    rest.len()
}

/// A character literal, told from a lifetime.
fn character(rest: &str) -> Option<usize> {
    let mut chars = rest.chars().skip(1);
    let (first, second) = (chars.next()?, chars.next()?);
    (first == '\\' || second == '\'').then(|| escaped(rest, '\''))
}

fn raw_text(rest: &str) -> Option<usize> {
    let body = rest.strip_prefix("br").or_else(|| rest.strip_prefix('r'))?;
    let hashes = body.len() - body.trim_start_matches('#').len();
    let inner = body[hashes..].strip_prefix('"')?;
    let end = format!("\"{}", "#".repeat(hashes));
    let start = rest.len() - inner.len();
    Some(inner.find(&end).map_or(rest.len(), |at| start + at + end.len()))
}

fn prefixed_text(rest: &str) -> Option<usize> {
    let body = rest.strip_prefix(['b', 'c'])?;
    if body.starts_with('"') {
        return Some(1 + escaped(body, '"'));
    }
    if rest.starts_with("b'") { Some(1 + escaped(body, '\'')) } else { None }
}

#[cfg(test)]
mod tests {
    use super::{paths, test_modules, tokens, without_tests};

    fn shown(text: &str) -> Vec<String> {
        let tokens = tokens(text);
        paths(&without_tests(&tokens)).iter().map(|path| path.segments.join("::")).collect()
    }

    #[test]
    fn comments_and_texts_hold_no_paths() {
        let text = r##"
            // crate::a::b
            /* crate::a::c /* nested */ crate::d::e */
            const A: &str = "crate::f::g \" crate::h::i";
            const B: &str = r#"crate::j::k"#;
            const C: char = '"'; fn f<'a>(x: &'a u8) -> char { 'x' }
            const D: u8 = b'"';
            use crate::l::m;
        "##;
        assert_eq!(shown(text), ["crate::l::m"]);
    }

    #[test]
    fn a_use_tree_is_read_leaf_by_leaf() {
        let text = "use crate::{a::{B, C as D}, e::*, f}; fn g() { let x = super::h::I::new(); }";
        assert_eq!(shown(text), ["crate::a::B", "crate::a::C", "crate::e::*", "crate::f", "super::h::I::new"]);
    }

    #[test]
    fn test_code_is_left_out() {
        let text = "use crate::a::b; #[cfg(test)] extern crate std; #[cfg(test)] mod tests { fn f() { crate::c::d(); } } \
                    fn g(x: [u8; 2]) { crate::e::f() }";
        assert_eq!(shown(text), ["crate::a::b", "crate::e::f"]);
    }

    #[test]
    fn test_modules_in_other_files_are_named() {
        let text =
            "mod a; #[cfg(test)] mod b; #[cfg(test)] mod inline {} #[cfg(test)] #[rustfmt::skip] pub(super) mod c;";
        assert_eq!(test_modules(&tokens(text)), ["b", "c"]);
    }

    #[test]
    fn lines_are_counted() {
        let tokens = tokens("use a::b;\n\n/* \n */ use c::d;");
        let lines: Vec<_> = paths(&tokens).iter().map(|path| path.line).collect();
        assert_eq!(lines, [1, 4]);
    }
}
