//! What came of a run: the figures, and whether all that had to happen did.

use std::time::Duration;

use super::truth::Truth;

/// What the run has counted beside the vehicles' logs.
#[derive(Debug, Default)]
pub(super) struct Tally {
    pub(super) orders: usize,
    /// Round trips of calls, of all managers, with the function.
    pub(super) calls: Vec<(String, Duration)>,
    pub(super) failed_calls: usize,
    pub(super) freezes: usize,
    pub(super) kills: usize,
    pub(super) take_overs: usize,
    /// How often links were cut.
    pub(super) cuts: usize,
    /// With a standby: after each kill, until a vehicle drove again.
    pub(super) standby: Vec<Duration>,
    /// Vehicles that were mended by the mechanic.
    pub(super) mended: usize,
    /// Of each stop-all: how many acknowledged it, of how many, and when the last one had.
    pub(super) stopped_all: Vec<(usize, usize, Duration)>,
    pub(super) messages: u64,
    pub(super) datagrams: u64,
    /// Of all processes.
    pub(super) cpu: Duration,
    /// The most at one time, of all processes.
    pub(super) resident_kib: u64,
    pub(super) took: Duration,
    /// What went wrong beside what the vehicles' logs say.
    pub(super) wrong: Vec<String>,
}

/// What has to happen in a run.
const STOPS: usize = 20;
const RESTARTS: usize = 5;

/// Prints all; whether the run was as it has to be.
pub(super) fn print(
    tally: &Tally,
    truth: &Truth<'_>,
    board: Option<&str>,
    with_faults: bool,
    with_standby: bool,
) -> bool {
    figures(tally, truth);
    let mut passed = true;
    let mut require = |what: &str, is_so: bool| {
        println!("{} {what}", if is_so { "ok    " } else { "FAILED" });
        passed &= is_so;
    };
    let once = (1..=tally.orders).all(|order| truth.delivered.get(&order) == Some(&1));
    require(&format!("all {} orders done, each parcel put down once where it was to lie", tally.orders), once);
    require("no two vehicles were ever in one cell, and none left the floor or jumped", truth.wrong.is_empty());
    let late = truth.stops.iter().filter(|stop| !stop.is_in_time()).count();
    require(&format!("each stop inside its bound: {late} of {} were not", truth.stops.len()), late == 0);
    if let Some(board) = board {
        let stops = truth.stops.iter().filter(|stop| stop.vehicle == board).count();
        let moves = truth.moves.get(board).copied().unwrap_or(0);
        require(&format!("the board, {board}, is at work: {moves} moves, {stops} stops"), moves > 0);
    }
    if with_faults {
        require(
            &format!("at least {STOPS} stops of moving vehicles: {}", truth.stops.len()),
            truth.stops.len() >= STOPS,
        );
        require(&format!("at least {RESTARTS} restarts of vehicles: {}", truth.restarts), truth.restarts >= RESTARTS);
        require(&format!("the manager hung for a while: {}", tally.freezes), tally.freezes > 0);
        require(&format!("the manager was killed and came back: {}", tally.kills), tally.kills > 0);
        if with_standby {
            let (took, kills) = (&tally.standby, tally.kills);
            require(
                &format!("after each of {kills} kills vehicles drove for the standby: {took:.1?}"),
                took.len() == kills,
            );
        } else {
            require(&format!("another manager took over: {}", tally.take_overs), tally.take_overs > 0);
        }
        require(&format!("the mechanic mended a vehicle: {}", tally.mended), tally.mended > 0);
        let all = tally.stopped_all.iter().all(|(stopped, asked, _)| stopped == asked);
        require(&format!("each stop-all was acknowledged by all that were there: {}", tally.stopped_all.len()), all);
    }
    require("no process ended on its own, and nothing was said that is no line", tally.wrong.is_empty());
    for wrong in truth.wrong.iter().chain(&tally.wrong).take(20) {
        println!("       {wrong}");
    }
    passed
}

fn figures(tally: &Tally, truth: &Truth<'_>) {
    let (seconds, done) = (tally.took.as_secs_f64(), truth.done.len());
    let millis = |span: Duration| span.as_secs_f64() * 1_000.0;
    println!();
    println!("time            {seconds:.0} s");
    println!("orders          {} done, {:.0} an hour", done, done as f64 * 3_600.0 / seconds);
    println!("moves           {} from cell to cell", truth.moves.values().sum::<usize>());
    println!(
        "messages        {} and {} datagrams, {:.0} a second together",
        tally.messages,
        tally.datagrams,
        (tally.messages + tally.datagrams) as f64 / seconds
    );
    let mut all: Vec<Duration> = tally.calls.iter().map(|(_, took)| *took).collect();
    print_spans("calls", &mut all);
    let mut advances: Vec<_> =
        tally.calls.iter().filter(|(word, _)| word == "advance").map(|(_, took)| *took).collect();
    print_spans("  of `advance`", &mut advances);
    println!("calls failed    {}: of vehicles that were stopped, switched off or away", tally.failed_calls);
    for (title, is_by_lease) in [("stops, told", false), ("stops by lease", true)] {
        let stops = || truth.stops.iter().filter(|stop| stop.is_by_lease == is_by_lease);
        let mut took: Vec<_> = stops().map(|stop| stop.took).collect();
        print_spans(title, &mut took);
        let held_up = stops().map(|stop| stop.held_up).max().unwrap_or_default();
        if let Some(stop) = stops().next() {
            println!(
                "                bound {:.0} ms; loop held up at most {:.0} ms",
                millis(stop.bound),
                millis(held_up)
            );
        }
    }
    for (stopped, asked, took) in &tally.stopped_all {
        println!(
            "stop-all        {stopped} of {asked} vehicles acknowledged it, the last one after {:.1} ms",
            millis(*took)
        );
    }
    if tally.cuts > 0 {
        println!("cuts            {}, of 12 s each", tally.cuts);
    }
    println!("CPU             {:.1} s, {:.2} processors", tally.cpu.as_secs_f64(), tally.cpu.as_secs_f64() / seconds);
    println!("memory          {} MiB at most, of all processes together", tally.resident_kib / 1_024);
    println!();
}

fn print_spans(title: &str, spans: &mut [Duration]) {
    spans.sort_unstable();
    let at = |part: f64| spans.get(((spans.len() as f64 * part) as usize).min(spans.len().saturating_sub(1)));
    let millis = |part| at(part).map_or(0.0, |span| span.as_secs_f64() * 1_000.0);
    println!(
        "{title:<15} {}: median {:.2} ms, p99 {:.2} ms, longest {:.2} ms",
        spans.len(),
        millis(0.5),
        millis(0.99),
        millis(1.0)
    );
}
