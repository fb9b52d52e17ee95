//! Whether a unit of this program has keys, and where they are: options, files and the default mean the same everywhere.

use std::path::PathBuf;

use cara_std::Builder;
use cara_std::keys::KeyError;

use crate::exit::Ended;

/// The keys of a unit.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub enum Keys {
    /// Those of the file that is found where such files are looked for.
    #[default]
    Found,
    /// Those of this file.
    File(PathBuf),
    /// None: plain mode, which is asked for in words.
    Insecure,
}

impl Keys {
    /// The builder of a unit that has them.
    pub fn given_to<T: Send + 'static, R>(&self, builder: Builder<T, R>) -> Builder<T, R> {
        match self {
            Self::Found => builder,
            Self::File(path) => builder.key_file(path),
            Self::Insecure => builder.insecure(),
        }
    }
}

/// What is wrong with keys, as the end of a command.
pub fn failed(error: KeyError) -> anyhow::Error {
    Ended::failed("Keys", error.to_string())
}
