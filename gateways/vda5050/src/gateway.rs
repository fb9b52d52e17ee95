//! One vehicle between its master and CARA: a thread with the vehicle's machine, its link and its client of the broker.

use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, AtomicU32, Ordering};
use std::time::{Duration, Instant, SystemTime};

use anyhow::{Context, Result};
use cara_std::{CommunicationSystem, Identity, Peer};
use rumqttc::{Client, QoS};
use serde::Serialize;

use crate::config::{self, Config};
use crate::driver::Driver;
use crate::errors::{Kind, Refusal};
use crate::log;
use crate::machine::at_once::is_stop;
use crate::machine::{ERRORS, Machine, Topic};
use crate::message::{
    BatteryState, Connection, ConnectionState, Factsheet, Header, InstantActions, Order, Report, Responses, State,
    Visualization, ZoneSetMessage, probe, read, sent_probe, write,
};
use crate::metrics::Seen;
use crate::mqtt::{HEARD, Heard, LARGEST, Link, Place};
use crate::record::{RecordLock, Store};
use crate::recording::Recording;
use crate::tls::Whose;
use crate::vehicle::Linked;
use crate::version::Version;

/// The loop comes round so often.
const TURN: Duration = Duration::from_millis(20);
/// The loop's heart: half of the vehicle's lease.
const HEART: Duration = Duration::from_millis(crate::vehicle::LEASE_MS / 2);
/// What is sent last waits so long for its acknowledgement.
const LAST_WORDS: Duration = Duration::from_secs(2);
/// A record that could not be read is tried so often.
const TRIED_AGAIN: Duration = Duration::from_secs(2);
/// The ends of certificates are looked at so often, and at each connection.
const LOOKED_AGAIN: Duration = Duration::from_secs(60);
/// Days before the end of a certificate at which there is a warning, the fewest first.
const EXPIRES_WITHIN: [u64; 2] = [7, 30];

/// Whether the program ends, for all its threads.
#[derive(Debug, Default)]
pub struct End {
    /// It does.
    pub is_due: AtomicBool,
    /// Another gateway speaks for the vehicles: nothing is said on `connection`.
    pub is_silent: AtomicBool,
}

/// Runs one vehicle until `end`. Where gateways share records, only while it is linked here and no other gateway speaks for it.
pub fn run(
    config: &Config,
    vehicle: &config::Vehicle,
    system: &CommunicationSystem,
    seen: &Arc<Seen>,
    recording: &Recording,
    end: &End,
) -> Result<()> {
    let is_shared = config.manager.shared_records.is_some();
    let identity = Identity::s_unit(&vehicle.name, vehicle.id)?;
    let peer = system.node(&identity).with_context(|| format!("there are no keys for {}", vehicle.name))?;
    while !end.is_due.load(Ordering::SeqCst) {
        // Released when nothing more is written or said.
        let lock = match is_shared {
            true if !peer.is_connected() => None,
            true => RecordLock::take(&config.records(), &vehicle.serial_number)?,
            false => None,
        };
        if is_shared && lock.is_none() {
            seen.turns.fetch_add(1, Ordering::Relaxed);
            std::thread::sleep(TURN);
            continue;
        }
        let mut gateway = Gateway::start(config, vehicle, system, &peer, (seen.clone(), recording.clone()), lock)?;
        let has_left = || is_shared && !peer.is_connected();
        while !end.is_due.load(Ordering::SeqCst) && !gateway.is_mended() && !has_left() {
            let turn = Instant::now();
            gateway.turn();
            std::thread::sleep(TURN.saturating_sub(turn.elapsed()));
        }
        let last = match end.is_due.load(Ordering::SeqCst) {
            true => (!end.is_silent.load(Ordering::SeqCst)).then_some(ConnectionState::Offline),
            false if has_left() => Some(ConnectionState::Broken),
            false => Some(ConnectionState::Offline),
        };
        gateway.stop(last);
        [&seen.linked, &seen.broker].iter().for_each(|is_there| is_there.store(false, Ordering::Relaxed));
    }
    Ok(())
}

