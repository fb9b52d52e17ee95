//! Memory with a limit for a process: a control group.

use std::fs;
use std::path::{Display, Path, PathBuf};

use anyhow::{Context, Result};

/// A control group whose memory has a limit, of either version of Linux's interface.
pub(crate) struct Group {
    folder: PathBuf,
    is_old: bool,
}

impl Group {
    pub(crate) fn of(side: usize) -> Result<Self> {
        let roots = [("/sys/fs/cgroup/memory", true), ("/sys/fs/cgroup", false)];
        let has_memory = |root: &str, is_old| {
            let controllers = fs::read_to_string(format!("{root}/cgroup.subtree_control")).unwrap_or_default();
            if is_old { Path::new(root).join("memory.limit_in_bytes").exists() } else { controllers.contains("memory") }
        };
        let root = roots.into_iter().find(|(root, is_old)| has_memory(root, *is_old));
        let (root, is_old) = root.context("this kernel limits the memory of no group")?;
        Ok(Self { folder: Path::new(root).join(format!("cara-hosts-{}-{side}", std::process::id())), is_old })
    }

    pub(crate) fn make(side: usize) -> Result<()> {
        Ok(fs::create_dir(Self::of(side)?.folder)?)
    }

    pub(crate) fn path(&self) -> Display<'_> {
        self.folder.display()
    }

    fn set(&self, limit: &str) -> Result<()> {
        let file = if self.is_old { "memory.limit_in_bytes" } else { "memory.max" };
        Ok(fs::write(self.folder.join(file), limit)?)
    }

    /// Lets it have so many bytes more than it has.
    pub(crate) fn limit(&self, more: u64) -> Result<()> {
        let file = if self.is_old { "memory.usage_in_bytes" } else { "memory.current" };
        let used: u64 = fs::read_to_string(self.folder.join(file))?.trim().parse()?;
        self.set(&(used + more).to_string())
    }

    pub(crate) fn remove(&self) {
        // It stays as long as a process is in it.
        let _ = fs::remove_dir(&self.folder);
    }

    pub(crate) fn free(&self) -> Result<()> {
        self.set(if self.is_old { "-1" } else { "max" })
    }
}
