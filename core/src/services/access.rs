//! Access control: which peer may see, call and publish which function.
//!
//! A table is a list of [`Rule`]s. A port lends it with each [`Context`](super::Context), so that it can be a `const`
//! on a board, and can be exchanged while the unit runs. Its semantics:
//!
//! - **No table**: the mode of the unit decides which nodes join, and a joined node may do everything.
//! - **A table**: what no rule allows is forbidden. Rules are evaluated in order; the first one that matches the
//!   [`Principal`], the function and the verb decides, also about the rate. A table without rules allows nothing.
//! - **A node** is matched by role, name, id, or several of them; a field that the rule leaves open matches any value.
//! - **The operator** on a control socket is matched by [`Who::Operator`] only: rules about nodes never match it.
//! - **[`Verb::Call`]**: the peer may call this unit's function. Checked when the request arrives, before its arguments
//!   are parsed, and, if the call has to wait, again just before it begins. Permission to call includes permission to
//!   see.
//! - **[`Verb::List`]**: the peer sees this unit's function in the list that is published to it.
//! - **[`Verb::TakeOver`]**: the peer's calls of this unit's function may take over what another caller moves. Without it a call that
//!   is to take over is refused, also where nothing is held.
//! - **[`Verb::Publish`]**: this unit sees the peer's function of that name, so that it can be called from here.
//! - **A rate** limits the calls of each peer to each function over all priorities: otherwise a peer could evade it by
//!   choosing another priority. A function that must always be reachable, such as a stop, belongs in a rule without a
//!   rate.
//!
//! A call that has begun continues when the table changes; a lease that the caller holds by it ends, which runs the
//! safe hook. A peer that joins again starts with its full rate.

use crate::distribution::identity::{Identity, Role};
use crate::error::Error;
use crate::time::{Duration, Instant};

/// What a principal may do with a function.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash)]
#[repr(u8)]
pub enum Verb {
    /// See it.
    List = 1,
    /// Call it, and see it.
    Call = 2,
    /// Offer it to this unit.
    Publish = 4,
    /// With a call that it may make: take over what another caller moves.
    TakeOver = 8,
}

/// A set of verbs.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Hash)]
pub struct Verbs(u8);

impl Verbs {
    /// No verb.
    pub const NONE: Self = Self(0);
    /// See functions.
    pub const LIST: Self = Self(Verb::List as u8);
    /// Call functions.
    pub const CALL: Self = Self(Verb::Call as u8);
    /// Offer functions.
    pub const PUBLISH: Self = Self(Verb::Publish as u8);
    /// Take over what another caller moves, with a call.
    pub const TAKE_OVER: Self = Self(Verb::TakeOver as u8);
    /// All of them.
    pub const ALL: Self = Self::LIST.and(Self::CALL).and(Self::PUBLISH).and(Self::TAKE_OVER);

    /// The verbs of both sets.
    pub const fn and(self, other: Self) -> Self {
        Self(self.0 | other.0)
    }

    /// Whether a verb is in the set.
    pub const fn contains(self, verb: Verb) -> bool {
        self.0 & verb as u8 != 0
    }
}

impl From<Verb> for Verbs {
    fn from(verb: Verb) -> Self {
        Self(verb as u8)
    }
}

/// The origin of a request to a unit.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Principal<'a> {
    /// Another node.
    Node(&'a Identity),
    /// The operator on the unit's control socket.
    Operator,
}

/// The principals that a rule matches. `N` is text: borrowed on a board, owned where there is an allocator.
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum Who<N = &'static str> {
    /// The operator on the control socket.
    Operator,
    /// Nodes of this role, name and id; any where it is `None`.
    Node {
        /// The role.
        role: Option<Role>,
        /// The name.
        name: Option<N>,
        /// The ID number.
        id: Option<u32>,
    },
}

impl<N> Who<N> {
    /// Every node.
    pub const ANYBODY: Self = Self::Node { role: None, name: None, id: None };
    /// Every m_unit.
    pub const M_UNITS: Self = Self::Node { role: Some(Role::MUnit), name: None, id: None };
    /// Every s_unit.
    pub const S_UNITS: Self = Self::Node { role: Some(Role::SUnit), name: None, id: None };

    /// The node of this name and id.
    pub const fn node(name: N, id: u32) -> Self {
        Self::Node { role: None, name: Some(name), id: Some(id) }
    }
}

impl<N: AsRef<str>> Who<N> {
    /// Whether the rule matches `principal`.
    pub(crate) fn means(&self, principal: Principal<'_>) -> bool {
        match (self, principal) {
            (Self::Operator, Principal::Operator) => true,
            (Self::Node { role, name, id }, Principal::Node(identity)) => {
                role.is_none_or(|role| role == identity.role())
                    && id.is_none_or(|id| id == identity.id())
                    && name.as_ref().is_none_or(|name| name.as_ref() == identity.name())
            }
            (Self::Operator, Principal::Node(_)) | (Self::Node { .. }, Principal::Operator) => false,
        }
    }
}