struct Gateway {
    config: Config,
    serial_number: String,
    prefix: String,
    folder: PathBuf,
    factsheet: Factsheet,
    driver: Driver<Linked, Store>,
    link: Link,
    client: Option<Client>,
    began: Instant,
    /// When a probe was sent, and when the last one was sent that came back.
    probed: [Instant; 2],
    is_broker_there: bool,
    /// Header id of the last state.
    stated: u32,
    /// What topic `connection` says.
    shown: Option<ConnectionState>,
    /// The header id of that, and whether it has come back.
    said: u32,
    is_echoed: bool,
    /// As it was logged: why the vehicle did not do something, why the record is not on disk, and why there is no broker.
    failed: Option<String>,
    unwritten: Option<String>,
    lost: Option<String>,
    /// Of a vehicle whose record cannot be read: when it was tried last.
    tried: Option<Instant>,
    reported: Option<(Report, Instant)>,
    visualized: Instant,
    /// For metrics.
    seen: Arc<Seen>,
    recording: Recording,
    /// Within how many days certificates expire, as it was logged, and when that was looked at.
    expires: [Option<u64>; 2],
    looked: Instant,
    /// Header id of the next last will.
    will: Arc<AtomicU32>,
}

impl Gateway {
    fn start(
        config: &Config,
        vehicle: &config::Vehicle,
        system: &CommunicationSystem,
        peer: &Peer,
        (seen, recording): (Arc<Seen>, Recording),
        lock: Option<RecordLock>,
    ) -> Result<Self> {
        let config = &Config { broker: config.broker.of(vehicle), ..config.clone() };
        let folder = config.records();
        let (store, machine) = match Store::open(&folder, &vehicle.serial_number) {
            Ok((store, record)) => (store.locked(lock), Machine::new(record, config.policy(), Duration::ZERO)),
            Err(error) => {
                log::line(format_args!(
                    "{}: out of service until its record is mended or moved away: {error}",
                    vehicle.serial_number
                ));
                let machine = Machine::out_of_service(&error.to_string(), config.policy(), Duration::ZERO);
                (Store::nowhere().locked(lock), machine)
            }
        };
        let tried = machine.is_out_of_service().then(Instant::now);
        let driver = Driver::new(machine, Linked::new(peer.clone(), system.heart(HEART)), store);
        let prefix = config.prefix(vehicle);
        let will = Arc::new(AtomicU32::new(0));
        let (serial_number, shared, header_id) = (vehicle.serial_number.clone(), config.clone(), will.clone());
        let last_words = move || {
            let header = header(&shared, &serial_number, header_id.load(Ordering::SeqCst));
            write(shared.version(), &Connection { header, connection_state: ConnectionState::Broken })
        };
        let client_id = format!("{}-{}", config.vda5050.manufacturer, vehicle.serial_number);
        let probes: &[_] = if config.broker.probe > 0 && !config.broker.probe_stops { &["cara-probe"] } else { &[] };
        let link = Link::start(Place {
            broker: config.broker.clone(),
            client_id,
            prefix: prefix.clone(),
            topics: [config.version().rules().topics, &["connection"], probes].concat(),
            will: Box::new(last_words),
            recording: recording.clone(),
            expiry: seen.expiry.clone(),
        })?;
        let now = Instant::now();
        Ok(Self {
            serial_number: vehicle.serial_number.clone(),
            factsheet: config.factsheet()?,
            config: config.clone(),
            prefix,
            driver,
            link,
            client: None,
            began: now,
            probed: [now; 2],
            is_broker_there: false,
            stated: 0,
            shown: None,
            said: 0,
            is_echoed: false,
            failed: None,
            unwritten: None,
            lost: None,
            tried,
            folder,
            seen,
            recording,
            expires: [None; 2],
            looked: now,
            reported: None,
            visualized: now,
            will,
        })
    }

    /// Whether the record of a vehicle that was out of service can be read again.
    fn is_mended(&mut self) -> bool {
        let Some(tried) = &mut self.tried else { return false };
        if tried.elapsed() < TRIED_AGAIN {
            return false;
        }
        *tried = Instant::now();
        Store::open(&self.folder, &self.serial_number).is_ok()
    }

