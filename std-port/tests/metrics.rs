//! The text form of the counters, line by line.

#![cfg(feature = "metrics")]

mod keyed;

use std::collections::HashMap;
use std::hash::{BuildHasher, Hasher, RandomState};
use std::slice;
use std::time::{Duration, Instant};

use cara_std::{
    CommunicationSystem, Error, Identity, Interfaces, Parameters, ParametersView, Served, ServiceError, ServiceOptions,
    Unit,
};

use keyed::keyed;

/// A number by name and labels.
type Samples = HashMap<(String, Vec<(String, String)>), f64>;

/// The text as it is specified: each family has its kind and a help text before its samples, and an end.
fn parse(text: &str) -> Samples {
    let mut samples = Samples::new();
    let (mut kinds, mut helps) = (HashMap::new(), HashMap::new());
    let mut lines = text.lines();
    assert_eq!(lines.next_back(), Some("# EOF"));
    for line in lines {
        if let Some(rest) = line.strip_prefix("# HELP ") {
            let (family, help) = rest.split_once(' ').unwrap();
            assert!(help.ends_with('.') && help.len() > 10, "{line}");
            assert_eq!(helps.insert(family.to_owned(), help.to_owned()), None, "{line}");
        } else if let Some(rest) = line.strip_prefix("# TYPE ") {
            let (family, kind) = rest.split_once(' ').unwrap();
            assert_eq!(kinds.insert(family.to_owned(), kind.to_owned()), None, "{line}");
        } else {
            let (name, labels, value) = sample(line);
            let family = name.strip_suffix("_total").unwrap_or(&name);
            let expected = if family == name { "gauge" } else { "counter" };
            assert_eq!(kinds.get(family).map(String::as_str), Some(expected), "{line}");
            assert!(helps.contains_key(family) && family.starts_with("cara_"), "{line}");
            assert_eq!(samples.insert((name, labels), value), None, "twice: {line}");
        }
    }
    samples
}

/// `name{label="value",…} number`.
fn sample(line: &str) -> (String, Vec<(String, String)>, f64) {
    let (name, rest) = line.split_once('{').unwrap_or_else(|| panic!("{line}"));
    assert!(name.chars().all(|c| c.is_ascii_lowercase() || c.is_ascii_digit() || c == '_'), "{line}");
    let mut labels = Vec::new();
    let mut rest = rest;
    loop {
        let (label, after) = rest.split_once("=\"").unwrap_or_else(|| panic!("{line}"));
        let (value, length) = unescape(after);
        labels.push((label.to_owned(), value));
        rest = &after[length..];
        match rest.strip_prefix(',') {
            Some(more) => rest = more,
            None => break,
        }
    }
    let value = rest.strip_prefix("} ").unwrap_or_else(|| panic!("{line}"));
    (name.to_owned(), labels, value.parse().unwrap_or_else(|_| panic!("{line}")))
}

/// The value up to its closing quote, and the bytes up to behind it.
fn unescape(text: &str) -> (String, usize) {
    let mut value = String::new();
    let mut characters = text.char_indices();
    while let Some((at, character)) = characters.next() {
        match character {
            '"' => return (value, at + 1),
            '\\' => value.push(match characters.next().unwrap().1 {
                'n' => '\n',
                other => other,
            }),
            other => value.push(other),
        }
    }
    panic!("no end: {text}")
}

/// `RequestsSent` as `requests_sent`.
fn snake(name: &str) -> String {
    let mut snake = String::new();
    for (index, character) in name.chars().enumerate() {
        if character.is_ascii_uppercase() && index > 0 {
            snake.push('_');
        }
        snake.push(character.to_ascii_lowercase());
    }
    snake
}

/// The one number of a counter, in whichever of the groups it is.
fn find(samples: &Samples, groups: &[&str], name: &str, labels: &[(&str, &str)]) -> f64 {
    let labels: Vec<_> = labels.iter().map(|(label, value)| (label.to_string(), value.to_string())).collect();
    let found: Vec<f64> = groups
        .iter()
        .flat_map(|group| [format!("cara_{group}_{}_total", snake(name)), format!("cara_{group}_{}", snake(name))])
        .filter_map(|full| samples.get(&(full, labels.clone())).copied())
        .collect();
    assert_eq!(found.len(), 1, "{name} {labels:?}");
    found[0]
}

/// Signs of life go on between two looks: a number lies between the one before and the one after.
fn between(before: &[(&'static str, u64)], after: &[(&'static str, u64)], number: impl Fn(&str) -> f64) {
    assert_eq!(before.len(), after.len());
    for ((name, low), (_, high)) in before.iter().zip(after) {
        let number = number(name);
        let (low, high) = ((*low).min(*high), (*low).max(*high));
        assert!((low as f64..=high as f64).contains(&number), "{name}: {number} is not in {low} to {high}");
    }
}

fn until(what: &str, condition: impl Fn() -> bool) {
    let end = Instant::now() + Duration::from_secs(30);
    while !condition() {
        assert!(Instant::now() < end, "not in time: {what}");
        std::thread::sleep(Duration::from_millis(1));
    }
}

