//! Which node is meant, and what it offers.

use cara_std::control::protocol::{Answer, FunctionInfo, NodeInfo, Question};

use cara_tools::close_names::close;

use crate::operator::Operator;
use cara_tools::exit::{Ended, Exit};
pub(crate) use cara_tools::name_and_id::full_name;
use cara_tools::name_and_id::quoted;

/// A node that is meant, and in which form a unit is asked about it.
#[derive(Clone, Debug)]
pub(crate) struct Chosen {
    pub(crate) node: NodeInfo,
    /// `NAME/ID`, with its role behind it where another connected node has the same.
    pub(crate) selector: String,
}

impl Chosen {
    pub(crate) fn among(nodes: &[NodeInfo], node: &NodeInfo) -> Self {
        let duplicates = nodes.iter().filter(|other| other.connected && full_name(other) == full_name(node)).count();
        let selector = if duplicates > 1 { format!("{}@{}", full_name(node), node.role) } else { full_name(node) };
        Self { node: node.clone(), selector }
    }
}

/// A [selector](Chosen::selector) as `NAME/ID`.
pub(crate) fn without_role(selector: &str) -> &str {
    let plain = selector.strip_suffix("@m_unit").or_else(|| selector.strip_suffix("@s_unit"));
    plain.unwrap_or(selector)
}

/// The nodes that the unit knows.
pub(crate) fn all(operator: &mut Operator, offering: Option<&str>) -> anyhow::Result<Vec<NodeInfo>> {
    let question = Question::Nodes { offering: offering.map(str::to_owned) };
    let answers = operator.answers(&question)?.into_iter();
    Ok(answers.filter_map(|answer| if let Answer::Node(node) = answer { Some(node) } else { None }).collect())
}

/// The node that is meant; one that is not connected is an error that says so.
pub(crate) fn connected(operator: &mut Operator, meant: &str) -> anyhow::Result<Chosen> {
    let known = known(operator, meant)?;
    if known.node.connected {
        return Ok(known);
    }
    let (name, full) = (&known.selector, quoted(&full_name(&known.node)));
    let was = if known.node.left_ms.is_some() { "was here and" } else { "has not joined: it" };
    let text = format!("{name} {was} is not connected now; `cara doctor {full}` looks for the reason");
    Err(Ended::failed("NotConnected", text))
}

/// The node that is meant, connected or not.
pub(crate) fn known(operator: &mut Operator, meant: &str) -> anyhow::Result<Chosen> {
    let nodes = all(operator, None)?;
    among(&nodes, meant)?.ok_or_else(|| Ended::failed("NotConnected", not_there(&nodes, meant, &operator.waited())))
}

/// The same of these; `None` if none is meant.
pub(crate) fn among(nodes: &[NodeInfo], meant: &str) -> anyhow::Result<Option<Chosen>> {
    match choose(nodes, meant) {
        Choice::One(node) => Ok(Some(Chosen::among(nodes, node))),
        Choice::Several(names) => {
            Err(Ended::usage(format!("several nodes are called `{meant}`: write {}", names.join(" or "))))
        }
        Choice::None => Ok(None),
    }
}

enum Choice<'n> {
    One(&'n NodeInfo),
    Several(Vec<String>),
    None,
}

fn choose<'n>(nodes: &'n [NodeInfo], meant: &str) -> Choice<'n> {
    let mut found = found(nodes, meant);
    if found.is_empty()
        && let Some((meant, role)) = meant.rsplit_once('@')
    {
        found = self::found(nodes, meant);
        found.retain(|node| node.role == role);
    }
    // One of the roster that is absent may be the one that is meant; one that was taken off it is not.
    if found.len() > 1 && found.iter().any(|node| counts(node)) {
        found.retain(|node| counts(node));
    }
    match found.as_slice() {
        [] => Choice::None,
        [node] => Choice::One(node),
        several => {
            let same = |node: &NodeInfo| several.iter().filter(|other| full_name(other) == full_name(node)).count();
            let name = |node: &NodeInfo| match same(node) {
                1 => full_name(node),
                _ => format!("{}@{}", full_name(node), node.role),
            };
            Choice::Several(several.iter().map(|node| name(node)).collect())
        }
    }
}

