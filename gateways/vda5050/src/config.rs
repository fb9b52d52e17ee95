//! The gateway's file: `example.toml` shows all of it.

use std::collections::BTreeSet;
use std::net::SocketAddr;
use std::path::{Path, PathBuf};

use anyhow::{Context, Result, ensure};
use serde::Deserialize;

use crate::machine::INSTANT_ACTIONS;
use crate::message::{self, ActionScope, AgvAction, Factsheet, OptionalParameter, Support};
use crate::order::{Capabilities, ID_BYTES};
use crate::state::{OnBrokerLoss, Policy};
use crate::version::Version;

/// All of it.
#[derive(Clone, Debug, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Config {
    /// Who the gateway is among the units of CARA.
    pub manager: Manager,
    /// Where the master is.
    pub broker: Broker,
    /// What goes over MQTT, as MCAP.
    pub recording: Option<Recording>,
    /// How vehicles are shown to it.
    pub vda5050: Vda5050,
    /// What they can do.
    #[serde(default)]
    pub capabilities: Capabilities,
    /// The vehicles.
    pub vehicle: Vec<Vehicle>,
}

/// The m_unit whose vehicles these are.
#[derive(Clone, Debug, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Manager {
    /// Its name.
    pub name: String,
    /// Its ID number.
    pub id: u32,
    /// Its fleet.
    pub fleet: u32,
    /// Its keys, if they are not where `CARA_KEYS` says.
    pub key_file: Option<PathBuf>,
    /// Where its claim and the records of the vehicles are kept.
    pub state_folder: PathBuf,
    /// Where the records are, if other gateways share them: each speaks for the vehicles that are linked to it.
    pub shared_records: Option<PathBuf>,
    /// Where metrics are served, on this host.
    pub metrics: Option<SocketAddr>,
    /// Only vehicles of this host.
    #[serde(default)]
    pub only_this_host: bool,
}

/// The MQTT broker.
#[derive(Clone, Debug, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Broker {
    /// Its name or address.
    pub host: String,
    /// Its port; 8883 is usual with TLS.
    #[serde(default = "port")]
    pub port: u16,
    /// Name and password.
    pub user: Option<String>,
    /// A file with the password.
    pub password_file: Option<PathBuf>,
    /// The authorities of the broker's certificate, as PEM. With it the connection is TLS 1.2 or 1.3.
    pub ca_file: Option<PathBuf>,
    /// The gateway's own certificate, as PEM.
    pub certificate_file: Option<PathBuf>,
    /// Its key.
    pub key_file: Option<PathBuf>,
    /// Seconds between signs of life.
    #[serde(default = "keep_alive")]
    pub keep_alive: u16,
    /// Milliseconds between probes: messages of each vehicle to its own topic `cara-probe` and back. 0 sends none.
    #[serde(default = "probe")]
    pub probe: u64,
    /// Probes go over topic `instantActions` instead, as messages without an action: so that the broker counts as away if it sends no
    /// stop. The client has to be allowed to publish there.
    #[serde(default)]
    pub probe_stops: bool,
    /// Milliseconds without a probe coming back after which the broker counts as away.
    #[serde(default = "probe_timeout")]
    pub probe_timeout: u64,
}

/// A recording, as `cara record` makes them.
#[derive(Clone, Debug, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Recording {
    /// The file. The one before becomes FILE.1.
    pub file: PathBuf,
    /// Bytes after which the next file begins.
    #[serde(default = "max_size")]
    pub max_size: u64,
    /// Files that are kept besides the one that is written.
    #[serde(default = "keep")]
    pub keep: u16,
}

const fn max_size() -> u64 {
    256 << 20
}
const fn keep() -> u16 {
    3
}

const fn port() -> u16 {
    1883
}
const fn keep_alive() -> u16 {
    15
}
const fn probe() -> u64 {
    500
}
const fn probe_timeout() -> u64 {
    2_000
}

