//! The screen of what is known. Whatever comes from a peer is [`clean`] before it is put on it.

use std::time::Duration;

use cara_std::Shown;
use ratatui::Frame;
use ratatui::buffer::Buffer;
use ratatui::layout::{Constraint, Layout, Rect};
use ratatui::style::{Color, Modifier, Style};
use ratatui::text::{Line, Span, Text};
use ratatui::widgets::{Block, Clear, Paragraph, Widget, Wrap};

use super::app::{App, Mode, Now, Task, View};
use super::rows::{self, Column, Row, Table, Tone, span};
use crate::nodes::without_role;

/// Longest text of a peer that is looked at for one line of the screen, in characters.
const LONGEST: usize = 1_000;
/// With so many lines, orders and events stand below the nodes.
const PANELS_FROM: u16 = 20;
/// A stop that is not acknowledged for so long is told loudly.
const PATIENCE: Duration = Duration::from_secs(1);

const HELP: &str = "\
S, Ctrl-S   STOP ALL vehicles at once, nothing is asked; Ctrl-S also while you type
s           stop the chosen node at once
r, R        reset the chosen node, all nodes (y confirms): they may move again
c           call a function of the chosen node: go_to(position: [1, 2])
Enter       watch the chosen node; Esc goes back
1 to 5, Tab nodes, orders, streams, counters, events
arrows, jk  choose a row; PgUp, PgDn, Home, End
/           filter rows by a text; Esc takes the filter away
o, O        sort by the next column; the other way round
l           the outcome of the last command, node by node
q, Ctrl-C   quit

TRIP is the round trip of the protocol's ping, SEEN how long ago the node was last
heard, CALLS and QUEUE what waits on its link, TROUBLE what was refused, dropped,
missed or late on it (view 4 names each). Grey figures are old.
cara top is no certified emergency stop.";

/// Which styles there are.
#[derive(Clone, Copy, Debug)]
pub(super) struct Theme {
    /// Not with `NO_COLOR`.
    pub(super) colours: bool,
}

impl Theme {
    fn style(self, tone: Tone) -> Style {
        let coloured = |style: Style, colour| if self.colours { style.fg(colour) } else { style };
        match tone {
            Tone::Plain => Style::new(),
            Tone::Good => coloured(Style::new(), Color::Green),
            Tone::Bad => coloured(Style::new().add_modifier(Modifier::BOLD), Color::Red),
            Tone::Faint => Style::new().add_modifier(Modifier::DIM),
        }
    }

    fn loud(self) -> Style {
        self.style(Tone::Bad).add_modifier(Modifier::REVERSED)
    }
}

const BOLD: Style = Style::new().add_modifier(Modifier::BOLD);

/// A text without what acts on a terminal.
fn clean(text: &str) -> String {
    let end = text.char_indices().nth(LONGEST).map_or(text.len(), |(end, _)| end);
    let cut = text.get(..end).unwrap_or(text);
    Shown(cut).to_string()
}

pub(super) fn draw(frame: &mut Frame<'_>, app: &App, now: Now, theme: Theme) {
    let area = frame.area();
    let banner = banner(app, now);
    let has_panels = app.view == View::Nodes && area.height >= PANELS_FROM;
    let panel = |lines: u16| if has_panels { lines + area.height.saturating_sub(PANELS_FROM) / 6 } else { 0 };
    let fixed = |height: u16| Constraint::Length(height);
    let heights = [
        fixed(2),
        fixed(1),
        fixed(banner.is_some().into()),
        Constraint::Fill(1),
        fixed(panel(4)),
        fixed(panel(5)),
        fixed(1),
        fixed(1),
    ];
    let [head, tabs, loud, main, orders, events, status, keys] = Layout::vertical(heights).areas(area);
    let buffer = frame.buffer_mut();
    draw_head(buffer, head, app, now, theme);
    draw_tabs(buffer, tabs, app);
    if let Some(text) = banner {
        let text = format!("{text:width$}", width = usize::from(loud.width));
        put(buffer, loud, 0, 0, &text, loud.width, theme.loud());
    }
    let old = app.is_old(now);
    draw_table(buffer, main, &app.table(now), app.cursor().key.as_deref(), old, theme);
    if has_panels {
        draw_panel(buffer, orders, "Orders that run, and what is inhibited", &rows::running(app, now), old, theme);
        let newest = Table { rows: rows::events(app, None), ..rows::of(app, View::Events, now) };
        draw_panel(buffer, events, "Events, newest first", &newest, false, theme);
    }
    draw_status(buffer, status, app, now, theme);
    let hint = "S STOP ALL  s stop  c call  r reset  Enter watch  / filter  ? help  q quit";
    put(buffer, keys, 0, 0, hint, keys.width, theme.style(Tone::Faint));
    draw_popup(frame, app, now, theme);
}

