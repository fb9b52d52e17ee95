//! Requests to `cara web`: who is let in, the calls that a page asks for, files of tokens, and addresses behind a proxy.

use std::net::{IpAddr, Ipv6Addr};
use std::sync::LazyLock;
use std::sync::atomic::{AtomicUsize, Ordering};

use cara_fuzz::{Script, Target, text};
use cara_std::control::protocol::Question;
use cara_web::entrance::{self, Entrance};

/// The target, for libFuzzer.
pub const TARGETS: &[Target] = &[Target { name: "page", run, longest: 300 }];

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
/// Of each header of a request, what it may say. An empty one is absent.
const HOSTS: &[&str] = &[
    "localhost:8420",
    "localhost",
    "127.0.0.1",
    "[::1]:8420",
    "FLEET.example",
    "fleet.example:443",
    "evil.example",
    "[localhost]",
    "[::1].evil.example",
    "",
];
const ORIGINS: &[&str] = &["", "http://HOST", "https://fleet.example", "https://evil.example", "https://HOST", "null"];
const TOKENS: &[&str] = &[
    "Bearer 0123456789abcdef",
    "Bearer fedcba9876543210",
    "",
    "Bearer ",
    "0123456789abcdef",
    "Bearer 0123456789abcde",
];
const OWN: &[&str] = &["1", ""];
const SITES: &[&str] = &["", "same-origin", "cross-site", "none"];

/// Values of the arguments of a call.
const VALUES: &[&str] = &[
    r#"["1","-9223372036854775808"]"#,
    r#"["9007199254740993"]"#,
    "[1]",
    "[1.5,-0.0]",
    r#"[1e300,"NaN","-inf"]"#,
    "[true,false]",
    r#""a text""#,
    r#""00ff7f""#,
    r#""[{\"a\":1},{\"a\":2}]""#,
    r#""{\"z\":9007199254740993,\"a\":1.0}""#,
    r#"{"z":1,"a":[null,1.0]}"#,
    "[]",
    "null",
    "18446744073709551616",
];
const TYPES: &[&str] = &["int", "float", "string", "bool", "bytes", "list", "record", "other"];
/// What a call may say beside its function and its arguments.
const MEMBERS: &[&str] = &[
    r#""node":"agv/1""#,
    r#""node":null"#,
    r#""asynchronous":true"#,
    r#""timeout_ms":2000"#,
    r#""priority":"high""#,
    r#""best_effort":true"#,
    r#""take_over":true"#,
    r#""hold":true"#,
    r#""hold":1"#,
    r#""unknown":1"#,
];

/// Requests that were let in, and calls that were taken: what has none shows nothing.
static TAKEN: [AtomicUsize; 2] = [const { AtomicUsize::new(0) }; 2];

/// How many requests were let in and how many calls were taken, of all that has run in this process.
pub fn taken() -> [usize; 2] {
    TAKEN.each_ref().map(|taken| taken.load(Ordering::Relaxed))
}

fn run(data: &[u8]) {
    let mut script = Script::new(data);
    match script.below(6) {
        0 => tokens(&text(script, PIECES)),
        1 => address(&text(script, PIECES)),
        2 | 3 => request(script),
        _ => call(&body(script)),
    }
}

