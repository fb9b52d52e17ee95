//! What is known of the fleet, with the order in which it changed: a page gets what has changed since its last message, and
//! of each thing the newest only, so nothing queues up for a slow one.

use std::collections::{BTreeMap, HashMap, HashSet, VecDeque};
use std::fmt::Write;
use std::time::Instant;

use cara_std::Shown;
use cara_std::control::Role;
use serde_json::{Value, json};

use crate::limits::{EVENTS, LOG_LINE, LOG_LINES, Limits, STREAMS};
use crate::users::User;

/// Kinds of things that are told.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum Section {
    /// The manager.
    Unit,
    /// By `NAME/ID@ROLE`.
    Nodes,
    /// Nodes that were refused, by address.
    Refused,
    /// By `NAME/ID FUNCTION`.
    Orders,
    /// By `NAME/ID`; that of the unit is empty.
    Counters,
    /// Node and signature of each stream, by number.
    Streams,
    /// Their newest values, by the same number.
    Values,
    /// The last lines of logs, each with its time, by `NAME/ID`.
    Logs,
    /// Round trips, by `NAME/ID`.
    Pings,
    /// What the doctor found last.
    Doctor,
    /// The limits of this server.
    Limits,
    /// Which manager had which vehicle, when somebody looked last.
    Managers,
}

const SECTIONS: [(Section, &str); 12] = [
    (Section::Unit, "unit"),
    (Section::Nodes, "nodes"),
    (Section::Refused, "refused"),
    (Section::Orders, "orders"),
    (Section::Counters, "counters"),
    (Section::Streams, "streams"),
    (Section::Values, "values"),
    (Section::Logs, "logs"),
    (Section::Pings, "pings"),
    (Section::Doctor, "doctor"),
    (Section::Limits, "limits"),
    (Section::Managers, "managers"),
];

#[derive(Default)]
struct Table {
    /// Each with the change that it came with.
    rows: BTreeMap<String, (u64, String)>,
    /// The change with which a row was last taken away: who has seen less gets the whole table.
    shortened: u64,
}

/// The whole of it.
pub(crate) struct Picture {
    start: Instant,
    change: u64,
    tables: [Table; SECTIONS.len()],
    events: VecDeque<(u64, String)>,
    events_seen: u64,
    /// By node and name: its number, and how many values have come.
    streams: HashMap<(String, String), (usize, u64)>,
    next_stream: usize,
    /// The lines as JSON, by node.
    logs: HashMap<String, VecDeque<String>>,
    link: Link,
}

/// The way to the manager.
#[derive(Default)]
struct Link {
    up: bool,
    /// When it last answered a look, in milliseconds of this server.
    answered: Option<u64>,
    error: Option<String>,
}

/// How much a page has been told.
#[derive(Clone, Copy, Debug, Default)]
pub(crate) struct Seen {
    change: u64,
    events: u64,
}

impl Picture {
    pub(crate) fn new() -> Self {
        Self {
            start: Instant::now(),
            change: 0,
            tables: Default::default(),
            events: VecDeque::new(),
            events_seen: 0,
            streams: HashMap::new(),
            next_stream: 0,
            logs: HashMap::new(),
            link: Link::default(),
        }
    }

    /// Milliseconds since this server's start: the clock of all times that pages are told.
    pub(crate) fn now(&self) -> u64 {
        self.start.elapsed().as_millis() as u64
    }

    /// Puts a row into a table. One that is as it was is no change.
    pub(crate) fn put(&mut self, section: Section, key: &str, row: &Value) {
        self.put_text(section, key, row.to_string());
    }

    fn put_text(&mut self, section: Section, key: &str, text: String) {
        let table = &mut self.tables[section as usize];
        if table.rows.get(key).is_none_or(|(_, old)| *old != text) {
            self.change += 1;
            table.rows.insert(key.to_owned(), (self.change, text));
        }
    }

    /// The rows of a table that are told from here on; all others go.
    pub(crate) fn set(&mut self, section: Section, rows: &[(String, Value)]) {
        let keys: HashSet<&str> = rows.iter().map(|(key, _)| key.as_str()).collect();
        self.keep(section, |key| keys.contains(key));
        rows.iter().for_each(|(key, row)| self.put(section, key, row));
    }

    fn keep(&mut self, section: Section, is_kept: impl Fn(&str) -> bool) {
        let table = &mut self.tables[section as usize];
        let before = table.rows.len();
        table.rows.retain(|key, _| is_kept(key));
        if table.rows.len() < before {
            self.change += 1;
            table.shortened = self.change;
        }
    }

