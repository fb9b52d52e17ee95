//! `GET /metrics` in Prometheus' text form, over plain HTTP.

use std::io;
use std::net::{SocketAddr, TcpListener};
use std::sync::Arc;

use axum::Router;
use axum::http::{StatusCode, header};
use axum::response::{IntoResponse, Response};
use axum::routing::get;
use cara_std::metrics::CONTENT_TYPE;

use super::places::Places;

/// Answers with the text of the metrics, or `None` once the unit has ended.
pub(super) type Metrics = Arc<dyn Fn() -> Option<String> + Send + Sync>;

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
        axum::serve(Places::new(listener), router(metrics)).await
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

#[cfg(test)]
mod tests {
    use std::io::{Read, Write};
    use std::net::TcpStream;
    use std::time::Duration;

    use super::super::places::PLACES;
    use super::*;

    fn served(metrics: Metrics) -> SocketAddr {
        let listener = listen(([127, 0, 0, 1], 0).into()).unwrap();
        let address = listener.local_addr().unwrap();
        serve(listener, metrics).unwrap();
        address
    }

    fn connect(address: SocketAddr) -> TcpStream {
        let stream = TcpStream::connect(address).unwrap();
        stream.set_read_timeout(Some(Duration::from_secs(30))).unwrap();
        stream
    }

    fn ask(mut stream: TcpStream, request: &str) -> String {
        write!(stream, "{request} HTTP/1.1\r\nHost: x\r\nConnection: close\r\n\r\n").unwrap();
        let mut answer = String::new();
        stream.read_to_string(&mut answer).unwrap();
        answer
    }

    #[test]
    fn metrics_are_at_one_path_and_read_only() {
        let address = served(Arc::new(|| Some("cara_up 1\n".into())));
        let got = ask(connect(address), "GET /metrics");
        assert!(got.starts_with("HTTP/1.1 200 ") && got.ends_with("\r\n\r\ncara_up 1\n"), "{got}");
        assert!(got.contains(&format!("content-type: {CONTENT_TYPE}\r\n")), "{got}");
        let head = ask(connect(address), "HEAD /metrics");
        assert!(head.starts_with("HTTP/1.1 200 ") && head.ends_with("\r\n\r\n"), "{head}");
        assert!(head.contains("content-length: 10\r\n"), "{head}");
        for (request, code) in [("GET /", 404), ("GET /metrics/x", 404), ("POST /metrics", 405), ("ro\0t", 400)] {
            let refused = ask(connect(address), request);
            assert!(refused.starts_with(&format!("HTTP/1.1 {code} ")), "{request}: {refused}");
        }
    }

    #[test]
    fn a_unit_that_has_ended_has_no_metrics() {
        let gone = ask(connect(served(Arc::new(|| None))), "GET /metrics");
        assert!(gone.starts_with("HTTP/1.1 503 "), "{gone}");
    }

    #[test]
    fn connections_beyond_the_places_wait_until_one_is_free() {
        let address = served(Arc::new(|| Some(String::new())));
        let mut held: Vec<_> = (0..PLACES).map(|_| connect(address)).collect();
        let mut waiting = connect(address);
        write!(waiting, "GET /metrics HTTP/1.1\r\nHost: x\r\nConnection: close\r\n\r\n").unwrap();
        waiting.set_read_timeout(Some(Duration::from_millis(300))).unwrap();
        assert!(waiting.read(&mut [0; 1]).is_err(), "it has no place yet");
        held.pop();
        waiting.set_read_timeout(Some(Duration::from_secs(30))).unwrap();
        let mut answer = String::new();
        waiting.read_to_string(&mut answer).unwrap();
        assert!(answer.starts_with("HTTP/1.1 200 "), "{answer}");
    }
}
