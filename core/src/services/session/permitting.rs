//! What the access table lets the peer do.

use super::publishing::Refusals;
use super::wire::{Remote, Wire};
use crate::config::Priority;
use crate::distribution::function::Signature;
use crate::distribution::function_list::{Function, Slot};
use crate::error::Error;
use crate::services::access::{Access, Decision, Principal, Verb};
use crate::services::lease::Service;
use crate::services::{Context, Port};

/// The table's decision about the peer; without a table everything is allowed.
pub(super) fn decide<E>(
    access: Option<&dyn Access>,
    remote: Option<&Remote<E>>,
    function: &str,
    verb: Verb,
) -> Decision {
    match (access, remote) {
        (None, _) => Decision::Allowed { rule: 0, rate: None },
        (Some(access), Some(remote)) => access.decide(Principal::Node(&remote.hello.identity), function, verb),
        (Some(_), None) => Decision::Denied,
    }
}

/// Whether the peer may make this call; taking over is a separate right.
pub(super) fn decide_call<E>(
    access: Option<&dyn Access>,
    remote: Option<&Remote<E>>,
    function: &str,
    takes_over: bool,
) -> Decision {
    if takes_over && !decide(access, remote, function, Verb::TakeOver).is_allowed() {
        return Decision::Denied;
    }
    decide(access, remote, function, Verb::Call)
}

/// Whether the peer may see a function: it may call or list it.
pub(super) fn may_see<P: Port>(wire: &Wire<P>, cx: &Context<'_, P>, slot: Slot) -> bool {
    cx.table().is_none() || may(wire, cx, slot, Verb::Call) || may(wire, cx, slot, Verb::List)
}

pub(super) fn may<P: Port>(wire: &Wire<P>, cx: &Context<'_, P>, slot: Slot, verb: Verb) -> bool {
    let function = cx.functions.function(slot);
    function.is_none_or(|function| decide(cx.table(), wire.remote.as_ref(), function.name(), verb).is_allowed())
}

/// Whether the peer may call a published function now, by the table and its rate.
pub(super) fn permit_call<P: Port>(
    wire: &mut Wire<P>,
    cx: &Context<'_, P>,
    function: &Function<'_, dyn Service>,
    priority: Priority,
    takes_over: bool,
) -> Result<(), Error> {
    match decide_call(cx.table(), wire.remote.as_ref(), function.name(), takes_over) {
        Decision::Denied => Err(Error::NotAllowed),
        Decision::Allowed { rate: None, .. } => Ok(()),
        // Neither a stop nor another emergency is limited by a rate.
        Decision::Allowed { .. } if function.attributes.is_urgent(priority) => Ok(()),
        Decision::Allowed { rate: Some(rate), .. } => match wire.publishing.bucket(function.slot) {
            Some(bucket) => bucket.take(cx.now, rate),
            None => Err(Error::UnknownFunction),
        },
    }
}

/// Whether this unit accepts a function that the peer publishes.
pub(super) fn may_publish<P: Port>(
    cx: &Context<'_, P>,
    remote: Option<&Remote<P::Endpoint>>,
    refusals: &mut Refusals,
    signature: &[u8],
) -> bool {
    // A signature that cannot be decoded is refused by the list.
    let Some(signature) = cx.table().and_then(|_| Signature::decode(signature).ok()) else { return true };
    let allowed = decide(cx.table(), remote, signature.name(), Verb::Publish).is_allowed();
    if !allowed {
        log_refusal(cx, remote, refusals, signature.name(), "publish");
    }
    allowed
}

/// Logs a refusal, at most once a second.
pub(super) fn log_refusal<P: Port>(
    cx: &Context<'_, P>,
    remote: Option<&Remote<P::Endpoint>>,
    refusals: &mut Refusals,
    function: &str,
    verb: &str,
) {
    let Some(count) = refusals.count(cx.now) else { return };
    if cx.table().is_some_and(|access| access.may_log(cx.now)) {
        refusals.was_logged(cx.now);
        let (name, id) = remote.map_or(("", 0), |remote| (remote.hello.identity.name(), remote.hello.identity.id()));
        warning!("{}/{} may not {} {}: {} refused", name, id, verb, function, count);
    }
}
