//! Exclusive leadership of CARA's managers through [etcd](https://etcd.io), 3.4 or newer: of all managers of one identity the one
//! that created a key under its own lease may claim. It asks over etcd's JSON gateway, with one blocking request at a time, so that
//! a build needs neither an asynchronous runtime nor `protoc`.
//!
//! ```no_run
//! use cara_etcd::Etcd;
//! use cara_std::{CommunicationSystem, UnitEvent};
//!
//! let etcd = Etcd::new(["http://10.0.0.1:2379", "http://10.0.0.2:2379", "http://10.0.0.3:2379"]);
//! let depot = CommunicationSystem::builder("depot", 1)?.standby().authority(etcd).build()?;
//! let events = depot.events();
//! depot.start()?;
//! for event in events {
//!     match event {
//!         UnitEvent::Leading { claim } => println!("leads with the claim {claim}"),
//!         UnitEvent::NotLeading => println!("does not lead"),
//!         _ => {}
//!     }
//! }
//! # Ok::<(), cara_std::BuildError>(())
//! ```
//!
//! The key is the prefix, the fleet, and the manager's name and id: `cara/leaders/7/depot/1`. Its value is the process that has it, for
//! people. Whoever may write there decides who leads. Do not delete it by hand: its holder counts on it until it asks again, and two
//! would lead meanwhile. A holder that has ended, or hangs, loses it with its lease.

use std::error::Error;
use std::time::Duration;

use base64::Engine as _;
use base64::engine::general_purpose::STANDARD as BASE64;
use cara_std::{Authority, Fleet, Identity, Key};
use serde_json::{Value, json};
use ureq::Agent;
#[cfg(feature = "tls")]
pub use ureq::tls;

/// How long a lease lasts unless set.
const SPAN: Duration = Duration::from_secs(5);

/// A cluster of etcd, to be given to [`Builder::authority`](cara_std::Builder::authority).
#[derive(Debug)]
pub struct Etcd {
    endpoints: Vec<String>,
    /// The one that is asked; another one after each failure.
    asked: usize,
    prefix: String,
    span: Duration,
    user: Option<User>,
    #[cfg(feature = "tls")]
    tls: tls::TlsConfig,
    /// From the first question on.
    agent: Option<Agent>,
    /// The lease that this manager has, with or without the key.
    lease: Option<String>,
}

struct User {
    name: String,
    password: String,
    token: Option<String>,
}

impl std::fmt::Debug for User {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.debug_struct("User").field("name", &self.name).finish_non_exhaustive()
    }
}

impl Etcd {
    /// The members' addresses for clients, as `http://10.0.0.1:2379`.
    pub fn new<S: Into<String>>(endpoints: impl IntoIterator<Item = S>) -> Self {
        Self {
            endpoints: endpoints.into_iter().map(Into::into).collect(),
            asked: 0,
            prefix: "cara/leaders/".to_owned(),
            span: SPAN,
            user: None,
            #[cfg(feature = "tls")]
            tls: tls::TlsConfig::default(),
            agent: None,
            lease: None,
        }
    }

    /// What the keys begin with; `cara/leaders/` unless set.
    pub fn prefix(mut self, prefix: impl Into<String>) -> Self {
        self.prefix = prefix.into();
        self
    }

    /// How long a lease lasts, in whole seconds; 5 s unless set. So long after the end of a manager another one gets the key. It is
    /// renewed three times in it, and a request waits for a quarter of it. etcd makes a shorter one as long as its elections need: 2 s
    /// with its defaults.
    pub fn lease(mut self, span: Duration) -> Self {
        self.span = span.max(Duration::from_secs(1));
        self
    }

    /// A user of etcd who may read and write the keys.
    pub fn user(mut self, name: impl Into<String>, password: impl Into<String>) -> Self {
        self.user = Some(User { name: name.into(), password: password.into(), token: None });
        self
    }

    /// The roots and the certificate for endpoints that begin with `https`.
    #[cfg(feature = "tls")]
    pub fn tls(mut self, tls: tls::TlsConfig) -> Self {
        self.tls = tls;
        self
    }

    fn agent(&self) -> Agent {
        let config = Agent::config_builder().http_status_as_error(false).proxy(None);
        #[cfg(feature = "tls")]
        let config = config.tls_config(self.tls.clone());
        config.timeout_global(Some(self.span / 4)).build().new_agent()
    }

