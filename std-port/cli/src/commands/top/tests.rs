//! Screens of the state, without a terminal and a manager.

use std::cell::Cell;
use std::time::{Duration, Instant};

use cara_std::control::protocol::{
    CipherInfo, ConstraintsInfo, DatagramsInfo, InhibitedInfo, LimitsInfo, LinkInfo, NodeInfo, OrderInfo, RefusedInfo,
    UnitInfo,
};
use cara_std::is_hidden;
use ratatui::Terminal;
use ratatui::backend::TestBackend;
use ratatui::buffer::Buffer;
use ratatui::crossterm::event::{KeyCode, KeyEvent, KeyModifiers};
use ratatui::style::{Color, Modifier};

use super::app::{Act, App, Ask, Counted, EVENTS, Mode, News, Probe, Snapshot, Value, View};
use super::draw::{Theme, draw};
use super::{Pace, SOONEST};

fn at(ms: u64) -> Duration {
    Duration::from_millis(ms)
}

fn node(name: &str, id: u32) -> NodeInfo {
    NodeInfo {
        name: name.into(),
        id,
        role: "s_unit".into(),
        connected: true,
        expected: true,
        address: Some("10.0.0.7:5000".into()),
        version: Some(1),
        epoch: None,
        connected_ms: Some(61_000),
        left_ms: None,
        left_reason: None,
        left_text: None,
        searched_ms: None,
        searched_from: None,
        limits: Some(LimitsInfo { message_size: 32_768, chunk_size: 4_096, calls: 8, minimum_interval_us: 0 }),
        link: Some(LinkInfo {
            silent_ms: 120,
            calls: 1,
            calls_here: 0,
            queued_bytes: 2_048,
            stream_ms: 120,
            datagrams: Some(DatagramsInfo::Pass),
            segment: None,
            cipher: Some(CipherInfo::AesGcm),
        }),
        clock: None,
        functions: 2,
    }
}

fn lost(name: &str, id: u32) -> NodeInfo {
    NodeInfo {
        connected: false,
        address: None,
        connected_ms: None,
        left_ms: Some(3_200),
        left_reason: Some("Silent".into()),
        left_text: Some("nothing was heard of it".into()),
        link: None,
        ..node(name, id)
    }
}

fn order(node: &str, id: u32, left_ms: Option<u64>, stopped_by: Option<u32>) -> OrderInfo {
    OrderInfo {
        node: node.into(),
        id,
        function: "go_to".into(),
        order: if left_ms.is_some() { "runs" } else { "stopped" }.into(),
        holder: Some(1),
        trace: None,
        claim: None,
        left_ms,
        inhibited: stopped_by.map(|by| InhibitedInfo { by, reason: 0 }),
        age_ms: None,
    }
}

fn unit() -> UnitInfo {
    let constraints = ConstraintsInfo {
        request_timeout_us: 2_000_000,
        minimum_interval_us: 0,
        maximum_nodes: 1_000,
        message_size: 32_768,
        chunk_size: 4_096,
        keep_alive_us: 1_000_000,
        calls_per_peer: 64,
        scheduling: Default::default(),
    };
    UnitInfo {
        name: "depot".into(),
        id: 1,
        role: "m_unit".into(),
        fleet: 7,
        mode: Some("secured".into()),
        keys: None,
        version: 1,
        release: None,
        discovery_port: 21_971,
        tcp_port: 21_971,
        epoch: "1".into(),
        uptime_ms: 180_000,
        interfaces: Vec::new(),
        constraints,
        connected: 2,
        leading: None,
    }
}

