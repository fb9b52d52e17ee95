//! "Did you mean": names that are close to one that is not known.

/// How alike two names must be to be offered, from 0 to 1.
const ALIKE: f64 = 0.75;

/// The known names that are close to `name`, the closest first.
pub fn close<'n>(name: &str, known: impl IntoIterator<Item = &'n str>) -> Vec<&'n str> {
    let alike = |other: &str| strsim::jaro_winkler(&name.to_lowercase(), &other.to_lowercase());
    let mut scored: Vec<_> = known.into_iter().map(|other| (alike(other), other)).collect();
    scored.retain(|(score, _)| *score >= ALIKE);
    scored.sort_by(|a, b| b.0.total_cmp(&a.0));
    scored.into_iter().map(|(_, other)| other).collect()
}

/// The names that are close, or else all: `position`, or: `x` or `y`.
pub fn either<'n>(name: &str, known: impl Iterator<Item = &'n str> + Clone) -> String {
    let mut names = close(name, known.clone());
    if names.is_empty() {
        names = known.collect();
    }
    if names.is_empty() {
        return "no argument".into();
    }
    names.iter().map(|name| format!("`{name}`")).collect::<Vec<_>>().join(" or ")
}

#[cfg(test)]
mod tests {
    use super::{close, either};

    #[test]
    fn what_is_close_is_offered() {
        let known = ["go_to", "pos_info", "battery", "stop"];
        assert_eq!(close("goto", known), ["go_to"]);
        assert_eq!(close("GO_TO", known), ["go_to"]);
        assert_eq!(close("batery", known), ["battery"]);
        assert!(close("zzz", known).is_empty());
    }

    #[test]
    fn where_nothing_is_close_all_are_told() {
        assert_eq!(either("positon", ["position", "speed"].into_iter()), "`position`");
        assert_eq!(either("qq", ["x", "y"].into_iter()), "`x` or `y`");
        assert_eq!(either("qq", [].into_iter()), "no argument");
    }
}
