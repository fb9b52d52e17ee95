//! What the processes of a soak held over its hours: slopes with their errors, and what has grown.
//!
//! A slope is that of one straight line through all lives of a process, each with a level of its own: least squares of what it held
//! over the hours, within a life. Values are means of a minute, since neighbours within one are hardly independent.

use std::collections::BTreeMap;
use std::path::Path;

use anyhow::{Context, Result, ensure};

/// Seconds of each life in which it fills up: the memory of a process with many vehicles until each has started some 30 times.
const WARM_UP: f64 = 3_600.0;
const MINUTE: f64 = 60.0;

/// Something that must not grow.
pub(crate) struct Quantity {
    pub(crate) name: &'static str,
    /// Its column in the file.
    column: usize,
    /// Growth an hour that fails a run, where it is also larger than two standard errors.
    bound: f64,
}

pub(crate) const QUANTITIES: [Quantity; 4] = [
    Quantity { name: "resident memory, KiB", column: 4, bound: 1_024.0 },
    Quantity { name: "proportional memory, KiB", column: 5, bound: 1_024.0 },
    Quantity { name: "descriptors", column: 6, bound: 2.0 },
    Quantity { name: "threads", column: 7, bound: 1.0 },
];
const FIELDS: usize = 11;
/// Counters in the file.
const COUNTERS: [usize; 3] = [8, 9, 10];

/// One process from its start to its end or to another role.
pub(crate) type Life = Vec<Sample>;

/// What it held in one minute.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(crate) struct Sample {
    pub(crate) hours: f64,
    pub(crate) values: [f64; 4],
    counters: [f64; 3],
}

/// Lives by what the process is.
pub(crate) type Processes = BTreeMap<String, Vec<Life>>;

/// A slope an hour with its standard error.
#[derive(Clone, Copy, Debug, PartialEq)]
struct Slope {
    value: f64,
    error: f64,
}

impl Slope {
    /// Of the lives that are long enough; `None` where there is none.
    fn of(lives: &[Life], quantity: usize) -> Option<Self> {
        let (mut xx, mut xy, mut yy, mut freedom) = (0.0, 0.0, 0.0, -1.0);
        for life in lives.iter().filter(|life| life.len() > 2) {
            let count = life.len() as f64;
            let mean =
                |of: fn(&Sample, usize) -> f64| life.iter().map(|sample| of(sample, quantity)).sum::<f64>() / count;
            let (x, y) = (mean(|sample, _| sample.hours), mean(|sample, quantity| sample.values[quantity]));
            for sample in life {
                let (dx, dy) = (sample.hours - x, sample.values[quantity] - y);
                (xx, xy, yy) = (xx + dx * dx, xy + dx * dy, yy + dy * dy);
            }
            freedom += count - 1.0;
        }
        let value = xy / xx;
        let is_known = freedom > 0.0 && xx > 0.0;
        is_known.then(|| Self { value, error: ((yy - value * xy).max(0.0) / freedom / xx).sqrt() })
    }

    fn grows(self, bound: f64) -> bool {
        self.value > bound && self.value > 2.0 * self.error
    }
}

/// What a file has of processes that lived longer than they take to warm up.
pub(crate) fn parsed(csv: &Path) -> Result<Processes> {
    let text = std::fs::read_to_string(csv).with_context(|| format!("reading {}", csv.display()))?;
    let processes = parse(&text);
    ensure!(!processes.is_empty(), "no process in {} lived longer than {WARM_UP} s", csv.display());
    Ok(processes)
}

/// Prints slopes, and fails where something has grown.
pub(crate) fn judge(processes: &Processes) -> Result<()> {
    let mut grown = Vec::new();
    println!(
        "| process | lives | minutes | {} | CPU | messages, datagrams a second |",
        QUANTITIES.map(|one| one.name).join(" | ")
    );
    println!("|{}", "---|".repeat(5 + QUANTITIES.len()));
    for (process, lives) in processes {
        let minutes: usize = lives.iter().map(Vec::len).sum();
        let cells = QUANTITIES.iter().enumerate().map(|(index, quantity)| {
            let Some(slope) = Slope::of(lives, index) else { return "too short".to_owned() };
            if slope.grows(quantity.bound) {
                grown.push(format!("{process}: {} by {:.1} ± {:.1} an hour", quantity.name, slope.value, slope.error));
            }
            let values = lives.iter().flatten().map(|sample| sample.values[index]);
            format!("{:.0}; {:+.1} ± {:.1}", values.sum::<f64>() / minutes as f64, slope.value, slope.error)
        });
        let cells: Vec<_> = cells.collect();
        let [cpu, messages, datagrams] = [0, 1, 2].map(|counter| rate(lives, counter));
        let cells = cells.join(" | ");
        println!(
            "| {process} | {} | {minutes} | {cells} | {:.3} | {messages:.0}, {datagrams:.0} |",
            lives.len(),
            cpu / 1e3
        );
    }
    println!("\nmean; slope an hour ± standard error, behind the first {WARM_UP:.0} s of each life");
    ensure!(grown.is_empty(), "what grows: {}", grown.join("; "));
    Ok(())
}

