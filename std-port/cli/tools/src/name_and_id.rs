//! A unit's name and ID number as one argument.

use std::fmt;
use std::str::FromStr;

use cara_std::control::protocol::NodeInfo;

/// A unit's name and ID number, written as `AGV_manager/1`.
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

/// A node's `NAME/ID`.
pub fn full_name(node: &NodeInfo) -> String {
    format!("{}/{}", node.name, node.id)
}

/// A text as one word of a shell's command line.
pub fn quoted(text: &str) -> String {
    let plain = |character: char| character.is_ascii_alphanumeric() || "_-./".contains(character);
    if !text.is_empty() && !text.starts_with('-') && text.chars().all(plain) {
        return text.to_owned();
    }
    format!("'{}'", text.replace('\'', r"'\''"))
}

#[cfg(test)]
mod tests {
    use super::{NameAndId, quoted};

    #[test]
    fn a_name_and_an_id_are_told_apart() {
        let named: NameAndId = "a/b/7".parse().unwrap();
        assert_eq!((named.name.as_str(), named.id, named.to_string().as_str()), ("a/b", 7, "a/b/7"));
        for wrong in ["agv", "agv/x", "/1", "agv/-1", "agv/4294967296"] {
            assert!(wrong.parse::<NameAndId>().is_err(), "{wrong}");
        }
    }

    #[test]
    fn what_a_shell_would_read_otherwise_is_quoted() {
        let told = ["agv-17/17", "#7", "$(reboot)", "it's"].map(quoted);
        assert_eq!(told, ["agv-17/17", "'#7'", "'$(reboot)'", r"'it'\''s'"]);
    }
}