/// How vehicles are shown to the master.
#[derive(Clone, Debug, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Vda5050 {
    /// Whole version, as in messages: 2.0.x, 2.1.x or, as a preview, 3.0.x.
    pub version: String,
    /// First level of the topics.
    #[serde(default = "interface_name")]
    pub interface_name: String,
    /// Third level of the topics.
    pub manufacturer: String,
    /// What a vehicle does while the broker is away.
    pub on_broker_loss: OnBrokerLoss,
    /// Whether one that stood for that goes on by itself; else it waits for `stopPause`.
    #[serde(default)]
    pub resumes_by_itself: bool,
    /// Seconds between states while nothing happens, 30 at most.
    #[serde(default = "state_every")]
    pub state_every: f64,
    /// Seconds between states at least, whatever happens.
    #[serde(default = "state_interval")]
    pub state_interval: f64,
    /// Seconds between messages of topic `visualization`; 0 sends none.
    #[serde(default)]
    pub visualization_every: f64,
    /// Orders and instant actions older than so many seconds are refused, but for those that stop; 0 takes all. For synchronised clocks
    /// only.
    #[serde(default)]
    pub oldest: f64,
    /// The factsheet of the series, as JSON.
    pub factsheet: PathBuf,
}

fn interface_name() -> String {
    "uagv".into()
}
const fn state_every() -> f64 {
    10.0
}
const fn state_interval() -> f64 {
    0.2
}

/// A vehicle: an s_unit of CARA.
#[derive(Clone, Debug, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Vehicle {
    /// Its name in CARA.
    pub name: String,
    /// Its ID number in CARA.
    pub id: u32,
    /// Its serial number, the fourth level of its topics.
    pub serial_number: String,
}

impl Broker {
    /// For one vehicle: `{serial}` in its user and its files is the serial number.
    pub fn of(&self, vehicle: &Vehicle) -> Self {
        let named = |text: &str| text.replace("{serial}", &vehicle.serial_number);
        let mut broker = self.clone();
        broker.user = broker.user.map(|user| named(&user));
        let files = [&mut broker.password_file, &mut broker.certificate_file, &mut broker.key_file];
        // A path that is no text has nothing to be replaced.
        files.into_iter().flatten().for_each(|file| {
            if let Some(text) = file.to_str() {
                *file = named(text).into();
            }
        });
        broker
    }
}

impl Config {
    /// Reads and checks a file. Paths in it are relative to its folder.
    pub fn read(file: &Path) -> Result<Self> {
        let text = std::fs::read_to_string(file).with_context(|| format!("cannot read {}", file.display()))?;
        let mut config: Self = toml::from_str(&text).with_context(|| file.display().to_string())?;
        let folder = file.parent().unwrap_or(Path::new(""));
        let Self { manager, broker, recording, vda5050, .. } = &mut config;
        let files =
            [&mut broker.password_file, &mut broker.ca_file, &mut broker.certificate_file, &mut broker.key_file];
        let files = files.into_iter().chain([&mut manager.key_file, &mut manager.shared_records]).flatten();
        files.chain([&mut manager.state_folder, &mut vda5050.factsheet]).for_each(|path| *path = folder.join(&*path));
        if let Some(recording) = recording {
            recording.file = folder.join(&recording.file);
        }
        config.check().with_context(|| file.display().to_string())?;
        Ok(config)
    }

