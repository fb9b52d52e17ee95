//! What is shown and what keys do: no terminal, no manager and no clock. The time since the start is an argument.

use std::collections::{HashMap, VecDeque};
use std::time::Duration;

use cara_std::control::protocol::{NodeInfo, OrderInfo, RefusedInfo, UnitInfo};
use cara_std::is_hidden;
use ratatui::crossterm::event::{KeyCode, KeyEvent, KeyModifiers};

use super::rows::{self, Table};
use crate::nodes::without_role;

/// Time since `cara top` was started.
pub(super) type Now = Duration;

/// What was told longer ago than this is old: the manager is asked twice a second.
const OLD: Duration = Duration::from_secs(2);
/// Values of a node that left longer ago are shown no more.
const KEPT_MS: u64 = 60_000;
/// Events that are kept.
pub(super) const EVENTS: usize = 500;
/// Commands whose outcomes are kept.
const TASKS: usize = 32;
/// Lines of one outcome that are kept; beyond the nodes of a manager.
const LINES: usize = 2_000;
/// Typed calls that are kept.
const TYPED: usize = 32;
/// Longest typed line, in characters.
const LONGEST: usize = 4_096;
/// Calls and resets that are waited for at a time. Each takes a connection of the manager.
const MOST_CALLS: usize = 3;
/// Stops that are waited for at a time: a manager keeps four connections for them.
const MOST_STOPS: usize = 4;

/// What the manager told at one time.
#[derive(Clone, Debug)]
pub(super) struct Snapshot {
    pub(super) unit: UnitInfo,
    pub(super) nodes: Vec<NodeInfo>,
    pub(super) refused: Vec<RefusedInfo>,
    pub(super) orders: Vec<OrderInfo>,
    /// Not each time: they are the largest part.
    pub(super) counters: Option<Vec<Counted>>,
}

/// Counters of the unit (no node) or of a link.
#[derive(Clone, Debug)]
pub(super) struct Counted {
    pub(super) node: Option<String>,
    pub(super) counters: Vec<(String, u64)>,
}

/// What one node was asked.
#[derive(Clone, Debug)]
pub(super) struct Probe {
    /// Its [selector].
    pub(super) node: String,
    /// In microseconds; none if no answer came.
    pub(super) round_trip: Option<f64>,
    /// None if they were not asked for this time.
    pub(super) values: Option<Vec<Value>>,
}

/// The newest value of a stream.
#[derive(Clone, Debug)]
pub(super) struct Value {
    pub(super) stream: String,
    /// The value in the form of a call, or why there is none.
    pub(super) text: String,
    /// When it was told.
    pub(super) age: Option<Duration>,
}

/// What was told of an event.
#[derive(Clone, Debug)]
pub(super) struct Event {
    pub(super) number: u64,
    pub(super) unix_ms: u64,
    pub(super) name: String,
    pub(super) node: Option<String>,
    pub(super) text: String,
}

/// What comes from the manager.
#[derive(Debug)]
pub(super) enum News {
    Snapshot(Box<Snapshot>),
    /// The manager does not answer, and is asked again.
    Gone(String),
    Probe(Probe),
    Event {
        /// Now if absent.
        unix_ms: Option<u64>,
        name: String,
        node: Option<String>,
        text: String,
    },
    /// Signatures that a node has published.
    Functions {
        node: String,
        signatures: Vec<String>,
    },
    /// What came of one node.
    Line {
        task: u64,
        is_bad: bool,
        text: String,
    },
    /// What came of it all.
    End {
        task: u64,
        is_bad: bool,
        text: String,
    },
}

/// What the manager is to do.
#[derive(Clone, Debug, PartialEq, Eq)]
pub(super) enum Ask {
    Call {
        node: String,
        text: String,
    },
    /// Of all if there is no node.
    Stop {
        node: Option<String>,
    },
    Reset {
        node: Option<String>,
    },
    Functions {
        node: String,
    },
}

impl Ask {
    pub(super) fn title(&self) -> String {
        let of = |verb: &str, node: &Option<String>| match node {
            Some(node) => format!("{verb} {}", without_role(node)),
            None => format!("{verb} ALL"),
        };
        match self {
            Self::Call { node, text } => format!("call {} {text}", without_role(node)),
            Self::Stop { node } => of("stop", node),
            Self::Reset { node } => of("reset", node),
            Self::Functions { node } => format!("functions {}", without_role(node)),
        }
    }
}