    fn turn(&mut self) {
        self.seen.turns.fetch_add(1, Ordering::Relaxed);
        self.driver.vehicle_mut().turn();
        // However many come, the vehicle has its turn.
        for _ in 0..HEARD {
            let Ok(heard) = self.link.heard.try_recv() else { break };
            self.hear(heard);
        }
        self.probe();
        if self.looked.elapsed() >= LOOKED_AGAIN {
            self.look_at_certificates();
        }
        let now = self.began.elapsed();
        let turned = self.driver.turn(now);
        let is_watched = !self.driver.is_stuck(self.began.elapsed()) && !self.driver.is_silent();
        self.driver.vehicle_mut().give_up(!is_watched);
        match turned {
            Err(error) => {
                let why = format!("the record cannot be written: {error}");
                self.log_news(|gateway| &mut gateway.unwritten, Some(why));
            }
            Ok(()) if self.driver.is_kept() => self.unwritten = None,
            Ok(()) => {}
        }
        let failed = self.driver.failed().map(str::to_owned);
        self.log_news(|gateway| &mut gateway.failed, failed);
        // Nothing is said that would not be known after a restart.
        if self.driver.is_kept() {
            self.publish();
        }
        self.seen.linked.store(self.driver.machine.is_linked(), Ordering::Relaxed);
        self.seen.out_of_service.store(self.tried.is_some(), Ordering::Relaxed);
    }

    /// Logs why something is not done, unless that is what was logged last.
    fn log_news(&mut self, last: impl Fn(&mut Self) -> &mut Option<String>, now: Option<String>) {
        let last = last(self);
        if *last != now {
            *last = now;
            if let Some(why) = last.clone() {
                log::line(format_args!("{}: {why}", self.serial_number));
            }
        }
    }

    /// Warns of certificates that expire soon. Their files are read elsewhere, as their disk may hang.
    fn look_at_certificates(&mut self) {
        self.looked = Instant::now();
        let mut alarms = Vec::new();
        for whose in Whose::ALL {
            let Some(end) = self.seen.expiry.of(whose) else { continue };
            let left = end.duration_since(SystemTime::now()).unwrap_or_default();
            let within = EXPIRES_WITHIN.into_iter().find(|days| left < Duration::from_secs(days * 24 * 3_600));
            let before = std::mem::replace(&mut self.expires[whose as usize], within);
            let Some(days) = within else { continue };
            let (word, end) = (whose.word(), humantime::format_rfc3339_seconds(end));
            if within != before {
                log::line(format_args!(
                    "{}: the {word}'s certificate expires within {days} days: {end}",
                    self.serial_number
                ));
            }
            let text = format!("the {word}'s certificate expires within {days} days");
            let refusal = Refusal::new(Kind::CertificateExpires, text);
            alarms.push(refusal.about("certificate", word).about("expires", end));
        }
        self.driver.machine.alarm(alarms);
    }

    fn hear(&mut self, heard: Heard) {
        match heard {
            Heard::Connected(client) => {
                self.client = Some(client);
                self.probed = [Instant::now(); 2];
                self.shown = None;
                self.broker(true);
                self.look_at_certificates();
            }
            Heard::Lost(why) => {
                let was_there = self.client.take().is_some();
                if was_there || self.lost.as_ref() != Some(&why) {
                    log::line(format_args!("{}: the broker is away: {why}", self.serial_number));
                    self.lost = Some(why);
                }
                self.broker(false);
            }
            Heard::Message(topic, is_retained, bytes) => match topic.as_str() {
                "order" => match self.checked::<Order>("order", is_retained, &bytes) {
                    Ok(order) => match self.is_of_now("order", &order.header) {
                        Ok(()) => self.driver.machine.order(order),
                        Err(refusal) => self.refuse(&refusal),
                    },
                    Err(refusal) => self.refuse(&refusal),
                },
                "instantActions" => match self.own_probe(&bytes) {
                    None => match self.checked("instantActions", is_retained, &bytes) {
                        Ok(message) => self.at_once(message),
                        Err(refusal) => self.refuse(&refusal),
                    },
                    sent => self.hear_probe(sent),
                },
                "zoneSet" => match self.checked("zoneSet", is_retained, &bytes) {
                    Ok(message) => self.refuse(&unwanted_zones(&message)),
                    Err(refusal) => self.refuse(&refusal),
                },
                "responses" => match self.checked("responses", is_retained, &bytes) {
                    Ok(message) => self.refuse(&unwanted_responses(&message)),
                    Err(refusal) => self.refuse(&refusal),
                },
                "connection" => self.hear_connection(&bytes),
                _ => self.hear_probe(std::str::from_utf8(&bytes).ok().and_then(|text| text.parse().ok())),
            },
            Heard::TooLong(topic, bytes) => {
                self.seen.received.fetch_add(1, Ordering::Relaxed);
                let text = format!("the message has {bytes} bytes, and {LARGEST} at most are read");
                let refusal = Refusal::new(Kind::Validation, text);
                // Of one that is too long to be held nothing else is known.
                self.refuse(&topic.into_iter().fold(refusal, |refusal, topic| refusal.about("topic", topic)));
            }
            Heard::Acknowledged => {}
        }
    }

