//! A node's life: built, started, told of signals, ended.

use std::io::ErrorKind;
use std::net::{SocketAddr, TcpListener};
use std::path::Path;
use std::sync::{Arc, OnceLock};

use anyhow::Context;
use cara_std::control::{RunningUnit, running};
use cara_std::{BuildError, Error};
use serde_json::json;
use signal_hook::consts::{SIGHUP, SIGINT, SIGTERM};
use signal_hook::iterator::Signals;

use super::black_box::BlackBox;
use super::logging::Logging;
use super::mistake::Mistakes;
use super::offer::offer;
use super::program::Programs;
use super::settings::{Overrides, Placed, Settings};
use super::unit::{Node, NotBuilt};
use super::{events, http, service, wrong};
use cara_tools::exit::{Ended, Exit};
use cara_tools::global::Global;
use cara_tools::output;

/// Runs a node until it is asked to end.
pub(super) fn run(
    settings: Settings,
    over: &Overrides,
    logging: &Logging,
    black_box: &BlackBox,
    global: &Global,
) -> anyhow::Result<()> {
    // First, so that a signal during the start ends the node in an orderly way too.
    let mut signals = Signals::new([SIGINT, SIGTERM, SIGHUP]).context("signals cannot be waited for")?;
    let programs = Arc::new(Programs::default());
    let node = Node::build(&settings).map_err(|error| match error {
        NotBuilt::Unit(error) => not_built(error, &settings),
        NotBuilt::Access(error) => Ended::usage(error.to_string()),
        NotBuilt::Audit(error) => {
            let path = settings.audit.as_deref().unwrap_or(Path::new("")).display();
            Ended::usage(format!("the audit log {path} cannot be written: {error}"))
        }
    })?;
    if let Some(log) = logging.stream() {
        node.show_log(log).map_err(|error| Ended::usage(format!("[log] stream: {error}")))?;
    }
    if settings.tells_clock {
        node.my_function_list().add_clock().map_err(|error| Ended::usage(format!("clock: {error}")))?;
    }
    offer_all(&node, &settings, &programs, black_box)?;
    let metrics = settings.metrics.as_ref().map(|place| listen(place, &settings)).transpose()?;
    let (ending, fenced) = (signals.handle(), Arc::new(OnceLock::new()));
    let reported = fenced.clone();
    black_box.start(&settings, node.look());
    events::log(node.events(), node.addresses(), black_box.clone(), move |term| {
        let _ = reported.set(term);
        ending.close();
    })?;
    node.start().map_err(Ended::not_started)?;
    let served = metrics.as_ref().map(TcpListener::local_addr).transpose()?;
    if let Some(listener) = metrics {
        http::serve(listener, node.metrics()).context("metrics cannot be served")?;
    }
    if let Err(error) = report_up(&settings, &node, served, global) {
        tracing::warn!(%error, "the line that the node is up could not be written");
    }
    service::up(&node);
    node.follow_commands(black_box.clone());
    node.follow_streams(&settings.boxed_streams, black_box.clone());
    let mut settings = settings;
    for signal in signals.forever() {
        tracing::info!(signal = signal_hook::low_level::signal_name(signal), "signal");
        if signal != SIGHUP || settings.source.name.is_empty() {
            break;
        }
        reload(&mut settings, over, &node, logging);
    }
    // Programs first, so that what makes safe is the last one to act; stopping ends the leases that are live.
    programs.end_calls();
    node.stop();
    // Only now, since a service manager that hangs may hold this up.
    service::ends();
    programs.finish();
    black_box.end();
    match fenced.get() {
        None => Ok(()),
        Some(claim) => Err(Ended::fenced(*claim)),
    }
}

/// Puts the file's services into the unit's list, and publishes them to all.
fn offer_all(node: &Node, settings: &Settings, programs: &Arc<Programs>, black_box: &BlackBox) -> anyhow::Result<()> {
    let list = node.my_function_list();
    for (number, service) in settings.services.iter().enumerate() {
        offer(&list, number, service, programs, black_box).map_err(|error| {
            let help = "the unit does not take this function; [capacities] says how much it has room for";
            wrong(settings.mistake(service.span.clone(), &error.to_string(), help))
        })?;
    }
    node.publish_my_function_list().map_err(|error| Ended::failed(format!("{error:?}"), error.to_string()))
}

/// Which value of the file the unit could not be built with.
fn not_built(error: BuildError, settings: &Settings) -> anyhow::Error {
    match error {
        BuildError::Unit(error) => not_made(error, settings),
        BuildError::Keys(error) => cara_tools::keys::failed(error),
        BuildError::StandbyWithoutKeys | BuildError::StandbyWithoutState => Ended::usage(error.to_string()),
        other => Ended::failed("Failed", other.to_string()),
    }
}

