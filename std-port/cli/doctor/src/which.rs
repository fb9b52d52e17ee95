//! The node that the doctor is asked about.

use cara_std::Identity;

/// `NAME`, `NAME/ID` or `#ID`.
#[derive(Clone, Debug, PartialEq, Eq)]
pub(crate) struct Which(pub(crate) String);

impl Which {
    /// Whether a node is meant.
    pub(crate) fn is(&self, name: &str, id: u32) -> bool {
        self.0 == name || self.0 == format!("{name}/{id}") || self.0 == format!("#{id}")
    }

    /// Whether a node is meant.
    pub(crate) fn is_identity(&self, identity: &Identity) -> bool {
        self.is(identity.name(), identity.id())
    }

    /// Whether a node is meant of which `NAME/ID` is known.
    pub(crate) fn is_text(&self, text: &str) -> bool {
        text.rsplit_once('/')
            .and_then(|(name, id)| Some((name, id.parse().ok()?)))
            .is_some_and(|(name, id)| self.is(name, id))
    }
}

/// What the command line says, unless no node can be called so.
pub(crate) fn parse(text: &str) -> Result<Which, String> {
    let number = |id: &str| id.parse::<u32>().is_ok();
    let (name, sound) = match (text.strip_prefix('#'), text.rsplit_once('/')) {
        (Some(id), _) => ("node", number(id)),
        (None, Some((name, id))) => (name, number(id)),
        (None, None) => (text, true),
    };
    if !sound {
        return Err("write NAME, NAME/ID or #ID; the ID is a number from 0 to 4294967295".to_owned());
    }
    Identity::s_unit(name, 0).map_err(|error| error.to_string())?;
    Ok(Which(text.to_owned()))
}

#[cfg(test)]
mod tests {
    use super::{Which, parse};

    #[test]
    fn what_no_node_can_be_called_is_refused() {
        for text in ["", "#", "#x", "agv-17/x", "agv-17/", "/17", "agv/4294967296", "a\nb"] {
            assert!(parse(text).is_err(), "{text:?}");
        }
        for text in ["agv-17", "agv-17/17", "#17", "a/b/7", "two words"] {
            assert_eq!(parse(text).unwrap().0, text);
        }
    }

    #[test]
    fn a_node_is_meant_by_name_id_or_both() {
        for text in ["agv-7", "agv-7/7", "#7"] {
            assert!(Which(text.into()).is("agv-7", 7) && Which(text.into()).is_text("agv-7/7"), "{text}");
        }
        for text in ["agv", "agv-7/8", "#8", "7", ""] {
            assert!(!Which(text.into()).is("agv-7", 7) && !Which(text.into()).is_text("agv-7/7"), "{text}");
        }
        assert!(Which("a/7".into()).is("a/7", 1), "a name may have a slash");
        assert!(!Which("agv".into()).is_text("agv/x") && !Which("agv".into()).is_text("agv"));
    }
}
