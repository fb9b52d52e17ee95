//! What the doctor can find. Each [`Id`] has its paragraph in docs/troubleshooting.md, under its name.

use serde::Serialize;

/// How bad it is.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord, Serialize)]
#[serde(rename_all = "snake_case")]
pub(crate) enum Severity {
    /// Why a node is not there, or why no node can be.
    Error,
    /// Not as it should be.
    Warning,
    /// For information; no action is needed.
    Info,
}

/// The kinds of findings. Their names are stable: programs and the documentation refer to them.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash, Serialize)]
#[serde(rename_all = "kebab-case")]
pub(crate) enum Id {
    /// Another program has the port of broadcasts.
    PortInUse,
    /// No network interface with an IPv4 address beside loopback.
    NoInterface,
    /// Interfaces, none of which is up.
    InterfaceDown,
    /// Interfaces that are up, none of which has a broadcast address.
    NoBroadcastAddress,
    /// The environment says that loopback alone is to be used.
    LoopbackOnly,
    /// The system refuses to send broadcasts.
    SendRefused,
    /// A broadcast of this host does not come back to it.
    BroadcastLost,
    /// A node answers when it is asked alone, and not when all are.
    BroadcastOneWay,
    /// An m_unit that shows itself cannot be connected to.
    TcpBlocked,
    /// A unit of this host holds its control socket and does not answer.
    UnitHangs,
    /// Too many ask a unit of this host.
    ControlFull,
    /// Another version of the protocol.
    OtherVersion,
    /// Another fleet.
    OtherFleet,
    /// Plain mode at one end, keys at the other.
    ModeMismatch,
    /// No keys of the fleet on this host.
    KeysMissing,
    /// A file with keys that is not taken.
    KeyFileRefused,
    /// Keys of another root, or of a generation that is over.
    WrongKeys,
    /// Generations of keys of which neither end takes the other's.
    KeyGenerations,
    /// The manager has no key for the node.
    NoPairKey,
    /// Two live nodes with one identity.
    Duplicate,
    /// A manager with a newer term commands in the place of one of its identity.
    Fenced,
    /// A node that starts again and again.
    Restarting,
    /// The manager takes no more nodes.
    Full,
    /// The node looks for another manager than those that run.
    WrongManager,
    /// No manager runs.
    NoManager,
    /// The manager refuses the node for another reason.
    Refused,
    /// Node and manager are both there, and no link is.
    NotJoining,
    /// The node was connected, left, and has not come back.
    Lost,
    /// Nothing was heard from the node.
    NotHeard,
    /// The node may be connected to a manager that cannot be asked from here.
    AskItsManager,
    /// Signs of life get lost on the node's link.
    LossyLink,
    /// The node's datagrams do not pass, in one direction or both.
    DatagramsBlocked,
    /// The stream of the node's link was dead though the node was heard.
    StreamDead,
    /// The node's clock differs from its manager's.
    ClockWrong,
    /// Too few files may be open for the nodes that may connect.
    FewDescriptors,
    /// A unit's access table has a mistake, so that an earlier one is in force.
    AccessTable,
    /// A claim is obeyed, and not stored.
    ClaimNotStored,
    /// Something else is sent to the port of broadcasts.
    ForeignDatagrams,
    /// Units of this host cannot be asked.
    ControlRefused,
    /// Several units run on this host.
    SeveralUnits,
    /// The node is connected.
    Connected,
    /// The m_unit is there and answers.
    Answers,
}

impl Id {
    /// All of them, in the order of the documentation.
    #[cfg(test)]
    pub(crate) const ALL: [Self; 42] = [
        Self::PortInUse,
        Self::NoInterface,
        Self::InterfaceDown,
        Self::NoBroadcastAddress,
        Self::LoopbackOnly,
        Self::SendRefused,
        Self::BroadcastLost,
        Self::BroadcastOneWay,
        Self::TcpBlocked,
        Self::UnitHangs,
        Self::ControlFull,
        Self::OtherVersion,
        Self::OtherFleet,
        Self::ModeMismatch,
        Self::KeysMissing,
        Self::KeyFileRefused,
        Self::WrongKeys,
        Self::KeyGenerations,
        Self::NoPairKey,
        Self::Duplicate,
        Self::Fenced,
        Self::Restarting,
        Self::Full,
        Self::WrongManager,
        Self::NoManager,
        Self::Refused,
        Self::NotJoining,
        Self::Lost,
        Self::NotHeard,
        Self::AskItsManager,
        Self::LossyLink,
        Self::DatagramsBlocked,
        Self::StreamDead,
        Self::ClockWrong,
        Self::FewDescriptors,
        Self::AccessTable,
        Self::ClaimNotStored,
        Self::ForeignDatagrams,
        Self::ControlRefused,
        Self::SeveralUnits,
        Self::Connected,
        Self::Answers,
    ];