/// Connected, or missed.
fn counts(node: &NodeInfo) -> bool {
    node.connected || node.expected
}

/// By both, else by name, else by ID.
fn found<'n>(nodes: &'n [NodeInfo], meant: &str) -> Vec<&'n NodeInfo> {
    let matches = |wanted: &dyn Fn(&NodeInfo) -> bool| nodes.iter().filter(|node| wanted(node)).collect::<Vec<_>>();
    let mut found = matches(&|node| full_name(node) == meant);
    if found.is_empty() {
        found = matches(&|node| node.name == meant);
    }
    if found.is_empty() {
        found = matches(&|node| meant.strip_prefix('#').and_then(|id| id.parse().ok()) == Some(node.id));
    }
    found
}

fn not_there(nodes: &[NodeInfo], meant: &str, waited: &str) -> String {
    let name = meant.rsplit_once('/').map_or(meant, |(name, _)| name);
    let hint = match nodes {
        [] => "no node is".to_owned(),
        nodes => {
            let close = close(name, nodes.iter().map(|node| node.name.as_str()));
            let (mut names, others): (Vec<_>, Vec<_>) =
                nodes.iter().partition(|node| close.contains(&node.name.as_str()));
            names.extend(others);
            let more = names.len().saturating_sub(SHOWN);
            let shown: Vec<_> = names.into_iter().take(SHOWN).map(full_name).collect();
            let more = if more == 0 { String::new() } else { format!(" and {more} more") };
            format!("there {} {}{more}", if nodes.len() == 1 { "is" } else { "are" }, shown.join(", "))
        }
    };
    format!("no node `{meant}` is connected{waited}; {hint}. `cara doctor {}` looks for the reason", quoted(meant))
}

/// Nodes that an error lists.
const SHOWN: usize = 8;

/// What a node has published to the unit.
pub(crate) fn functions(operator: &mut Operator, node: &str) -> anyhow::Result<Vec<FunctionInfo>> {
    let answers = operator.answers(&Question::Functions { node: node.to_owned() })?.into_iter();
    Ok(answers.filter_map(|answer| if let Answer::Function(info) = answer { Some(info) } else { None }).collect())
}

/// A function that a node does not offer: close names, and all that it does.
pub(crate) fn no_such_function(node: &str, name: &str, functions: &[FunctionInfo]) -> anyhow::Error {
    Ended::usage(not_offered(format!("{node} has not published `{name}`"), "it has", name, functions))
}

/// The error for a stream that `node` does not have: what it has instead, and how that is used.
pub(crate) fn no_such_stream(node: &str, name: &str, published: &[FunctionInfo]) -> anyhow::Error {
    let without = quoted(without_role(node));
    if published.iter().any(|function| function.name == name) {
        let text = format!("`{name}` of {node} is a function and no stream: `cara call {without} {name}` calls it");
        return Ended::usage(text);
    }
    let streams: Vec<_> = published.iter().filter(|function| is_stream(function)).cloned().collect();
    let text =
        not_offered(format!("{node} has not published the stream `{name}`"), "as streams it has", name, &streams);
    // The name that a unit itself gives to it.
    Ended { exit: Exit::Usage, text, name: "UnknownFunction".into() }.into()
}

pub(crate) fn is_stream(function: &FunctionInfo) -> bool {
    function.attributes.stream.is_some()
}

/// A function that no connected node offers: a mistake, unless one that `is_missing` may offer it.
pub(crate) fn offered_nowhere(name: &str, functions: &[FunctionInfo], is_missing: bool) -> anyhow::Error {
    let text = not_offered(format!("no connected node has published `{name}`"), "they have", name, functions);
    if is_missing { Ended::failed("UnknownFunction", text) } else { Ended::usage(text) }
}

