//! Which vehicle has which place, without I/O. The lease is no part of it: what the record says outlasts every link.

use std::collections::BTreeMap;
use std::fmt;
use std::str::FromStr;

use cara_std::Identity;
use cara_std::keys::{full_name, parse_node};

/// Who may be in a place.
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum Occupant {
    /// No vehicle.
    Nobody,
    /// This vehicle.
    Vehicle(Identity),
    /// The record does not say: somebody has to look, and to release the place.
    Unknown,
}

/// Why nothing has changed.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
pub enum Refused {
    /// There is no such place.
    #[error("there is no place of this name")]
    NoPlace,
    /// Another vehicle may be in it.
    #[error("{0} may be in it")]
    Taken(Occupant),
    /// A newer pass was given since.
    #[error("a newer pass was given")]
    OldPass,
    /// The file could not be written.
    #[error("{0}")]
    NotKept(String),
}

/// A place.
#[derive(Clone, Debug, PartialEq, Eq)]
struct Place {
    occupant: Occupant,
    /// Counts what was granted: only the newest pass gives the place back.
    pass: i64,
}

/// All places of one unit.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub struct Record(BTreeMap<String, Place>);

impl Record {
    /// Adds a place unless it is there. Whether it is empty is not known yet.
    pub fn add(&mut self, place: &str) {
        self.0.entry(place.to_owned()).or_insert(Place { occupant: Occupant::Unknown, pass: 0 });
    }

    /// Who may be in a place.
    pub fn occupant(&self, place: &str) -> Result<&Occupant, Refused> {
        self.0.get(place).map(|place| &place.occupant).ok_or(Refused::NoPlace)
    }

    /// A vehicle may enter an empty place, and its own. The number of the pass; older ones count no longer.
    pub fn enter(&mut self, place: &str, vehicle: &Identity) -> Result<i64, Refused> {
        let place = self.place(place)?;
        match &place.occupant {
            Occupant::Nobody => {}
            Occupant::Vehicle(occupant) if occupant == vehicle => {}
            other => return Err(Refused::Taken(other.clone())),
        }
        place.pass = place.pass.wrapping_add(1);
        place.occupant = Occupant::Vehicle(vehicle.clone());
        Ok(place.pass)
    }

    /// The vehicle with this pass has left. Saying it twice does no harm.
    pub fn left(&mut self, place: &str, vehicle: &Identity, pass: i64) -> Result<(), Refused> {
        let place = self.place(place)?;
        if place.pass != pass {
            return Err(Refused::OldPass);
        }
        match &place.occupant {
            Occupant::Vehicle(occupant) if occupant == vehicle => place.occupant = Occupant::Nobody,
            Occupant::Nobody => {}
            other => return Err(Refused::Taken(other.clone())),
        }
        Ok(())
    }

    /// Somebody has looked: this occupant is not in it.
    pub fn release(&mut self, place: &str, looked_for: &Occupant) -> Result<(), Refused> {
        let place = self.place(place)?;
        if place.occupant != *looked_for {
            return Err(Refused::Taken(place.occupant.clone()));
        }
        place.occupant = Occupant::Nobody;
        Ok(())
    }

    fn place(&mut self, place: &str) -> Result<&mut Place, Refused> {
        self.0.get_mut(place).ok_or(Refused::NoPlace)
    }
}

impl fmt::Display for Occupant {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::Nobody => f.write_str("nobody"),
            Self::Vehicle(vehicle) => f.write_str(&full_name(vehicle)),
            Self::Unknown => f.write_str("unknown"),
        }
    }
}

impl FromStr for Occupant {
    type Err = &'static str;

    fn from_str(text: &str) -> Result<Self, Self::Err> {
        match text {
            "nobody" => Ok(Self::Nobody),
            "unknown" => Ok(Self::Unknown),
            // A vehicle's name has a slash.
            vehicle => parse_node(vehicle).map(Self::Vehicle),
        }
    }
}

/// A line a place: its name, its newest pass, its occupant.
impl fmt::Display for Record {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        self.0.iter().try_for_each(|(name, Place { occupant, pass })| writeln!(f, "{name} {pass} {occupant}"))
    }
}

impl FromStr for Record {
    type Err = String;

    fn from_str(text: &str) -> Result<Self, String> {
        let mut record = Self::default();
        // A name that was cut off may be another vehicle's.
        if !text.is_empty() && !text.ends_with('\n') {
            return Err("the last line is cut off".into());
        }
        for (number, line) in text.lines().enumerate() {
            let place = || -> Option<_> {
                let mut words = line.splitn(3, ' ');
                let (name, pass, occupant) = (words.next()?, words.next()?, words.next()?);
                Some((name.to_owned(), Place { occupant: occupant.parse().ok()?, pass: pass.parse().ok()? }))
            };
            let (name, place) = place().ok_or_else(|| format!("line {} is damaged", number + 1))?;
            record.0.insert(name, place);
        }
        Ok(record)
    }
}
