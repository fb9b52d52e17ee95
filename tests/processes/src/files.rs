//! Where figures are to be written: whether they can be, before it takes long to get them.

use std::fs::OpenOptions;
use std::io::ErrorKind;
use std::path::Path;

use anyhow::{Context, Result, bail};

/// Fails unless a file can be written at `path`. What stands there stays as it is, and nothing is left behind.
pub fn can_write(path: &Path) -> Result<()> {
    let shown = path.display();
    if path.is_dir() {
        bail!("{shown} is a folder: name a file in it");
    }
    let reported = || format!("cannot write {shown}: name a file in a folder that is there and where you may write");
    match OpenOptions::new().write(true).create_new(true).open(path) {
        Ok(_) => std::fs::remove_file(path).with_context(reported),
        Err(error) if error.kind() == ErrorKind::AlreadyExists => {
            OpenOptions::new().append(true).open(path).map(drop).with_context(reported)
        }
        Err(error) => Err(error).with_context(reported),
    }
}

/// Fails unless files can be written in `folder`, which is made if it is not there.
pub fn can_write_in(folder: &Path) -> Result<()> {
    let reported = || format!("cannot make the folder {}: name one where you may write", folder.display());
    std::fs::create_dir_all(folder).with_context(reported)?;
    can_write(&folder.join(".trial"))
}

#[cfg(test)]
mod tests {
    use super::{can_write, can_write_in};
    use std::path::Path;

    #[test]
    fn a_trial_changes_nothing() {
        let folder = std::env::temp_dir().join(format!("files-{}", super::super::random_fleet()));
        can_write_in(&folder.join("inner")).unwrap();
        let file = folder.join("inner/rows.json");
        can_write(&file).unwrap();
        assert!(!file.exists());
        std::fs::write(&file, "rows").unwrap();
        can_write(&file).unwrap();
        assert_eq!(std::fs::read_to_string(&file).unwrap(), "rows");
        assert_eq!(std::fs::read_dir(folder.join("inner")).unwrap().count(), 1);
        std::fs::remove_dir_all(&folder).unwrap();
    }

    #[test]
    fn what_cannot_be_written_is_named() {
        for path in ["/proc/rows.json", "/nowhere/rows.json", "."] {
            let error = format!("{:#}", can_write(Path::new(path)).unwrap_err());
            assert!(error.contains(path), "{error}");
        }
        let error = format!("{:#}", can_write_in(Path::new("/proc/plots")).unwrap_err());
        assert!(error.contains("/proc/plots"), "{error}");
    }
}
