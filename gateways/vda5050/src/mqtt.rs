//! The connection of one vehicle to the broker (6.2, 6.14): one client per vehicle, as a last will is a client's.
//!
//! Each connection is a client of its own, so that nothing that was queued before a loss is sent behind it, and files of TLS are read
//! again.

use std::iter::repeat;
use std::panic::{AssertUnwindSafe, catch_unwind};
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::mpsc::{Receiver, SyncSender, sync_channel};
use std::time::{Duration, Instant};

use anyhow::{Context, Result, anyhow, bail, ensure};
use rumqttc::{
    Client, ConnectionError, Event, LastWill, MqttOptions, Packet, QoS, RecvTimeoutError, StateError, SubscribeFilter,
    SubscribeReasonCode, TlsConfiguration, Transport, mqttbytes,
};

use crate::config;
use crate::log;
use crate::recording::Recording;
use crate::tls::{self, Expiry};

/// The largest message that is read, in bytes. A longer one is refused.
pub const LARGEST: usize = 512 * 1024;
/// One that is longer than that ends the connection: it would have to be held.
const LARGEST_TAKEN: usize = 16 * 1024 * 1024;
/// The largest that is sent: a state has all nodes and actions that are left, which came in many messages.
const LARGEST_SENT: usize = 16 * 1024 * 1024;
/// Without these the broker counts as away: whom no stop reaches must not drive, and an unanswered probe says the same.
const NEEDED: [&str; 3] = ["order", "instantActions", "cara-probe"];
/// Messages that wait to be sent.
const WAITING: usize = 256;
/// Messages that wait to be looked at: as many are looked at in one turn of the loop.
pub const HEARD: usize = 16;
/// A broker that has not answered the subscriptions for so long counts as away, as one that has refused them.
const ANSWERED: Duration = Duration::from_secs(5);
/// Between two attempts to connect.
const BACK_OFF: Duration = Duration::from_secs(1);

/// What came of the broker.
pub enum Heard {
    /// There is a connection, and the broker has taken the subscriptions that are needed.
    Connected(Client),
    /// It has ended, or there is none.
    Lost(String),
    /// The last level of its topic, whether it is a retained one, and its bytes.
    Message(String, bool, Vec<u8>),
    /// One with more than [`LARGEST`] bytes: the last level of its topic, if that was read, and how many. One that ends the connection
    /// is told of before that.
    TooLong(Option<String>, usize),
    /// What was sent with quality of service 1 has arrived.
    Acknowledged,
}

/// What a client is.
pub struct Place {
    /// The broker.
    pub broker: config::Broker,
    /// Name of the client: the same for each gateway that speaks for this vehicle, so that the broker knows one.
    pub client_id: String,
    /// Its topics without their last level.
    pub prefix: String,
    /// The last levels of those that it hears.
    pub topics: Vec<&'static str>,
    /// The message on topic `connection` if it goes away.
    pub will: Box<dyn Fn() -> Vec<u8> + Send>,
    /// Where what comes is recorded.
    pub recording: Recording,
    /// What is seen of certificates.
    pub expiry: Arc<Expiry>,
}

/// A thread that stays connected.
pub struct Link {
    /// What it hears. One that is not emptied loses messages.
    pub heard: Receiver<Heard>,
    ends: Arc<AtomicBool>,
}

impl Link {
    /// Starts it.
    pub fn start(place: Place) -> Result<Self> {
        let (sender, heard) = sync_channel(HEARD);
        let ends = Arc::new(AtomicBool::new(false));
        let ended = ends.clone();
        std::thread::Builder::new().name(format!("mqtt {}", place.client_id)).spawn(move || {
            while !ended.load(Ordering::SeqCst) {
                // One that has panicked, as where the resolver's thread cannot be started, is tried again like any other.
                let ended = catch_unwind(AssertUnwindSafe(|| connection(&place, &sender)));
                let ended = ended.unwrap_or_else(|_| Err(anyhow!("the connection has panicked")));
                let why = ended.err().map_or_else(String::new, |error| reason(&error));
                if sender.send(Heard::Lost(why)).is_err() {
                    return;
                }
                std::thread::sleep(BACK_OFF);
            }
        })?;
        Ok(Self { heard, ends })
    }

    /// It does not connect again.
    pub fn end(&self) {
        self.ends.store(true, Ordering::SeqCst);
    }
}

impl Drop for Link {
    fn drop(&mut self) {
        self.end();
    }
}

/// An error with its causes; those of rumqttc have theirs in their own text.
fn reason(error: &anyhow::Error) -> String {
    let mut reason = String::new();
    for cause in error.chain().map(ToString::to_string) {
        if !reason.contains(&cause) {
            let colon = if reason.is_empty() { "" } else { ": " };
            reason = format!("{reason}{colon}{cause}");
        }
    }
    reason
}