    fn check(&self) -> Result<()> {
        let Self { broker, vda5050, vehicle, .. } = self;
        let is_known = ["2.0.", "2.1.", "3.0."].iter().any(|version| vda5050.version.starts_with(version));
        ensure!(is_known, "version {} is not 2.0.x, 2.1.x or 3.0.x", vda5050.version);
        for level in [&vda5050.interface_name, &vda5050.manufacturer] {
            ensure!(is_level(level, false), "{level:?} cannot be a level of a topic");
        }
        ensure!(!vehicle.is_empty(), "there is no vehicle");
        let (mut serial_numbers, mut units) = (BTreeSet::new(), BTreeSet::new());
        for vehicle in vehicle {
            ensure!(
                units.insert((&vehicle.name, vehicle.id)),
                "vehicle {}/{} is there twice",
                vehicle.name,
                vehicle.id
            );
            let serial = &vehicle.serial_number;
            ensure!(is_level(serial, true), "serial number {serial:?} has other characters than A-Z a-z 0-9 _ . : -");
            ensure!(serial_numbers.insert(serial), "serial number {serial} is there twice");
        }
        let names = self.capabilities.actions.keys().chain(&self.capabilities.maps);
        ensure!(
            names.into_iter().all(|name| name.len() <= ID_BYTES),
            "names of actions and maps have 64 bytes at most"
        );
        let scopes = self.capabilities.actions.values().flat_map(|kind| &kind.scopes);
        ensure!(!scopes.into_iter().any(|scope| *scope == ActionScope::Zone), "no vehicle has zones");
        let seconds = [vda5050.state_every, vda5050.state_interval, vda5050.visualization_every, vda5050.oldest];
        ensure!(seconds.iter().all(|seconds| (0.0..1e6).contains(seconds)), "intervals are from 0 to 1,000,000 s");
        ensure!((1.0..=30.0).contains(&vda5050.state_every), "state_every is from 1 to 30 s (6.10)");
        if let OnBrokerLoss::FinishBase { seconds, metres } = vda5050.on_broker_loss {
            ensure!(
                (0.0..1e6).contains(&seconds) && (0.0..1e6).contains(&metres),
                "limits of finish-base are not negative"
            );
        }
        let metrics = self.manager.metrics;
        ensure!(metrics.is_none_or(|at| at.ip().is_loopback()), "metrics are served at a loopback address only");
        let recording = self.recording.as_ref();
        ensure!(
            recording.is_none_or(|one| one.max_size >= 64 * 1024 && one.keep >= 1),
            "recording: max_size is at least 65536 bytes, and keep at least 1"
        );
        ensure!(broker.keep_alive >= 5, "keep_alive is 5 s at least");
        ensure!(broker.probe == 0 || broker.probe_timeout > broker.probe, "probe_timeout is longer than probe");
        ensure!(broker.probe > 0 || !broker.probe_stops, "probe_stops needs probe");
        ensure!(
            broker.certificate_file.is_some() == broker.key_file.is_some(),
            "a certificate and its key go together"
        );
        ensure!(broker.certificate_file.is_none() || broker.ca_file.is_some(), "TLS needs ca_file");
        ensure!(broker.user.is_some() || broker.password_file.is_none(), "a password needs its user");
        Ok(())
    }

    /// Where the records of the vehicles are.
    pub fn records(&self) -> PathBuf {
        let Manager { state_folder, shared_records, .. } = &self.manager;
        shared_records.clone().unwrap_or_else(|| state_folder.join("vda5050"))
    }

    /// What the vehicles speak.
    pub fn version(&self) -> Version {
        Version::of(&self.vda5050.version).unwrap_or_default()
    }

    /// How a vehicle is driven.
    pub fn policy(&self) -> Policy {
        Policy {
            version: self.version(),
            can: self.capabilities.clone(),
            on_broker_loss: self.vda5050.on_broker_loss,
            resumes_by_itself: self.vda5050.resumes_by_itself,
            // The interface to vehicles has one actuator for actions.
            actions_at_once: 1,
        }
    }

    /// The factsheet of the series. The gateway writes the header, and what it knows itself: limits, optional members and actions.
    pub fn factsheet(&self) -> Result<Factsheet> {
        let file = &self.vda5050.factsheet;
        let text = std::fs::read(file).with_context(|| format!("cannot read {}", file.display()))?;
        let mut value: serde_json::Value = serde_json::from_slice(&text).with_context(|| file.display().to_string())?;
        let object = value.as_object_mut().with_context(|| format!("{} is no JSON object", file.display()))?;
        for (name, any) in [("headerId", 0.into()), ("timestamp", "".into()), ("version", "".into())] {
            object.insert(name.into(), any);
        }
        for name in ["manufacturer", "serialNumber"] {
            object.insert(name.into(), "".into());
        }
        let mut factsheet = message::factsheet(value).with_context(|| file.display().to_string())?;
        self.complete(&mut factsheet);
        if self.version() == Version::V3 {
            self.complete_third(&mut factsheet).with_context(|| file.display().to_string())?;
        }
        Ok(factsheet)
    }