    /// What stops the vehicle counts whenever it was sent, and whatever the master's clock says.
    fn at_once(&mut self, mut message: InstantActions) {
        if let Err(refusal) = self.is_of_now("instantActions", &message.header) {
            let sent = message.actions.len();
            message.actions.retain(is_stop);
            if message.actions.len() < sent {
                self.refuse(&refusal);
            }
        }
        self.driver.machine.instant_actions(message);
    }

    /// What came while the broker did not answer was sent who knows when.
    fn is_of_now(&self, topic: &str, header: &Header) -> Result<(), Refusal> {
        let refused = |text: &str| {
            let refusal = Refusal::new(Kind::Validation, text).about("topic", topic);
            Err(refusal.about("headerId", header.header_id))
        };
        if !self.is_broker_there {
            return refused("the message came while the broker did not answer");
        }
        if self.config.vda5050.oldest > 0.0 {
            let Ok(sent) = humantime::parse_rfc3339_weak(&header.timestamp) else {
                return refused("the timestamp cannot be read");
            };
            let age = SystemTime::now().duration_since(sent).unwrap_or_default();
            if age.as_secs_f64() > self.config.vda5050.oldest {
                return refused("the message is too old");
            }
        }
        Ok(())
    }

    fn refuse(&mut self, refusal: &Refusal) {
        self.seen.refused.fetch_add(1, Ordering::Relaxed);
        self.driver.machine.refuse(refusal);
    }

    /// What the gateway has said last comes back. Behind that, the last will of an earlier client may come, and is contradicted.
    fn hear_connection(&mut self, bytes: &[u8]) {
        let Ok(Connection { header, connection_state }) = read(self.config.version(), bytes) else { return };
        if (header.header_id, Some(connection_state)) == (self.said, self.shown) {
            self.is_echoed = true;
        } else if self.is_echoed {
            self.shown = None;
        }
    }

    /// A message for this vehicle.
    fn checked<T: serde::de::DeserializeOwned + HasHeader>(
        &self,
        topic: &str,
        is_retained: bool,
        bytes: &[u8],
    ) -> Result<T, Refusal> {
        self.seen.received.fetch_add(1, Ordering::Relaxed);
        let refused = |text: String| Refusal::new(Kind::Validation, text).about("topic", topic);
        if is_retained {
            return Err(refused("a retained message is not of now".into()));
        }
        let message: T = read(self.config.version(), bytes).map_err(|error| refused(error.to_string()))?;
        let Header { header_id, version, manufacturer, serial_number, .. } = message.header();
        let refused = |text: &str| Err(refused(text.to_owned()).about("headerId", header_id));
        if (manufacturer, serial_number) != (&self.config.vda5050.manufacturer, &self.serial_number) {
            return refused("the message is for another vehicle");
        }
        if Version::of(version) != Some(self.config.version()) {
            return refused("the message is of another version");
        }
        Ok(message)
    }

    /// A probe says when it was sent: one that was held up proves nothing of now, nor do messages behind it.
    fn hear_probe(&mut self, sent: Option<u64>) {
        let sent =
            sent.map(Duration::from_millis).filter(|sent| *sent <= self.began.elapsed()).map(|sent| self.began + sent);
        self.probed[1] = sent.map_or(self.probed[1], |sent| sent.max(self.probed[1]));
    }

    /// When it was sent, if this is a probe that goes the way of what stops the vehicle.
    fn own_probe(&self, bytes: &[u8]) -> Option<u64> {
        sent_probe(bytes).filter(|_| self.config.broker.probe_stops)
    }

    /// Sends probes, and takes a broker that does not return them for one that is away.
    fn probe(&mut self) {
        let every = Duration::from_millis(self.config.broker.probe);
        let Some(client) = &self.client else { return };
        if every.is_zero() {
            return;
        }
        if self.probed[0].elapsed() >= every {
            self.probed[0] = Instant::now();
            let sent = self.began.elapsed().as_millis();
            let (topic, text) = match self.config.broker.probe_stops {
                true => ("instantActions", probe(&header(&self.config, &self.serial_number, 0), sent)),
                false => ("cara-probe", sent.to_string().into_bytes()),
            };
            let _ = client.try_publish(format!("{}/{topic}", self.prefix), QoS::AtMostOnce, false, text);
        }
        let answers = self.probed[1].elapsed() < Duration::from_millis(self.config.broker.probe_timeout);
        if !answers && self.is_broker_there {
            log::line(format_args!("{}: the broker returns no probe", self.serial_number));
        }
        self.broker(answers);
    }