/// What a key leads to.
#[derive(Debug, PartialEq, Eq)]
pub(super) enum Act {
    /// Under the number of its task.
    Ask(u64, Ask),
    Quit,
}

/// A command that was given.
#[derive(Debug)]
pub(super) struct Task {
    pub(super) number: u64,
    pub(super) title: String,
    pub(super) is_stop: bool,
    pub(super) started: Now,
    pub(super) lines: Vec<(bool, String)>,
    pub(super) end: Option<(bool, String)>,
}

#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub(super) enum View {
    #[default]
    Nodes,
    Orders,
    Streams,
    Counters,
    Events,
    /// One node.
    Node,
}

impl View {
    pub(super) const ALL: [(Self, &str); 5] = [
        (Self::Nodes, "1 Nodes"),
        (Self::Orders, "2 Orders"),
        (Self::Streams, "3 Streams"),
        (Self::Counters, "4 Counters"),
        (Self::Events, "5 Events"),
    ];
}

/// Which row of a view is chosen, by what it is about and not by its place: rows come, go and change places.
#[derive(Clone, Debug, Default)]
pub(super) struct Cursor {
    pub(super) key: Option<String>,
    /// By which column, and whether backwards; as they come if there is none.
    pub(super) sort: Option<(usize, bool)>,
}

/// A line that is typed.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub(super) struct Typed {
    pub(super) text: String,
    /// In characters.
    pub(super) at: usize,
}

impl Typed {
    fn set(&mut self, text: String) {
        self.at = text.chars().count();
        self.text = text;
    }

    fn byte(&self) -> usize {
        self.text.char_indices().nth(self.at).map_or(self.text.len(), |(byte, _)| byte)
    }

    fn insert(&mut self, text: &str) {
        let room = LONGEST.saturating_sub(self.text.chars().count());
        let text: String = text.chars().filter(|character| !is_hidden(*character)).take(room).collect();
        self.text.insert_str(self.byte(), &text);
        self.at += text.chars().count();
    }

    fn key(&mut self, key: KeyEvent) {
        match key.code {
            KeyCode::Char('u') if key.modifiers.contains(KeyModifiers::CONTROL) => *self = Self::default(),
            KeyCode::Char(character) if !key.modifiers.intersects(KeyModifiers::CONTROL | KeyModifiers::ALT) => {
                self.insert(character.encode_utf8(&mut [0; 4]));
            }
            KeyCode::Backspace if self.at > 0 => {
                self.at -= 1;
                self.text.remove(self.byte());
            }
            KeyCode::Delete if self.byte() < self.text.len() => _ = self.text.remove(self.byte()),
            KeyCode::Left => self.at = self.at.saturating_sub(1),
            KeyCode::Right => self.at = (self.at + 1).min(self.text.chars().count()),
            KeyCode::Home => self.at = 0,
            KeyCode::End => self.at = self.text.chars().count(),
            _ => {}
        }
    }
}

/// What keys are for at the moment.
#[derive(Debug, Default)]
pub(super) enum Mode {
    #[default]
    Rows,
    Help,
    Filter,
    /// A call to this node is typed, or waited for.
    Call {
        node: String,
        task: Option<u64>,
    },
    /// `y` does it.
    Confirm(Ask),
    /// The outcome of a task, from this line on.
    Report {
        task: u64,
        top: usize,
    },
}

/// All that is known and chosen.
#[derive(Default)]
pub(super) struct App {
    /// `NAME/ID` of the manager.
    pub(super) manager: String,
    /// Milliseconds from 1970 to when [`Now`] was 0.
    pub(super) started_ms: u64,
    pub(super) snapshot: Option<Snapshot>,
    /// When the snapshot came.
    pub(super) reported_at: Now,
    /// Since when the manager does not answer, and why.
    pub(super) gone: Option<(Now, String)>,
    pub(super) counters: Vec<Counted>,
    /// What each counter has grown by between the last two times.
    pub(super) grown: HashMap<(Option<String>, String), u64>,
    /// By selector: when its last answer came, how long it took, and its values with the time at which they came.
    pub(super) round_trips: HashMap<String, (Now, Option<f64>)>,
    pub(super) values: HashMap<String, (Now, Vec<Value>)>,
    pub(super) functions: HashMap<String, Vec<String>>,
    /// Newest first.
    pub(super) events: VecDeque<Event>,
    next_event: u64,
    /// Newest last.
    pub(super) tasks: VecDeque<Task>,
    next_task: u64,
    pub(super) mode: Mode,
    pub(super) view: View,
    /// The node that is watched, and from where.
    pub(super) watched: Option<(String, View)>,
    cursors: HashMap<usize, Cursor>,
    pub(super) filter: Typed,
    pub(super) call: Typed,
    typed: VecDeque<String>,
    /// Which of them is shown in the prompt, counted from the newest one.
    recalled: Option<usize>,
}

