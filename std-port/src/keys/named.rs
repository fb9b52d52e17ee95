//! A node as it is written in commands: `depot/1@m_unit`, `agv-17/17`.

use cara_core::distribution::identity::{Identity, Role};

/// The node as `cara keys` takes it: `NAME/ID`, and `@m_unit` behind an m_unit's.
///
/// ```
/// use cara_std::Identity;
/// use cara_std::keys::{full_name, parse_node};
///
/// assert_eq!(full_name(&Identity::m_unit("depot", 1)?), "depot/1@m_unit");
/// assert_eq!(parse_node("agv/17"), Ok(Identity::s_unit("agv", 17)?));
/// # Ok::<(), cara_std::Error>(())
/// ```
pub fn full_name(identity: &Identity) -> String {
    match identity.role() {
        Role::MUnit => format!("{identity}@m_unit"),
        Role::SUnit => identity.to_string(),
    }
}

/// What [`full_name`] wrote; `@s_unit` may stand behind an s_unit's.
pub fn parse_node(text: &str) -> Result<Identity, &'static str> {
    const FORM: &str = "write NAME/ID for an s_unit and NAME/ID@m_unit for an m_unit";
    let (plain, role) = match text.rsplit_once('@') {
        Some((plain, "m_unit")) => (plain, Role::MUnit),
        Some((plain, "s_unit")) => (plain, Role::SUnit),
        _ => (text, Role::SUnit),
    };
    let (name, id) = plain.rsplit_once('/').ok_or(FORM)?;
    let id = id.parse().map_err(|_| "the ID behind the slash is a number from 0 to 4294967295")?;
    Identity::new(name, id, role).map_err(|_| "a name has 1 to 32 bytes and no control characters")
}

/// A command as it is typed, with quotes where a word needs them.
pub(super) fn command(words: &[&str]) -> String {
    // No word has a zero byte: names have no control characters.
    shlex::try_join(words.iter().copied()).unwrap_or_else(|_| words.join(" "))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn what_is_written_is_read() {
        for identity in [Identity::m_unit("depot", 1), Identity::s_unit("a/b @c", u32::MAX), Identity::m_unit("ä", 0)]
        {
            let identity = identity.unwrap();
            assert_eq!(parse_node(&full_name(&identity)), Ok(identity));
        }
        assert_eq!(parse_node("agv/1@s_unit"), Ok(Identity::s_unit("agv", 1).unwrap()));
    }

    #[test]
    fn what_names_no_node_is_told() {
        let long = format!("{}/1", "n".repeat(33));
        for wrong in ["", "agv", "agv/", "/1", "agv/x", "agv/-1", "agv/4294967296", "a\nb/1", "agv/1@manager", &long] {
            assert!(parse_node(wrong).is_err(), "{wrong:?}");
        }
    }

    #[test]
    fn a_command_can_be_pasted() {
        assert_eq!(command(&["cara", "keys", "derive", "agv 1/1"]), "cara keys derive 'agv 1/1'");
    }
}
