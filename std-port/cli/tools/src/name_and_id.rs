//! A unit's name and ID number as one argument, and other words of a command line.

pub use cara_std::NameAndId;
use cara_std::control::protocol::NodeInfo;

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
    use super::quoted;

    #[test]
    fn what_a_shell_would_read_otherwise_is_quoted() {
        let reported = ["agv-17/17", "#7", "$(reboot)", "it's"].map(quoted);
        assert_eq!(reported, ["agv-17/17", "'#7'", "'$(reboot)'", r"'it'\''s'"]);
    }
}