fn snapshot() -> Snapshot {
    let counters = |node: Option<&str>, counters: &[(&str, u64)]| Counted {
        node: node.map(str::to_owned),
        counters: counters.iter().map(|(name, count)| ((*name).to_owned(), *count)).collect(),
    };
    Snapshot {
        unit: unit(),
        nodes: vec![node("agv", 2), node("agv", 1), lost("lift", 3)],
        refused: vec![RefusedInfo {
            address: "10.0.0.9:4000".into(),
            node: Some("spy/9".into()),
            reason: "NoKey".into(),
            text: "there is no key".into(),
            ago_ms: 9_000,
        }],
        orders: vec![order("agv", 1, Some(1_500), None), order("agv", 2, None, Some(4))],
        counters: Some(vec![
            counters(None, &[("WhoHasSent", 4), ("RefusedKey", 2)]),
            counters(Some("agv/1"), &[("FramesReceived", 900), ("RequestsBusy", 3)]),
        ]),
    }
}

fn probe(node: &str) -> News {
    let value = |stream: &str, text: &str, age| Value { stream: stream.into(), text: text.into(), age };
    let values = vec![value("pose", "pose(x: 7)", Some(at(300))), value("battery", "battery: no value yet", None)];
    News::Probe(Probe { node: node.into(), round_trip: Some(412.0), values: Some(values) })
}

fn event(name: &str, node: &str, text: &str) -> News {
    News::Event { unix_ms: Some(1_795_816_458_345), name: name.into(), node: Some(node.into()), text: text.into() }
}

/// Everything at second 10.
fn app() -> App {
    let mut app = App::new("depot/1".into());
    app.reported(News::Snapshot(Box::new(snapshot())), at(10_000));
    app.reported(probe("agv/1@s_unit"), at(10_000));
    app.reported(event("joined", "agv/1", "is connected"), at(10_000));
    app.reported(event("left", "lift/3", "nothing was heard of it"), at(10_000));
    app
}

fn buffer(app: &App, now: Duration, size: (u16, u16), colours: bool) -> Buffer {
    let mut terminal = Terminal::new(TestBackend::new(size.0, size.1)).unwrap();
    terminal.draw(|frame| draw(frame, app, now, Theme { colours })).unwrap();
    terminal.backend().buffer().clone()
}

fn screen_of(app: &App, now: Duration, size: (u16, u16)) -> String {
    let buffer = buffer(app, now, size, true);
    let line = |y| (0..size.0).map(|x| buffer[(x, y)].symbol()).collect::<String>().trim_end().to_owned();
    (0..size.1).map(line).collect::<Vec<_>>().join("\n")
}

fn screen(app: &App, now: Duration) -> String {
    screen_of(app, now, (80, 24))
}

#[track_caller]
fn is_screen(app: &App, now: Duration, expected: &str) {
    let shown = screen(app, now);
    assert_eq!(shown.trim_end(), expected.trim_matches('\n').trim_end(), "\n{shown}");
}

fn key(app: &mut App, code: KeyCode) -> Option<Act> {
    app.key(KeyEvent::new(code, KeyModifiers::NONE), at(10_000))
}

fn letter(app: &mut App, letter: char) -> Option<Act> {
    key(app, KeyCode::Char(letter))
}

fn control(app: &mut App, letter: char) -> Option<Act> {
    app.key(KeyEvent::new(KeyCode::Char(letter), KeyModifiers::CONTROL), at(10_000))
}

fn asked(act: Option<Act>) -> Ask {
    let Some(Act::Ask(_, ask)) = act else { panic!("{act:?}") };
    ask
}

fn task(act: Option<Act>) -> u64 {
    let Some(Act::Ask(task, _)) = act else { panic!("{act:?}") };
    task
}

fn stop(node: Option<&str>) -> Ask {
    Ask::Stop { node: node.map(str::to_owned) }
}

