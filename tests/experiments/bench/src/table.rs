//! The rows for people.

use comfy_table::{Table, presets};

use crate::results::{Counts, Mode, OnLink, Response, Results, measured};

/// Prints a table for each kind of row that there is.
pub(crate) fn show(results: &Results) {
    response(&results.response);
    response(&results.echoes);
    throughput(results);
    if let Some(share) = &results.share {
        let [generate, process] = [share.generate, share.process].map(|part| part * 100.0);
        println!(
            "{} characters, round trip {} µs: {generate:.1} % to make the messages, {process:.1} % to read them\n",
            share.chars, share.round_trip_us
        );
    }
    scale(results);
    constraints(results);
    availability(results);
    link_response(results);
    link_availability(results);
    link_constraints(results);
    goals(results);
    let run = &results.run;
    let state = if run.is_complete { "complete" } else { "not complete" };
    println!("{} run, {state}, {} s, load {} to {}", run.extent, run.seconds, run.load_before, run.load_after);
    run.notes.iter().for_each(|note| println!("note: {note}"));
    for outside in &run.peers {
        println!(
            "{}: {} {}",
            outside.peer,
            outside.system,
            [std::slice::from_ref(&outside.state), &outside.notes].concat().join("; ")
        );
    }
}

fn print(header: &[&str], rows: impl Iterator<Item = Vec<String>>) {
    let mut table = Table::new();
    table.load_style(presets::ASCII_MARKDOWN).set_header(header.iter().copied());
    rows.for_each(|row| {
        table.add_row(row);
    });
    if !table.is_empty() {
        println!("{table}\n");
    }
}

/// A peer's name, and its mode where that is not plain.
fn of_mode(peer: &str, mode: Mode) -> String {
    match mode {
        Mode::Plain => peer.to_owned(),
        Mode::Secured => format!("{peer}, secured"),
    }
}

fn response(rows: &[Response]) {
    let header = [
        "pin",
        "distr.",
        "pause",
        "print",
        "chars",
        "peer",
        "n",
        "mean µs",
        "p50 µs",
        "quartiles µs",
        "p99 µs",
        "p99.9 µs",
        "max µs",
        "ratio",
        "quartiles",
        "p99 ratio",
        "to plain",
        "CPU µs",
        "CPU ratio",
    ];
    let rows = rows.iter().map(|row| {
        vec![
            row.pin.to_string(),
            row.distribution.to_string(),
            row.pause_ms.to_string(),
            row.print.to_string(),
            row.chars.to_string(),
            of_mode(&row.peer, row.mode),
            row.n.to_string(),
            format!("{:.1}", row.mean_us),
            format!("{:.1}", row.p50_us),
            format!("{:.1}-{:.1}", row.lower_quartile_us, row.upper_quartile_us),
            format!("{:.1}", row.p99_us),
            format!("{:.1}", row.p999_us),
            format!("{:.1}", row.max_us),
            format!("{:.3}", row.ratio),
            format!("{:.3}-{:.3}", row.ratio_lower_quartile, row.ratio_upper_quartile),
            format!("{:.3}", row.p99_ratio),
            row.plain_ratio.map_or_else(String::new, |ratio| format!("{ratio:.3}")),
            format!("{:.1}", row.cpu_us_per_call),
            format!("{:.2}", row.cpu_ratio),
        ]
    });
    print(&header, rows);
}

fn throughput(results: &Results) {
    let rows = results.throughput.iter().map(|row| {
        vec![
            format!("{:?}", row.kind),
            row.pin.to_string(),
            row.callers.to_string(),
            of_mode(&row.peer, row.mode),
            format!("{:.0}", row.requests_per_s),
            format!("{:.3}", row.ratio),
        ]
    });
    print(&["kind", "pin", "callers", "peer", "per second", "ratio"], rows);
}

fn scale(results: &Results) {
    let rows = results.scale.iter().map(|row| {
        vec![
            row.nodes.to_string(),
            row.mode.name().to_owned(),
            format!("{:.1}", row.request_us),
            format!("{:.3}", row.request_ratio),
            format!("{:.1}", row.each_us),
            format!("{:.3}", row.each_ratio),
            row.rss_per_node_bytes.to_string(),
            row.discovery_s.to_string(),
        ]
    });
    let header = ["nodes", "mode", "one: µs", "ratio", "each in turn: µs", "ratio", "bytes per node", "discovery s"];
    print(&header, rows);
}

fn constraints(results: &Results) {
    let rows = results.constraints.iter().map(|row| {
        let mut cells = vec![
            row.mode.name().to_owned(),
            row.minimum_interval_ms.to_string(),
            row.message_size.to_string(),
            row.chars.to_string(),
            row.period_ms.to_string(),
        ];
        cells.extend(counts(&row.counts));
        cells.push(row.executed_per_s.to_string());
        cells
    });
    let first = ["mode", "interval ms", "message size", "chars", "period ms"];
    print(&[&first[..], &COUNTS, &["per second"]].concat(), rows);
}