    /// A value of a stream, `age_ms` old.
    pub(crate) fn value(&mut self, node: &str, stream: &str, values: &Value, age_ms: u64, limits: &Limits) {
        let name = stream.split('(').next().unwrap_or(stream);
        let key = (node.to_owned(), name.to_owned());
        if !self.streams.contains_key(&key) && self.streams.len() >= STREAMS {
            return limits.streams.refuse();
        }
        let next = &mut self.next_stream;
        let (number, count) = self.streams.entry(key).or_insert_with(|| {
            *next += 1;
            (*next, 0)
        });
        *count += 1;
        let (number, count) = (number.to_string(), *count);
        limits.streams.uses(self.streams.len());
        self.put(Section::Streams, &number, &json!({ "node": node, "name": name, "signature": stream }));
        let at = self.now().saturating_sub(age_ms);
        self.put(Section::Values, &number, &json!([count, at, values]));
    }

    /// A line of a node's log.
    pub(crate) fn log(&mut self, node: &str, unix_ms: u64, text: &str) {
        let text: String = Shown(text).to_string().chars().take(LOG_LINE).collect();
        let lines = self.logs.entry(node.to_owned()).or_default();
        if lines.len() == LOG_LINES {
            lines.pop_front();
        }
        lines.push_back(json!([unix_ms, text]).to_string());
        let row = format!("[{}]", lines.iter().map(String::as_str).collect::<Vec<_>>().join(","));
        self.put_text(Section::Logs, node, row);
    }

    /// Forgets streams and logs of nodes that are not known any more.
    pub(crate) fn only_streams_of(&mut self, is_known: impl Fn(&str) -> bool) {
        self.streams.retain(|(node, _), _| is_known(node));
        let left: HashSet<String> = self.streams.values().map(|(number, _)| number.to_string()).collect();
        self.keep(Section::Streams, |key| left.contains(key));
        self.keep(Section::Values, |key| left.contains(key));
        self.logs.retain(|node, _| is_known(node));
        self.keep(Section::Logs, &is_known);
    }

    /// Something happened. How many events are kept now.
    pub(crate) fn event(&mut self, event: &Value) -> usize {
        self.events_seen += 1;
        self.change += 1;
        if self.events.len() == EVENTS {
            self.events.pop_front();
        }
        self.events.push_back((self.events_seen, event.to_string()));
        self.events.len()
    }

    /// The manager has answered a look.
    pub(crate) fn answered(&mut self) {
        self.link = Link { up: true, answered: Some(self.now()), error: None };
    }

    /// The way to the manager is broken.
    pub(crate) fn lost(&mut self, error: &str) {
        if self.link.up || self.link.error.as_deref() != Some(error) {
            self.change += 1;
        }
        self.link.up = false;
        self.link.error = Some(error.to_owned());
    }

    /// Whether a page that has seen so much is to be told something.
    pub(crate) fn has_news(&self, seen: Seen) -> bool {
        self.change > seen.change
    }

    /// What has changed since, as JSON, with the way to the manager in each, and who is told. Notes that it is seen. Who may only
    /// stop is told of what there is to stop.
    pub(crate) fn news(&self, seen: &mut Seen, user: &User, limits: &Limits) -> String {
        let Link { up, answered, error } = &self.link;
        let link = json!({ "up": up, "answered": answered, "error": error });
        let me = json!({ "name": user.name, "role": user.role });
        let mut text = format!("{{\"now\":{},\"me\":{me},\"link\":{link}", self.now());
        let may_see = user.role >= Role::See;
        let is_told = |section| may_see || section == Section::Unit || section == Section::Nodes;
        for (section, name) in SECTIONS.into_iter().filter(|(section, _)| is_told(*section)) {
            self.tables[section as usize].write(&mut text, name, seen.change);
        }
        let first = self.events.front().map_or(self.events_seen, |(number, _)| number - 1);
        let passed_over = first.saturating_sub(seen.events);
        // A page that has just come has missed nothing.
        if seen.change > 0 && passed_over > 0 {
            limits.events.refuse_many(passed_over);
        }
        let news = self.events.iter().filter(|(number, _)| *number > seen.events).map(|(_, event)| event.as_str());
        let news: Vec<&str> = news.collect();
        if may_see && !news.is_empty() {
            // Writing to a string cannot fail.
            let _ = write!(text, ",\"events\":[{}]", news.join(","));
        }
        text.push('}');
        *seen = Seen { change: self.change, events: self.events_seen };
        text
    }
}