#[test]
fn nodes_orders_and_events_stand_on_one_screen() {
    is_screen(
        &app(),
        at(10_200),
        "
cara top  depot/1  fleet 7  secured  up 3 min
2 of 3 s_units, 1 missing | 1 orders run, 1 inhibited | 1 refused
 1 Nodes   2 Orders   3 Streams   4 Counters   5 Events
  NODE         ROLE   STATE       TRIP     SEEN    CALLS QUEUE   ADDRESS
> agv/1        s_unit live        412 us   320 ms  1     2 KiB   10.0.0.7:5000
  agv/2        s_unit live        -        320 ms  1     2 KiB   10.0.0.7:5000
  lift/3       s_unit LOST 3.4 s  -        -       -     -       -
  spy/9               REFUSED              9.2 s                 10.0.0.9:4000





── Orders that run, and what is inhibited: 2 ───────────────────────────────────
  agv/1          go_to         runs         1       1.3 s   -
  agv/2          go_to         stopped      1       -       by unit 4

── Events, newest first: 2 ─────────────────────────────────────────────────────
  2026-11-27 21:54:18 left              lift/3           nothing was heard of it
  2026-11-27 21:54:18 joined            agv/1            is connected



S STOP ALL  s stop  c call  r reset  Enter watch  / filter  ? help  q quit
",
    );
}

#[test]
fn nothing_of_a_node_that_is_gone_looks_live() {
    let mut app = app();
    let mut later = snapshot();
    later.nodes.retain(|node| node.id != 1);
    later.nodes.push(NodeInfo { left_ms: Some(3_000), ..lost("agv", 1) });
    later.refused[0].ago_ms = 31_000;
    app.reported(News::Snapshot(Box::new(later.clone())), at(10_000));
    letter(&mut app, '2');
    let shown = screen(&app, at(10_100));
    assert!(shown.contains("agv/1          go_to         was runs     1       ?"), "{shown}");
    letter(&mut app, '3');
    assert!(screen(&app, at(10_100)).contains("pose(x: 7)"));
    later.nodes.last_mut().unwrap().left_ms = Some(61_000);
    app.reported(News::Snapshot(Box::new(later)), at(10_000));
    assert!(!screen(&app, at(10_100)).contains("pose(x: 7)"), "it has been gone for a minute");
}

#[test]
fn each_other_view_is_a_table_of_its_own() {
    let mut app = app();
    for (digit, expected) in [
        (
            '2',
            "
  NODE           FUNCTION      ORDER        OF UNIT LEFT    INHIBITED
> agv/1          go_to         runs         1       1.3 s   -
  agv/2          go_to         stopped      1       -       by unit 4
",
        ),
        (
            '3',
            "
  NODE             VALUE                                                AGE
> agv/1            pose(x: 7)                                           500 ms
  agv/1            battery: no value yet                                -
",
        ),
        (
            '4',
            "
  OF                               COUNTER                COUNT        GROWN
> the manager                      RefusedKey             2
  agv/1                            RequestsBusy           3
  the manager                      WhoHasSent             4
  agv/1                            FramesReceived         900
",
        ),
        (
            '5',
            "
  AT (UTC)            EVENT             NODE             TEXT
  2026-11-27 21:54:18 left              lift/3           nothing was heard of it
  2026-11-27 21:54:18 joined            agv/1            is connected
",
        ),
    ] {
        letter(&mut app, digit);
        let shown = screen(&app, at(10_200));
        let body: Vec<_> = shown.lines().skip(3).take(6).map(str::trim_end).collect();
        assert_eq!(body.join("\n").trim_end(), expected.trim_matches('\n'), "\n{shown}");
    }
}

