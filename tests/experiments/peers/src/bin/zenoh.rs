//! zenoh: a get that a queryable answers, and puts that zenoh batches. Peers with fixed endpoints, no scouting.

use std::net::{SocketAddr, TcpListener};
use std::sync::{Arc, Mutex, PoisonError};
use std::thread;
use std::time::{Duration, Instant};

use anyhow::{Context, Result, anyhow, ensure};
use cara_bench_ends::{Caller, Delivery, Executed, Peer, Place, Server};
use zenoh::pubsub::Publisher;
use zenoh::qos::CongestionControl;
use zenoh::query::Querier;
use zenoh::{Config, Session, Wait};

/// How long the two may take to learn of each other.
const PATIENCE: Duration = Duration::from_secs(20);
/// How long one get may take.
const TIMEOUT: Duration = Duration::from_secs(10);

/// The session that all callers of a process share, as its makers advise.
#[derive(Default)]
struct Zenoh {
    session: Mutex<Option<Session>>,
}

fn open(listens: Option<&str>, connects: Option<&str>) -> Result<Session> {
    let mut config = Config::default();
    let list = |endpoint: Option<&str>| endpoint.map_or("[]".into(), |endpoint| format!("[\"{endpoint}\"]"));
    for (key, value) in [
        ("mode", "\"peer\"".to_owned()),
        ("scouting/multicast/enabled", "false".to_owned()),
        ("scouting/gossip/enabled", "false".to_owned()),
        ("listen/endpoints", list(listens)),
        ("connect/endpoints", list(connects)),
    ] {
        config.insert_json5(key, &value).map_err(|error| anyhow!("{key}: {error}"))?;
    }
    zenoh::open(config).wait().map_err(|error| anyhow!("{error}"))
}

impl Peer for Zenoh {
    fn start_server(&self, place: &Place) -> Result<Server> {
        let free: SocketAddr = TcpListener::bind((place.host(), 0))?.local_addr()?;
        let address = format!("tcp/{free}");
        let session = open(Some(&address), None)?;
        let echo = session.declare_queryable("echo").callback(|query| {
            let text = query.payload().and_then(|payload| payload.try_to_string().ok());
            let text = text.unwrap_or_default().into_owned();
            // The client may be gone.
            let _ = query.reply(query.key_expr().clone(), text).wait();
        });
        let executed = Arc::new(Executed::default());
        let counted = executed.clone();
        let take = session.declare_subscriber("take").callback(move |sample| {
            let text = sample.payload().try_to_string().map(|text| text.into_owned());
            if text.is_ok() {
                counted.note();
            }
        });
        let echo = echo.wait().map_err(|error| anyhow!("{error}"))?;
        let take = take.wait().map_err(|error| anyhow!("{error}"))?;
        Ok(Server::new(address, executed, (session, echo, take)))
    }

    fn connect(&self, _: &Place, address: &str) -> Result<Box<dyn Caller>> {
        let session = {
            let mut session = self.session.lock().unwrap_or_else(PoisonError::into_inner);
            let open = match session.take() {
                Some(open) => open,
                None => open(None, Some(address))?,
            };
            session.insert(open).clone()
        };
        let echo = session.declare_querier("echo").timeout(TIMEOUT).wait().map_err(|error| anyhow!("{error}"))?;
        let take = session.declare_publisher("take").congestion_control(CongestionControl::Block).express(false);
        let take = take.wait().map_err(|error| anyhow!("{error}"))?;
        let mut calls = Calls { _session: session, echo, take };
        let end = Instant::now() + PATIENCE;
        while calls.echo("").is_err() || !calls.has_subscriber()? {
            ensure!(Instant::now() < end, "zenoh's queryable or subscriber was not found");
            thread::sleep(Duration::from_millis(10));
        }
        Ok(Box::new(calls))
    }
}

struct Calls {
    _session: Session,
    echo: Querier<'static>,
    take: Publisher<'static>,
}

impl Calls {
    fn has_subscriber(&self) -> Result<bool> {
        Ok(self.take.matching_status().wait().map_err(|error| anyhow!("{error}"))?.matching())
    }
}

impl Caller for Calls {
    fn echo(&mut self, text: &str) -> Result<usize> {
        let replies = self.echo.get().payload(text.to_owned()).wait().map_err(|error| anyhow!("{error}"))?;
        let reply = replies.recv().ok().context("no reply")?;
        let sample = reply.result().map_err(|error| anyhow!("{error:?}"))?;
        Ok(sample.payload().try_to_string()?.into_owned().len())
    }

    fn send(&mut self, text: &str, _: Delivery) -> Result<(), String> {
        self.take.put(text.to_owned()).wait().map_err(|error| error.to_string())
    }
}

fn main() -> Result<()> {
    cara_bench_ends::main(&Zenoh::default())
}