/// A second's share of a counter.
fn rate(lives: &[Life], counter: usize) -> f64 {
    let ends = lives.iter().filter_map(|life| Some((life.first()?, life.last()?)));
    let (counted, hours) = ends.fold((0.0, 0.0), |(counted, hours), (first, last)| {
        (counted + last.counters[counter] - first.counters[counter], hours + last.hours - first.hours)
    });
    if hours > 0.0 { counted / hours / 3_600.0 } else { 0.0 }
}

/// The lines of a file; a half one is left out.
fn parse(text: &str) -> Processes {
    let mut lives: BTreeMap<(String, String, String), Vec<(f64, Sample)>> = BTreeMap::new();
    for line in text.lines() {
        let fields: Vec<&str> = line.split(',').collect();
        let number = |column: usize| fields.get(column)?.parse::<f64>().ok();
        let Some(seconds) = number(1).filter(|_| fields.len() == FIELDS) else { continue };
        let values = QUANTITIES.map(|quantity| number(quantity.column).unwrap_or(0.0));
        let counters = COUNTERS.map(|column| number(column).unwrap_or(0.0));
        let key = (fields[2].to_owned(), fields[0].to_owned(), fields[3].to_owned());
        lives.entry(key).or_default().push((seconds, Sample { hours: seconds / 3_600.0, values, counters }));
    }
    let mut processes = Processes::new();
    for ((process, ..), samples) in lives {
        let start = samples.first().map_or(0.0, |(seconds, _)| *seconds);
        let warm = samples.into_iter().filter(|(seconds, _)| seconds - start >= WARM_UP).collect::<Vec<_>>();
        let minutes = warm.chunk_by(|(one, _), (next, _)| (one / MINUTE) as u64 == (next / MINUTE) as u64);
        let life: Life = minutes.map(mean).collect();
        if !life.is_empty() {
            processes.entry(process).or_default().push(life);
        }
    }
    processes
}

fn mean(samples: &[(f64, Sample)]) -> Sample {
    let of = |value: &dyn Fn(&Sample) -> f64| {
        samples.iter().map(|(_, sample)| value(sample)).sum::<f64>() / samples.len() as f64
    };
    Sample {
        hours: of(&|sample| sample.hours),
        values: std::array::from_fn(|index| of(&|sample| sample.values[index])),
        counters: std::array::from_fn(|index| of(&|sample| sample.counters[index])),
    }
}

#[cfg(test)]
mod tests {
    use super::{Slope, parse};

    /// Two lives of three hours, the second on a higher level; threads jitter by one, memory grows by `leak` KiB an hour.
    fn file(leak: f64) -> String {
        let line = |life: u32, step: u32| {
            let seconds = life * 10_800 + step * 10;
            let memory =
                20_000.0 + f64::from(life) * 5_000.0 + leak * f64::from(step) / 360.0 + f64::from(step % 7) * 30.0;
            format!("0,{seconds},manager,{life},{memory:.0},{memory:.0},210,{},{step},0,0\n", 20 + (step / 6) % 2)
        };
        (0..2).flat_map(|life| (0..1_080).map(move |step| line(life, step))).collect()
    }

    #[test]
    fn a_leak_is_told_from_levels_and_jitter() {
        let slope = |leak, quantity| Slope::of(&parse(&file(leak))["manager"], quantity).unwrap();
        assert!((slope(2_000.0, 0).value - 2_000.0).abs() < 60.0, "{:?}", slope(2_000.0, 0));
        assert!(slope(2_000.0, 0).grows(1_024.0) && !slope(2_000.0, 2).grows(2.0));
        assert!(!slope(0.0, 0).grows(0.0) && !slope(0.0, 3).grows(0.0), "{:?}", slope(0.0, 3));
        assert!(!slope(900.0, 0).grows(1_024.0));
    }

    #[test]
    fn the_start_of_a_life_and_half_lines_do_not_count() {
        let text = file(0.0) + "0,90000,manager,1,5\nsegment,seconds\n";
        let lives = &parse(&text)["manager"];
        assert_eq!(lives.iter().map(Vec::len).collect::<Vec<_>>(), [120, 120]);
        assert!(lives[0][0].hours * 3_600.0 >= super::WARM_UP);
        assert!(parse("0,10,manager,1,5,5,5,5,5,5,5\n").is_empty());
    }
}