#[test]
fn a_watched_node_shows_all_that_is_known_of_it() {
    let mut app = app();
    assert_eq!(asked(key(&mut app, KeyCode::Enter)), Ask::Functions { node: "agv/1@s_unit".into() });
    let signatures = vec!["go_to(position: int[2])".to_owned()];
    app.reported(News::Functions { node: "agv/1@s_unit".into(), signatures }, at(10_000));
    is_screen(
        &app,
        at(10_200),
        "
cara top  depot/1  fleet 7  secured  up 3 min
2 of 3 s_units, 1 missing | 1 orders run, 1 inhibited | 1 refused
 1 Nodes   2 Orders   3 Streams   4 Counters   5 Events  watching agv/1
  WHAT
> state                  live
  role                   s_unit
  address                10.0.0.7:5000
  round trip             412 us
  connected for          61 s
  last sign of it        320 ms ago
  calls                  1 to it are open, 0 of it here
  queue                  2 KiB not sent yet
  cipher                 AES-256-GCM
  it takes               32 KiB a message, 8 calls
  order go_to            runs, of unit 1, left 1.3 s, inhibited -
  stream                 pose(x: 7)  500 ms old
  stream                 battery: no value yet  - old
  function               go_to(position: int[2])
  RequestsBusy           3
  2026-11-27 21:54:18    joined: is connected



S STOP ALL  s stop  c call  r reset  Enter watch  / filter  ? help  q quit
",
    );
    // It is what keys are about, wherever the cursor stands.
    key(&mut app, KeyCode::End);
    assert_eq!(asked(letter(&mut app, 's')), stop(Some("agv/1@s_unit")));
    key(&mut app, KeyCode::Esc);
    assert_eq!(app.view, View::Nodes);
    // Of one that the manager has forgotten nothing is shown as known.
    key(&mut app, KeyCode::Enter);
    app.reported(News::Snapshot(Box::new(Snapshot { nodes: vec![node("agv", 2)], ..snapshot() })), at(10_300));
    assert!(screen(&app, at(10_400)).contains("the manager knows it no longer"));
}

#[test]
fn times_go_on_between_two_looks() {
    let app = app();
    let line =
        |now| screen(&app, now).lines().skip(13).find(|line| line.contains("go_to")).unwrap_or_default().to_owned();
    assert!(line(at(10_000)).contains("1.5 s"), "{}", screen(&app, at(10_000)));
    assert!(line(at(11_000)).contains("500 ms"), "{}", line(at(11_000)));
    assert!(line(at(11_900)).contains(" 0 ms"), "{}", line(at(11_900)));
    assert!(screen(&app, at(11_000)).contains("1.1 s"), "seen 120 ms before it was told");
}

#[test]
fn old_data_never_looks_live() {
    let mut app = app();
    let live = screen(&app, at(11_900));
    assert!(live.contains(" live ") && !live.contains("OLD"), "{live}");
    // Nothing came for more than two seconds.
    let silent = screen(&app, at(12_100));
    assert!(silent.contains("THE MANAGER DOES NOT ANSWER | all below is 2.1 s OLD"), "{silent}");
    assert!(silent.contains("was live") && !silent.contains("unit live ") && silent.contains(" ? "), "{silent}");
    // It says at once why, where that is known, and goes on counting.
    app.reported(News::Gone("the unit has ended, or closed the connection".into()), at(10_100));
    app.reported(News::Gone("no unit answers".into()), at(15_000));
    let gone = screen(&app, at(15_100));
    assert!(gone.contains("MANAGER GONE 5.0 s | all below is 5.1 s OLD | trying again | no unit answers"), "{gone}");
    assert!(gone.contains("was live") && gone.contains("manager_gone"), "{gone}");
    let old = buffer(&app, at(15_100), (80, 24), true);
    let cell = (0..80).map(|x| &old[(x, 6)]).find(|cell| cell.symbol() == "w").unwrap();
    assert!(cell.modifier.contains(Modifier::DIM) && cell.fg == Color::Reset, "{cell:?}");
    app.reported(News::Snapshot(Box::new(snapshot())), at(16_000));
    let back = screen(&app, at(16_100));
    assert!(!back.contains("OLD") && back.contains(" live ") && back.contains("manager_back"), "{back}");
    let restarted = UnitInfo { epoch: "2".into(), ..unit() };
    app.reported(News::Snapshot(Box::new(Snapshot { unit: restarted, ..snapshot() })), at(17_000));
    assert!(screen(&app, at(17_000)).contains("manager_restarted"));
}

