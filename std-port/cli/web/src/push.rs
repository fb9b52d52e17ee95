//! What changes, pushed to pages as server-sent events: a message at most ten times a second, and one a second in any case,
//! so that a page sees when it hears nothing more.

use std::pin::Pin;
use std::sync::Arc;
use std::task::{Context, Poll};
use std::time::Duration;

use axum::body::{Body, Bytes};
use axum::extract::{Extension, State};
use axum::http::{HeaderName, StatusCode, header};
use axum::response::{IntoResponse, Response};
use futures_core::Stream;
use tokio::sync::mpsc;
use tokio::time::{Instant, sleep};

use crate::limits::{PAGES, Place};
use crate::picture::Seen;
use crate::server::Shared;
use crate::users::User;

/// Between two messages with news.
const TICK: Duration = Duration::from_millis(100);
/// Between two messages without.
const SIGN_OF_LIFE: Duration = Duration::from_secs(1);

/// `GET /api/stream`.
pub(crate) async fn stream(State(shared): State<Arc<Shared>>, Extension(user): Extension<Arc<User>>) -> Response {
    let Some(place) = Place::take(&shared.limits, |limits| &limits.pages) else {
        let text = format!("{PAGES} pages are open already, which is all that `cara web` serves: close one");
        return (StatusCode::SERVICE_UNAVAILABLE, text).into_response();
    };
    // One message waits at most: the next is made when that has been taken, of what is the newest then.
    let (to, messages) = mpsc::channel(1);
    tokio::spawn(notify(shared, user, to, place));
    piecewise("text/event-stream", messages)
}

/// An answer whose pieces are passed on as they come, by a proxy too.
pub(crate) fn piecewise(kind: &'static str, pieces: mpsc::Receiver<Bytes>) -> Response {
    let headers = [(header::CONTENT_TYPE, kind), (HeaderName::from_static("x-accel-buffering"), "no")];
    (headers, Body::from_stream(Pieces(pieces))).into_response()
}

async fn notify(shared: Arc<Shared>, user: Arc<User>, to: mpsc::Sender<Bytes>, _place: Place) {
    let mut seen = Seen::default();
    let mut last: Option<Instant> = None;
    while let Ok(permit) = to.reserve().await {
        let is_due = last.is_none_or(|last| last.elapsed() >= SIGN_OF_LIFE);
        let news = {
            let picture = shared.picture();
            (is_due || picture.has_news(seen)).then(|| picture.news(&mut seen, &user, &shared.limits))
        };
        match news {
            Some(news) => {
                last = Some(Instant::now());
                permit.send(format!("data: {news}\n\n").into());
            }
            None => drop(permit),
        }
        tokio::select! {
            () = sleep(TICK) => {}
            () = to.closed() => return,
        }
    }
}

/// A body that comes in pieces.
struct Pieces(mpsc::Receiver<Bytes>);

impl Stream for Pieces {
    type Item = Result<Bytes, std::convert::Infallible>;

    fn poll_next(mut self: Pin<&mut Self>, cx: &mut Context<'_>) -> Poll<Option<Self::Item>> {
        self.0.poll_recv(cx).map(|piece| piece.map(Ok))
    }
}