fn not_offered(mut text: String, they_have: &str, name: &str, functions: &[FunctionInfo]) -> String {
    let close = close(name, functions.iter().map(|function| function.name.as_str()));
    if let Some(nearest) = close.first() {
        text += &format!("; did you mean `{nearest}`?");
    }
    match functions {
        [] => text += &format!("\n  {they_have} published nothing to this unit"),
        functions => {
            text += &format!("\n  {they_have} published:");
            functions.iter().for_each(|function| text += &format!("\n    {}", function.signature));
        }
    }
    text
}

#[cfg(test)]
mod tests {
    use super::{Choice, Chosen, NodeInfo, choose, full_name, not_there};

    fn node(name: &str, id: u32, connected: bool) -> NodeInfo {
        let (role, functions) = ("s_unit".into(), 0);
        let name = name.into();
        let (address, version, epoch, connected_ms, limits, link, clock) = (None, None, None, None, None, None, None);
        let (left_ms, left_reason, left_text, searched_ms, searched_from) = (None, None, None, None, None);
        NodeInfo {
            name,
            id,
            role,
            connected,
            expected: connected,
            address,
            version,
            epoch,
            connected_ms,
            left_ms,
            left_reason,
            left_text,
            searched_ms,
            searched_from,
            limits,
            link,
            clock,
            functions,
        }
    }

    fn chosen(nodes: &[NodeInfo], meant: &str) -> String {
        match choose(nodes, meant) {
            Choice::One(node) => full_name(node),
            Choice::Several(names) => names.join("|"),
            Choice::None => "none".into(),
        }
    }

    #[test]
    fn a_node_is_meant_by_name_id_or_both() {
        let nodes = [node("agv", 1, true), node("agv", 2, true), node("a/1", 3, true), node("a", 1, false)];
        assert_eq!(chosen(&nodes, "agv"), "agv/1|agv/2");
        assert_eq!(chosen(&nodes, "agv/2"), "agv/2");
        assert_eq!(chosen(&nodes, "#3"), "a/1/3");
        assert_eq!(chosen(&nodes, "a/1/3"), "a/1/3");
        assert_eq!(chosen(&nodes, "a/1"), "a/1");
        assert_eq!(chosen(&nodes, "#1"), "agv/1", "the other one of this id was retired");
        let missed = NodeInfo { expected: true, ..node("agv", 2, false) };
        assert_eq!(
            chosen(&[node("agv", 1, true), missed], "agv"),
            "agv/1|agv/2",
            "the one that is missed may be meant"
        );
        assert_eq!(chosen(&nodes, "#x"), "none");
    }

    #[test]
    fn one_name_in_two_roles_is_told_apart() {
        let manager = |connected| NodeInfo { role: "m_unit".into(), ..node("veh", 50, connected) };
        let nodes = [node("veh", 50, true), manager(false)];
        assert_eq!(chosen(&nodes, "veh/50"), "veh/50", "the other one has left");
        assert_eq!(Chosen::among(&nodes, &nodes[0]).selector, "veh/50");
        let nodes = [node("veh", 50, true), manager(true)];
        assert_eq!(chosen(&nodes, "veh"), "veh/50@s_unit|veh/50@m_unit");
        assert!(matches!(choose(&nodes, "veh/50@m_unit"), Choice::One(node) if node.role == "m_unit"));
        assert_eq!(Chosen::among(&nodes, &nodes[1]).selector, "veh/50@m_unit");
    }

    #[test]
    fn who_is_not_there_is_told_with_who_is() {
        let nodes = [node("agv-1", 11, true), node("lift", 2, true)];
        let reported = not_there(&nodes, "agv1/11", "");
        assert!(
            reported.contains("there are agv-1/11, lift/2.") && reported.contains("`cara doctor agv1/11`"),
            "{reported}"
        );
        assert!(
            not_there(&nodes[1..], "#19", "").ends_with("there is lift/2. `cara doctor '#19'` looks for the reason")
        );
        let many: Vec<_> = (0..11).map(|id| node("agv", id, true)).collect();
        assert!(not_there(&many, "zz", "").contains(", agv/7 and 3 more."), "{}", not_there(&many, "zz", ""));
        assert!(not_there(&nodes, "zz", "").contains("there are agv-1/11, lift/2."));
        assert!(not_there(&[], "zz", "").contains("no node is."));
    }
}
