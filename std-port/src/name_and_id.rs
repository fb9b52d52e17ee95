//! A unit's name and ID number as one argument of a command line.

use std::fmt;
use std::str::FromStr;

/// A unit's name and ID number, written as `AGV_manager/1`.
///
/// ```
/// let manager: cara_std::NameAndId = "AGV_manager/1".parse()?;
/// assert_eq!((manager.name.as_str(), manager.id), ("AGV_manager", 1));
/// # Ok::<(), &'static str>(())
/// ```
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct NameAndId {
    /// Its name.
    pub name: String,
    /// Its ID number.
    pub id: u32,
}

impl FromStr for NameAndId {
    type Err = &'static str;

    fn from_str(text: &str) -> Result<Self, Self::Err> {
        let (name, id) = text.rsplit_once('/').ok_or("write NAME/ID, as in AGV_manager/1")?;
        let id = id.parse().map_err(|_| "the ID behind the slash is a number from 0 to 4294967295")?;
        if name.is_empty() {
            return Err("the name before the slash is missing: write NAME/ID, as in AGV_manager/1");
        }
        Ok(Self { name: name.to_owned(), id })
    }
}

impl fmt::Display for NameAndId {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "{}/{}", self.name, self.id)
    }
}

#[cfg(test)]
mod tests {
    use super::NameAndId;

    #[test]
    fn a_name_and_an_id_are_told_apart() {
        let named: NameAndId = "a/b/7".parse().unwrap();
        assert_eq!((named.name.as_str(), named.id, named.to_string().as_str()), ("a/b", 7, "a/b/7"));
        for wrong in ["agv", "agv/x", "/1", "agv/-1", "agv/4294967296"] {
            assert!(wrong.parse::<NameAndId>().is_err(), "{wrong}");
        }
    }
}
