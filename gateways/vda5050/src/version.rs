//! The version of VDA 5050 that vehicles speak, and the rules in which versions differ. The names of messages are in
//! [`message`](crate::message), those of errors in [`errors`](crate::errors).

use crate::message::{BlockingType, Deviation, EStop, NodePosition, SafetyState};

/// A major version. 2.0 and 2.1 differ in members only.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub enum Version {
    /// 2.0 and 2.1.
    #[default]
    V2,
    /// 3.0, a preview.
    V3,
}

/// What an order, an action or a topic means in one version, and not in the other. Clauses are those of 3.0.
#[derive(Debug)]
pub struct Rules {
    /// The second level of topics (4.2).
    pub root: &'static str,
    /// The topics of the master (4.3).
    pub topics: &'static [&'static str],
    /// The actions at once that the gateway does itself, as the model calls them (6.2.3).
    pub own_actions: &'static [&'static str],
    /// A new order begins with update 0 (figure 8, box 4).
    pub begins_with_update_0: bool,
    /// The same update with other content is an error, and any update behind `cancelOrder` (figure 8, boxes 7 and 8).
    pub compares_content: bool,
    /// Actions at once have a list of their own, and stay in it until `clearInstantActions` (7.8).
    pub lists_instant_actions: bool,
    /// `cancelOrder` may name its order (6.1.3).
    pub cancels_by_name: bool,
    /// Actions at once of the vehicle have the blocking type NONE (6.2.1).
    pub instant_is_none: bool,
    /// Modes SERVICE and TEACHIN empty `lastNodeId` (6.6.6).
    pub service_forgets_node: bool,
}

static V2: Rules = Rules {
    root: "v2",
    topics: &["order", "instantActions"],
    own_actions: &["startPause", "stopPause", "cancelOrder", "stateRequest", "factsheetRequest", "initPosition"],
    begins_with_update_0: false,
    compares_content: false,
    lists_instant_actions: false,
    cancels_by_name: false,
    instant_is_none: false,
    service_forgets_node: false,
};

static V3: Rules = Rules {
    root: "v3",
    topics: &["order", "instantActions", "zoneSet", "responses"],
    own_actions: &[
        "startPause",
        "stopPause",
        "cancelOrder",
        "stateRequest",
        "factsheetRequest",
        "initPosition",
        "clearInstantActions",
    ],
    begins_with_update_0: true,
    compares_content: true,
    lists_instant_actions: true,
    cancels_by_name: true,
    instant_is_none: true,
    service_forgets_node: true,
};

impl Version {
    /// Both.
    pub const ALL: [Self; 2] = [Self::V2, Self::V3];

    /// Of a version as messages have it, such as `2.1.0`.
    pub fn of(version: &str) -> Option<Self> {
        match version.split_once('.')?.0 {
            "2" => Some(Self::V2),
            "3" => Some(Self::V3),
            _ => None,
        }
    }

    /// Its rules.
    pub const fn rules(self) -> &'static Rules {
        match self {
            Self::V2 => &V2,
            Self::V3 => &V3,
        }
    }
}

impl BlockingType {
    /// Whether the vehicle stands for such an action (6.2.2).
    pub const fn blocks_driving(self) -> bool {
        matches!(self, Self::Soft | Self::Hard)
    }

    /// Whether no other action runs beside it.
    pub const fn is_alone(self) -> bool {
        matches!(self, Self::Single | Self::Hard)
    }
}

impl NodePosition {
    /// As a state has it: 3.0 without deviations, and 2.x with a circle, also of an order that was sent in 3.0.
    pub(crate) fn reported(mut self, version: Version) -> Self {
        match version {
            Version::V2 => {
                let circle = |deviation: Deviation| Deviation::Radius(deviation.radius());
                self.allowed_deviation_xy = self.allowed_deviation_xy.map(circle);
            }
            Version::V3 => (self.allowed_deviation_xy, self.allowed_deviation_theta) = (None, None),
        }
        self
    }
}

impl SafetyState {
    /// As a state has it: in 3.0 what ends by itself is a violated field, and no emergency stop (7.8).
    pub(crate) fn reported(self, version: Version) -> Self {
        match (version, self.e_stop) {
            (Version::V3, EStop::AutoAck) => Self { e_stop: EStop::None, field_violation: true },
            _ => self,
        }
    }
}