/// Each text of a peer or of the manager, on each view and in each window.
#[test]
fn a_manager_with_an_authority_is_shown_leading_or_not() {
    let head = |leading| {
        let mut app = App::new("depot/1".into());
        app.reported(News::Snapshot(Box::new(Snapshot { unit: UnitInfo { leading, ..unit() }, ..snapshot() })), at(0));
        screen(&app, at(0)).lines().next().unwrap().to_owned()
    };
    let first = "cara top  depot/1  fleet 7  secured  up 3 min";
    let shown = [None, Some(true), Some(false)].map(head);
    assert_eq!(shown, [first.to_owned(), format!("{first}  leads"), format!("{first}  DOES NOT LEAD")]);
}

#[test]
fn what_peers_say_does_not_act_on_the_terminal() {
    let evil = "a\u{1b}[31m\u{202e}b\u{7}\u{9b}\r\nc\u{200b}";
    let named = NodeInfo { name: evil.into(), role: evil.into(), address: Some(evil.into()), ..node("", 1) };
    let selector = format!("{evil}/1@{evil}");
    let mut app = App::new(evil.into());
    let left = NodeInfo { name: evil.into(), left_text: Some(evil.into()), ..lost("", 2) };
    let refused = RefusedInfo { address: evil.into(), node: Some(evil.into()), ..snapshot().refused[0].clone() };
    let counters = Some(vec![Counted { node: Some(evil.into()), counters: vec![(evil.into(), 3)] }]);
    let orders = vec![OrderInfo { function: evil.into(), order: evil.into(), ..order(evil, 1, Some(9), None) }];
    let unit = UnitInfo { mode: Some(evil.into()), ..unit() };
    let reported = Snapshot { unit, nodes: vec![named, left], refused: vec![refused], orders, counters };
    app.reported(News::Snapshot(Box::new(reported)), at(10_000));
    let value = Value { stream: evil.into(), text: evil.into(), age: Some(at(1)) };
    app.reported(
        News::Probe(Probe { node: selector.clone(), round_trip: None, values: Some(vec![value]) }),
        at(10_000),
    );
    app.reported(event(evil, evil, evil), at(10_000));
    app.reported(News::Functions { node: selector.clone(), signatures: vec![evil.into()] }, at(10_000));
    let clean = |app: &App, what: &str| {
        for size in [(80, 24), (140, 50)] {
            let shown = screen_of(app, at(10_100), size);
            assert!(!shown.replace('\n', "").chars().any(is_hidden), "{what}: {shown:?}");
        }
        screen_of(app, at(10_100), (140, 50))
    };
    for digit in ['1', '2', '3', '4', '5'] {
        letter(&mut app, digit);
        assert!(clean(&app, "a view").contains("\\u{1b}"), "{digit}");
    }
    letter(&mut app, '1');
    key(&mut app, KeyCode::Home);
    assert_eq!(asked(key(&mut app, KeyCode::Enter)), Ask::Functions { node: selector.clone() }, "as it is called");
    assert!(clean(&app, "watched").contains("\\u{1b}"));
    letter(&mut app, 'c');
    clean(&app, "a call");
    app.paste(evil);
    assert_eq!(app.call.text, "a[31mbc");
    let number = task(key(&mut app, KeyCode::Enter));
    app.reported(News::End { task: number, is_bad: true, text: evil.into() }, at(10_000));
    assert!(clean(&app, "a mistake").contains("\\u{1b}"));
    key(&mut app, KeyCode::Esc);
    let number = task(letter(&mut app, 's'));
    app.reported(News::Line { task: number, is_bad: true, text: evil.into() }, at(10_000));
    app.reported(News::End { task: number, is_bad: true, text: evil.into() }, at(10_000));
    assert!(matches!(app.mode, Mode::Report { .. }) && clean(&app, "a report").contains("\\u{1b}"));
    app.reported(News::Gone(evil.into()), at(10_000));
    key(&mut app, KeyCode::Esc);
    letter(&mut app, 'r');
    clean(&app, "a question");
}

