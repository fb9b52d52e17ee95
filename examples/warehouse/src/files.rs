//! The files that a run is made of.

use std::path::{Path, PathBuf};

use anyhow::{Context, Result};
use clap::Args;

use crate::map::Map;

/// The floor and its stations.
#[derive(Args, Clone, Debug)]
pub struct MapFiles {
    /// The floor, in the `.map` format of the MovingAI benchmarks.
    #[arg(long, value_name = "FILE")]
    pub map: PathBuf,
    /// Charging stations, a cell a line.
    #[arg(long, value_name = "FILE")]
    pub stations: PathBuf,
}

impl MapFiles {
    /// Reads both; a mistake is told with its place.
    pub fn map(&self) -> Result<Map> {
        let mut map = Map::parse(&self.map.to_string_lossy(), &read(&self.map)?)?;
        map.read_stations(&self.stations.to_string_lossy(), &read(&self.stations)?)?;
        Ok(map)
    }
}

/// Reads a file of text.
pub fn read(path: &Path) -> Result<String> {
    std::fs::read_to_string(path).with_context(|| format!("cannot read {}", path.display()))
}
