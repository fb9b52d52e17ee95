//! What a scrape by Prometheus gets: the counters of the unit, and of each vehicle what became of its broker, its link and its
//! messages. Plain HTTP, on this host only.

use std::fmt::Write as _;
use std::io::{self, Read, Write};
use std::net::{TcpListener, TcpStream};
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, AtomicU64, Ordering};
use std::time::{Duration, Instant, UNIX_EPOCH};

use crate::tls::{Expiry, Whose};

/// How long a reader may take, one after the other.
const PATIENCE: Duration = Duration::from_secs(1);
/// The longest request.
const REQUEST: usize = 4_096;

/// One vehicle, as its loop has seen it last.
#[derive(Debug, Default)]
pub struct Seen {
    /// Its serial number.
    pub serial_number: String,
    /// The broker is there.
    pub broker: AtomicBool,
    /// The vehicle is linked.
    pub linked: AtomicBool,
    /// Its record cannot be read.
    pub out_of_service: AtomicBool,
    /// Errors in its state.
    pub errors: AtomicU64,
    /// Messages to the master.
    pub sent: AtomicU64,
    /// Orders and instant actions.
    pub received: AtomicU64,
    /// Those that cannot be read, or are not for now.
    pub refused: AtomicU64,
    /// How often the broker went away.
    pub broker_losses: AtomicU64,
    /// Turns of its loop.
    pub turns: AtomicU64,
    /// Certificates of its connection.
    pub expiry: Arc<Expiry>,
}

/// All vehicles, behind the text of the unit's own counters.
pub fn text(of_unit: &str, vehicles: &[Arc<Seen>]) -> String {
    /// The last line of OpenMetrics.
    const END: &str = "# EOF\n";
    type Value = fn(&Seen) -> u64;
    let gauges: [(&str, &str, Value); 4] = [
        ("broker", "Whether the broker is there", |seen| seen.broker.load(Ordering::Relaxed).into()),
        ("linked", "Whether the vehicle is linked", |seen| seen.linked.load(Ordering::Relaxed).into()),
        ("out_of_service", "Whether its record cannot be read", |seen| {
            seen.out_of_service.load(Ordering::Relaxed).into()
        }),
        ("errors", "Errors in its state", |seen| seen.errors.load(Ordering::Relaxed)),
    ];
    let counters: [(&str, &str, Value); 4] = [
        ("sent", "Messages to the master", |seen| seen.sent.load(Ordering::Relaxed)),
        ("received", "Orders and instant actions", |seen| seen.received.load(Ordering::Relaxed)),
        ("refused", "Messages that cannot be read or are not for now", |seen| seen.refused.load(Ordering::Relaxed)),
        ("broker_losses", "How often the broker went away", |seen| seen.broker_losses.load(Ordering::Relaxed)),
    ];
    let mut text = of_unit.strip_suffix(END).unwrap_or(of_unit).to_owned();
    let mut family = |name: &str, kind: &str, suffix: &str, help: &str, value: Value| {
        // A `String` takes whatever is written to it.
        let _ = writeln!(text, "# HELP cara_vda5050_{name} {help}.\n# TYPE cara_vda5050_{name} {kind}");
        for seen in vehicles {
            let (vehicle, value) = (&seen.serial_number, value(seen));
            let _ = writeln!(text, "cara_vda5050_{name}{suffix}{{vehicle=\"{vehicle}\"}} {value}");
        }
    };
    gauges.into_iter().for_each(|(name, help, value)| family(name, "gauge", "", help, value));
    counters.into_iter().for_each(|(name, help, value)| family(name, "counter", "_total", help, value));
    let name = "cara_vda5050_certificate_expires";
    let _ = writeln!(text, "# HELP {name} When it expires, in seconds since 1970.\n# TYPE {name} gauge");
    for seen in vehicles {
        for whose in Whose::ALL {
            let Some(end) = seen.expiry.of(whose) else { continue };
            let seconds = end.duration_since(UNIX_EPOCH).unwrap_or_default().as_secs();
            let (vehicle, whose) = (&seen.serial_number, whose.word());
            let _ = writeln!(text, "{name}{{vehicle=\"{vehicle}\",certificate=\"{whose}\"}} {seconds}");
        }
    }
    let name = "cara_vda5050_log_lost";
    let _ = writeln!(text, "# HELP {name} Lines of the log that nobody has read.\n# TYPE {name} counter");
    let _ = writeln!(text, "{name}_total {}", crate::log::lost());
    text + END
}

/// Answers readers one by one, for ever.
pub fn serve(listener: &TcpListener, text: impl Fn() -> String) {
    loop {
        match listener.accept() {
            // A reader that goes away is no concern of anyone.
            Ok((stream, _)) => drop(answer(stream, &text)),
            Err(_) => std::thread::sleep(PATIENCE),
        }
    }
}

fn answer(mut stream: TcpStream, text: &impl Fn() -> String) -> io::Result<()> {
    let end = Instant::now() + PATIENCE;
    let (mut request, mut read) = ([0; REQUEST], 0);
    while !request[..read].windows(4).any(|bytes| bytes == b"\r\n\r\n") {
        let left = end.saturating_duration_since(Instant::now());
        if left.is_zero() || read == REQUEST {
            return Ok(());
        }
        stream.set_read_timeout(Some(left))?;
        match stream.read(&mut request[read..])? {
            0 => return Ok(()),
            bytes => read += bytes,
        }
    }
    stream.set_write_timeout(Some(PATIENCE))?;
    let is_asked = request.starts_with(b"GET /metrics ");
    let (status, kind, body) = match is_asked {
        true => ("200 OK", cara_std::metrics::CONTENT_TYPE, text()),
        false => ("404 Not Found", "text/plain", "it is at /metrics\n".to_owned()),
    };
    let length = body.len();
    let head =
        format!("HTTP/1.1 {status}\r\ncontent-type: {kind}\r\ncontent-length: {length}\r\nconnection: close\r\n\r\n");
    stream.write_all((head + &body).as_bytes())
}