#[test]
fn every_size_is_drawn() {
    let mut app = app();
    let enter: [&[char]; 5] = [&[], &['c'], &['r'], &['?'], &['/']];
    for keys in enter {
        for digit in ['1', '2', '3', '4', '5'] {
            key(&mut app, KeyCode::Esc);
            letter(&mut app, digit);
            for code in keys {
                letter(&mut app, *code);
            }
            for size in (1..30).flat_map(|height| [1, 2, 3, 9, 40, 79, 80, 200].map(|width| (width, height))) {
                screen_of(&app, at(99_000), size);
            }
        }
    }
}

#[test]
fn without_colours_there_are_none() {
    let mut app = app();
    app.reported(News::Gone("gone".into()), at(10_100));
    let coloured = |colours| {
        let buffer = buffer(&app, at(10_200), (80, 24), colours);
        buffer.content.iter().filter(|cell| cell.fg != Color::Reset || cell.bg != Color::Reset).count()
    };
    assert!(coloured(true) > 0);
    assert_eq!(coloured(false), 0);
}

fn many(count: u32) -> News {
    let nodes = (1..=count).map(|id| node(&format!("agv-{id:03}"), id)).collect();
    News::Snapshot(Box::new(Snapshot { nodes, refused: Vec::new(), ..snapshot() }))
}

#[test]
fn two_hundred_nodes_are_scrolled_and_the_chosen_one_stays_chosen() {
    let mut app = App::new("depot/1".into());
    app.reported(many(200), at(10_000));
    assert!(screen(&app, at(10_000)).contains("agv-001/1 ") && !screen(&app, at(10_000)).contains("agv-100"));
    key(&mut app, KeyCode::End);
    let end = screen(&app, at(10_000));
    assert!(end.contains("> agv-200/200 ") && end.contains(" of 200"), "{end}");
    key(&mut app, KeyCode::Up);
    assert_eq!(app.target(at(10_000)).as_deref(), Some("agv-199/199@s_unit"));
    // Rows change their places around it.
    letter(&mut app, 'o');
    letter(&mut app, 'O');
    assert_eq!(app.target(at(10_000)).as_deref(), Some("agv-199/199@s_unit"));
    let shown = screen(&app, at(10_000));
    let of = |name: &str| shown.find(name).unwrap_or_else(|| panic!("{name}: {shown}"));
    assert!(of("agv-200") < of("> agv-199") && of("> agv-199") < of("agv-198"));
}

/// What a key acts on is what the user saw: another row in the same place is not it.
#[test]
fn a_chosen_node_that_goes_is_replaced_by_none() {
    let mut app = App::new("depot/1".into());
    app.reported(many(3), at(10_000));
    key(&mut app, KeyCode::End);
    app.reported(many(2), at(10_100));
    assert_eq!(letter(&mut app, 's'), None);
    assert!(screen(&app, at(10_200)).contains("no node is chosen"), "{}", screen(&app, at(10_200)));
    assert_eq!(asked(letter(&mut app, 'S')), stop(None), "all of them need none");
}

#[test]
fn a_node_that_was_refused_before_it_joined_is_chosen() {
    let mut app = App::new("depot/1".into());
    app.reported(News::Snapshot(Box::new(Snapshot { nodes: Vec::new(), ..snapshot() })), at(10_000));
    assert_eq!(app.target(at(10_000)), None);
    app.reported(many(1), at(10_500));
    assert_eq!(app.target(at(10_500)).as_deref(), Some("agv-001/1@s_unit"));
}