/// Text in a line of an area; what is outside is not drawn.
fn put(buffer: &mut Buffer, area: Rect, x: u16, y: u16, text: &str, width: u16, style: Style) {
    let area = area.intersection(buffer.area);
    let width = width.min(area.width.saturating_sub(x));
    if y >= area.height || width == 0 {
        return;
    }
    buffer.set_stringn(area.x + x, area.y + y, text, width.into(), style);
}

/// What makes everything that is shown doubtful.
fn banner(app: &App, now: Now) -> Option<String> {
    let age = span(app.age(now));
    let shown = if app.snapshot.is_some() { format!("all below is {age} OLD") } else { "nothing is known".into() };
    match &app.gone {
        Some((since, why)) => {
            let gone = span(now.saturating_sub(*since));
            Some(format!(" MANAGER GONE {gone} | {shown} | trying again | {}", clean(why)))
        }
        None if app.snapshot.is_none() => Some(" waiting for the manager's first answer".to_owned()),
        None if app.is_old(now) => Some(format!(" THE MANAGER DOES NOT ANSWER | {shown}")),
        None => None,
    }
}

fn draw_head(buffer: &mut Buffer, area: Rect, app: &App, now: Now, theme: Theme) {
    let manager = clean(&app.manager);
    let Some(snapshot) = &app.snapshot else {
        return put(buffer, area, 0, 0, &format!("cara top  {manager}"), area.width, BOLD);
    };
    let unit = &snapshot.unit;
    let up = span(Duration::from_millis(unit.uptime_ms) + app.age(now));
    let mode = unit.mode.as_deref().unwrap_or("");
    let leads = match unit.leading {
        Some(true) => "  leads",
        Some(false) => "  DOES NOT LEAD",
        None => "",
    };
    let first = format!("cara top  {manager}  fleet {}  {}  up {up}{leads}", unit.fleet, clean(mode));
    put(buffer, area, 0, 0, &first, area.width, BOLD);
    let expected = snapshot.nodes.iter().filter(|node| node.expected);
    let missing = expected.clone().filter(|node| !node.connected).count();
    let count = |what: &dyn Fn(&cara_std::control::protocol::OrderInfo) -> bool| {
        snapshot.orders.iter().filter(|order| what(order)).count()
    };
    let second = format!(
        "{} of {} s_units, {missing} missing | {} orders run, {} inhibited | {} refused",
        expected.clone().count() - missing,
        expected.count(),
        count(&|order| order.order == "runs"),
        count(&|order| order.inhibited.is_some()),
        snapshot.refused.len(),
    );
    let tone = match (app.is_old(now), missing) {
        (true, _) => Tone::Faint,
        (false, 0) => Tone::Plain,
        (false, _) => Tone::Bad,
    };
    put(buffer, area, 0, 1, &second, area.width, theme.style(tone));
}

fn draw_tabs(buffer: &mut Buffer, area: Rect, app: &App) {
    let mut x = 0;
    for (view, name) in View::ALL {
        let style = if view == app.view { BOLD.add_modifier(Modifier::REVERSED) } else { Style::new() };
        put(buffer, area, x, 0, &format!(" {name} "), area.width, style);
        x += name.len() as u16 + 3;
    }
    let rest = match (&app.watched, &app.mode) {
        (Some((node, _)), _) if app.view == View::Node => format!("watching {}", clean(without_role(node))),
        (_, Mode::Filter) => format!("/{}_", clean(&app.filter.text)),
        _ if app.filter.text.is_empty() => return,
        _ => format!("/{}", clean(&app.filter.text)),
    };
    put(buffer, area, x, 0, &rest, area.width, BOLD);
}

fn draw_panel(buffer: &mut Buffer, area: Rect, title: &str, table: &Table, old: bool, theme: Theme) {
    let rule = "─".repeat(area.width.into());
    put(buffer, area, 0, 0, &rule, area.width, theme.style(Tone::Faint));
    put(buffer, area, 2, 0, &format!(" {title}: {} ", table.rows.len()), area.width, Style::new());
    let body = Rect { y: area.y + 1, height: area.height.saturating_sub(1), ..area };
    draw_rows(buffer, body, table, 0, None, old, theme);
}