fn not_made(error: Error, settings: &Settings) -> anyhow::Error {
    let in_use = error == Error::PortInUse;
    let address = settings.interfaces.bind_address();
    let is_free = |port: &Placed<u16>| TcpListener::bind((address, port.value)).is_ok();
    let tcp = settings.tcp_port.as_ref().filter(|port| in_use && port.value != 0 && !is_free(port));
    let port = tcp.or(settings.discovery_port.as_ref()).filter(|_| in_use);
    if let Some(Placed { value, span: Some(span) }) = port {
        if let Some(error) = runs_already(settings, *value) {
            return error;
        }
        let what = format!("port {value} is in use by another program");
        let help = format!("choose another one; `ss -lntup | grep :{value}` shows who has it");
        return Ended::failed("PortInUse", settings.mistake(span.clone(), &what, &help).to_string());
    }
    let is_reserved = |port: &&Placed<u16>| error == Error::PortNotPermitted && (1..1024).contains(&port.value);
    let refused = settings.tcp_port.as_ref().filter(is_reserved);
    let refused = refused.or(settings.discovery_port.as_ref().filter(is_reserved));
    if let Some(Placed { value, span: Some(span) }) = refused {
        let what = format!("the system does not permit port {value}");
        // No restart mends it.
        return wrong(settings.mistake(span.clone(), &what, NOT_PERMITTED));
    }
    let which = port.or(refused).map_or(String::new(), |port| format!("port {}: ", port.value));
    Ended::failed(format!("{error:?}"), format!("{which}{error}"))
}

const NOT_PERMITTED: &str = "a port below 1024 takes root or CAP_NET_BIND_SERVICE: choose another one";

/// What to do where metrics have no port.
fn not_served(kind: ErrorKind) -> &'static str {
    match kind {
        ErrorKind::PermissionDenied => NOT_PERMITTED,
        ErrorKind::AddrInUse => "choose an address with a free port; `ss -lntp` shows who has this one",
        ErrorKind::AddrNotAvailable => "choose an address of this host: `ip address` shows them",
        _ => "choose an address of this host with a free port",
    }
}

/// A port is taken: by the manager that this one is meant to be, which runs here. Another port would not help.
fn runs_already(settings: &Settings, port: u16) -> Option<anyhow::Error> {
    let Settings { name, id, fleet, manager, takes_over, stands_by, .. } = settings;
    let is_refused = manager.is_none() && !takes_over && !stands_by;
    let own = format!("{name}/{id}");
    let is_own = |unit: &RunningUnit| unit.unit == own && unit.fleet == *fleet;
    let runs = is_refused && running().is_ok_and(|units| units.iter().any(is_own));
    runs.then(|| {
        let text = format!(
            "the m_unit {own} of fleet {fleet} is running already on this host, and port {port} is in use: stop it first, or give \
             this one its own name or id"
        );
        Ended { exit: Exit::AlreadyRunning, text, name: "AlreadyRunning".into() }.into()
    })
}

fn listen(place: &Placed<SocketAddr>, settings: &Settings) -> anyhow::Result<TcpListener> {
    http::listen(place.value).map_err(|error| {
        if error.kind() == ErrorKind::AddrInUse
            && let Some(error) = runs_already(settings, place.value.port())
        {
            return error;
        }
        let what = format!("metrics cannot be served at {}: {error}", place.value);
        let help = not_served(error.kind());
        match &place.span {
            Some(span) => Ended::failed("Network", settings.mistake(span.clone(), &what, help).to_string()),
            None => Ended::failed("Network", format!("{what}; {help}")),
        }
    })
}

/// One line that says that the node is up, for scripts that wait for it.
fn report_up(settings: &Settings, node: &Node, metrics: Option<SocketAddr>, global: &Global) -> anyhow::Result<()> {
    let Settings { name, id, fleet, .. } = settings;
    let (mode, discovery) = (node.mode().as_str(), node.discovery_port());
    let metrics = metrics.map(|address| format!("http://{address}/metrics"));
    let (tcp, control) = (node.tcp_port(), node.control_path());
    if global.json {
        let control = control.map(|path| path.display().to_string());
        output::object(&json!({
            "up": true, "name": name, "id": id, "fleet": fleet, "mode": mode, "discovery_port": discovery,
            "tcp_port": tcp, "control": control, "metrics": metrics,
        }))?;
        return Ok(());
    }
    let tcp = tcp.map_or(String::new(), |port| format!(", TCP port {port}"));
    let control = control.map_or("none".into(), |path| path.display().to_string());
    let metrics = metrics.map_or(String::new(), |url| format!(", metrics {url}"));
    output::line(format_args!(
        "{name}/{id} is up: fleet {fleet}, {mode}, discovery port {discovery}{tcp}, control socket {control}{metrics}"
    ))?;
    Ok(())
}

/// Takes over constraints and the log's level of a file that has changed. A mistake changes nothing.
fn reload(settings: &mut Settings, over: &Overrides, node: &Node, logging: &Logging) {
    let fresh = match read_again(settings, over) {
        Ok(fresh) => fresh,
        Err(error) => return tracing::error!("the old configuration stays: {error}"),
    };
    if let Err(error) = node.set_constraints(fresh.constraints) {
        return tracing::error!(%error, "the old configuration stays; more nodes need more open files (`LimitNOFILE=`)");
    }
    logging.change(fresh.file_log.as_deref());
    *settings = fresh;
    tracing::info!("constraints and log are those of the file again; the rest of it waits for a restart");
}

fn read_again(settings: &Settings, over: &Overrides) -> Result<Settings, String> {
    let path = std::path::Path::new(&settings.source.name);
    let source = super::read(Some(path)).map_err(|error| format!("{error:#}"))?;
    Settings::of(source, over).map_err(|mistakes: Mistakes| mistakes.to_string())
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn what_keeps_metrics_from_being_served_is_what_the_advice_is_about() {
        assert!(not_served(ErrorKind::PermissionDenied).contains("below 1024"));
        assert!(not_served(ErrorKind::AddrInUse).contains("a free port"));
        assert!(not_served(ErrorKind::AddrNotAvailable).contains("ip address"));
    }
}
