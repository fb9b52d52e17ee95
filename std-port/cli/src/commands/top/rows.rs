//! The rows of each view, of what was told.

use std::collections::{HashMap, HashSet};
use std::time::Duration;

use cara_std::control::protocol::{NodeInfo, OrderInfo, RefusedInfo};
use cara_tools::name_and_id::full_name;
use cara_tools::units::{show_bytes, show_micros, show_time};

use super::app::{App, Counted, Event, Now, Value, View, selector};
use crate::nodes::without_role;

/// A round trip that was measured longer ago is shown as old.
const OLD_ROUND_TRIP: Duration = Duration::from_secs(10);
/// A node that still tries is refused again sooner.
const OLD_REFUSAL: Duration = Duration::from_secs(30);
/// A value that is older is shown as old.
const OLD_VALUE: Duration = Duration::from_secs(5);

/// How a row or a cell is to be seen.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub(super) enum Tone {
    #[default]
    Plain,
    Good,
    Bad,
    Faint,
}

/// A column.
#[derive(Clone, Copy, Debug)]
pub(super) struct Column {
    pub(super) heading: &'static str,
    /// Its width in cells; 0 for what is left.
    pub(super) width: u16,
    /// It is left out where the terminal is narrower.
    pub(super) from: u16,
}

const fn column(heading: &'static str, width: u16) -> Column {
    Column { heading, width, from: 0 }
}

const NODES: [Column; 10] = [
    column("NODE", 0),
    column("ROLE", 6),
    column("STATE", 11),
    column("TRIP", 8),
    column("SEEN", 7),
    column("CALLS", 5),
    column("QUEUE", 7),
    Column { heading: "TROUBLE", width: 7, from: 90 },
    column("ADDRESS", 15),
    Column { heading: "UP", width: 7, from: 110 },
];
const ORDERS: [Column; 6] = [
    column("NODE", 0),
    column("FUNCTION", 13),
    column("ORDER", 12),
    column("OF UNIT", 7),
    column("LEFT", 7),
    column("INHIBITED", 20),
];
const STREAMS: [Column; 3] = [column("NODE", 16), column("VALUE", 0), column("AGE", 8)];
const COUNTERS: [Column; 4] = [column("OF", 0), column("COUNTER", 22), column("COUNT", 12), column("GROWN", 9)];
const EVENTS: [Column; 4] = [column("AT (UTC)", 19), column("EVENT", 17), column("NODE", 16), column("TEXT", 0)];
const NODE: [Column; 2] = [column("WHAT", 22), column("", 0)];

/// Counters of what goes as it should; all others count what was refused, dropped, missed or late.
const ROUTINE: [&str; 23] = [
    "FramesReceived",
    "BytesReceived",
    "MessagesReceived",
    "MessagesSent",
    "BytesSent",
    "DatagramsReceived",
    "DatagramsSent",
    "KeysRenewed",
    "RequestsSent",
    "RequestsReceived",
    "RequestsRun",
    "SamplesSent",
    "SamplesReceived",
    "SamplesReplaced",
    "WhoHasSent",
    "WhoHasHeard",
    "WhoHasDeferred",
    "AnnounceSent",
    "AnnounceBroadcast",
    "AnnounceHeard",
    "HintsAsked",
    "Dialled",
    "Joined",
];

#[derive(Clone, Debug, Default)]
pub(super) struct Cell {
    pub(super) text: String,
    /// What it is sorted by before its text.
    rank: f64,
    pub(super) tone: Tone,
}

fn cell(text: impl Into<String>) -> Cell {
    Cell { text: text.into(), ..Cell::default() }
}

fn ranked(text: impl Into<String>, rank: f64) -> Cell {
    Cell { text: text.into(), rank, ..Cell::default() }
}

impl Cell {
    fn toned(self, tone: Tone) -> Self {
        Self { tone, ..self }
    }
}

#[derive(Clone, Debug, Default)]
pub(super) struct Row {
    /// What it is about.
    pub(super) key: String,
    /// The selector of the node that it is about.
    pub(super) node: Option<String>,
    pub(super) cells: Vec<Cell>,
}

