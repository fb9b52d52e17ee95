//! The manager and the vehicle, each in a process, which finds keys, sockets and state where the environment says. What they do
//! they print: it is judged by the process that started them.

use std::fmt;
use std::io::{BufRead, Write, stdin, stdout};
use std::time::{Duration, Instant, SystemTime, UNIX_EPOCH};

use anyhow::{Context, Result};
use cara_processes::faults::TIMEOUT;
use cara_std::{
    CommunicationSystem, Definition, Interfaces, OrderOutcome, Parameters, ParametersView, Renew, RequestOptions,
    Served, ServiceError, ServiceOptions, Unit,
};

use crate::motion::LEASE;

/// Numbers of calls of each life of the manager begin above this times the number of its life.
const OF_A_LIFE: i64 = 1_000_000;

/// A line at once, past the test's own capture.
fn say(line: fmt::Arguments) {
    let line = format!("{line}\n");
    let mut output = stdout().lock();
    // Who is not read any more is killed next.
    let _ = output.write_all(line.as_bytes()).and_then(|()| output.flush());
}

fn set(name: &str) -> Result<String> {
    std::env::var(name).with_context(|| name.to_owned())
}

fn numbered(number: i64) -> Result<Parameters> {
    let mut parameters = Parameters::new();
    parameters.add_int("number", 1)?;
    parameters.set_value("number", number)?;
    Ok(parameters)
}

/// What the environment says.
pub(crate) fn play() -> Result<()> {
    match &*set("CARA_TEST_PART")? {
        "manager" => manager()?,
        _ => vehicle()?,
    }
    for line in stdin().lock().lines() {
        if line? == "leak" {
            let mut leaked = Vec::new();
            loop {
                leaked.push(vec![1u8; 1 << 20]);
            }
        }
    }
    // Nobody waits for it.
    std::process::exit(0);
}

fn manager() -> Result<()> {
    let builder = CommunicationSystem::builder("manager", 1)?.fleet(set("CARA_TEST_FLEET")?.parse()?);
    let manager = builder.interfaces(Interfaces::Loopback).build()?;
    if let Err(error) = manager.start() {
        eprintln!("cannot start: {error}");
        std::process::exit(1);
    }
    let orders = manager.clone();
    std::thread::spawn(move || {
        loop {
            if let Ok(peer) = orders.s_unit("agv")
                && peer.outcome_of("drive") != OrderOutcome::Runs
            {
                let _ = peer.call("drive", &mut Parameters::new()).renewing(Renew::Process).wait();
            }
            std::thread::sleep(Duration::from_millis(50));
        }
    });
    let first = set("CARA_TEST_LIFE")?.parse::<i64>()? * OF_A_LIFE;
    std::thread::spawn(move || {
        for number in first.. {
            let mut arguments = numbered(number).unwrap();
            let options = RequestOptions { timeout: Some(TIMEOUT.into()), ..RequestOptions::default() };
            let began = Instant::now();
            let called = manager.s_unit("agv").map(|peer| peer.call("count", &mut arguments).with(options).wait());
            let took = began.elapsed().as_millis();
            let unix = SystemTime::now().duration_since(UNIX_EPOCH).unwrap_or_default().as_secs();
            if let Ok(Ok(())) = called {
                say(format_args!("answered {number} {took} {} {unix}", arguments.variable("number").unwrap_or(-1)));
            } else {
                say(format_args!("failed {number} {took} {unix}"));
            }
            std::thread::sleep(Duration::from_millis(10));
        }
    });
    Ok(())
}

fn vehicle() -> Result<()> {
    let builder = Unit::builder("agv", 7, "manager", 1)?.fleet(set("CARA_TEST_FLEET")?.parse()?);
    let vehicle = builder.interfaces(Interfaces::Loopback).build()?;
    let list = vehicle.my_function_list();
    list.add_function("count", &numbered(0)?, |arguments: Parameters| {
        say(format_args!("ran {}", arguments.variable("number").unwrap_or(-1)));
        arguments
    })?;
    let drive = |_: &Served, _: &mut ParametersView| -> Result<(), ServiceError> {
        say(format_args!("drives"));
        Ok(())
    };
    let moves = ServiceOptions::new().lease(LEASE, || say(format_args!("stands")));
    list.add_service(&Definition::parse("drive()")?, moves, drive)?;
    vehicle.publish_my_function_list()?;
    vehicle.start()?;
    // It goes on until the process ends.
    std::mem::forget(vehicle);
    Ok(())
}