/// One connection, until it ends.
fn connection(place: &Place, sender: &SyncSender<Heard>) -> Result<()> {
    let (client, mut connection) = Client::new(options(place)?, WAITING);
    // Who listens holds the only one then: when that goes, the connection ends without a farewell, and the last will is sent.
    let mut client = Some(client);
    let mut subscribed: Option<Instant> = None;
    loop {
        let left = subscribed.filter(|_| client.is_some()).map(|since| ANSWERED.saturating_sub(since.elapsed()));
        ensure!(left != Some(Duration::ZERO), "the broker does not answer the subscriptions");
        let event = match left {
            None => connection.recv().map_err(|_| RecvTimeoutError::Disconnected),
            Some(left) => connection.recv_timeout(left),
        };
        let event = match event {
            Ok(event) => event,
            // It is looked at above.
            Err(RecvTimeoutError::Timeout) => continue,
            Err(RecvTimeoutError::Disconnected) => return Ok(()),
        };
        if let Err(error) = &event
            && let Some(bytes) = too_long(error)
        {
            sender.send(Heard::TooLong(None, bytes)).context("nobody listens")?;
            bail!("a message of {bytes} bytes came: one with more than {LARGEST_TAKEN} ends the connection");
        }
        let heard = match event? {
            Event::Incoming(Packet::ConnAck(_)) => {
                subscribed = Some(Instant::now());
                let filter = |topic: &&str| SubscribeFilter::new(format!("{}/{topic}", place.prefix), QoS::AtMostOnce);
                if let Some(client) = &client {
                    client.try_subscribe_many(place.topics.iter().map(filter))?;
                }
                continue;
            }
            Event::Incoming(Packet::SubAck(answer)) => {
                // What is not answered is refused.
                let codes = answer.return_codes.into_iter().chain(repeat(SubscribeReasonCode::Failure));
                let codes = place.topics.iter().zip(codes);
                for (topic, _) in codes.filter(|(_, code)| *code == SubscribeReasonCode::Failure) {
                    let text = format!("the broker refuses to send {topic} of {}", place.prefix);
                    ensure!(!NEEDED.contains(topic), text);
                    log::line(text);
                }
                match client.take() {
                    Some(client) => Heard::Connected(client),
                    None => continue,
                }
            }
            Event::Incoming(Packet::PubAck(_)) => Heard::Acknowledged,
            Event::Incoming(Packet::Publish(message)) => {
                let topic = message.topic.strip_prefix(&place.prefix).and_then(|topic| topic.strip_prefix('/'));
                let Some(topic) = topic else { continue };
                place.recording.take(false, &message.topic, message.retain, &message.payload);
                if message.payload.len() > LARGEST {
                    Heard::TooLong(Some(topic.to_owned()), message.payload.len())
                } else {
                    Heard::Message(topic.to_owned(), message.retain, message.payload.to_vec())
                }
            }
            Event::Incoming(Packet::Disconnect) | Event::Outgoing(rumqttc::Outgoing::Disconnect) => return Ok(()),
            _ => continue,
        };
        // One that waits holds the connection back, and the broker with it.
        sender.send(heard).context("nobody listens")?;
    }
}

/// How many bytes a message has that ends the connection, if that is why it ends.
const fn too_long(error: &ConnectionError) -> Option<usize> {
    match error {
        ConnectionError::MqttState(StateError::Deserialization(mqttbytes::Error::PayloadSizeLimitExceeded(bytes))) => {
            Some(*bytes)
        }
        _ => None,
    }
}

fn options(place: &Place) -> Result<MqttOptions> {
    let Place { broker, client_id, prefix, will, expiry, .. } = place;
    let mut options = MqttOptions::new(client_id, &broker.host, broker.port);
    options.set_keep_alive(Duration::from_secs(broker.keep_alive.into()));
    options.set_clean_session(true).set_max_packet_size(LARGEST_TAKEN, LARGEST_SENT);
    options.set_last_will(LastWill::new(format!("{prefix}/connection"), will(), QoS::AtLeastOnce, true));
    if let Some(user) = &broker.user {
        let password = match &broker.password_file {
            Some(file) => std::fs::read_to_string(file).with_context(|| format!("cannot read {}", file.display()))?,
            None => String::new(),
        };
        options.set_credentials(user, password.trim_end());
    }
    if let Some(tls) = tls::client(broker, expiry)? {
        options.set_transport(Transport::tls_with_config(TlsConfiguration::Rustls(Arc::new(tls))));
    }
    Ok(options)
}