    fn post(&mut self, path: &str, body: &Value) -> Result<Value, Refused> {
        let endpoint = self.endpoints.get(self.asked).ok_or(Refused::NoEndpoint)?;
        let agent = self.agent.clone().unwrap_or_else(|| self.agent());
        let mut request = agent.post(format!("{}/v3/{path}", endpoint.trim_end_matches('/')));
        if let Some(token) = self.user.as_ref().and_then(|user| user.token.as_ref()) {
            request = request.header("Authorization", token);
        }
        let answered = request.send(body.to_string()).and_then(|mut answer| answer.body_mut().read_to_string());
        let text = answered.map_err(|error| Refused::Silent { endpoint: endpoint.clone(), error })?;
        self.agent = Some(agent);
        let answer: Value = serde_json::from_str(&text).unwrap_or_default();
        // An answer of a stream is inside of another object.
        let answer = answer.get("result").unwrap_or(&answer);
        if answer.get("header").is_some() { Ok(answer.clone()) } else { Err(Refused::Answer(text)) }
    }

    fn log_in(&mut self) -> Result<(), Refused> {
        let Some(User { name, password, token: None }) = &self.user else { return Ok(()) };
        let answer = self.post("auth/authenticate", &json!({ "name": name, "password": password }))?;
        if let Some(user) = &mut self.user {
            user.token = answer["token"].as_str().map(str::to_owned);
        }
        Ok(())
    }

    /// The key with the lease's time, if it is this manager's.
    fn ask(&mut self, key: &str) -> Result<Option<Key>, Refused> {
        self.log_in()?;
        let mut lease = None;
        if let Some(id) = self.lease.take() {
            let answer = self.post("lease/keepalive", &json!({ "ID": id }));
            // After no answer it may be there all the same.
            self.lease = Some(id);
            lease = Some(Lease::of(&answer?)).filter(|lease| lease.seconds > 0);
        }
        self.lease = lease.as_ref().map(|lease| lease.id.clone());
        let answer = self.post("kv/range", &json!({ "key": key }))?;
        if let Some(found) = answer["kvs"].get(0) {
            return match lease.filter(|lease| found["lease"] == lease.id) {
                Some(lease) => lease.key(&answer, number(&found["create_revision"])).map(Some),
                None => Ok(None),
            };
        }
        let lease = match lease {
            Some(lease) => lease,
            None => Lease::of(&self.post("lease/grant", &json!({ "TTL": self.span.as_secs() }))?),
        };
        self.lease = Some(lease.id.clone());
        let value = BASE64.encode(format!("process {}", std::process::id()));
        let create = json!({
            "compare": [{ "key": key, "target": "CREATE", "create_revision": "0" }],
            "success": [{ "request_put": { "key": key, "value": value, "lease": lease.id } }],
        });
        let answer = self.post("kv/txn", &create)?;
        let is_created = answer["succeeded"] == true;
        is_created.then(|| lease.key(&answer, number(&answer["header"]["revision"]))).transpose()
    }
}

impl Authority for Etcd {
    fn hold(&mut self, manager: &Identity, fleet: Fleet) -> Result<Option<Key>, Box<dyn Error + Send + Sync>> {
        let key = format!("{}{}/{}/{}", self.prefix, fleet.0, manager.name(), manager.id());
        // One endpoint answers all of it.
        let answer = self.ask(&BASE64.encode(key));
        if answer.is_err() {
            self.asked = (self.asked + 1) % self.endpoints.len().max(1);
            if let Some(user) = &mut self.user {
                user.token = None;
            }
        }
        Ok(answer?)
    }

    fn release(&mut self) {
        if let Some(id) = self.lease.take() {
            // Without an answer its time ends it.
            let _ = self.post("lease/revoke", &json!({ "ID": id }));
        }
    }
}

/// A lease as an answer shows it.
struct Lease {
    id: String,
    seconds: u64,
    raft_term: u64,
}

impl Lease {
    fn of(answer: &Value) -> Self {
        let id = answer["ID"].as_str().unwrap_or_default().to_owned();
        Self { id, seconds: number(&answer["TTL"]), raft_term: number(&answer["header"]["raft_term"]) }
    }

    /// The key of this lease, as a later answer shows it. A leader that another one has replaced renews leases that end earlier
    /// than it says, so that an answer under another leader does not count.
    fn key(self, later: &Value, revision: u64) -> Result<Key, Refused> {
        if self.raft_term != number(&later["header"]["raft_term"]) {
            return Err(Refused::LeaderChanged);
        }
        Ok(Key { revision, lasts: Duration::from_secs(self.seconds).into() })
    }
}

/// The gateway writes whole numbers of 64 bits as strings, and leaves zeros out.
fn number(value: &Value) -> u64 {
    value.as_str().and_then(|digits| digits.parse().ok()).unwrap_or_default()
}

/// Why etcd did not say who has the key.
#[derive(Debug, thiserror::Error)]
enum Refused {
    #[error("no endpoint of etcd is set")]
    NoEndpoint,
    #[error("etcd does not answer at {endpoint}: {error}")]
    Silent { endpoint: String, error: ureq::Error },
    #[error("etcd refuses: {0}")]
    Answer(String),
    #[error("etcd has elected another leader meanwhile")]
    LeaderChanged,
}
