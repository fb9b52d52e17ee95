//! `GET /metrics` in Prometheus' text form, over plain HTTP.

use std::io;
use std::net::{SocketAddr, TcpListener};
use std::sync::Arc;

use axum::Router;
use axum::http::{StatusCode, header};
use axum::response::{IntoResponse, Response};
use axum::routing::get;

/// Answers with the text of the metrics, or `None` once the unit has ended.
pub(super) type Metrics = Arc<dyn Fn() -> Option<String> + Send + Sync>;

/// What Prometheus expects of the text form.
const CONTENT_TYPE: &str = "text/plain; version=0.0.4; charset=utf-8";

/// Opens the port, so that one in use shows before the node starts.
pub(super) fn listen(address: SocketAddr) -> io::Result<TcpListener> {
    let listener = TcpListener::bind(address)?;
    listener.set_nonblocking(true)?;
    Ok(listener)
}

/// Serves metrics in a thread of its own, until the process ends.
pub(super) fn serve(listener: TcpListener, metrics: Metrics) -> io::Result<()> {
    let runtime = tokio::runtime::Builder::new_current_thread().enable_io().enable_time().build()?;
    let serve = async move {
        let listener = tokio::net::TcpListener::from_std(listener)?;
        axum::serve(listener, router(metrics)).await
    };
    std::thread::Builder::new().name("cara-metrics".into()).spawn(move || {
        if let Err(error) = runtime.block_on(serve) {
            tracing::error!(%error, "metrics are served no more");
        }
    })?;
    Ok(())
}

fn router(metrics: Metrics) -> Router {
    Router::new().route("/metrics", get(move || std::future::ready(answer(&metrics))))
}

fn answer(metrics: &Metrics) -> Response {
    match metrics() {
        Some(text) => ([(header::CONTENT_TYPE, CONTENT_TYPE)], text).into_response(),
        None => StatusCode::SERVICE_UNAVAILABLE.into_response(),
    }
}