fn of<'a>(script: &mut Script<'_>, choices: &[&'a str]) -> &'a str {
    choices[usize::from(script.byte()) % choices.len()]
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
    let mut host = String::new();
    let mut headers: Vec<(&'static str, Vec<u8>)> = Vec::new();
    for (name, choices) in
        [("host", HOSTS), ("origin", ORIGINS), ("authorization", TOKENS), ("x-cara", OWN), ("sec-fetch-site", SITES)]
    {
        let value = match script.byte() {
            0xF0.. => script.bytes().to_vec(),
            0xE0.. => text(Script::new(script.bytes()), PIECES).into_bytes(),
            known => choices[usize::from(known) % choices.len()].replace("HOST", &host).into_bytes(),
        };
        if name == "host" {
            host = String::from_utf8_lossy(&value).into_owned();
        }
        if !value.is_empty() {
            headers.push((name, value));
        }
    }
    let shown: Vec<(&'static str, &[u8])> = headers.iter().map(|(name, value)| (*name, &value[..])).collect();
    if !ENTRANCE.lets_in(method, &shown) {
        return;
    }
    TAKEN[0].fetch_add(1, Ordering::Relaxed);
    let value =
        |wanted| shown.iter().find(|(name, _)| *name == wanted).map(|(_, value)| String::from_utf8_lossy(value));
    let token = value("authorization").unwrap_or_default();
    assert!([TOKEN, OTHER].iter().any(|known| token == format!("Bearer {known}")), "let in with `{token}`");
    assert!(is_this_host(&host), "let in as {host}");
    let origin = value("origin");
    let is_ours = |origin: &str| origin == format!("http://{host}") || origin == "https://fleet.example";
    assert!(origin.as_deref().is_none_or(is_ours), "let in from {origin:?}");
    if method != "GET" && method != "HEAD" {
        assert!(origin.is_some() && value("x-cara").is_some(), "a change is let in that no page asks for");
        let site = value("sec-fetch-site");
        assert!(site.as_deref().is_none_or(|site| site == "same-origin"), "a change is let in from {site:?}");
    }
}

fn is_this_host(host: &str) -> bool {
    let is_port = |port: &str| port.is_empty() || port.starts_with(':');
    if let Some((address, port)) = host.strip_prefix('[').and_then(|rest| rest.split_once(']')) {
        return address.parse::<Ipv6Addr>().is_ok() && is_port(port);
    }
    let name = host.rsplit_once(':').map_or(host, |(name, _)| name).to_ascii_lowercase();
    name.parse::<IpAddr>().is_ok() || ["localhost", "fleet.example"].contains(&&*name)
}

/// The body of a call: mostly one, with arguments of any type and value; or pieces of it in any order.
fn body(mut script: Script<'_>) -> Vec<u8> {
    if script.below(8) == 7 {
        let pieces: Vec<&str> = ["[", "]", "{", "}", ",", ":", "\"", "\\", "\"arguments\":", "\"function\":\"go\""]
            .into_iter()
            .chain(VALUES.iter().copied())
            .chain(MEMBERS.iter().copied())
            .collect();
        return text(script, &pieces).into_bytes();
    }
    let arguments: Vec<String> = (0..script.below(4))
        .map(|_| {
            let (kind, size) = (of(&mut script, TYPES), script.number());
            let value = match script.byte() {
                0xE0.. => String::from_utf8_lossy(script.bytes()).into_owned(),
                known => VALUES[usize::from(known) % VALUES.len()].to_owned(),
            };
            format!(r#"{{"name":"x","size":{size},"type":"{kind}","value":{value}}}"#)
        })
        .collect();
    let mut members = vec![r#""function":"go""#.to_owned(), format!(r#""arguments":[{}]"#, arguments.join(","))];
    members.extend((0..script.below(4)).map(|_| of(&mut script, MEMBERS).to_owned()));
    format!("{{{}}}", members.join(",")).into_bytes()
}

/// A call is the same on the control socket, and where a page shows it and asks for it again.
fn call(body: &[u8]) {
    match entrance::call(body) {
        Ok((call, _)) => {
            TAKEN[1].fetch_add(1, Ordering::Relaxed);
            let shown = entrance::written(&call).to_string();
            let (again, _) = entrance::call(shown.as_bytes()).unwrap_or_else(|error| panic!("{shown}: {error}"));
            let line = |call| serde_json::to_string(&Question::Call(call)).expect("it is JSON");
            let written = line(call);
            assert_eq!(line(again), written, "a page asks for another call");
            let read: Question = serde_json::from_str(&written).expect("what is written can be read");
            assert_eq!(serde_json::to_string(&read).expect("it is JSON"), written);
        }
        Err(error) => assert!(!error.is_empty()),
    }
}