/// A node in the one form that means no other one.
pub(super) fn selector(node: &NodeInfo) -> String {
    format!("{}/{}@{}", node.name, node.id, node.role)
}

impl App {
    pub(super) fn new(manager: String) -> Self {
        Self { manager, ..Self::default() }
    }

    /// Whether what is shown may be otherwise by now.
    pub(super) fn is_old(&self, now: Now) -> bool {
        self.snapshot.is_none() || self.gone.is_some() || self.age(now) > OLD
    }

    /// How long ago the snapshot was told.
    pub(super) fn age(&self, now: Now) -> Duration {
        now.saturating_sub(self.reported_at)
    }

    pub(super) fn nodes(&self) -> &[NodeInfo] {
        self.snapshot.as_ref().map_or(&[], |snapshot| &snapshot.nodes)
    }

    pub(super) fn cursor(&self) -> Cursor {
        self.cursors.get(&(self.view as usize)).cloned().unwrap_or_default()
    }

    fn cursor_mut(&mut self) -> &mut Cursor {
        self.cursors.entry(self.view as usize).or_default()
    }

    pub(super) fn task(&self, number: u64) -> Option<&Task> {
        self.tasks.iter().find(|task| task.number == number)
    }

    /// The selector of the node that keys are about.
    pub(super) fn target(&self, now: Now) -> Option<String> {
        if let (View::Node, Some((node, _))) = (self.view, &self.watched) {
            return Some(node.clone());
        }
        let key = self.cursor().key?;
        self.table(now).rows.into_iter().find(|row| row.key == key)?.node
    }

    /// The rows of the view, filtered and sorted.
    pub(super) fn table(&self, now: Now) -> Table {
        let mut table = rows::of(self, self.view, now);
        let wanted = self.filter.text.to_lowercase();
        if !wanted.is_empty() && self.view != View::Node {
            table.rows.retain(|row| row.cells.iter().any(|cell| cell.text.to_lowercase().contains(&wanted)));
        }
        if let Some((column, backwards)) = self.cursor().sort {
            table.sort(column, backwards);
        }
        table
    }

    // What is told.

    pub(super) fn reported(&mut self, news: News, now: Now) {
        match news {
            News::Snapshot(snapshot) => self.snapshot_came(*snapshot, now),
            News::Gone(why) => {
                if self.gone.is_none() {
                    self.note(self.clock(now), "manager_gone", None, why.clone());
                }
                self.gone = Some((self.gone.as_ref().map_or(now, |(since, _)| *since), why));
            }
            News::Probe(probe) => {
                if probe.round_trip.is_some() || !self.round_trips.contains_key(&probe.node) {
                    self.round_trips.insert(probe.node.clone(), (now, probe.round_trip));
                }
                if let Some(values) = probe.values {
                    self.values.insert(probe.node, (now, values));
                }
                self.settle(now);
            }
            News::Event { unix_ms, name, node, text } => {
                self.note(unix_ms.unwrap_or_else(|| self.clock(now)), &name, node, text);
            }
            News::Functions { node, signatures } => _ = self.functions.insert(node, signatures),
            News::Line { task, is_bad, text } => {
                if let Some(task) = self.tasks.iter_mut().find(|known| known.number == task)
                    && task.lines.len() < LINES
                {
                    task.lines.push((is_bad, text));
                }
            }
            News::End { task, is_bad, text } => self.ended(task, is_bad, text),
        }
    }