#[test]
fn every_counter_of_the_api_is_in_the_text_with_its_value() {
    let fleet = RandomState::new().build_hasher().finish() as u32;
    let name = r#"the "manager" \ 1"#;
    let own = Identity::m_unit(name, 1).unwrap();
    let others = [1, 2, 3].map(|id| Identity::s_unit("agv", id).unwrap());
    let manager = CommunicationSystem::builder(name, 1).unwrap().interfaces(Interfaces::Loopback);
    let manager = keyed(manager, fleet, &own, &others).constraints(keyed::M_UNIT).build().unwrap();
    manager.start().unwrap();
    let agvs: Vec<_> = others
        .iter()
        .map(|other| {
            let agv = Unit::builder("agv", other.id(), name, 1).unwrap().interfaces(Interfaces::Loopback);
            let agv = keyed(agv, fleet, other, slice::from_ref(&own)).build().unwrap();
            let fail = |_: &Served, _: &mut ParametersView| Err(ServiceError::NotReady);
            agv.my_function_list().add_function("fail", &Parameters::new(), fail).unwrap();
            agv.publish_my_function_list().unwrap();
            agv.start().unwrap();
            agv
        })
        .collect();
    until("all have come", || manager.nodes_offering("fail").len() == 3);
    for (index, peer) in manager.s_units().iter().enumerate() {
        for _ in 0..=index {
            let failed = peer.block_request("fail", &mut Parameters::new());
            assert_eq!(failed, Err(Error::Service(ServiceError::NotReady)));
        }
    }
    agvs[0].stop();
    until("one has left", || manager.number_of_s_units() == 2);

    let unit = format!("{name}/1");
    let look = || -> Vec<_> { manager.s_units().iter().map(|peer| peer.counters()).collect() };
    let (before, peers_before) = (manager.counters(), look());
    let samples = parse(&manager.metrics());
    let (after, peers_after) = (manager.counters(), look());
    let mut compared = before.len();
    between(&before, &after, |name| find(&samples, &["node", "links", "unit"], name, &[("unit", &unit)]));
    for ((peer, before), after) in manager.s_units().iter().zip(&peers_before).zip(&peers_after) {
        let node = peer.identity().to_string();
        let labels = [("unit", unit.as_str()), ("peer", &node), ("role", "s_unit")];
        between(before, after, |name| find(&samples, &["link"], name, &labels));
        let sent = find(&samples, &["link"], "RequestsSent", &labels);
        let connected = find(&samples, &["link"], "Connected", &labels);
        assert_eq!(connected, if peer.is_connected() { 1.0 } else { 0.0 });
        assert!(sent >= 1.0, "those of one that has left are kept");
        compared += before.len() + 1;
    }
    assert_eq!(find(&samples, &["links"], "RequestsSent", &[("unit", &unit)]), 6.0);
    assert_eq!(find(&samples, &["unit"], "NodesConnected", &[("unit", &unit)]), 2.0);
    assert!(find(&samples, &["unit"], "UptimeSeconds", &[("unit", &unit)]) > 0.0);
    assert_eq!(samples.len(), compared + 1, "nothing else is in the text");

    let agv = parse(&agvs[1].metrics());
    assert!(agv.keys().any(|(name, labels)| name == "cara_link_requests_received_total" && labels[1].1 == unit));
}

#[test]
fn the_clock_of_a_node_is_in_the_text_if_the_node_tells_it() {
    let fleet = RandomState::new().build_hasher().finish() as u32;
    let own = Identity::m_unit("manager", 1).unwrap();
    let others = [1, 2].map(|id| Identity::s_unit("agv", id).unwrap());
    let manager = CommunicationSystem::builder("manager", 1).unwrap().interfaces(Interfaces::Loopback);
    let manager = keyed(manager, fleet, &own, &others).constraints(keyed::M_UNIT).build().unwrap();
    manager.start().unwrap();
    assert!(!manager.metrics().contains("cara_clock"));
    let _agvs = others.each_ref().map(|other| {
        let agv = Unit::builder("agv", other.id(), "manager", 1).unwrap().interfaces(Interfaces::Loopback);
        let agv = keyed(agv, fleet, other, slice::from_ref(&own)).build().unwrap();
        let tell = |_: &Served, view: &mut ParametersView| -> Result<(), ServiceError> {
            let now = std::time::SystemTime::now().duration_since(std::time::UNIX_EPOCH).unwrap();
            Ok(view.set_value("unix_us", now.as_micros() as i64 - 3_000_000)?)
        };
        if other.id() == 1 {
            let clock = "clock() -> (unix_us: int)".parse().unwrap();
            agv.my_function_list().add_service(&clock, ServiceOptions::new(), tell).unwrap();
        }
        agv.publish_my_function_list().unwrap();
        agv.start().unwrap();
        agv
    });
    until("both have come", || manager.number_of_s_units() == 2);
    until("one is measured", || manager.s_units().iter().any(|peer| peer.clock_offset().is_some()));
    let samples = parse(&manager.metrics());
    let clocks: HashMap<&str, f64> = samples
        .iter()
        .filter(|((name, _), _)| name.starts_with("cara_clock"))
        .map(|((name, labels), value)| {
            let labels: Vec<_> = labels.iter().map(|(label, value)| (label.as_str(), value.as_str())).collect();
            assert_eq!(labels, [("unit", "manager/1"), ("peer", "agv/1"), ("role", "s_unit")]);
            (name.as_str(), *value)
        })
        .collect();
    let (offset, error) = (clocks["cara_clock_offset_seconds"], clocks["cara_clock_error_seconds"]);
    assert_eq!(clocks.len(), 2);
    assert!((offset + 3.0).abs() <= error + 1e-5 && (0.0..1.0).contains(&error), "{offset} {error}");
}
