//! The secrets that this host has, so that none of them gets into an archive, wherever it may stand.

use std::collections::BTreeSet;
use std::path::{Path, PathBuf};
use std::{env, fs, io};

use cara_std::keys::location::{VARIABLE, own_folder};
use cara_tools::files;
use serde_json::Value;

/// Longest file with keys that is read.
const LONGEST_FILE: u64 = 16 << 20;
/// A shorter value of a variable is no secret that could be found again.
const SHORTEST: usize = 8;
/// Keys in their files, as hexadecimal digits.
const SHORTEST_KEY: usize = 32;
/// Tokens of users of the page, in their files.
const SHORTEST_TOKEN: usize = 16;
/// JSON stands as text in JSON, which may stand in JSON again: the arguments of a call in a log line in a black box.
const DEEPEST: usize = 3;
/// Variables of the environment whose names have one of these.
const TELLING: [&str; 6] = ["KEY", "TOKEN", "SECRET", "PASS", "CREDENTIAL", "AUTH"];
const BASE64: &[u8; 64] = b"ABCDEFGHIJKLMNOPQRSTUVWXYZabcdefghijklmnopqrstuvwxyz0123456789+/";

#[derive(Default)]
pub(super) struct Secrets {
    /// In each form in which they are looked for.
    values: BTreeSet<Vec<u8>>,
    keys: Parts,
    /// The keys in base64.
    encoded: Parts,
    /// What may have secrets that are not known, and why.
    pub(super) unread: Vec<(PathBuf, String)>,
}

/// Texts that are looked for in others. Their number does not matter to that.
#[derive(Default)]
struct Parts {
    texts: BTreeSet<Vec<u8>>,
    lengths: BTreeSet<usize>,
}

impl Parts {
    fn add(&mut self, text: Vec<u8>) {
        self.lengths.insert(text.len());
        self.texts.insert(text);
    }

    fn are_in(&self, text: &[u8]) -> bool {
        self.lengths.iter().any(|length| text.windows(*length).any(|part| self.texts.contains(part)))
    }
}

impl Secrets {
    /// Of the environment, the files of keys, the folder of state, and files that are named.
    pub(super) fn of_host<'a>(state: Option<&Path>, named: impl Iterator<Item = &'a PathBuf>) -> Self {
        let mut secrets = Self::default();
        for (name, value) in env::vars_os() {
            let (Some(name), Some(value)) = (name.to_str(), value.to_str()) else { continue };
            let name = name.to_ascii_uppercase();
            // The path of a file with a secret is none.
            if TELLING.iter().any(|part| name.contains(part)) && !Path::new(value).exists() {
                secrets.add_value(value);
            }
        }
        let usual = [own_folder(), env::var_os(VARIABLE).map(PathBuf::from), Some("/etc/cara/keys".into())];
        for path in usual.into_iter().flatten().chain(state.map(Path::to_owned)) {
            secrets.take(&path, |error| error.kind() != io::ErrorKind::NotFound);
        }
        named.for_each(|path| secrets.take(path, |_| true));
        secrets
    }

    /// Takes the secrets of a file, or of the files of a folder.
    fn take(&mut self, path: &Path, is_told: impl Fn(&io::Error) -> bool) {
        let mut failed = |path: &Path, error: io::Error| {
            if is_told(&error) {
                self.unread.push((path.to_owned(), error.to_string()));
            }
        };
        let files = files_in(path).map_err(|error| failed(path, error)).unwrap_or_default();
        let mut read = Vec::new();
        for file in &files {
            match files::read(file, LONGEST_FILE) {
                Ok((bytes, _)) => read.push((file, bytes)),
                Err(error) => failed(file, error),
            }
        }
        for (file, bytes) in read {
            if has_extension(file, "token") {
                let text = String::from_utf8_lossy(&bytes);
                let tokens = text.lines().filter_map(|line| line.split_whitespace().last());
                tokens.filter(|token| token.len() >= SHORTEST_TOKEN).for_each(|token| self.add_value(token));
            }
            for key in runs(&bytes, u8::is_ascii_hexdigit, SHORTEST_KEY) {
                self.add_key(key.to_ascii_lowercase());
            }
        }
    }

    fn add_value(&mut self, value: &str) {
        // A text is looked through line by line.
        for part in value.lines().chain([value]).filter(|part| part.len() >= SHORTEST) {
            let mut form = part.to_owned();
            for _ in 0..=DEEPEST {
                self.values.insert(form.clone().into_bytes());
                // Without the quotes around it.
                form = Value::from(form).to_string();
                form.pop();
                form.remove(0);
            }
        }
    }

    /// Adds a key, as lower-case digits.
    fn add_key(&mut self, digits: Vec<u8>) {
        let pairs = digits.chunks_exact(2).filter_map(|pair| std::str::from_utf8(pair).ok());
        let bytes: Vec<_> = pairs.filter_map(|pair| u8::from_str_radix(pair, 16).ok()).collect();
        // It may stand behind other bytes. Characters that have bits of these, or of what follows, are not looked for.
        for before in 0..3 {
            let text = base64(&[&[0; 2][..before], &bytes].concat());
            let own = (before * 8).div_ceil(6)..(before + bytes.len()) * 8 / 6;
            self.encoded.add(text.get(own).unwrap_or_default().to_vec());
        }
        self.keys.add(digits);
    }

    pub(super) fn are_in(&self, bytes: &[u8]) -> bool {
        let is_base64 = |byte: &u8| byte.is_ascii_alphanumeric() || b"+/-_".contains(byte);
        self.values.iter().any(|value| bytes.windows(value.len()).any(|part| part == value))
            || runs(bytes, u8::is_ascii_hexdigit, SHORTEST_KEY)
                .any(|digits| self.keys.are_in(&digits.to_ascii_lowercase()))
            || runs(bytes, is_base64, SHORTEST_KEY * 2 / 3).any(|text| self.encoded.are_in(&usual(text)))
    }
}

/// The longest pieces of such bytes, of at least a length.
fn runs(bytes: &[u8], is_such: impl Fn(&u8) -> bool, least: usize) -> impl Iterator<Item = &[u8]> {
    bytes.split(move |byte| !is_such(byte)).filter(move |run| run.len() >= least)
}

/// Without the end that a length which is no multiple of 3 has.
fn base64(bytes: &[u8]) -> Vec<u8> {
    let of_three = |three: &[u8]| {
        let bits = three.iter().fold(0, |bits, byte| bits << 8 | usize::from(*byte));
        let bits = bits << (8 * (3 - three.len()));
        [18, 12, 6, 0].map(|shift| BASE64[bits >> shift & 63])
    };
    bytes.chunks(3).flat_map(of_three).collect()
}

/// Base64 for URLs as the usual one.
fn usual(text: &[u8]) -> Vec<u8> {
    let of_one = |byte: &u8| match byte {
        b'-' => b'+',
        b'_' => b'/',
        byte => *byte,
    };
    text.iter().map(of_one).collect()
}

/// The files of a folder that may hold keys; the path itself, if it is none.
fn files_in(path: &Path) -> io::Result<Vec<PathBuf>> {
    if !path.is_dir() {
        return Ok(vec![path.to_owned()]);
    }
    let entries: io::Result<Vec<_>> = fs::read_dir(path)?.map(|entry| Ok(entry?.path())).collect();
    Ok(entries?
        .into_iter()
        .filter(|file| ["keys", "root", "token"].iter().any(|own| has_extension(file, own)))
        .collect())
}

fn has_extension(file: &Path, extension: &str) -> bool {
    file.extension().is_some_and(|own| own == extension)
}