impl Table {
    /// Adds `"name":{"whole":…,"rows":{…}}` if something has changed.
    fn write(&self, text: &mut String, name: &str, seen: u64) {
        let whole = seen == 0 || self.shortened > seen;
        let rows: Vec<String> = self
            .rows
            .iter()
            .filter(|(_, (change, _))| whole || *change > seen)
            .map(|(key, (_, row))| format!("{}:{row}", json!(key)))
            .collect();
        if whole || !rows.is_empty() {
            let _ = write!(text, ",\"{name}\":{{\"whole\":{whole},\"rows\":{{{}}}}}", rows.join(","));
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn everything() -> User {
        User::only(String::new())
    }

    fn news(picture: &Picture, seen: &mut Seen) -> Value {
        serde_json::from_str(&picture.news(seen, &everything(), &Limits::new())).unwrap()
    }

    #[test]
    fn a_page_is_told_all_and_then_what_has_changed() {
        let (mut picture, mut seen) = (Picture::new(), Seen::default());
        picture.set(Section::Nodes, &[("a".into(), json!({ "x": 1 })), ("\"".into(), json!(2))]);
        let first = news(&picture, &mut seen);
        assert_eq!(first["nodes"], json!({ "whole": true, "rows": { "a": { "x": 1 }, "\"": 2 } }));
        assert!(!picture.has_news(seen));
        picture.put(Section::Nodes, "a", &json!({ "x": 1 }));
        assert!(!picture.has_news(seen), "it is as it was");
        picture.put(Section::Nodes, "a", &json!({ "x": 3 }));
        let second = news(&picture, &mut seen);
        assert_eq!(second["nodes"], json!({ "whole": false, "rows": { "a": { "x": 3 } } }));
        assert!(second.get("orders").is_none());
        picture.set(Section::Nodes, &[("a".into(), json!({ "x": 3 }))]);
        assert_eq!(news(&picture, &mut seen)["nodes"], json!({ "whole": true, "rows": { "a": { "x": 3 } } }));
    }

    #[test]
    fn a_slow_page_gets_the_newest_value_and_the_count_of_all() {
        let (mut picture, mut seen, limits) = (Picture::new(), Seen::default(), Limits::new());
        (0..50).for_each(|x| picture.value("a/1", "pose(x: int)", &json!([["x", [x]]]), 0, &limits));
        let reported = news(&picture, &mut seen);
        assert_eq!(
            reported["streams"]["rows"]["1"],
            json!({ "node": "a/1", "name": "pose", "signature": "pose(x: int)" })
        );
        let value = &reported["values"]["rows"]["1"];
        assert_eq!((&value[0], &value[2]), (&json!(50), &json!([["x", [49]]])));
    }

    #[test]
    fn streams_have_a_limit_and_those_of_forgotten_nodes_go() {
        let (mut picture, limits) = (Picture::new(), Limits::new());
        (0..=STREAMS).for_each(|id| picture.value(&format!("a/{id}"), "s()", &json!([]), 0, &limits));
        let streams = |limits: &Limits| limits.json().as_array().unwrap()[6].clone();
        assert_eq!((&streams(&limits)["used"], &streams(&limits)["refused"]), (&json!(STREAMS), &json!(1)));
        picture.only_streams_of(|node| node == "a/7");
        let reported = news(&picture, &mut Seen::default());
        assert_eq!(reported["values"]["rows"].as_object().unwrap().len(), 1);
        picture.value("b/1", "s()", &json!([]), 0, &limits);
        assert_eq!(streams(&limits)["used"], 2);
    }

    #[test]
    fn events_are_kept_up_to_a_limit_and_those_passed_over_are_counted() {
        let (mut picture, mut seen, limits) = (Picture::new(), Seen::default(), Limits::new());
        picture.event(&json!(0));
        picture.news(&mut seen, &everything(), &limits);
        (1..=EVENTS + 5).for_each(|number| assert!(picture.event(&json!(number)) <= EVENTS));
        let reported: Value = serde_json::from_str(&picture.news(&mut seen, &everything(), &limits)).unwrap();
        assert_eq!(reported["events"].as_array().unwrap().len(), EVENTS);
        assert_eq!(limits.json().as_array().unwrap()[7]["refused"], 5);
    }

    #[test]
    fn a_lost_manager_is_in_every_message() {
        let (mut picture, mut seen) = (Picture::new(), Seen::default());
        picture.answered();
        assert_eq!(news(&picture, &mut seen)["link"]["up"], true);
        picture.lost("gone");
        assert!(picture.has_news(seen));
        let link = news(&picture, &mut seen)["link"].clone();
        assert_eq!((&link["up"], &link["error"]), (&json!(false), &json!("gone")));
        assert!(link["answered"].is_u64(), "since when its data is old");
    }

    #[test]
    fn sections_stand_where_their_numbers_say() {
        SECTIONS.iter().enumerate().for_each(|(index, (section, _))| assert_eq!(*section as usize, index));
    }
}