    fn snapshot_came(&mut self, mut snapshot: Snapshot, now: Now) {
        if self.gone.take().is_some() {
            self.note(self.clock(now), "manager_back", None, "the manager answers again".to_owned());
        }
        if let Some(before) = &self.snapshot
            && before.unit.epoch != snapshot.unit.epoch
        {
            self.note(self.clock(now), "manager_restarted", None, "the manager was started again".to_owned());
            self.counters.clear();
        }
        if let Some(counters) = snapshot.counters.take() {
            let before = std::mem::replace(&mut self.counters, counters);
            self.grown = rows::grown(&before, &self.counters);
        }
        self.reported_at = now;
        // What is known of nodes that the manager has forgotten goes too.
        let known: Vec<String> = snapshot.nodes.iter().map(selector).collect();
        let is_known = |node: &String| known.contains(node);
        self.round_trips.retain(|node, _| is_known(node));
        let gone =
            snapshot.nodes.iter().filter(|node| !node.connected && node.left_ms.is_none_or(|left| left > KEPT_MS));
        let gone: Vec<String> = gone.map(selector).collect();
        self.values.retain(|node, _| is_known(node) && !gone.contains(node));
        self.functions.retain(|node, _| is_known(node));
        self.snapshot = Some(snapshot);
        self.settle(now);
    }

    /// Milliseconds since 1970.
    fn clock(&self, now: Now) -> u64 {
        self.started_ms + now.as_millis() as u64
    }

    fn note(&mut self, unix_ms: u64, name: &str, node: Option<String>, text: String) {
        let number = self.next_event;
        self.next_event += 1;
        self.events.push_front(Event { number, unix_ms, name: name.to_owned(), node, text });
        self.events.truncate(EVENTS);
    }

    fn ended(&mut self, number: u64, is_bad: bool, text: String) {
        let Some(task) = self.tasks.iter_mut().find(|known| known.number == number) else { return };
        task.end = Some((is_bad, text));
        let report = Mode::Report { task: number, top: 0 };
        match &self.mode {
            // A stop that has failed is told whatever is typed.
            _ if is_bad && task.is_stop => self.mode = report,
            // With a mistake the prompt stays, to mend it.
            Mode::Call { task: Some(asked), .. } if *asked == number && !is_bad => self.mode = Mode::Rows,
            Mode::Rows if is_bad => self.mode = report,
            _ => {}
        }
    }

    /// Chooses the first row where none has ever been chosen. An address that is refused is none that keys could be about: it
    /// would go, and leave no row chosen, when its node joins.
    fn settle(&mut self, now: Now) {
        if self.cursor().key.is_none() && self.view != View::Events {
            let mut rows = self.table(now).rows.into_iter();
            let first = rows.find(|row| self.view != View::Nodes || row.node.is_some());
            self.cursor_mut().key = first.map(|row| row.key);
        }
    }

    // Keys.

    /// Text that was pasted: for a line that is typed, and no keys.
    pub(super) fn paste(&mut self, text: &str) {
        match self.mode {
            Mode::Filter => self.filter.insert(text),
            Mode::Call { task: None, .. } => self.call.insert(text),
            _ => {}
        }
    }

    pub(super) fn key(&mut self, key: KeyEvent, now: Now) -> Option<Act> {
        let control = key.modifiers.contains(KeyModifiers::CONTROL);
        match key.code {
            KeyCode::Char('c') if control => return Some(Act::Quit),
            // Wherever one is, also while something is typed.
            KeyCode::Char('s') if control => return self.ask(Ask::Stop { node: None }, now),
            _ => {}
        }
        match std::mem::take(&mut self.mode) {
            Mode::Rows => self.key_of_rows(key, now),
            // The key that ends it is not lost if it is the one that stops.
            Mode::Help if key.code == KeyCode::Char('S') => self.key_of_rows(key, now),
            Mode::Help => None,
            Mode::Filter => self.key_of_filter(key, now),
            Mode::Call { node, task } => self.key_of_call(key, node, task, now),
            Mode::Confirm(ask) => match key.code {
                KeyCode::Char('y') => self.ask(ask, now),
                KeyCode::Char('S') => self.key_of_rows(key, now),
                _ => None,
            },
            Mode::Report { task, top } => {
                let top = match key.code {
                    KeyCode::Char('S') => return self.key_of_rows(key, now),
                    KeyCode::Up | KeyCode::Char('k') => top.saturating_sub(1),
                    KeyCode::Down | KeyCode::Char('j') => top + 1,
                    KeyCode::PageUp => top.saturating_sub(10),
                    KeyCode::PageDown => top + 10,
                    _ => return None,
                };
                let last = self.task(task).map_or(0, |task| task.lines.len());
                self.mode = Mode::Report { task, top: top.min(last) };
                None
            }
        }
    }

