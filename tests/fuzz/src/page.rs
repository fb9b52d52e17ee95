//! Requests to `cara web`: who is let in, the calls that a page asks for, files of tokens, and addresses behind a proxy.

use std::sync::LazyLock;

use cara_std::control::protocol::Question;
use cara_web::entrance::{self, Entrance};

use crate::files::text;
use crate::script::Script;

const TOKEN: &str = "0123456789abcdef";
const OTHER: &str = "fedcba9876543210";
const OUTSIDE: &str = "https://fleet.example/hall/";

static ENTRANCE: LazyLock<Entrance> = LazyLock::new(|| {
    let users = format!("see lobby {TOKEN}\noperate anna {OTHER}\n");
    Entrance::new(&users, Some(OUTSIDE)).expect("they are right")
});

/// Pieces of headers, of addresses, and of files of tokens.
const PIECES: &[&str] = &[
    "0123456789abcdef",
    "fedcba9876543210",
    "Bearer 0123456789abcdef",
    "Bearer ",
    "https://fleet.example",
    "http://localhost",
    "http://",
    "https://",
    "localhost",
    "127.0.0.1",
    "[::1]",
    "fleet.example",
    "evil.example",
    ":8420",
    ":443",
    ":80",
    "/hall/",
    "null",
    "same-origin",
    "cross-site",
    "see ",
    "operate ",
    "lobby ",
    "anna ",
    "\n",
    " ",
    "#",
    ".",
    "@",
    "1",
];
/// Pieces of the calls of a page.
const CALLS: &[&str] = &[
    r#"{"function":"go","node":null,"asynchronous":false,"timeout_ms":null,"priority":null,"best_effort":false,"arguments":"#,
    "[",
    "]",
    "{",
    "}",
    ",",
    r#"{"name":"x","size":1,"type":"int","value":"#,
    r#"{"name":"x","size":1,"type":"float","value":"#,
    r#"{"name":"x","size":1,"type":"bytes","value":"#,
    r#"{"name":"x","size":1,"type":"list","value":"#,
    r#"{"name":"x","size":1,"type":"record","value":"#,
    r#""9007199254740993""#,
    r#"" -1 ""#,
    "\"[[1]]\"",
    r#""{\"a\": 1.0}""#,
    r#""[{\"name\":\"x\",\"size\":1,\"type\":\"int\",\"value\":[\"1\"]}]""#,
    "\"NaN\"",
    "1",
    "-0.0",
    "1e300",
    "18446744073709551616",
    "null",
    "true",
    "\"a\":",
    ",\"take_over\":true",
    ",\"hold\":true",
    "\"",
    "\\",
];

pub(crate) fn run(data: &[u8]) {
    let mut script = Script::new(data);
    match script.below(6) {
        0 => tokens(&text(script, PIECES)),
        1 => address(&text(script, PIECES)),
        2 | 3 => request(script),
        _ => call(text(script, CALLS).as_bytes()),
    }
}

/// An error never shows what may be a token.
fn tokens(text: &str) {
    if let Err(error) = Entrance::new(text, None) {
        let shown = error.to_string();
        assert!(!shown.contains(TOKEN) && !shown.contains(OTHER), "a token is shown: {shown}");
    }
}

/// What is shown of an address is the same address.
fn address(given: &str) {
    if let Some(shown) = entrance::address(given) {
        assert_eq!(entrance::address(&shown).as_ref(), Some(&shown), "{given}");
    }
}

/// Nobody is let in without a token, under another name of this host, nor from another page.
fn request(mut script: Script<'_>) {
    let method = ["GET", "POST", "HEAD", "PUT"][usize::from(script.below(4))];
    let mut value = || match script.byte() {
        0 => None,
        known @ 1..=200 => PIECES.get(usize::from(known) - 1).map(|piece| (*piece).to_owned()),
        _ => Some(text(Script::new(script.bytes()), PIECES)),
    };
    let values = [value(), value(), value(), value(), value()];
    let names = ["host", "origin", "authorization", "x-cara", "sec-fetch-site"];
    let headers: Vec<_> =
        names.into_iter().zip(&values).filter_map(|(name, value)| Some((name, value.as_deref()?))).collect();
    if !ENTRANCE.lets_in(method, &headers) {
        return;
    }
    let [host, origin, token, own, site] = values.each_ref().map(Option::as_deref);
    let token = token.unwrap_or_default();
    assert!([TOKEN, OTHER].iter().any(|known| token == format!("Bearer {known}")), "let in with `{token}`");
    let host = host.unwrap_or_default();
    let name = host.rsplit_once(':').map_or(host, |(name, _)| name).to_ascii_lowercase();
    let is_address = host.starts_with('[') || name.parse::<std::net::IpAddr>().is_ok();
    assert!(is_address || ["localhost", "fleet.example"].contains(&&*name), "let in as {host}");
    let is_ours = |origin: &str| origin == format!("http://{host}") || origin == "https://fleet.example";
    assert!(origin.is_none_or(is_ours), "let in from {origin:?}");
    if method != "GET" && method != "HEAD" {
        assert!(origin.is_some() && own.is_some(), "a change is let in that no page asks for");
        assert!(site.is_none_or(|site| site == "same-origin"), "a change is let in from {site:?}");
    }
}

/// A call is the same on the control socket, and where a page shows it and asks for it again.
fn call(body: &[u8]) {
    match entrance::call(body) {
        Ok(call) => {
            let shown = entrance::written(&call).to_string();
            let again = entrance::call(shown.as_bytes()).unwrap_or_else(|error| panic!("{shown}: {error}"));
            let line = |call| serde_json::to_string(&Question::Call(call)).expect("it is JSON");
            let written = line(call);
            assert_eq!(line(again), written, "a page asks for another call");
            let read: Question = serde_json::from_str(&written).expect("what is written can be read");
            assert_eq!(serde_json::to_string(&read).expect("it is JSON"), written);
        }
        Err(error) => assert!(!error.is_empty()),
    }
}
