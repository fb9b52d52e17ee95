//! The alert rules and the dashboard of `packaging`, read by Prometheus.

use std::collections::BTreeSet;
use std::fs;
use std::net::TcpListener;
use std::path::Path;
use std::time::{Duration, Instant};

use anyhow::{Context, Result, ensure};
use cara_processes::{Process, random_fleet};
use serde_json::{Value, json};

use crate::command::Run;
use crate::{binaries, workspace};

const RULES: &str = "packaging/prometheus/cara.rules.yml";
const DASHBOARD: &str = "packaging/grafana/cara.json";
/// How long anything may take that takes a few seconds when the machine has nothing else to do.
const STEP: Duration = Duration::from_secs(60);
/// Of a panel: the units that are chosen.
const CHOSEN: &str = "$unit";

/// Each rule fires by what it is for; a Prometheus scrapes a manager, finds all that the dashboard shows, and sees a vehicle go.
pub(crate) fn check() -> Result<()> {
    Run::new("promtool").args(["check", "rules", RULES]).stream()?;
    Run::new("promtool").args(["test", "rules", "tests/packages/alerts.yml"]).stream()?;
    all_are_tested()?;
    binaries::build(&["agv", "cara"])?;
    scrape(&panels()?)
}

/// A rule without a test would pass.
fn all_are_tested() -> Result<()> {
    let names = |path: &str, word: &str| -> Result<BTreeSet<String>> {
        let text = workspace::read(Path::new(path))?;
        let after = text.lines().filter_map(|line| line.split_once(word)).map(|(_, rest)| rest);
        Ok(after.filter_map(|rest| rest.split([',', ' ']).next().map(str::to_owned)).collect())
    };
    let (rules, tested) = (names(RULES, "- alert: ")?, names("tests/packages/alerts.yml", "alertname: ")?);
    ensure!(!rules.is_empty() && rules == tested, "{RULES} has {rules:?}, and tested are {tested:?}");
    Ok(())
}

/// The expressions of the dashboard, with all units chosen.
fn panels() -> Result<Vec<String>> {
    let dashboard: Value = serde_json::from_str(&workspace::read(Path::new(DASHBOARD))?)?;
    let panels = dashboard["panels"].as_array().context("no panels")?.iter();
    let targets = panels.flat_map(|panel| panel["targets"].as_array().into_iter().flatten());
    let all: Vec<String> = targets.filter_map(|target| Some(target["expr"].as_str()?.replace(CHOSEN, ".*"))).collect();
    ensure!(all.len() > 10, "the dashboard shows {} expressions", all.len());
    Ok(all)
}

fn scrape(panels: &[String]) -> Result<()> {
    let folder = tempfile::tempdir()?;
    let (place, programs) = (folder.path(), workspace::target().join("debug"));
    let (fleet, cara) = (random_fleet().to_string(), programs.join("cara"));
    let keys = format!("CARA_KEYS={}", place.join("keys").display());
    let in_place = ["env".to_owned(), keys.clone(), format!("CARA_CONTROL_DIR={}", place.display())];
    let start = |name: &str, program: &Path, arguments: &[&str]| {
        let program = program.display().to_string();
        let words = in_place[1..].iter().map(String::as_str).chain([program.as_str()]);
        Process::start(name, Path::new("env"), words.chain(arguments.iter().copied()))
    };
    let made = Run::new("env").args([&keys]).args([&cara]);
    made.args(["keys", "new-fleet", "--fleet", &fleet, "AGV_manager/1@m_unit", "agv-1/11", "clock-1/12"]).text()?;
    let arguments =
        ["--loopback", "--fleet", &fleet, "node", "--name", "AGV_manager", "--id", "1", "--metrics", "127.0.0.1:0"];
    let manager = start("manager", &cara, &arguments)?;
    let up = manager.seen("metrics http://", STEP)?.text;
    let address =
        up.split_once("metrics http://").and_then(|(_, rest)| rest.split('/').next()).context("no address")?;
    let mut vehicle = start("agv-1", &programs.join("agv"), &["--attended", "--loopback", "--fleet", &fleet])?;
    vehicle.expect("joined", STEP)?;
    let clock = place.join("clock-1.toml");
    let text =
        "name = \"clock-1\"\nid = 12\nrole = \"s_unit\"\nclock = true\n[manager]\nname = \"AGV_manager\"\nid = 1\n";
    fs::write(&clock, text)?;
    let arguments = ["--loopback", "--fleet", &fleet, "node", &clock.display().to_string()];
    let _clock = start("clock-1", &cara, &arguments)?;
    let settings = json!({
        "global": { "scrape_interval": "1s", "evaluation_interval": "1s" },
        "rule_files": [workspace::root().join(RULES)],
        "scrape_configs": [{ "job_name": "cara", "static_configs": [{ "targets": [address] }] }],
    });
    // JSON is YAML.
    let file = place.join("prometheus.yml");
    fs::write(&file, settings.to_string())?;
    let listen = TcpListener::bind("127.0.0.1:0")?.local_addr()?.to_string();
    let prometheus = [
        format!("--config.file={}", file.display()),
        format!("--storage.tsdb.path={}", place.join("data").display()),
        format!("--web.listen-address={listen}"),
        "--log.level=warn".to_owned(),
    ];
    let _prometheus = Process::start("prometheus", Path::new("prometheus"), prometheus)?;
    for panel in panels {
        until(&listen, panel)?;
    }
    println!("{} expressions of the dashboard have values", panels.len());
    vehicle.kill()?;
    until(&listen, "ALERTS{alertname=\"CaraNodeNotConnected\", peer=\"agv-1/11\", alertstate=\"firing\"}")?;
    println!("a vehicle that is gone is an alert");
    Ok(())
}

/// Waits until an expression has a value.
fn until(listen: &str, expression: &str) -> Result<()> {
    let end = Instant::now() + STEP;
    loop {
        let server = format!("http://{listen}");
        let asked = Run::new("promtool").args(["query", "instant", "-o", "json", &server, expression]).captured()?;
        match asked {
            (true, values, _) if values.trim() != "[]" => return Ok(()),
            (_, values, errors) => {
                ensure!(Instant::now() < end, "{expression} has no value: {values}{errors}");
                std::thread::sleep(Duration::from_millis(200));
            }
        }
    }
}