    fn key_of_rows(&mut self, key: KeyEvent, now: Now) -> Option<Act> {
        match key.code {
            KeyCode::Char('q') => return Some(Act::Quit),
            KeyCode::Char('?' | 'h') | KeyCode::F(1) => self.mode = Mode::Help,
            KeyCode::Char('S') => return self.ask(Ask::Stop { node: None }, now),
            KeyCode::Char('s') => {
                let node = self.chosen(now)?;
                return self.ask(Ask::Stop { node: Some(node) }, now);
            }
            KeyCode::Char('r') => self.mode = Mode::Confirm(Ask::Reset { node: Some(self.chosen(now)?) }),
            KeyCode::Char('R') => self.mode = Mode::Confirm(Ask::Reset { node: None }),
            KeyCode::Char('c') => {
                let node = self.chosen(now)?;
                self.recalled = None;
                self.mode = Mode::Call { node: node.clone(), task: None };
                return Some(self.functions_of(node));
            }
            KeyCode::Enter if self.view != View::Node => {
                let node = self.chosen(now)?;
                self.watched = Some((node.clone(), self.view));
                self.view = View::Node;
                *self.cursor_mut() = Cursor::default();
                self.settle(now);
                return Some(self.functions_of(node));
            }
            KeyCode::Esc | KeyCode::Backspace => self.back(now),
            KeyCode::Char('l') => {
                let newest = self.tasks.back().map(|task| task.number);
                self.mode = newest.map_or(Mode::Rows, |task| Mode::Report { task, top: 0 });
            }
            KeyCode::Char('/') => self.mode = Mode::Filter,
            KeyCode::Char('o') => self.sort(now),
            KeyCode::Char('O') => {
                let cursor = self.cursor_mut();
                cursor.sort = cursor.sort.map(|(column, backwards)| (column, !backwards));
            }
            KeyCode::Char(digit @ '1'..='5') => self.show(digit as usize - '1' as usize, now),
            KeyCode::Tab | KeyCode::BackTab => {
                let at = View::ALL.iter().position(|(view, _)| *view == self.view);
                let count = View::ALL.len();
                let step = if key.code == KeyCode::Tab { 1 } else { count - 1 };
                self.show(at.map_or(0, |at| (at + step) % count), now);
            }
            _ => self.step(key.code, now),
        }
        None
    }

    fn functions_of(&mut self, node: String) -> Act {
        self.next_task += 1;
        Act::Ask(self.next_task, Ask::Functions { node })
    }

    /// The node that a key is about; without one this is said.
    fn chosen(&mut self, now: Now) -> Option<String> {
        let target = self.target(now);
        if target.is_none() {
            self.say(now, "no node is chosen: choose one with the arrow keys, in view 1");
        }
        target
    }

    /// A remark in the status line.
    fn say(&mut self, now: Now, text: &str) {
        self.next_task += 1;
        let end = Some((true, text.to_owned()));
        let (number, title, lines) = (self.next_task, String::new(), Vec::new());
        self.keep(Task { number, title, is_stop: false, started: now, lines, end });
    }

    fn keep(&mut self, task: Task) {
        self.tasks.push_back(task);
        while self.tasks.len() > TASKS {
            self.tasks.pop_front();
        }
    }

    /// Gives a command, unless too many are waited for.
    fn ask(&mut self, ask: Ask, now: Now) -> Option<Act> {
        let is_stop = matches!(ask, Ask::Stop { .. });
        let open = self.tasks.iter().filter(|task| task.end.is_none() && task.is_stop == is_stop).count();
        if open >= if is_stop { MOST_STOPS } else { MOST_CALLS } {
            self.say(now, &format!("{} was not sent: {open} before it have not been answered", ask.title()));
            return None;
        }
        self.next_task += 1;
        let (number, title, lines) = (self.next_task, ask.title(), Vec::new());
        self.keep(Task { number, title, is_stop, started: now, lines, end: None });
        Some(Act::Ask(number, ask))
    }

    /// From the watched node to where it was chosen; else away with the filter.
    fn back(&mut self, now: Now) {
        match self.watched.take() {
            Some((_, view)) if self.view == View::Node => self.view = view,
            _ => {
                self.filter = Typed::default();
                self.filtered(now);
            }
        }
    }

    fn show(&mut self, index: usize, now: Now) {
        if let Some((view, _)) = View::ALL.get(index) {
            self.view = *view;
            self.settle(now);
        }
    }

