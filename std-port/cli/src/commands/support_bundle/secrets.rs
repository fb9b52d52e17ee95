//! The secrets that this host has, so that none of them gets into an archive, wherever it may stand.

use std::collections::BTreeSet;
use std::fs;
use std::path::{Path, PathBuf};

use cara_std::keys::location::own_folder;
use cara_tools::files;

/// Longest file with keys that is read.
const LONGEST_FILE: u64 = 16 << 20;
/// A shorter word of a file of keys, or value of a variable, is no secret that could be found again.
const SHORTEST: usize = 8;
/// Keys in their files, as hexadecimal digits.
const SHORTEST_KEY: usize = 32;
/// Variables of the environment whose names have one of these.
const TELLING: [&str; 6] = ["KEY", "TOKEN", "SECRET", "PASS", "CREDENTIAL", "AUTH"];

#[derive(Default)]
pub(super) struct Secrets {
    values: Vec<Vec<u8>>,
    keys: BTreeSet<Vec<u8>>,
    /// Of the keys, so that their number does not matter where they are looked for.
    lengths: BTreeSet<usize>,
}

impl Secrets {
    /// Of the environment, the files of keys, and the folder of state.
    pub(super) fn of_host(state: Option<&Path>) -> Self {
        let variables = std::env::vars_os().filter_map(|(name, value)| {
            let name = name.to_str()?.to_ascii_uppercase();
            let value = value.to_str()?.to_owned();
            // The path of a file with a secret is none.
            (TELLING.iter().any(|part| name.contains(part)) && !Path::new(&value).exists()).then_some(value)
        });
        let values = variables.filter(|value| value.len() >= SHORTEST).map(String::into_bytes).collect();
        let mut secrets = Self { values, ..Self::default() };
        let folders =
            own_folder().into_iter().chain([PathBuf::from("/etc/cara/keys")]).chain(state.map(Path::to_owned));
        folders.flat_map(files_in).filter_map(|path| files::read(&path, LONGEST_FILE).ok()).for_each(|(bytes, _)| {
            secrets.keys.extend(digits(&bytes).map(<[u8]>::to_vec));
        });
        secrets.lengths = secrets.keys.iter().map(Vec::len).collect();
        secrets
    }

    pub(super) fn are_in(&self, bytes: &[u8]) -> bool {
        let is_key = |digits: &[u8]| {
            self.lengths.iter().any(|length| digits.windows(*length).any(|part| self.keys.contains(part)))
        };
        self.values.iter().any(|value| bytes.windows(value.len()).any(|part| part == value))
            || digits(bytes).any(is_key)
    }
}

/// What may be a key.
fn digits(bytes: &[u8]) -> impl Iterator<Item = &[u8]> {
    bytes.split(|byte| !byte.is_ascii_hexdigit()).filter(|digits| digits.len() >= SHORTEST_KEY)
}

/// The files of a folder that may hold keys; the path itself, if it is none.
fn files_in(folder: PathBuf) -> Vec<PathBuf> {
    let Ok(entries) = fs::read_dir(&folder) else { return vec![folder] };
    let is_of_keys =
        |path: &PathBuf| path.extension().is_some_and(|own| ["keys", "root", "token"].iter().any(|it| own == *it));
    entries.filter_map(|entry| Some(entry.ok()?.path())).filter(is_of_keys).collect()
}