    /// The name, as in `--json` and the documentation.
    pub(crate) const fn name(self) -> &'static str {
        match self {
            Self::PortInUse => "port-in-use",
            Self::NoInterface => "no-interface",
            Self::InterfaceDown => "interface-down",
            Self::NoBroadcastAddress => "no-broadcast-address",
            Self::LoopbackOnly => "loopback-only",
            Self::SendRefused => "send-refused",
            Self::BroadcastLost => "broadcast-lost",
            Self::BroadcastOneWay => "broadcast-one-way",
            Self::TcpBlocked => "tcp-blocked",
            Self::UnitHangs => "unit-hangs",
            Self::ControlFull => "control-full",
            Self::OtherVersion => "other-version",
            Self::OtherFleet => "other-fleet",
            Self::ModeMismatch => "mode-mismatch",
            Self::KeysMissing => "keys-missing",
            Self::KeyFileRefused => "key-file-refused",
            Self::WrongKeys => "wrong-keys",
            Self::KeyGenerations => "key-generations",
            Self::NoPairKey => "no-pair-key",
            Self::Duplicate => "duplicate",
            Self::Fenced => "fenced",
            Self::Restarting => "restarting",
            Self::Full => "full",
            Self::WrongManager => "wrong-manager",
            Self::NoManager => "no-manager",
            Self::Refused => "refused",
            Self::NotJoining => "not-joining",
            Self::Lost => "lost",
            Self::NotHeard => "not-heard",
            Self::AskItsManager => "ask-its-manager",
            Self::LossyLink => "lossy-link",
            Self::DatagramsBlocked => "datagrams-blocked",
            Self::StreamDead => "stream-dead",
            Self::ClockWrong => "clock-wrong",
            Self::FewDescriptors => "few-descriptors",
            Self::AccessTable => "access-table",
            Self::ClaimNotStored => "claim-not-stored",
            Self::ForeignDatagrams => "foreign-datagrams",
            Self::ControlRefused => "control-refused",
            Self::SeveralUnits => "several-units",
            Self::Connected => "connected",
            Self::Answers => "answers",
        }
    }
}

/// Something that the doctor found.
#[derive(Clone, Debug, PartialEq, Eq, Serialize)]
pub(crate) struct Finding {
    pub(crate) id: Id,
    pub(crate) severity: Severity,
    /// The node or interface that it is about.
    pub(crate) about: Option<String>,
    /// What was seen.
    pub(crate) found: String,
    /// What to do.
    pub(crate) advice: String,
    /// Listening on would not change it.
    #[serde(skip)]
    pub(crate) certain: bool,
}

impl Finding {
    pub(crate) fn error(id: Id, found: impl Into<String>, advice: impl Into<String>) -> Self {
        Self { id, severity: Severity::Error, about: None, found: found.into(), advice: advice.into(), certain: false }
    }

    pub(crate) fn warning(id: Id, found: impl Into<String>, advice: impl Into<String>) -> Self {
        Self { severity: Severity::Warning, ..Self::error(id, found, advice) }
    }

    pub(crate) fn info(id: Id, found: impl Into<String>, advice: impl Into<String>) -> Self {
        Self { severity: Severity::Info, ..Self::error(id, found, advice) }
    }

    pub(crate) fn about(self, about: impl std::fmt::Display) -> Self {
        Self { about: Some(about.to_string()), ..self }
    }

    pub(crate) fn certain(self, certain: bool) -> Self {
        Self { certain, ..self }
    }
}

#[cfg(test)]
mod tests {
    use super::{Finding, Id};

    #[test]
    fn the_name_is_that_of_the_json_and_the_list_is_whole() {
        for (index, id) in Id::ALL.into_iter().enumerate() {
            assert_eq!(serde_json::to_value(id).unwrap(), id.name());
            assert_eq!(id as usize, index);
        }
        assert_eq!(Id::ALL.len(), Id::Answers as usize + 1);
        let text = serde_json::to_string(&Finding::error(Id::Full, "a", "b").about("c")).unwrap();
        assert_eq!(text, r#"{"id":"full","severity":"error","about":"c","found":"a","advice":"b"}"#);
    }

    /// The documentation has a paragraph for each finding and for no other.
    #[test]
    fn every_finding_has_its_paragraph() {
        let page = include_str!("../../../../docs/troubleshooting.md");
        let headings = page.lines().filter_map(|line| line.strip_prefix("### `")?.strip_suffix('`'));
        let names: Vec<_> = Id::ALL.map(Id::name).into();
        assert_eq!(headings.collect::<Vec<_>>(), names);
        let index = page.split("## The findings").next().unwrap();
        for name in names {
            assert!(index.contains(&format!("(#{name})")), "{name} stands under no symptom");
        }
    }
}