/// The functions that a rule matches.
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum Functions<L = &'static [&'static str]> {
    /// All of them.
    All,
    /// Those of these names.
    Named(L),
}

impl<L> Functions<L> {
    /// Whether the rule is about a function.
    pub(crate) fn contain<N: AsRef<str>>(&self, function: &str) -> bool
    where
        L: AsRef<[N]>,
    {
        match self {
            Self::All => true,
            Self::Named(names) => names.as_ref().iter().any(|name| name.as_ref() == function),
        }
    }
}

/// How often each peer may call each function: a burst of so many calls, and as many in each span of time.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Rate {
    calls: u32,
    every: Duration,
}

impl Rate {
    /// So many calls in each span; none at all where either is zero.
    pub const fn new(calls: u32, every: Duration) -> Self {
        Self { calls, every }
    }

    /// So many calls in each second.
    pub const fn per_second(calls: u32) -> Self {
        Self::new(calls, Duration::from_secs(1))
    }

    /// The calls, and the span in which they may be made.
    pub const fn parts(self) -> (u32, Duration) {
        (self.calls, self.every)
    }

    /// Time that one call takes up: rounded up, so that there are never more calls than allowed.
    fn interval(self) -> Duration {
        let calls = u64::from(self.calls);
        let rounded = self.every.as_micros().saturating_add(calls.saturating_sub(1));
        Duration::from_micros(rounded.checked_div(calls).unwrap_or(u64::MAX).max(1))
    }

    fn burst(self) -> Duration {
        if self.every == Duration::ZERO { Duration::ZERO } else { self.interval().times(u64::from(self.calls)) }
    }
}

/// A token bucket, stored as the time at which it is full again.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct Bucket {
    full_at: Instant,
}

impl Bucket {
    /// Takes one token; [`Error::TooSoon`] if there is none.
    pub fn take(&mut self, now: Instant, rate: Rate) -> Result<(), Error> {
        let full_at = self.full_at.max(now) + rate.interval();
        let wait = full_at.since(now + rate.burst());
        if wait > Duration::ZERO {
            return Err(Error::TooSoon { wait });
        }
        self.full_at = full_at;
        Ok(())
    }

    /// Whether the full rate is available.
    pub fn is_full(&self, now: Instant) -> bool {
        self.full_at <= now
    }
}

/// A row of a table, which allows what it names.
///
/// ```
/// use cara_core::services::access::{Functions, Rate, Rule, Verbs, Who};
///
/// const RULES: [Rule; 2] = [
///     Rule::new(Who::node("AGV_manager", 1), Functions::All, Verbs::CALL),
///     Rule::new(Who::M_UNITS, Functions::Named(&["pos_info"]), Verbs::CALL).at(Rate::per_second(10)),
/// ];
/// # assert_eq!(RULES[1].rate, Some(Rate::per_second(10)));
/// ```
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Rule<N = &'static str, L = &'static [&'static str]> {
    /// The principals that it matches.
    pub who: Who<N>,
    /// The functions that it matches.
    pub functions: Functions<L>,
    /// What is allowed.
    pub verbs: Verbs,
    /// How often functions may be called; unlimited if `None`.
    pub rate: Option<Rate>,
}

impl Rule {
    /// A rule without a rate.
    pub const fn new(who: Who, functions: Functions, verbs: Verbs) -> Self {
        Self { who, functions, verbs, rate: None }
    }

    /// The same rule with a rate.
    pub const fn at(mut self, rate: Rate) -> Self {
        self.rate = Some(rate);
        self
    }
}

/// What a table says.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Decision {
    /// No rule allows it.
    Denied,
    /// A rule allows it.
    Allowed {
        /// The rule's place in the table, from 0.
        rule: usize,
        /// How often.
        rate: Option<Rate>,
    },
}

impl Decision {
    /// Whether it is allowed, as far as its rate reaches.
    pub const fn is_allowed(self) -> bool {
        matches!(self, Self::Allowed { .. })
    }
}

/// Looks a question up: the first rule that matches decides.
pub fn decide<N: AsRef<str>, L: AsRef<[N]>>(
    rules: &[Rule<N, L>],
    who: Principal<'_>,
    function: &str,
    verb: Verb,
) -> Decision {
    let matches =
        |rule: &Rule<N, L>| rule.verbs.contains(verb) && rule.who.means(who) && rule.functions.contain(function);
    match rules.iter().enumerate().find(|(_, rule)| matches(rule)) {
        Some((index, rule)) => Decision::Allowed { rule: index, rate: rule.rate },
        None => Decision::Denied,
    }
}