#[test]
fn a_stop_asks_nothing_and_a_reset_does() {
    let mut app = app();
    assert_eq!(asked(letter(&mut app, 's')), stop(Some("agv/1@s_unit")));
    assert_eq!(asked(letter(&mut app, 'S')), stop(None));
    assert_eq!(letter(&mut app, 'r'), None);
    assert!(screen(&app, at(10_000)).contains("reset agv/1? What was stopped may move again."));
    assert_eq!(letter(&mut app, 'n'), None);
    assert_eq!(letter(&mut app, 'y'), None, "the question has gone");
    letter(&mut app, 'R');
    assert_eq!(asked(letter(&mut app, 'y')), Ask::Reset { node: None });
}

#[test]
fn all_are_stopped_from_wherever_one_is() {
    let mut app = app();
    for before in ['c', '/', 'r', '?', 'l'] {
        letter(&mut app, before);
        let number = task(control(&mut app, 's'));
        app.reported(News::End { task: number, is_bad: false, text: "3 of 3 acknowledged".into() }, at(10_000));
        key(&mut app, KeyCode::Esc);
    }
    for before in ['r', '?'] {
        letter(&mut app, before);
        assert_eq!(asked(letter(&mut app, 'S')), stop(None));
    }
}

#[test]
fn a_stop_that_fails_or_hangs_is_loud() {
    let mut app = app();
    letter(&mut app, 'c');
    let number = task(control(&mut app, 's'));
    assert!(screen(&app, at(10_500)).contains("stop ALL: waiting for 500 ms, 0 answered"));
    app.reported(News::Line { task: number, is_bad: false, text: "agv/1  acknowledged after 1 ms".into() }, at(10_600));
    let late = screen(&app, at(11_500));
    assert!(late.contains("stop ALL: NOT ACKNOWLEDGED YET, waiting for 1.5 s, 1 answered"), "{late}");
    app.reported(
        News::Line { task: number, is_bad: true, text: "lift/3: not reached: it was away".into() },
        at(11_600),
    );
    app.reported(News::End { task: number, is_bad: true, text: "1 of 2 acknowledged".into() }, at(11_600));
    // Over what was typed, with what has failed first.
    let reported = screen(&app, at(11_700));
    let of = |text: &str| reported.find(text).unwrap_or_else(|| panic!("{text}: {reported}"));
    assert!(of("1 of 2 acknowledged") < of("lift/3: not reached") && of("lift/3: not reached") < of("agv/1  ack"));
    // Hammering on the key does not fill the manager's connections.
    key(&mut app, KeyCode::Esc);
    let sent = (0..20).filter(|_| letter(&mut app, 'S').is_some()).count();
    assert_eq!(sent, 4);
    assert!(app.tasks.len() <= 32);
}

#[test]
fn a_call_is_typed_and_a_mistake_keeps_the_prompt() {
    let mut app = app();
    assert_eq!(asked(letter(&mut app, 'c')), Ask::Functions { node: "agv/1@s_unit".into() });
    let signatures = vec!["go_to(position: int[2])".to_owned(), "halt()".to_owned()];
    app.reported(News::Functions { node: "agv/1@s_unit".into(), signatures }, at(10_000));
    assert!(screen(&app, at(10_000)).contains("halt()"));
    "gx".chars().for_each(|character| _ = letter(&mut app, character));
    key(&mut app, KeyCode::Backspace);
    key(&mut app, KeyCode::Tab);
    app.paste("position: [1]\n)");
    assert_eq!(app.call.text, "go_to(position: [1])");
    let act = key(&mut app, KeyCode::Enter);
    let text = "go_to(position: [1])".to_owned();
    let Some(Act::Ask(number, ask)) = act else { panic!("{act:?}") };
    assert_eq!(ask, Ask::Call { node: "agv/1@s_unit".into(), text });
    assert_eq!(key(&mut app, KeyCode::Enter), None, "it is not called twice");
    let mistake = "error: `position` has 2 elements, and this has 1\n  go_to(position: [1])\n                  ^^^";
    app.reported(News::End { task: number, is_bad: true, text: mistake.into() }, at(10_000));
    let shown = screen(&app, at(10_000));
    let line = |text: &str| {
        let place = |line: &str| line.find(text).map(|at| line[..at].chars().count());
        shown.lines().find_map(place).unwrap_or_else(|| panic!("{text}: {shown}"))
    };
    assert!(shown.contains("> go_to(position: [1])") && line("^^^") == line("  go_to(") + 18, "{shown}");
    // Mended, it is called, and the prompt goes.
    key(&mut app, KeyCode::Left);
    key(&mut app, KeyCode::Left);
    app.paste(", 2");
    let number = task(key(&mut app, KeyCode::Enter));
    app.reported(News::End { task: number, is_bad: false, text: "go_to()  1 ms".into() }, at(10_000));
    assert!(
        matches!(app.mode, Mode::Rows)
            && screen(&app, at(10_000)).contains("call agv/1 go_to(position: [1, 2]): go_to()")
    );
    // It can be had again.
    letter(&mut app, 'c');
    control(&mut app, 'u');
    key(&mut app, KeyCode::Up);
    assert_eq!(app.call.text, "go_to(position: [1, 2])");
}