#[derive(Clone, Debug)]
pub(super) struct Table {
    pub(super) columns: &'static [Column],
    pub(super) rows: Vec<Row>,
}

impl Table {
    pub(super) fn sort(&mut self, column: usize, backwards: bool) {
        let nothing = Cell::default();
        self.rows.sort_by(|a, b| {
            let (a, b) = (a.cells.get(column).unwrap_or(&nothing), b.cells.get(column).unwrap_or(&nothing));
            let order = a.rank.total_cmp(&b.rank).then_with(|| a.text.cmp(&b.text));
            if backwards { order.reverse() } else { order }
        });
    }
}

/// A span of time in few characters.
pub(super) fn span(span: Duration) -> String {
    match (span.as_millis(), span.as_secs()) {
        (millis, 0) => format!("{millis} ms"),
        (millis, seconds @ 1..=9) => format!("{seconds}.{} s", millis / 100 % 10),
        (_, seconds @ 10..=119) => format!("{seconds} s"),
        (_, seconds @ 120..=7_199) => format!("{} min", seconds / 60),
        (_, seconds) => format!("{} h", seconds / 3_600),
    }
}

fn ms(ms: u64) -> Duration {
    Duration::from_millis(ms)
}

/// By how much each counter has grown.
pub(super) fn grown(before: &[Counted], after: &[Counted]) -> HashMap<(Option<String>, String), u64> {
    let then: HashMap<(Option<&str>, &str), u64> =
        each(before).map(|(node, name, count)| ((node, name), count)).collect();
    let grown = each(after).filter_map(|(node, name, count)| {
        let grown = count.checked_sub(*then.get(&(node, name))?)?;
        (grown > 0).then(|| ((node.map(str::to_owned), name.to_owned()), grown))
    });
    grown.collect()
}

fn each(all: &[Counted]) -> impl Iterator<Item = (Option<&str>, &str, u64)> {
    all.iter().flat_map(|of| of.counters.iter().map(|(name, count)| (of.node.as_deref(), name.as_str(), *count)))
}

fn is_trouble(name: &str) -> bool {
    !ROUTINE.contains(&name)
}

pub(super) fn of(app: &App, view: View, now: Now) -> Table {
    match view {
        View::Nodes => Table { columns: &NODES, rows: nodes(app, now) },
        View::Orders => Table { columns: &ORDERS, rows: orders(app, now, false) },
        View::Streams => Table { columns: &STREAMS, rows: streams(app, now) },
        View::Counters => Table { columns: &COUNTERS, rows: counters(app) },
        View::Events => Table { columns: &EVENTS, rows: events(app, None) },
        View::Node => Table { columns: &NODE, rows: node(app, now) },
    }
}

/// Orders that run, and what is inhibited.
pub(super) fn running(app: &App, now: Now) -> Table {
    Table { columns: &ORDERS, rows: orders(app, now, true) }
}

fn nodes(app: &App, now: Now) -> Vec<Row> {
    let trouble: HashMap<&str, u64> =
        app.counters.iter().filter_map(|of| Some((of.node.as_deref()?, troubles(of)))).collect();
    let mut all: Vec<&NodeInfo> = app.nodes().iter().collect();
    all.sort_by(|a, b| (&a.name, a.id).cmp(&(&b.name, b.id)));
    let mut rows: Vec<Row> = all.into_iter().map(|node| node_row(app, now, node, &trouble)).collect();
    let refused = app.snapshot.as_ref().map_or(&[][..], |snapshot| &snapshot.refused);
    rows.extend(refused.iter().map(|refused| refused_row(refused, app.age(now))));
    rows
}

fn troubles(of: &Counted) -> u64 {
    of.counters.iter().filter(|(name, _)| is_trouble(name)).fold(0, |sum, (_, count)| sum.saturating_add(*count))
}