/// An access table: rules on a board, a file's contents on Linux.
pub trait Access {
    /// What the table says; [`decide`] over its rules.
    fn decide(&self, who: Principal<'_>, function: &str, verb: Verb) -> Decision;

    /// Whether a refusal may be logged now. A link asks at most once a second; a table of many links says yes to one of
    /// them.
    fn may_log(&self, _now: Instant) -> bool {
        true
    }
}

impl<N: AsRef<str>, L: AsRef<[N]>, const RULES: usize> Access for [Rule<N, L>; RULES] {
    fn decide(&self, who: Principal<'_>, function: &str, verb: Verb) -> Decision {
        decide(self, who, function, verb)
    }
}

impl<N: AsRef<str>, L: AsRef<[N]>> Access for &[Rule<N, L>] {
    fn decide(&self, who: Principal<'_>, function: &str, verb: Verb) -> Decision {
        decide(self, who, function, verb)
    }
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used, clippy::arithmetic_side_effects, clippy::indexing_slicing, clippy::panic)]
    use super::*;
    use proptest::prelude::*;
    use std::vec::Vec;

    const TABLE: [Rule; 4] = [
        Rule::new(Who::node("manager", 1), Functions::All, Verbs::CALL),
        Rule::new(Who::M_UNITS, Functions::Named(&["pos_info"]), Verbs::CALL).at(Rate::per_second(2)),
        Rule::new(Who::S_UNITS, Functions::Named(&["go_to", "stop"]), Verbs::PUBLISH),
        Rule::new(Who::Operator, Functions::Named(&["stop"]), Verbs::LIST.and(Verbs::CALL)),
    ];

    fn ask(who: Principal<'_>, function: &str, verb: Verb) -> Option<usize> {
        match TABLE.decide(who, function, verb) {
            Decision::Denied => None,
            Decision::Allowed { rule, .. } => Some(rule),
        }
    }

    #[test]
    fn the_first_rule_that_matches_decides_and_nothing_else_is_allowed() {
        let [manager, other] = [("manager", 1), ("other", 2)].map(|(name, id)| Identity::m_unit(name, id).unwrap());
        let [manager, other] = [&manager, &other].map(Principal::Node);
        assert_eq!(ask(manager, "go_to", Verb::Call), Some(0));
        assert_eq!(ask(manager, "pos_info", Verb::Call), Some(0));
        assert_eq!(ask(other, "pos_info", Verb::Call), Some(1));
        assert_eq!(ask(other, "go_to", Verb::Call), None);
        assert_eq!(ask(manager, "go_to", Verb::Publish), None);
        let agv = Identity::s_unit("manager", 2).unwrap();
        assert_eq!(ask(Principal::Node(&agv), "go_to", Verb::Call), None, "the name alone is not the node");
        assert_eq!(ask(Principal::Node(&agv), "stop", Verb::Publish), Some(2));
    }

    #[test]
    fn the_operator_is_nobody_but_the_operator() {
        assert_eq!(ask(Principal::Operator, "stop", Verb::Call), Some(3));
        assert_eq!(ask(Principal::Operator, "go_to", Verb::Call), None);
        let anybody: [Rule; 1] = [Rule::new(Who::ANYBODY, Functions::All, Verbs::ALL)];
        assert_eq!(anybody.decide(Principal::Operator, "stop", Verb::Call), Decision::Denied);
        let node = Identity::s_unit("operator", 0).unwrap();
        assert_eq!(ask(Principal::Node(&node), "stop", Verb::Call), None);
    }

    #[test]
    fn an_empty_table_allows_nothing() {
        let table: &[Rule] = &[];
        assert!(!table.decide(Principal::Operator, "stop", Verb::List).is_allowed());
    }

    #[test]
    fn a_rate_lets_its_calls_through_at_once_and_then_one_by_one() {
        let (mut bucket, rate) = (Bucket::default(), Rate::per_second(2));
        let at = |millis: u64| Instant::START + Duration::from_millis(millis);
        assert_eq!([(); 2].map(|()| bucket.take(at(0), rate)), [Ok(()), Ok(())]);
        assert_eq!(bucket.take(at(100), rate), Err(Error::TooSoon { wait: Duration::from_millis(400) }));
        assert_eq!(bucket.take(at(500), rate), Ok(()));
        assert!(bucket.take(at(500), rate).is_err() && !bucket.is_full(at(500)));
        assert!(bucket.is_full(at(1_500)));
    }

    #[test]
    fn a_rate_of_nothing_lets_nothing_through() {
        for rate in [Rate::per_second(0), Rate::new(5, Duration::ZERO), Rate::new(0, Duration::ZERO)] {
            assert!(Bucket::default().take(Instant::from_micros(7), rate).is_err(), "{rate:?}");
        }
        assert!(Bucket::default().take(Instant::FAR_FUTURE, Rate::new(u32::MAX, Duration::MAX)).is_ok());
    }

    /// Principals, functions and verbs: small numbers that the tests make rules of.
    fn rows() -> impl Strategy<Value = Vec<Rule<&'static str, Vec<&'static str>>>> {
        const NAMES: [&str; 3] = ["a", "b", "c"];
        let role = prop_oneof![Just(None), Just(Some(Role::MUnit)), Just(Some(Role::SUnit))];
        let name = prop::option::of(prop::sample::select(NAMES.to_vec()));
        let node = (role, name, prop::option::of(0..3_u32)).prop_map(|(role, name, id)| Who::Node { role, name, id });
        let who = prop_oneof![1 => Just(Who::Operator), 4 => node];
        let functions = prop_oneof![
            Just(Functions::All),
            prop::collection::vec(prop::sample::select(NAMES.to_vec()), 0..3).prop_map(Functions::Named)
        ];
        let row = (who, functions, 0..8_u8).prop_map(|(who, functions, verbs)| Rule {
            who,
            functions,
            verbs: Verbs(verbs),
            rate: None,
        });
        prop::collection::vec(row, 0..6)
    }

    proptest! {
        #[test]
        fn a_table_allows_what_one_of_its_rules_allows_alone(
            rules in rows(),
            (name, id, m_unit) in (prop::sample::select(&["a", "b", "c"][..]), 0..3_u32, any::<bool>()),
            (function, verb) in (prop::sample::select(&["a", "b", "c"][..]), 0..4_u32),
            operator in prop::bool::weighted(0.2),
        ) {
            let role = if m_unit { Role::MUnit } else { Role::SUnit };
            let identity = Identity::new(name, id, role).unwrap();
            let who = if operator { Principal::Operator } else { Principal::Node(&identity) };
            let verb = [Verb::List, Verb::Call, Verb::Publish, Verb::TakeOver][verb as usize];
            // Written out once more, without the code under test.
            let allows = |rule: &Rule<&str, Vec<&str>>| {
                let named = match &rule.functions { Functions::All => true, Functions::Named(names) => names.contains(&function) };
                let meant = match &rule.who {
                    Who::Operator => operator,
                    Who::Node { role: r, name: n, id: i } =>
                        !operator && [r.is_none() || *r == Some(role), n.is_none() || *n == Some(name), i.is_none() || *i == Some(id)] == [true; 3],
                };
                named && meant && rule.verbs.0 & verb as u8 != 0
            };
            match decide(&rules, who, function, verb) {
                Decision::Denied => prop_assert!(!rules.iter().any(allows)),
                Decision::Allowed { rule, rate } => {
                    prop_assert_eq!(rules.iter().position(allows), Some(rule));
                    prop_assert_eq!(rate, rules[rule].rate);
                }
            }
        }

        #[test]
        fn no_span_of_time_sees_more_calls_than_the_rate(
            (calls, every) in (1..6_u32, 1..5_000_u64),
            steps in prop::collection::vec(0..3_000_u64, 1..60),
        ) {
            let rate = Rate::new(calls, Duration::from_micros(every));
            let (mut bucket, mut now, mut taken) = (Bucket::default(), 0_u64, Vec::new());
            for step in steps {
                now += step;
                if bucket.take(Instant::from_micros(now), rate).is_ok() {
                    taken.push(now);
                }
            }
            // What was there at the beginning, and what came back since.
            for (first, from) in taken.iter().enumerate() {
                for (last, to) in taken.iter().enumerate().skip(first) {
                    let most = u64::from(calls) + (to - from) * u64::from(calls) / every;
                    prop_assert!((last - first + 1) as u64 <= most, "{} in {} us", last - first + 1, to - from);
                }
            }
        }

        #[test]
        fn a_call_that_waits_as_told_is_let_through(
            (calls, every) in (1..6_u32, 1..5_000_u64),
            at in prop::collection::vec(0..2_000_u64, 1..40),
        ) {
            let rate = Rate::new(calls, Duration::from_micros(every));
            let (mut bucket, mut now) = (Bucket::default(), Instant::START);
            for step in at {
                now = now + Duration::from_micros(step);
                if let Err(error) = bucket.take(now, rate) {
                    let Error::TooSoon { wait } = error else { panic!("{error}") };
                    now = now + wait;
                    prop_assert_eq!(bucket.take(now, rate), Ok(()));
                }
            }
        }
    }
}
