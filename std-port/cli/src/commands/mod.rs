//! The verbs, one file each.

pub(crate) mod access;
pub(crate) mod black_box;
pub(crate) mod call;
pub(crate) mod completions;
pub(crate) mod counters;
pub(crate) mod forget_claim;
pub(crate) mod functions;
pub(crate) mod hand_over;
pub(crate) mod logs;
pub(crate) mod man;
pub(crate) mod orders;
pub(crate) mod ping;
pub(crate) mod publish;
pub(crate) mod record;
pub(crate) mod replay;
pub(crate) mod retire;
pub(crate) mod scan;
pub(crate) mod set;
pub(crate) mod stop;
pub(crate) mod stream;
pub(crate) mod support_bundle;
pub(crate) mod top;
pub(crate) mod watch;
pub(crate) mod web;