fn node_row(app: &App, now: Now, node: &NodeInfo, trouble: &HashMap<&str, u64>) -> Row {
    let (key, age) = (selector(node), app.age(now));
    let link = node.link.filter(|_| node.connected);
    let seen = link.map(|link| ms(link.silent_ms) + age);
    let number = |text: Option<(String, f64)>| text.map_or(ranked("-", -1.0), |(text, rank)| ranked(text, rank));
    let troubles = trouble.get(full_name(node).as_str()).copied().unwrap_or(0);
    let up = node.connected_ms.map(|up| ms(up) + age);
    let cells = vec![
        cell(full_name(node)),
        cell(&node.role),
        state(app, now, node),
        round_trip(app, now, node),
        number(seen.map(|seen| (span(seen), seen.as_secs_f64()))),
        number(link.map(|link| (link.calls.to_string(), link.calls as f64))),
        number(link.map(|link| (show_bytes(link.queued_bytes as u64), link.queued_bytes as f64))),
        ranked(troubles.to_string(), troubles as f64),
        cell(node.address.as_deref().unwrap_or("-")),
        number(up.map(|up| (span(up), up.as_secs_f64()))),
    ];
    Row { node: Some(key.clone()), key, cells }
}

fn state(app: &App, now: Now, node: &NodeInfo) -> Cell {
    let age = app.age(now);
    match (node.connected, node.left_ms) {
        (true, _) if app.is_old(now) => ranked("was live", 2.0).toned(Tone::Faint),
        (true, _) => ranked("live", 3.0).toned(Tone::Good),
        (false, Some(left)) if node.expected => ranked(format!("LOST {}", span(ms(left) + age)), 0.0).toned(Tone::Bad),
        (false, Some(left)) => ranked(format!("left {}", span(ms(left) + age)), 4.0).toned(Tone::Faint),
        (false, None) => ranked("absent", 1.0).toned(Tone::Bad),
    }
}

fn round_trip(app: &App, now: Now, node: &NodeInfo) -> Cell {
    let none = ranked("-", f64::INFINITY);
    let Some((at, took)) = app.round_trips.get(&selector(node)).filter(|_| node.connected) else { return none };
    let Some(took) = took else { return ranked("none", f64::INFINITY).toned(Tone::Bad) };
    let is_old = now.saturating_sub(*at) > OLD_ROUND_TRIP || app.is_old(now);
    ranked(show_micros(took.round()), *took).toned(if is_old { Tone::Faint } else { Tone::Plain })
}

fn refused_row(refused: &RefusedInfo, age: Duration) -> Row {
    let ago = ms(refused.ago_ms) + age;
    let cells = vec![
        cell(refused.node.as_deref().unwrap_or("?")),
        cell(""),
        ranked("REFUSED", -1.0).toned(if ago > OLD_REFUSAL { Tone::Faint } else { Tone::Bad }),
        cell(""),
        cell(span(ago)),
        cell(""),
        cell(""),
        cell(""),
        cell(&refused.address),
        cell(""),
    ];
    Row { key: format!("refused {}", refused.address), node: None, cells }
}

/// The selector of a node by its `NAME/ID`; of two with the same the s_unit.
fn known(app: &App, name: &str) -> Option<String> {
    let mut all = app.nodes().iter().filter(|node| full_name(node) == name);
    let first = all.next()?;
    Some(selector(all.find(|node| node.role == "s_unit").unwrap_or(first)))
}

fn orders(app: &App, now: Now, running_alone: bool) -> Vec<Row> {
    let all = app.snapshot.as_ref().map_or(&[][..], |snapshot| &snapshot.orders);
    let shown = all.iter().filter(|order| !running_alone || order.order == "runs" || order.inhibited.is_some());
    let row = |order: &OrderInfo| {
        let name = format!("{}/{}", order.node, order.id);
        let is_it = |node: &NodeInfo| node.connected && node.id == order.id && node.name == order.node;
        let is_old = app.is_old(now) || !app.nodes().iter().any(is_it);
        let tone = match (order.order.as_str(), order.inhibited) {
            (_, Some(_)) => Tone::Bad,
            ("runs", None) if is_old => Tone::Faint,
            ("runs", None) => Tone::Good,
            _ => Tone::Plain,
        };
        let cells = vec![
            cell(&name),
            cell(&order.function),
            cell(if is_old { format!("was {}", order.order) } else { order.order.clone() }).toned(tone),
            cell(order.holder.map_or_else(|| "-".to_owned(), |holder| holder.to_string())),
            left(app, now, order, is_old),
            cell(inhibited(order)).toned(tone),
        ];
        Row { key: format!("{name} {}", order.function), node: known(app, &name), cells }
    };
    shown.map(row).collect()
}

