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

#[cfg(test)]
mod tests {
    use super::Which;

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
