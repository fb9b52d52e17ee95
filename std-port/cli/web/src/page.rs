//! The page, as it is in this crate: nothing of it comes from elsewhere.

use axum::extract::Path;
use axum::http::{StatusCode, header};
use axum::response::{IntoResponse, Response};

const HTML: &str = "text/html; charset=utf-8";
const STYLE: &str = "text/css; charset=utf-8";
const SCRIPT: &str = "text/javascript; charset=utf-8";

/// Each file with its type.
pub(crate) const FILES: [(&str, &str, &str); 13] = [
    ("", HTML, include_str!("page/index.html")),
    ("style.css", STYLE, include_str!("page/style.css")),
    ("icon.svg", "image/svg+xml", include_str!("page/icon.svg")),
    ("main.js", SCRIPT, include_str!("page/main.js")),
    ("state.js", SCRIPT, include_str!("page/state.js")),
    ("api.js", SCRIPT, include_str!("page/api.js")),
    ("dom.js", SCRIPT, include_str!("page/dom.js")),
    ("map.js", SCRIPT, include_str!("page/map.js")),
    ("nodes.js", SCRIPT, include_str!("page/nodes.js")),
    ("forms.js", SCRIPT, include_str!("page/forms.js")),
    ("stop.js", SCRIPT, include_str!("page/stop.js")),
    ("alarms.js", SCRIPT, include_str!("page/alarms.js")),
    ("charts.js", SCRIPT, include_str!("page/charts.js")),
];

pub(crate) async fn index() -> Response {
    file("")
}

pub(crate) async fn named(Path(name): Path<String>) -> Response {
    file(&name)
}

fn file(wanted: &str) -> Response {
    match FILES.iter().find(|(name, ..)| *name == wanted) {
        Some((_, kind, text)) => ([(header::CONTENT_TYPE, *kind)], *text).into_response(),
        None => StatusCode::NOT_FOUND.into_response(),
    }
}