fn availability(results: &Results) {
    let rows = results.availability.iter().map(|row| {
        let mut cells = vec![
            row.distribution.to_string(),
            row.mode.name().to_owned(),
            format!("{:?}", row.delivery),
            row.chars.to_string(),
            row.period_ms.to_string(),
        ];
        cells.extend(counts(&row.counts));
        cells.push(row.executed_per_s.to_string());
        cells.push(row.ratio.map(|ratio| format!("{ratio:.3}")).unwrap_or_default());
        cells
    });
    let first = ["distr.", "mode", "delivery", "chars", "period ms"];
    print(&[&first[..], &COUNTS, &["per second", "to the floor's"]].concat(), rows);
}

/// Says why a list has no rows, where it has none.
fn skipped<T>(what: &str, rows: &[OnLink<T>]) {
    if let Some(reason) = rows.iter().find_map(|row| row.skipped.as_ref()) {
        println!("{what}: skipped: {reason}\n");
    }
}

fn link_response(results: &Results) {
    skipped("response on a link", &results.link_response);
    let rows = measured(&results.link_response).map(|(mbit, row)| {
        vec![
            mbit.to_string(),
            row.distribution.to_string(),
            row.chars.to_string(),
            of_mode(&row.peer, row.mode),
            row.n.to_string(),
            format!("{:.2}", row.mean_us / 1e3),
            format!("{:.2}", row.p50_us / 1e3),
            format!("{:.2}-{:.2}", row.lower_quartile_us / 1e3, row.upper_quartile_us / 1e3),
            format!("{:.2}", row.p99_us / 1e3),
            format!("{:.3}", row.ratio),
        ]
    });
    let header = ["Mbit/s", "distr.", "chars", "peer", "n", "mean ms", "p50 ms", "quartiles ms", "p99 ms", "ratio"];
    print(&header, rows);
}

fn link_availability(results: &Results) {
    let rows = measured(&results.link_availability).map(|(mbit, row)| {
        let mut cells = vec![
            mbit.to_string(),
            row.distribution.to_string(),
            of_mode(&row.peer, row.mode),
            format!("{:?}", row.delivery),
            row.chars.to_string(),
            row.period_ms.to_string(),
            format!("{:.2}", row.load),
        ];
        cells.extend(counts(&row.counts));
        cells.push(format!("{:.3}", row.in_time_of_offered));
        cells.push(format!("{:.2}-{:.2}", row.worst_group, row.best_group));
        cells
    });
    let first = ["Mbit/s", "distr.", "peer", "delivery", "chars", "period ms", "load"];
    print(&[&first[..], &COUNTS, &["in time/offered", "groups"]].concat(), rows);
}

fn link_constraints(results: &Results) {
    let rows = measured(&results.link_constraints).map(|(mbit, row)| {
        let mut cells = vec![
            mbit.to_string(),
            row.mode.name().to_owned(),
            format!("{:?}", row.delivery),
            row.minimum_interval_ms.to_string(),
            row.message_size.to_string(),
            row.chars.to_string(),
        ];
        cells.extend(counts(&row.counts));
        cells.push(format!("{:.3}", row.in_time_of_offered));
        cells.push(row.p50_us.map_or_else(|| "refused".to_owned(), |micros| format!("{:.2}", micros / 1e3)));
        cells
    });
    let first = ["Mbit/s", "mode", "delivery", "interval ms", "message size", "chars"];
    print(&[&first[..], &COUNTS, &["in time/offered", "call p50 ms"]].concat(), rows);
}

fn goals(results: &Results) {
    let rows = results.goals.iter().map(|goal| {
        let verdict = match goal.is_reached {
            Some(true) => "reached",
            Some(false) => "NOT reached",
            None => "not measured",
        };
        let figure = goal.figure.map(|figure| figure.to_string()).unwrap_or_default();
        vec![goal.quantity.clone(), goal.cell.clone(), goal.goal.clone(), figure, verdict.to_owned()]
    });
    print(&["goal", "where", "must be", "is", ""], rows);
}

const COUNTS: [&str; 6] = ["offered", "refused", "sent", "executed", "lost", "executed/offered"];

fn counts(counts: &Counts) -> [String; 6] {
    let Counts { offered, refused, sent, executed, lost, executed_of_offered, .. } = counts;
    let numbers = [offered, refused, sent, executed, lost].map(u64::to_string);
    let [offered, refused, sent, executed, lost] = numbers;
    [offered, refused, sent, executed, lost, format!("{executed_of_offered:.3}")]
}