/// How long it goes on, counted down from when it was told.
fn left(app: &App, now: Now, order: &OrderInfo, is_old: bool) -> Cell {
    match order.left_ms {
        None => ranked("-", f64::INFINITY),
        Some(_) if is_old => ranked("?", f64::INFINITY),
        Some(left) => {
            let left = ms(left).saturating_sub(app.age(now));
            ranked(span(left), left.as_secs_f64())
        }
    }
}

fn inhibited(order: &OrderInfo) -> String {
    match order.inhibited {
        None => "-".to_owned(),
        Some(inhibited) if inhibited.by == 0 => format!("by itself, reason {}", inhibited.reason),
        Some(inhibited) => format!("by unit {}", inhibited.by),
    }
}

fn streams(app: &App, now: Now) -> Vec<Row> {
    let connected: HashSet<String> = app.nodes().iter().filter(|node| node.connected).map(selector).collect();
    let mut all: Vec<_> = app.values.iter().collect();
    all.sort_by_key(|(node, _)| node.as_str());
    let of_node = |(node, (at, values)): (&String, &(Now, Vec<Value>))| {
        let row = |value: &Value| {
            let age = value.age.map(|age| age + now.saturating_sub(*at));
            let is_gone = !connected.contains(node);
            let is_old = is_gone || age.is_none_or(|age| age > OLD_VALUE) || app.is_old(now);
            let tone = if is_old { Tone::Faint } else { Tone::Plain };
            let cells = vec![
                cell(without_role(node)),
                cell(&value.text).toned(tone),
                age.map_or(cell("-"), |age| ranked(span(age), age.as_secs_f64())).toned(tone),
            ];
            Row { key: format!("{node} {}", value.stream), node: Some(node.clone()), cells }
        };
        values.iter().map(row).collect::<Vec<_>>()
    };
    all.into_iter().flat_map(of_node).collect()
}

/// Those that count trouble first.
fn counters(app: &App) -> Vec<Row> {
    let mut all: Vec<_> = each(&app.counters).filter(|(_, _, count)| *count > 0).collect();
    all.sort_by_key(|(_, name, _)| !is_trouble(name));
    let row = |(node, name, count): (Option<&str>, &str, u64)| {
        let grown = app.grown.get(&(node.map(str::to_owned), name.to_owned())).copied().unwrap_or(0);
        let tone = match (is_trouble(name), grown > 0) {
            (true, true) => Tone::Bad,
            (true, false) => Tone::Plain,
            (false, _) => Tone::Faint,
        };
        let more = if grown > 0 { format!("+{grown}") } else { String::new() };
        let cells = vec![
            cell(node.unwrap_or("the manager")).toned(tone),
            cell(name).toned(tone),
            ranked(count.to_string(), count as f64).toned(tone),
            ranked(more, grown as f64).toned(tone),
        ];
        let key = format!("{} {name}", node.unwrap_or_default());
        Row { key, node: node.and_then(|node| known(app, node)), cells }
    };
    all.into_iter().map(row).collect()
}

/// Newest first; all, or those of one node.
pub(super) fn events(app: &App, of: Option<&str>) -> Vec<Row> {
    let shown = app.events.iter().filter(|event| of.is_none_or(|of| event.node.as_deref() == Some(of)));
    let row = |event: &Event| {
        // To the second, which leaves more of a terminal to the text.
        let at = show_time(event.unix_ms)[..19].to_owned();
        let tone = event_tone(&event.name);
        let cells = vec![
            ranked(at, event.number as f64),
            cell(&event.name).toned(tone),
            cell(event.node.as_deref().unwrap_or("-")),
            cell(&event.text),
        ];
        Row { key: event.number.to_string(), node: event.node.as_deref().and_then(|node| known(app, node)), cells }
    };
    shown.map(row).collect()
}