fn draw_table(buffer: &mut Buffer, area: Rect, table: &Table, key: Option<&str>, old: bool, theme: Theme) {
    let mut x = 2;
    for (column, width) in widths(table.columns, area.width) {
        put(buffer, area, x, 0, column.heading, width, BOLD);
        x += width + 1;
    }
    let body = Rect { y: area.y + 1, height: area.height.saturating_sub(1), ..area };
    let chosen = key.and_then(|key| table.rows.iter().position(|row| row.key == key));
    let height = usize::from(body.height);
    let top = chosen.unwrap_or(0).saturating_sub(height / 2).min(table.rows.len().saturating_sub(height));
    draw_rows(buffer, body, table, top, chosen, old, theme);
    // Where rows are hidden, the heading tells how many there are.
    if table.rows.len() > height {
        let text = format!(" {}-{} of {} ", top + 1, (top + height).min(table.rows.len()), table.rows.len());
        let at = area.width.saturating_sub(text.len() as u16);
        put(buffer, area, at, 0, &text, area.width, BOLD);
    }
}

/// The columns that there is room for, with their widths.
fn widths(columns: &[Column], width: u16) -> Vec<(Column, u16)> {
    let shown: Vec<Column> = columns.iter().filter(|column| width >= column.from).copied().collect();
    let fixed: u16 = shown.iter().map(|column| column.width + 1).sum();
    // Two cells mark the chosen row.
    let left = width.saturating_sub(fixed + 1).max(10);
    shown.into_iter().map(|column| (column, if column.width == 0 { left } else { column.width })).collect()
}

fn draw_rows(
    buffer: &mut Buffer,
    area: Rect,
    table: &Table,
    top: usize,
    chosen: Option<usize>,
    old: bool,
    theme: Theme,
) {
    let columns = widths(table.columns, area.width);
    // Columns that are left out are left out of the rows too.
    let shown = |at: usize| table.columns.get(at).is_some_and(|column| area.width >= column.from);
    for (y, (at, row)) in (0..area.height).zip(table.rows.iter().enumerate().skip(top)) {
        let is_chosen = chosen == Some(at);
        let base = if is_chosen { Style::new().add_modifier(Modifier::REVERSED) } else { Style::new() };
        if is_chosen {
            put(buffer, area, 0, y, &format!("{:width$}", ">", width = usize::from(area.width)), area.width, base);
        }
        draw_row(buffer, area, y, row, &columns, &shown, |tone| {
            let tone = if old && tone != Tone::Bad { Tone::Faint } else { tone };
            base.patch(theme.style(tone))
        });
    }
}

fn draw_row(
    buffer: &mut Buffer,
    area: Rect,
    y: u16,
    row: &Row,
    columns: &[(Column, u16)],
    shown: &dyn Fn(usize) -> bool,
    style: impl Fn(Tone) -> Style,
) {
    let cells = row.cells.iter().enumerate().filter(|(at, _)| shown(*at)).map(|(_, cell)| cell);
    let mut x = 2;
    for (cell, (column, width)) in cells.zip(columns) {
        let text = clean(&cell.text);
        let text = if column.heading == "NODE" { with_id(&text, *width) } else { text };
        let style = style(cell.tone);
        put(buffer, area, x, y, &text, *width, style);
        if Span::raw(&text).width() > usize::from(*width) && x + width <= area.width {
            put(buffer, area, x + width - 1, y, "…", 1, style);
        }
        x += width + 1;
    }
}

/// A `NAME/ID` that is too long, without the middle: the ID tells nodes apart.
fn with_id(text: &str, width: u16) -> String {
    let width = usize::from(width);
    let Some((name, id)) = text.rsplit_once('/').filter(|_| Span::raw(text).width() > width) else {
        return text.to_owned();
    };
    let kept: String = name.chars().take(width.saturating_sub(id.len() + 2)).collect();
    format!("{kept}…/{id}")
}

/// How it is with the last command; a stop that is not acknowledged goes before newer ones.
fn draw_status(buffer: &mut Buffer, area: Rect, app: &App, now: Now, theme: Theme) {
    let open = |task: &&Task| task.is_stop && task.end.is_none();
    let Some(task) = app.tasks.iter().rev().find(open).or(app.tasks.back()) else { return };
    let title = if task.title.is_empty() { String::new() } else { format!("{}: ", clean(&task.title)) };
    let (text, style) = match &task.end {
        Some((is_bad, text)) => {
            let text = clean(text.lines().next().unwrap_or_default());
            (format!("{title}{text}"), theme.style(if *is_bad { Tone::Bad } else { Tone::Good }))
        }
        None => {
            let waited = now.saturating_sub(task.started);
            let answered = task.lines.len();
            let is_late = task.is_stop && waited > PATIENCE;
            let not = if is_late { "NOT ACKNOWLEDGED YET, " } else { "" };
            let text = format!("{title}{not}waiting for {}, {answered} answered", span(waited));
            (text, if is_late { theme.loud() } else { BOLD })
        }
    };
    put(buffer, area, 0, 0, &text, area.width, style);
}