    fn broker(&mut self, is_there: bool) {
        if self.is_broker_there != is_there {
            self.is_broker_there = is_there;
            self.seen.broker.store(is_there, Ordering::Relaxed);
            self.seen.broker_losses.fetch_add(u64::from(!is_there), Ordering::Relaxed);
            self.driver.machine.broker(is_there, self.began.elapsed());
        }
    }

    fn publish(&mut self) {
        if self.client.is_none() {
            return;
        }
        if self.show_connection().and_then(|()| self.send_state()).is_none() {
            // It is due again.
            self.reported = None;
        }
        if self.driver.machine.take_factsheet_due() {
            let _ = self.send_factsheet();
        }
        self.visualize();
    }

    /// Topic `connection`: ONLINE while the vehicle is linked. A lost link is a broken connection, and nothing else is known.
    fn show_connection(&mut self) -> Option<()> {
        let is_linked = self.driver.machine.is_linked();
        let state = if is_linked { ConnectionState::Online } else { ConnectionState::Broken };
        if self.shown == Some(state) {
            return Some(());
        }
        self.send_connection(state)?;
        self.reported = None;
        Some(())
    }

    fn send_connection(&mut self, connection_state: ConnectionState) -> Option<()> {
        let header = self.header(Topic::Connection);
        (self.said, self.is_echoed) = (header.header_id, false);
        self.will.store(header.header_id.saturating_add(1), Ordering::SeqCst);
        self.send("connection", QoS::AtLeastOnce, true, &Connection { header, connection_state })?;
        self.shown = Some(connection_state);
        Some(())
    }

    fn send_factsheet(&mut self) -> Option<()> {
        let header = self.header(Topic::Factsheet);
        let factsheet = Factsheet { header, ..self.factsheet.clone() };
        self.send("factsheet", QoS::AtMostOnce, true, &factsheet)
    }

    /// Topic `state`: with news, when it was asked for, and every so often.
    fn send_state(&mut self) -> Option<()> {
        let config::Vda5050 { state_every, state_interval, .. } = self.config.vda5050;
        let age = self.reported.as_ref().map(|(_, at)| at.elapsed().as_secs_f64());
        if age.is_some_and(|age| age < state_interval) {
            return Some(());
        }
        let Some(report) = self.driver.machine.report() else { return Some(()) };
        self.seen.errors.store(report.errors.len() as u64, Ordering::Relaxed);
        let has_news = self.reported.as_ref().is_none_or(|(last, _)| lasting(last) != lasting(&report));
        let is_due = self.driver.machine.take_report_due();
        if !(has_news || is_due || age.is_none_or(|age| age >= state_every)) {
            return Some(());
        }
        let header = self.header(Topic::State);
        self.stated = header.header_id;
        self.send("state", QoS::AtMostOnce, false, &State { header, report: report.clone() })?;
        self.reported = Some((report, Instant::now()));
        Some(())
    }

    fn visualize(&mut self) {
        let every = self.config.vda5050.visualization_every;
        if every <= 0.0 || self.visualized.elapsed().as_secs_f64() < every {
            return;
        }
        let Some(Report { agv_position: Some(at), velocity, .. }) = self.driver.machine.report() else { return };
        let header = self.header(Topic::Visualization);
        self.visualized = Instant::now();
        let reference_state_header_id = (self.config.version() == Version::V3).then_some(self.stated);
        let message = Visualization { header, reference_state_header_id, agv_position: Some(at), velocity };
        let _ = self.send("visualization", QoS::AtMostOnce, false, &message);
    }

    fn header(&mut self, topic: Topic) -> Header {
        header(&self.config, &self.serial_number, self.driver.machine.header_id(topic))
    }

    fn send(&self, topic: &str, quality: QoS, is_retained: bool, message: &impl Serialize) -> Option<()> {
        let client = self.client.as_ref()?;
        self.seen.sent.fetch_add(1, Ordering::Relaxed);
        let (topic, payload) = (format!("{}/{topic}", self.prefix), write(self.config.version(), message));
        client.try_publish(&topic, quality, is_retained, payload.clone()).ok()?;
        self.recording.take(true, &topic, is_retained, &payload);
        Some(())
    }