fn event_tone(name: &str) -> Tone {
    match name {
        "joined" | "manager_back" => Tone::Good,
        "left" | "not_joined" | "request_failed" | "lease_expired" | "inhibited" | "lost" | "fenced"
        | "manager_gone" | "manager_restarted" | "not_watched" => Tone::Bad,
        _ => Tone::Plain,
    }
}

/// All that is known of the watched node.
fn node(app: &App, now: Now) -> Vec<Row> {
    let Some((watched, _)) = &app.watched else { return Vec::new() };
    let Some(node) = app.nodes().iter().find(|node| selector(node) == *watched) else {
        return vec![line(watched, "state", cell("the manager knows it no longer").toned(Tone::Bad), 0)];
    };
    let name = full_name(node);
    let age = app.age(now);
    let mut said: Vec<(String, Cell)> = vec![
        ("state".into(), state(app, now, node)),
        ("role".into(), cell(&node.role)),
        ("address".into(), cell(node.address.as_deref().unwrap_or("-"))),
        ("round trip".into(), round_trip(app, now, node)),
    ];
    if let Some(left) = &node.left_text {
        said.push(("left because".into(), cell(left).toned(Tone::Bad)));
    }
    if let Some(up) = node.connected_ms {
        said.push(("connected for".into(), cell(span(ms(up) + age))));
    }
    if let Some(link) = node.link.filter(|_| node.connected) {
        said.push(("last sign of it".into(), cell(format!("{} ago", span(ms(link.silent_ms) + age)))));
        said.push(("calls".into(), cell(format!("{} to it are open, {} of it here", link.calls, link.calls_here))));
        said.push(("queue".into(), cell(format!("{} not sent yet", show_bytes(link.queued_bytes as u64)))));
        if let Some(cipher) = link.cipher {
            said.push(("cipher".into(), cell(cipher.name())));
        }
    }
    if let Some(clock) = node.clock {
        let text = format!(
            "{} \u{b1} {}, {} ago",
            signed_micros(clock.offset_us),
            show_micros(clock.error_us as f64),
            span(ms(clock.age_ms) + age)
        );
        let tone = if clock.trouble().is_some() { Tone::Bad } else { Tone::Plain };
        said.push(("clock offset".into(), cell(text).toned(tone)));
    }
    if let Some(limits) = node.limits {
        let text = format!("{} a message, {} calls", show_bytes(limits.message_size.into()), limits.calls);
        said.push(("it takes".into(), cell(text)));
    }
    for row in orders(app, now, false).into_iter().filter(|row| row.node.as_ref() == Some(watched)) {
        if let [_, function, order, holder, left, inhibited] = row.cells.as_slice() {
            let text =
                format!("{}, of unit {}, left {}, inhibited {}", order.text, holder.text, left.text, inhibited.text);
            said.push((format!("order {}", function.text), cell(text).toned(order.tone)));
        }
    }
    for row in streams(app, now).into_iter().filter(|row| row.node.as_ref() == Some(watched)) {
        if let [_, value, age] = row.cells.as_slice() {
            said.push(("stream".into(), cell(format!("{}  {} old", value.text, age.text)).toned(value.tone)));
        }
    }
    let functions = app.functions.get(watched).into_iter().flatten();
    said.extend(functions.map(|signature| ("function".into(), cell(signature))));
    let of_link = each(&app.counters)
        .filter(|(of, counter, count)| *of == Some(name.as_str()) && *count > 0 && is_trouble(counter));
    said.extend(of_link.map(|(_, name, count)| (name.to_owned(), cell(count.to_string()))));
    for row in events(app, Some(&name)) {
        if let [at, event, _, text] = row.cells.as_slice() {
            said.push((at.text.clone(), cell(format!("{}: {}", event.text, text.text)).toned(event.tone)));
        }
    }
    said.into_iter().enumerate().map(|(at, (what, cell))| line(watched, &what, cell, at)).collect()
}

/// `+1.50 ms`.
fn signed_micros(us: i64) -> String {
    format!("{}{}", if us < 0 { '-' } else { '+' }, show_micros(us.unsigned_abs() as f64))
}

fn line(node: &str, what: &str, text: Cell, at: usize) -> Row {
    Row { key: at.to_string(), node: Some(node.to_owned()), cells: vec![cell(what), text] }
}
