//! A small disk that fails: a file system on a loop device.

use std::fs::File;
use std::io::Write;
use std::path::{Path, PathBuf};
use std::process::Command;

use anyhow::Result;
use cara_processes::network::run;
use tempfile::TempDir;

#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum Way {
    Full,
    /// As after an error of the device.
    ReadOnly,
    /// Whoever writes waits.
    Frozen,
}

pub(crate) struct Disk {
    folder: TempDir,
    image: PathBuf,
    images: u32,
    is_frozen: bool,
}

impl Disk {
    pub(crate) fn new() -> Result<Self> {
        let folder = tempfile::tempdir()?;
        let image = folder.path().join("image-0");
        File::create(&image)?.set_len(8 << 20)?;
        run(&format!("mkfs.ext4 -q -m 0 {}", image.display()))?;
        std::fs::create_dir(folder.path().join("disk"))?;
        let disk = Self { folder, image, images: 1, is_frozen: false };
        disk.mount()?;
        Ok(disk)
    }

    fn mount(&self) -> Result<()> {
        run(&format!("mount -o loop {} {}", self.image.display(), self.path().display()))
    }

    /// Where it is mounted.
    pub(crate) fn path(&self) -> PathBuf {
        self.folder.path().join("disk")
    }

    fn filler(&self) -> PathBuf {
        self.path().join("filler")
    }

    pub(crate) fn fail(&mut self, way: Way) -> Result<()> {
        self.is_frozen = way == Way::Frozen;
        let path = self.path();
        match way {
            Way::Full => fill(&self.filler()),
            Way::ReadOnly => run(&format!("mount -o remount,abort {}", path.display())),
            Way::Frozen => run(&format!("fsfreeze -f {}", path.display())),
        }
    }

    pub(crate) fn mend(&mut self, way: Way) -> Result<()> {
        self.is_frozen = false;
        let path = self.path();
        match way {
            Way::Full => Ok(std::fs::remove_file(self.filler())?),
            Way::ReadOnly => {
                // The failed one stays below it: a manager that starts between the two would make a new folder of state at the mount
                // point, and claim anew. Vehicles refuse that claim for 3 s.
                let image = self.folder.path().join(format!("image-{}", self.images));
                std::fs::copy(&self.image, &image)?;
                (self.image, self.images) = (image, self.images + 1);
                // It says with its code that it has mended something; what it has not, `mount` tells.
                Command::new("e2fsck").arg("-fy").arg(&self.image).output()?;
                self.mount()
            }
            Way::Frozen => run(&format!("fsfreeze -u {}", path.display())),
        }
    }
}

fn fill(path: &Path) -> Result<()> {
    let mut file = File::create(path)?;
    for size in [4096, 1] {
        while file.write_all(&vec![0; size]).is_ok() {}
    }
    let _ = file.sync_all();
    Ok(())
}

impl Drop for Disk {
    fn drop(&mut self) {
        let path = self.path();
        if self.is_frozen {
            let _ = run(&format!("fsfreeze -u {}", path.display()));
        }
        for _ in 0..self.images {
            let _ = run(&format!("umount -l {}", path.display()));
        }
    }
}