    /// Says what `connection` is from now on, and waits until that has arrived. What moves stops, as its heart goes.
    fn stop(mut self, last: Option<ConnectionState>) {
        self.link.end();
        let end = Instant::now() + LAST_WORDS;
        while !self.driver.keep(self.began.elapsed()).unwrap_or_default() && Instant::now() < end {
            std::thread::sleep(TURN);
        }
        let is_kept = self.driver.is_kept();
        if last.filter(|_| is_kept).is_some_and(|last| self.send_connection(last).is_some()) {
            let end = Instant::now() + LAST_WORDS;
            while let Ok(heard) = self.link.heard.recv_timeout(end.saturating_duration_since(Instant::now())) {
                if matches!(heard, Heard::Acknowledged | Heard::Lost(_)) {
                    break;
                }
            }
        }
        if let Some(client) = &self.client {
            let _ = client.try_disconnect();
            let _ = self.link.heard.recv_timeout(LAST_WORDS);
        }
    }
}

/// What is news when it changes; the rest changes all the time while a vehicle drives.
fn lasting(report: &Report) -> Report {
    let mut report = report.clone();
    (report.agv_position, report.velocity) = (None, None);
    report.distance_since_last_node = None;
    let charging = report.battery_state.charging;
    report.battery_state = BatteryState { charging, ..BatteryState::default() };
    report
}

fn header(config: &Config, serial_number: &str, header_id: u32) -> Header {
    Header {
        header_id,
        timestamp: humantime::format_rfc3339_millis(SystemTime::now()).to_string(),
        version: config.vda5050.version.clone(),
        manufacturer: config.vda5050.manufacturer.clone(),
        serial_number: serial_number.to_owned(),
    }
}

/// No vehicle has zones: `supportedZones` of the factsheet is empty.
fn unwanted_zones(message: &ZoneSetMessage) -> Refusal {
    let refusal = Refusal::new(Kind::Unsupported, "the vehicle has no zones").about("topic", "zoneSet");
    let refusal = refusal.about("headerId", message.header.header_id);
    refusal.about("zoneSetId", &message.zone_set.zone_set_id).about("zoneSet", "zoneSet")
}

/// No vehicle requests anything, so that there is nothing to grant.
fn unwanted_responses(message: &Responses) -> Refusal {
    let refusal = Refusal::new(Kind::Unsupported, "the vehicle has requested nothing").about("topic", "responses");
    let refusal = refusal.about("headerId", message.header.header_id).about("responses", "responses");
    // One error for all, of a bounded size.
    let named = message.responses.iter().take(ERRORS);
    named.fold(refusal, |refusal, response| refusal.about("requestId", &response.request_id))
}

trait HasHeader {
    fn header(&self) -> &Header;
}

macro_rules! has_header {
    ($($message:ty),*) => { $(impl HasHeader for $message {
        fn header(&self) -> &Header {
            &self.header
        }
    })* };
}
has_header!(Order, InstantActions, ZoneSetMessage, Responses);

/// The m_unit whose vehicles these are, not started yet.
pub fn system(config: &Config) -> Result<CommunicationSystem> {
    let config::Manager { name, id, fleet, key_file, state_folder, only_this_host, .. } = &config.manager;
    let mut builder = CommunicationSystem::builder(name, *id)?.fleet(*fleet).state_folder(state_folder);
    if let Some(file) = key_file {
        builder = builder.key_file(file);
    }
    if *only_this_host {
        builder = builder.interfaces(cara_std::Interfaces::Loopback);
    }
    Ok(builder.build()?)
}

/// Looks at all that a start needs, and changes nothing: the file, the factsheet, the keys, TLS, and the records.
pub fn check(config: &Config) -> Result<()> {
    for vehicle in &config.vehicle {
        crate::tls::client(&config.broker.of(vehicle), &Arc::default())?;
    }
    let folder = config.records();
    for vehicle in &config.vehicle {
        if folder.join(format!("{}.json", vehicle.serial_number)).exists() {
            Store::open(Path::new(&folder), &vehicle.serial_number)?;
        }
    }
    check_vehicles(config, &system(config)?)
}

/// What no vehicle can do without.
pub fn check_vehicles(config: &Config, system: &CommunicationSystem) -> Result<()> {
    config.factsheet()?;
    for vehicle in &config.vehicle {
        let identity = Identity::s_unit(&vehicle.name, vehicle.id)?;
        system.node(&identity).with_context(|| format!("there are no keys for {}", vehicle.name))?;
    }
    Ok(())
}
