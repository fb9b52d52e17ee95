//! Keys for the units of a test, drawn into a temporary folder: units of its own process take their files from there,
//! and other processes get the folder in `CARA_KEYS`. No test reads the keys of the user that runs it.

use std::path::{Path, PathBuf};

use anyhow::{Context, Result};
use cara_std::keys::{FleetKeys, KeyError, Store, location, parse_node};
use cara_std::{Fleet, Identity, Role};
use tempfile::TempDir;

/// A folder with a fleet's root and the file of each node.
pub struct KeyFolder {
    folder: TempDir,
    fleet: Fleet,
}

impl KeyFolder {
    /// Draws the keys of a fleet's nodes, which are written as `cara keys` takes them. Each s_unit belongs to all m_units.
    pub fn draw(fleet: u32, nodes: &[&str]) -> Result<Self> {
        let drawn = Self { folder: tempfile::tempdir()?, fleet: Fleet(fleet) };
        let mut keys = FleetKeys::draw(drawn.fleet)?;
        add(&mut keys, nodes)?;
        Store::create(drawn.path(), keys)?.save()?;
        Ok(drawn)
    }

    /// Makes the keys of further nodes, and updates those of their peers.
    pub fn add(&self, nodes: &[&str]) -> Result<()> {
        let mut store = loop {
            match Store::open(self.path(), self.fleet) {
                // A process that another thread has just begun holds the lock until its program runs.
                Err(KeyError::InUse(_)) => std::thread::yield_now(),
                opened => break opened?,
            }
        };
        add(store.keys_mut(), nodes)?;
        store.save()?;
        Ok(())
    }

    /// What `CARA_KEYS` is to be for processes of the test.
    pub fn path(&self) -> &Path {
        self.folder.path()
    }

    /// The file of a node.
    pub fn file(&self, identity: &Identity) -> Result<PathBuf> {
        let file = self.path().join(location::file_name(identity, self.fleet));
        file.exists().then_some(file).with_context(|| format!("{identity} has no keys in this test"))
    }
}

/// Each s_unit belongs to all m_units.
fn add(keys: &mut FleetKeys, nodes: &[&str]) -> Result<()> {
    let nodes: Result<Vec<_>, _> = nodes.iter().map(|node| parse_node(node)).collect();
    let nodes = nodes.map_err(anyhow::Error::msg)?;
    let known = keys.members().nodes().iter().map(|member| member.identity.clone());
    let m_units = known.chain(nodes.clone()).filter(|node| node.role() == Role::MUnit).collect::<Vec<_>>();
    let has_s_units = nodes.iter().any(|node| node.role() == Role::SUnit);
    keys.add_all(&nodes, if has_s_units { &m_units } else { &[] })?;
    Ok(())
}