    fn sort(&mut self, now: Now) {
        let columns = rows::of(self, self.view, now).columns.len();
        let cursor = self.cursor_mut();
        cursor.sort = match cursor.sort {
            None => Some((0, false)),
            Some((column, _)) if column + 1 < columns => Some((column + 1, false)),
            Some(_) => None,
        };
    }

    fn step(&mut self, key: KeyCode, now: Now) {
        let rows = self.table(now).rows;
        let Some(last) = rows.len().checked_sub(1) else { return };
        let key_now = self.cursor().key;
        let at = key_now.and_then(|key| rows.iter().position(|row| row.key == key));
        let to = match (key, at) {
            (KeyCode::Up | KeyCode::Char('k'), Some(at)) => at.saturating_sub(1),
            (KeyCode::Down | KeyCode::Char('j'), Some(at)) => at + 1,
            (KeyCode::PageUp, Some(at)) => at.saturating_sub(10),
            (KeyCode::PageDown, Some(at)) => at + 10,
            (KeyCode::End | KeyCode::Char('G'), _) => last,
            (KeyCode::Up | KeyCode::Down | KeyCode::PageUp | KeyCode::PageDown, None) => 0,
            (KeyCode::Home | KeyCode::Char('g'), _) => 0,
            (KeyCode::Char('k' | 'j'), None) => 0,
            _ => return,
        };
        self.cursor_mut().key = rows.get(to.min(last)).map(|row| row.key.clone());
    }

    fn key_of_filter(&mut self, key: KeyEvent, now: Now) -> Option<Act> {
        match key.code {
            KeyCode::Enter => return None,
            KeyCode::Esc => self.filter = Typed::default(),
            _ => {
                self.filter.key(key);
                self.mode = Mode::Filter;
            }
        }
        self.filtered(now);
        None
    }

    /// A row that the filter hides is not the chosen one.
    fn filtered(&mut self, now: Now) {
        let rows = self.table(now).rows;
        let key = self.cursor().key;
        if !rows.iter().any(|row| Some(&row.key) == key.as_ref()) {
            self.cursor_mut().key = rows.first().map(|row| row.key.clone()).filter(|_| self.view != View::Events);
        }
    }

    fn key_of_call(&mut self, key: KeyEvent, node: String, task: Option<u64>, now: Now) -> Option<Act> {
        if key.code == KeyCode::Esc {
            return None;
        }
        let waits = task.is_some_and(|number| self.task(number).is_some_and(|task| task.end.is_none()));
        if waits {
            self.mode = Mode::Call { node, task };
            return None;
        }
        if key.code == KeyCode::Enter {
            let text = self.call.text.trim().to_owned();
            if text.is_empty() {
                return None;
            }
            self.typed.retain(|earlier| *earlier != text);
            self.typed.push_front(text.clone());
            self.typed.truncate(TYPED);
            let act = self.ask(Ask::Call { node: node.clone(), text }, now);
            if let Some(Act::Ask(number, _)) = &act {
                self.mode = Mode::Call { node, task: Some(*number) };
            }
            return act;
        }
        match key.code {
            KeyCode::Up | KeyCode::Down => self.recall(key.code == KeyCode::Up),
            KeyCode::Tab => self.complete(&node),
            _ => self.call.key(key),
        }
        self.mode = Mode::Call { node, task: None };
        None
    }

    fn recall(&mut self, earlier: bool) {
        let to = match (self.recalled, earlier) {
            (None, true) => Some(0),
            (Some(at), true) => Some(at + 1),
            (Some(at), false) => at.checked_sub(1),
            (None, false) => None,
        };
        if let Some(text) = to.and_then(|to| self.typed.get(to)) {
            self.call.set(text.clone());
            self.recalled = to;
        }
    }

    /// The first function whose name begins so.
    fn complete(&mut self, node: &str) {
        let found = self.offered(node).first().map(|signature| {
            let name = signature.split('(').next().unwrap_or_default();
            let takes = !signature.starts_with(&format!("{name}()"));
            format!("{name}{}", if takes { "(" } else { "()" })
        });
        if let Some(text) = found.filter(|_| !self.call.text.contains('(')) {
            self.call.set(text);
        }
    }

    /// What the node offers that begins as the call does which is typed.
    pub(super) fn offered(&self, node: &str) -> Vec<&str> {
        let name = self.call.text.split('(').next().unwrap_or_default().trim();
        let all = self.functions.get(node).into_iter().flatten().map(String::as_str);
        all.filter(|signature| signature.starts_with(name)).collect()
    }
}
