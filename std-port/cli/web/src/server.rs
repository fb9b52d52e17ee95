//! The paths, and what all of them share.

use std::collections::HashMap;
use std::sync::atomic::AtomicU64;
use std::sync::{Arc, Mutex};

use axum::extract::{Extension, State};
use axum::http::header;
use axum::response::{IntoResponse, Response};
use axum::routing::{get, post};
use axum::{Router, middleware};
use cara_map::Grid;
use tokio::sync::Semaphore;

use crate::asking::Hold;
use crate::door::Door;
use crate::guard::{self, Guard};
use crate::limits::{Limits, STOPS_OF_ALL, STOPS_OF_ONE};
use crate::lines::Caller;
use crate::picture::Picture;
use crate::start::Prepared;
use crate::users::User;
use crate::{Unit, asking, map, page, push, watching};

/// What all requests share.
pub(crate) struct Shared {
    pub(crate) unit: Arc<dyn Unit>,
    pub(crate) guard: Guard,
    pub(crate) limits: Arc<Limits>,
    pub(crate) picture: Mutex<Picture>,
    pub(crate) map: Option<Grid>,
    pub(crate) holds: Mutex<HashMap<u64, Hold>>,
    pub(crate) next_hold: AtomicU64,
    pub(crate) stops_of_all: Arc<Semaphore>,
    pub(crate) stops_of_one: Arc<Semaphore>,
    /// One question about functions at a time, and one survey of the network.
    pub(crate) functions: Semaphore,
    pub(crate) surveys: Semaphore,
}

impl Shared {
    pub(crate) fn new(unit: Arc<dyn Unit>, guard: Guard, map: Option<Grid>) -> Arc<Self> {
        Arc::new(Self {
            unit,
            guard,
            limits: Arc::new(Limits::new()),
            picture: Mutex::new(Picture::new()),
            map,
            holds: Mutex::default(),
            next_hold: AtomicU64::new(1),
            stops_of_all: Arc::new(Semaphore::new(STOPS_OF_ALL)),
            stops_of_one: Arc::new(Semaphore::new(STOPS_OF_ONE)),
            functions: Semaphore::new(1),
            surveys: Semaphore::new(1),
        })
    }
}

/// Serves until the process ends.
pub(crate) fn serve(prepared: Prepared, unit: Arc<dyn Unit>) -> anyhow::Result<()> {
    let Prepared { listener, tls, guard, map, .. } = prepared;
    let shared = Shared::new(unit, guard, map);
    watching::start(&shared)?;
    let runtime = tokio::runtime::Builder::new_multi_thread().worker_threads(2).enable_all().build()?;
    runtime.block_on(async {
        let listener = tokio::net::TcpListener::from_std(listener)?;
        let door = Door::open(listener, tls, shared.limits.clone())?;
        axum::serve(door, router(shared).into_make_service_with_connect_info::<Caller>()).await?;
        Ok(())
    })
}

pub(crate) fn router(shared: Arc<Shared>) -> Router {
    Router::new()
        .route("/", get(page::index))
        .route("/{file}", get(page::named))
        .route("/api/stream", get(push::stream))
        .route("/api/map", get(background))
        .route("/api/functions", post(asking::functions))
        .route("/api/call", post(asking::call))
        .route("/api/beat", post(asking::beat))
        .route("/api/ready", post(asking::ready))
        .route("/api/stop", post(asking::stop))
        .route("/api/reset", post(asking::reset))
        .route("/api/doctor", post(asking::doctor))
        .route("/api/managers", post(asking::managers))
        .layer(middleware::from_fn_with_state(shared.clone(), guard::pass))
        .with_state(shared)
}

/// The map, or null.
async fn background(State(shared): State<Arc<Shared>>, Extension(user): Extension<Arc<User>>) -> Response {
    if let Some(refusal) = guard::unseen(&user) {
        return refusal;
    }
    let map = shared.map.as_ref().map_or(serde_json::Value::Null, map::json);
    ([(header::CONTENT_TYPE, "application/json")], map.to_string()).into_response()
}