fn draw_popup(frame: &mut Frame<'_>, app: &App, now: Now, theme: Theme) {
    let toned = |text: &str, tone| Line::styled(clean(text), theme.style(tone));
    match &app.mode {
        Mode::Rows | Mode::Filter => {}
        Mode::Help => popup(frame, "Help", HELP.lines().map(Line::raw).collect(), "any key closes this"),
        Mode::Confirm(ask) => {
            let text = format!("{}? What was stopped may move again.", clean(&ask.title()));
            popup(frame, "Confirm", vec![Line::styled(text, BOLD)], "y does it, any other key does not");
        }
        Mode::Report { task, top } => {
            let Some(task) = app.task(*task) else { return };
            let mut lines = Vec::new();
            if let Some((is_bad, text)) = &task.end {
                let tone = if *is_bad { Tone::Bad } else { Tone::Good };
                lines.extend(text.lines().map(|line| toned(line, tone)));
            }
            // What has failed first.
            let (bad, good): (Vec<_>, Vec<_>) = task.lines.iter().partition(|(is_bad, _)| *is_bad);
            lines.extend(bad.iter().map(|(_, text)| toned(text, Tone::Bad)));
            lines.extend(good.iter().map(|(_, text)| toned(text, Tone::Plain)));
            let lines = lines.into_iter().skip(*top).collect();
            popup(frame, &clean(&task.title), lines, "up and down scroll, any other key closes this");
        }
        Mode::Call { node, task } => {
            let mut lines = vec![typed(app, frame.area().width), Line::raw("")];
            match task.and_then(|task| app.task(task)) {
                Some(Task { end: None, started, .. }) => {
                    lines.push(Line::raw(format!("waiting for {}", span(now.saturating_sub(*started)))));
                }
                Some(Task { end: Some((_, text)), .. }) => {
                    lines.extend(text.lines().map(|line| toned(line, Tone::Bad)));
                }
                None => lines.extend(app.offered(node).into_iter().map(|text| toned(text, Tone::Faint))),
            }
            let title = format!("Call {}", clean(without_role(node)));
            let hint = "Enter calls  Tab completes  Up earlier calls  Esc leaves  Ctrl-S STOPS ALL";
            popup(frame, &title, lines, hint);
        }
    }
}

/// The typed line with its cursor; of a long one the part around it.
fn typed(app: &App, width: u16) -> Line<'static> {
    let room = usize::from(width.saturating_sub(10)).max(8);
    let first = (app.call.at + 1).saturating_sub(room);
    let text: Vec<char> = app.call.text.chars().skip(first).take(room).collect();
    let at = app.call.at - first;
    let part = |characters: &[char]| clean(&characters.iter().collect::<String>());
    let (before, rest) = text.split_at(at.min(text.len()));
    let (under, after) = rest.split_at(rest.len().min(1));
    let under = if under.is_empty() { " ".to_owned() } else { part(under) };
    Line::from(vec![
        Span::styled("> ", BOLD),
        Span::raw(part(before)),
        Span::styled(under, Style::new().add_modifier(Modifier::REVERSED)),
        Span::raw(part(after)),
    ])
}

fn popup(frame: &mut Frame<'_>, title: &str, lines: Vec<Line<'_>>, hint: &str) {
    let area = frame.area();
    let width = area.width.saturating_sub(2).min(100);
    let inside = usize::from(width.saturating_sub(2)).max(1);
    // Long lines are wrapped.
    let height: usize = lines.iter().map(|line| line.width().max(1).div_ceil(inside)).sum();
    let height = u16::try_from(height + 2).unwrap_or(u16::MAX).min(area.height.saturating_sub(4));
    let (x, y) = ((area.width - width) / 2, area.height.saturating_sub(height) / 2);
    let place = Rect { x, y, width, height };
    Clear.render(place, frame.buffer_mut());
    let block = Block::bordered().title(format!(" {title} ")).title_bottom(format!(" {hint} "));
    let text = Paragraph::new(Text::from(lines)).wrap(Wrap { trim: false }).block(block);
    frame.render_widget(text, place);
}
