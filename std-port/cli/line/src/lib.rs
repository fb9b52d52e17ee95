//! `cara line`: a unit at the other end of a serial line, without an IP stack on the line, is to the units of this host a
//! unit at a loopback address of its own. Both ends run a Linux host with this command, or one is a board that speaks the
//! line itself. Searches of this host's units go over the line, and no others: a network's would fill it.

mod bridge;
mod host;
mod tty;

use std::net::Ipv4Addr;
use std::path::PathBuf;
use std::process::ExitCode;
use std::time::Duration;

use cara_std::{Fleet, Mode};
use cara_tools::exit::Ended;
use cara_tools::global::Global;
use cara_tools::{interrupt, output};
use serde_json::json;

use crate::bridge::Bridge;
use crate::host::Host;
use crate::tty::Tty;

/// How long a device may be away before it is looked for again.
const RETRY: Duration = Duration::from_secs(1);

/// Connects the unit at the other end of a serial line, which has no IP stack, with the units of this host.
///
/// The unit appears at a loopback address of its own. The line carries one fleet and one unit at each end; the other end is
/// a board that speaks the line, or a host with the same command. It runs until Ctrl-C.
#[derive(clap::Args)]
#[command(after_help = "\
cara line /dev/ttyUSB0 --baud 115200
cara line /dev/ttyAMA0 --baud 1000000 --fleet 7 --insecure")]
pub struct Arguments {
    /// The device.
    device: PathBuf,
    /// Bits per second: eight data bits, no parity, one stop bit.
    #[arg(long, value_name = "NUMBER", default_value_t = 115_200, value_parser = clap::value_parser!(u32).range(1_200..))]
    baud: u32,
    /// The address at which the unit appears; one of 127.67.0.0/16 that the device's number decides unless told.
    #[arg(long, value_name = "ADDRESS")]
    address: Option<Ipv4Addr>,
}

/// Runs until a signal ends the process; an error of the device is waited out, but for the first one.
pub fn run(arguments: Arguments, global: &Global) -> anyhow::Result<ExitCode> {
    interrupt::end_at_signals()?;
    let mode = if global.insecure { Mode::Plain } else { Mode::Secured };
    let port = global.discovery_port.unwrap_or(mode.port());
    let mut tty = open(&arguments)?;
    let address = arguments.address.map_or_else(|| tty.address(), Ok)?;
    if !address.is_loopback() || address == Ipv4Addr::LOCALHOST {
        return Err(Ended::usage(format!(
            "{address} is no loopback address of the line's own: take one of 127.67.0.0/16"
        )));
    }
    let mut host = Host::open(address, port, Fleet(global.fleet.unwrap_or(0)))?;
    say(global, "open", &address.to_string(), &arguments)?;
    loop {
        let ended = Bridge::new(tty, &mut host, arguments.baud).run();
        say(global, "lost", &ended.to_string(), &arguments)?;
        tty = loop {
            std::thread::sleep(RETRY);
            if let Ok(tty) = open(&arguments) {
                break tty;
            }
        };
        say(global, "open", &address.to_string(), &arguments)?;
    }
}

fn open(arguments: &Arguments) -> anyhow::Result<Tty> {
    let Arguments { device, baud, .. } = arguments;
    Tty::open(device, *baud).map_err(|error| {
        let text = format!("{} cannot be used at {baud} baud: {error}", device.display());
        Ended::failed("Device", text)
    })
}

fn say(global: &Global, what: &str, detail: &str, arguments: &Arguments) -> anyhow::Result<()> {
    let device = arguments.device.display();
    if global.json {
        output::object(&json!({ "device": device.to_string(), "event": what, "detail": detail }))?;
    } else {
        output::line(format_args!("{device}: {what}: {detail}"))?;
    }
    Ok(())
}