#[test]
fn pasted_text_is_no_keys() {
    let mut app = app();
    app.paste("Sq\nry");
    assert!(app.tasks.is_empty() && matches!(app.mode, Mode::Rows));
}

#[test]
fn rows_are_filtered_and_sorted() {
    let mut app = app();
    letter(&mut app, '/');
    "LIFT".chars().for_each(|character| _ = letter(&mut app, character));
    key(&mut app, KeyCode::Enter);
    let shown = screen(&app, at(10_000));
    assert!(shown.contains("> lift/3") && shown.contains("/LIFT"), "{shown}");
    assert_eq!(app.table(at(10_000)).rows.len(), 1);
    assert_eq!(app.target(at(10_000)).as_deref(), Some("lift/3@s_unit"), "what is hidden is not chosen");
    key(&mut app, KeyCode::Esc);
    // By STATE, the third column: what is refused and lost first.
    (0..3).for_each(|_| _ = letter(&mut app, 'o'));
    let states: Vec<_> = app.table(at(10_000)).rows.iter().map(|row| row.cells[2].text.clone()).collect();
    assert_eq!(states, ["REFUSED", "LOST 3.2 s", "live", "live"]);
}

#[test]
fn memory_is_bounded() {
    let mut app = app();
    for number in 0..3 * EVENTS {
        app.reported(event("joined", "agv/1", &number.to_string()), at(10_000));
        letter(&mut app, 's');
    }
    assert_eq!(app.events.len(), EVENTS);
    assert!(app.tasks.len() <= 32);
    let newest = app.events.front().map(|event| event.text.clone());
    assert_eq!(newest, Some((3 * EVENTS - 1).to_string()));
    let number = task(letter(&mut app, 'S').or_else(|| letter(&mut app, 'R').or_else(|| letter(&mut app, 'y'))));
    (0..5_000).for_each(|_| app.reported(News::Line { task: number, is_bad: false, text: "x".into() }, at(10_000)));
    assert_eq!(app.task(number).map(|task| task.lines.len()), Some(2_000));
    // What is known of a node goes with it.
    app.reported(many(1), at(10_500));
    assert!(app.round_trips.is_empty() && app.values.is_empty());
}

/// A screen of hundreds of nodes takes a while, and as many events come when they join: what is typed waits behind those.
#[test]
fn screens_that_take_long_hold_no_messages_up() {
    let start = Instant::now();
    let (now, screens) = (Cell::new(start), Cell::new(0));
    let mut pace = Pace { drawn: start, due: start };
    for _ in 0..1_000 {
        let draw = || {
            screens.set(screens.get() + 1);
            now.set(now.get() + 3 * SOONEST);
            Ok(())
        };
        pace.draw(|| now.get(), draw).unwrap();
        now.set(now.get() + Duration::from_micros(100));
        pace.heard();
    }
    assert_eq!(screens.get(), 3, "each 40 ms in 100 ms of messages");
}