    fn complete(&self, factsheet: &mut Factsheet) {
        let can = &self.capabilities;
        let limits = &mut factsheet.protocol_limits;
        (limits.max_string_lens.id_len, limits.max_string_lens.enum_len) =
            (Some(ID_BYTES as u32), Some(ID_BYTES as u32));
        let nodes = u32::try_from(can.max_nodes).unwrap_or(u32::MAX);
        limits.max_string_lens.msg_len = Some(crate::mqtt::LARGEST as u32);
        let lens = &mut limits.max_array_lens;
        lens.state_loads = Some(crate::stretch::LEGS as u32);
        (lens.order_nodes, lens.order_edges) = (Some(nodes), Some(nodes.saturating_sub(1)));
        limits.timing.min_state_interval = self.vda5050.state_interval;
        limits.timing.default_state_interval = Some(self.vda5050.state_every);
        let position = if can.needs_positions { Support::Required } else { Support::Supported };
        let max_speed = match self.version() {
            Version::V2 => "order.edges.maxSpeed",
            Version::V3 => "order.edges.maximumSpeed",
        };
        let known = [
            ("order.nodes.nodePosition", position),
            ("order.nodes.nodePosition.theta", Support::Supported),
            ("order.nodes.nodePosition.allowedDeviationXY", Support::Supported),
            ("order.nodes.nodePosition.allowedDeviationTheta", Support::Supported),
            (max_speed, Support::Supported),
        ];
        let features = &mut factsheet.protocol_features;
        features.optional_parameters = known
            .map(|(parameter, support)| OptionalParameter { parameter: parameter.into(), support, description: None })
            .into();
        let own_actions = self.version().rules().own_actions;
        let own = own_actions.iter().map(|name| (*name, vec![ActionScope::Instant]));
        let of_vehicle = can.actions.iter().map(|(name, kind)| (name.as_str(), kind.scopes.clone()));
        for (action_type, action_scopes) in own.chain(of_vehicle) {
            match features.agv_actions.iter_mut().find(|action| action.action_type == action_type) {
                Some(action) => action.action_scopes = action_scopes,
                None => {
                    let action_type = action_type.to_owned();
                    features.agv_actions.push(AgvAction { action_type, action_scopes, ..AgvAction::default() });
                }
            }
        }
        let is_there = |action: &AgvAction| {
            own_actions.contains(&action.action_type.as_str()) || can.actions.contains_key(&action.action_type)
        };
        features.agv_actions.retain(is_there);
    }

    /// What 3.0 asks beside that: no zones, and what becomes of an action under a pause and a cancelled order.
    fn complete_third(&self, factsheet: &mut Factsheet) -> Result<()> {
        ensure!(
            factsheet.physical_parameters.height_min.is_some(),
            "3.0 needs physicalParameters.minimumHeight (in 2.x heightMin)"
        );
        let specification = &mut factsheet.type_specification;
        // The names of the model: both may be in the file.
        ensure!(
            !specification.navigation_types.iter().any(|kind| kind == "AUTONOMOUS"),
            "a FREELY_NAVIGATING vehicle reports its planned path in 3.0 (6.8), which the gateway does not know"
        );
        specification.supported_zones = Some(Vec::new());
        let lens = &mut factsheet.protocol_limits.max_array_lens;
        lens.state_instant_action_states =
            Some(u32::try_from(self.capabilities.max_actions.saturating_add(INSTANT_ACTIONS)).unwrap_or(u32::MAX));
        for action in &mut factsheet.protocol_features.agv_actions {
            let kind = self.capabilities.actions.get(&action.action_type);
            action.pause_allowed = Some(false);
            action.cancel_allowed = Some(kind.is_some_and(|kind| kind.can_be_cancelled));
        }
        Ok(())
    }

    /// The topics of a vehicle, up to its own name.
    pub fn prefix(&self, vehicle: &Vehicle) -> String {
        let Vda5050 { interface_name, manufacturer, .. } = &self.vda5050;
        format!("{interface_name}/{}/{manufacturer}/{}", self.version().rules().root, vehicle.serial_number)
    }
}

fn is_level(text: &str, is_serial: bool) -> bool {
    let fits = |letter: char| match letter {
        '_' | '.' | ':' | '-' => true,
        _ if is_serial => letter.is_ascii_alphanumeric(),
        _ => !letter.is_control() && !"/+#$".contains(letter),
    };
    // A serial number names a file as well.
    !text.is_empty()
        && text.len() <= 64
        && text.trim() == text
        && text.chars().all(fits)
        && !text.chars().all(|letter| letter == '.')
}
