//! Who may ask: a request must be for this host by address or by a name that was told (a page of another site whose name was made
//! to lead here has that name), must know the token, and if it changes something, must come from this page. The files of the page
//! are no secret, and are for everybody who asks for this host.

use std::error::Error;
use std::net::{IpAddr, Ipv6Addr};
use std::pin::Pin;
use std::sync::Arc;
use std::task::{Context, Poll};
use std::time::Duration;

use axum::body::{Body, BodyDataStream, Bytes, HttpBody, to_bytes};
use axum::extract::{ConnectInfo, Request, State};
use axum::http::{HeaderMap, HeaderName, HeaderValue, Method, StatusCode, Uri, header};
use axum::middleware::Next;
use axum::response::{IntoResponse, Response};
use cara_std::control::Role;
use futures_core::Stream;
use subtle::ConstantTimeEq;
use tokio::time::{sleep, timeout};

use crate::limits::{BODY, Place};
use crate::lines::{Asks, Caller};
use crate::server::Shared;
use crate::users::User;

/// In each request that changes something: a form of another site cannot set it.
pub(crate) const HEADER: &str = "x-cara";
/// A wrong token is answered after so long.
const WRONG_TOKEN: Duration = Duration::from_millis(500);

/// How long the content of a request may take as a whole.
const CONTENT: Duration = Duration::from_secs(5);

/// Nothing from elsewhere, nothing in line, nothing that frames the page.
const POLICY: &str = "default-src 'none'; script-src 'self'; style-src 'self'; img-src 'self'; connect-src 'self'; \
                      form-action 'none'; base-uri 'none'; frame-ancestors 'none'";

/// Of every answer.
const HEADERS: [(HeaderName, &str); 6] = [
    (header::CONTENT_SECURITY_POLICY, POLICY),
    (header::X_CONTENT_TYPE_OPTIONS, "nosniff"),
    (header::REFERRER_POLICY, "no-referrer"),
    (header::CACHE_CONTROL, "no-store"),
    (HeaderName::from_static("cross-origin-opener-policy"), "same-origin"),
    (HeaderName::from_static("cross-origin-resource-policy"), "same-origin"),
];

/// What requests are held against.
pub(crate) struct Guard {
    users: Vec<Arc<User>>,
    scheme: &'static str,
    names: Vec<String>,
    /// Where browsers see the page: those of a proxy.
    origins: Vec<String>,
}

/// Where a browser finds the page behind a proxy.
#[derive(Clone, Debug, PartialEq, Eq)]
pub(crate) struct Outside {
    /// As browsers write it: `https://fleet.example`.
    origin: String,
    host: String,
    path: String,
}

impl std::str::FromStr for Outside {
    type Err = &'static str;

    fn from_str(text: &str) -> Result<Self, Self::Err> {
        const WRONG: &str =
            "write it as a browser shows it: https://fleet.example, with its port unless that is 443 (http: 80)";
        let (scheme, rest) = text.split_once("://").filter(|_| !text.contains(['?', '#'])).ok_or(WRONG)?;
        let scheme = scheme.to_ascii_lowercase();
        let own_port = match &*scheme {
            "http" => "80",
            "https" => "443",
            _ => return Err(WRONG),
        };
        let (host, path) = rest.split_at(rest.find('/').unwrap_or(rest.len()));
        let uri: Uri = format!("{scheme}://{host}/").parse().map_err(|_| WRONG)?;
        let authority = uri.authority().filter(|authority| !authority.as_str().contains('@')).ok_or(WRONG)?;
        let host = Some(authority.host()).filter(|host| !host.is_empty()).ok_or(WRONG)?.to_ascii_lowercase();
        // With brackets in its midst an authority has parts that are neither.
        let behind = authority.as_str().get(host.len()..).unwrap_or_default();
        let port = match behind.strip_prefix(':').map(str::parse::<u16>) {
            None if behind.is_empty() => String::new(),
            Some(Ok(port)) if port.to_string() == own_port => String::new(),
            Some(Ok(port)) => format!(":{port}"),
            _ => return Err(WRONG),
        };
        let path = if path.ends_with('/') { path.to_owned() } else { format!("{path}/") };
        Ok(Self { origin: format!("{scheme}://{host}{port}"), host, path })
    }
}

impl Outside {
    /// The address of the page.
    pub(crate) fn url(&self) -> String {
        format!("{}{}", self.origin, self.path)
    }
}

/// Why a request is refused.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum Refusal {
    Host,
    Origin,
    Token,
}

impl Guard {
    pub(crate) fn new(users: Vec<User>, has_tls: bool, names: &[String], outside: &[Outside]) -> Self {
        let scheme = if has_tls { "https" } else { "http" };
        let names = names.iter().map(|name| name.to_ascii_lowercase());
        let names = names.chain(outside.iter().map(|outside| outside.host.clone())).collect();
        let users = users.into_iter().map(Arc::new).collect();
        Self { users, scheme, names, origins: outside.iter().map(|outside| outside.origin.clone()).collect() }
    }

    /// Whether a request may pass. `for_data` is one that is not for the files of the page, which hold no secret.
    pub(crate) fn check(&self, method: &Method, headers: &HeaderMap, for_data: bool) -> Result<(), Refusal> {
        let host = text(headers, header::HOST).ok_or(Refusal::Host)?;
        if !self.is_this_host(host) {
            return Err(Refusal::Host);
        }
        // Browsers tell the origin of a module script, too; behind a proxy that is not how this server sees itself.
        if for_data && !self.is_from_here(method, headers, host) {
            return Err(Refusal::Origin);
        }
        if for_data && self.user(headers).is_none() {
            return Err(Refusal::Token);
        }
        Ok(())
    }

    fn is_this_host(&self, host: &str) -> bool {
        if let Some(rest) = host.strip_prefix('[') {
            let address = rest.split_once(']').filter(|(_, port)| port.is_empty() || port.starts_with(':'));
            return address.is_some_and(|(address, _)| address.parse::<Ipv6Addr>().is_ok());
        }
        let name = host.rsplit_once(':').map_or(host, |(name, _)| name).to_ascii_lowercase();
        name.parse::<IpAddr>().is_ok() || name == "localhost" || self.names.contains(&name)
    }

    fn is_from_here(&self, method: &Method, headers: &HeaderMap, host: &str) -> bool {
        let origin = text(headers, header::ORIGIN);
        let is_reported = |origin: &str| self.origins.iter().any(|reported| reported == origin);
        let is_own = |origin: &str| origin == format!("{}://{host}", self.scheme) || is_reported(origin);
        if method == Method::GET || method == Method::HEAD {
            return origin.is_none_or(is_own);
        }
        // A browser that tells more than the origin is believed where it says that the request is of another site.
        let site = text(headers, HeaderName::from_static("sec-fetch-site"));
        origin.is_some_and(is_own) && headers.contains_key(HEADER) && site.is_none_or(|site| site == "same-origin")
    }

    /// Who has the token. All are compared, so that the time says nothing about which one it is.
    fn user(&self, headers: &HeaderMap) -> Option<Arc<User>> {
        let reported = text(headers, header::AUTHORIZATION)
            .and_then(|reported| reported.strip_prefix("Bearer "))
            .unwrap_or_default();
        let is = |user: &User| bool::from(reported.as_bytes().ct_eq(user.token.as_bytes()));
        self.users.iter().fold(None, |found, user| if is(user) { Some(user) } else { found }).cloned()
    }
}

/// A value that is no text counts as an empty one, and not as absent: what is absent may pass.
fn text(headers: &HeaderMap, name: HeaderName) -> Option<&str> {
    headers.get(name).map(|value| value.to_str().unwrap_or_default())
}

/// The check of every request, and the headers of every answer.
pub(crate) async fn pass(
    State(shared): State<Arc<Shared>>,
    ConnectInfo(caller): ConnectInfo<Caller>,
    mut request: Request,
    next: Next,
) -> Response {
    let asks = caller.asks();
    let path = request.uri().path();
    let (for_data, is_stop) = (path.starts_with("/api/"), path == "/api/stop");
    let checked = shared.guard.check(request.method(), request.headers(), for_data);
    let user = shared.guard.user(request.headers());
    user.into_iter().for_each(|user| drop(request.extensions_mut().insert(user)));
    // A file is nothing that a connection is kept for.
    asks.proves(for_data && checked.is_ok());
    let mut place = None;
    let mut response = match checked {
        Err(refusal) => refuse(&shared, refusal).await,
        Ok(()) if !for_data => next.run(request).await,
        Ok(()) => match whole(&shared, request).await {
            Err(refusal) => refusal,
            Ok(request) => {
                asks.is_whole();
                if !is_stop {
                    place = Place::take(&shared.limits, |limits| &limits.requests);
                }
                match place.is_some() || is_stop {
                    true => next.run(request).await,
                    false => {
                        (StatusCode::SERVICE_UNAVAILABLE, "too much is asked for at a time: try again").into_response()
                    }
                }
            }
        },
    };
    for (name, value) in HEADERS {
        response.headers_mut().insert(name, HeaderValue::from_static(value));
    }
    // Of a body in pieces it is not told by itself.
    if let (Some(length), true) = (response.body().size_hint().exact(), response.status() != StatusCode::NO_CONTENT) {
        response.headers_mut().insert(header::CONTENT_LENGTH, length.into());
    }
    response.map(|body| Body::from_stream(Answer { body: body.into_data_stream(), _place: place, _asks: asks }))
}

/// A request with all of its content. Until that has come its connection gives way to others.
async fn whole(shared: &Shared, request: Request) -> Result<Request, Response> {
    let (head, body) = request.into_parts();
    let Ok(content) = timeout(CONTENT, to_bytes(body, BODY)).await else {
        shared.limits.slow_bodies.refuse();
        return Err((StatusCode::REQUEST_TIMEOUT, "the content came too slowly").into_response());
    };
    match content {
        Ok(content) => Ok(Request::from_parts(head, content.into())),
        Err(error) if error.source().is_some_and(|source| source.to_string() == "length limit exceeded") => {
            shared.limits.bodies.refuse();
            Err((StatusCode::PAYLOAD_TOO_LARGE, format!("a request has at most {BODY} bytes")).into_response())
        }
        // Its connection has ended.
        Err(error) => Err((StatusCode::BAD_REQUEST, error.to_string()).into_response()),
    }
}

/// The body of an answer, with what its request has until that is sent.
struct Answer {
    body: BodyDataStream,
    _place: Option<Place>,
    _asks: Asks,
}

impl Stream for Answer {
    type Item = Result<Bytes, axum::Error>;

    fn poll_next(mut self: Pin<&mut Self>, cx: &mut Context<'_>) -> Poll<Option<Self::Item>> {
        Pin::new(&mut self.body).poll_next(cx)
    }
}

/// The answer to a user who sees nothing, where the manager is not asked: all else it decides and writes down itself.
pub(crate) fn unseen(user: &User) -> Option<Response> {
    let text = "this needs the role `see`, and this token has `stop`: ask for another one";
    (user.role < Role::See).then(|| (StatusCode::FORBIDDEN, text).into_response())
}

async fn refuse(shared: &Shared, refusal: Refusal) -> Response {
    let (status, text) = match refusal {
        Refusal::Host => {
            shared.limits.hosts.refuse();
            (
                StatusCode::MISDIRECTED_REQUEST,
                "the name in the address is not known here: start `cara web` with --host-name NAME, or behind a proxy with --origin URL",
            )
        }
        Refusal::Origin => {
            shared.limits.origins.refuse();
            (
                StatusCode::FORBIDDEN,
                "only the page of `cara web` itself may ask for this: behind a proxy start it with --origin URL, where browsers see it",
            )
        }
        Refusal::Token => {
            shared.limits.tokens.refuse();
            sleep(WRONG_TOKEN).await;
            (StatusCode::UNAUTHORIZED, "the token is missing or wrong")
        }
    };
    (status, text).into_response()
}

#[cfg(test)]
mod tests {
    use super::*;

    const TOKEN: &str = "0123456789abcdef";

    fn guard() -> Guard {
        let outside: Outside = "https://Fleet.example/hall".parse().unwrap();
        Guard::new(vec![User::only(TOKEN.to_owned())], false, &["Depot.example".to_owned()], &[outside])
    }

    fn headers(list: &[(&'static str, &str)]) -> HeaderMap {
        list.iter()
            .map(|(name, value)| (HeaderName::from_static(name), HeaderValue::from_str(value).unwrap()))
            .collect()
    }

    fn bearer() -> String {
        format!("Bearer {TOKEN}")
    }

    #[test]
    fn a_name_that_was_not_told_is_refused() {
        for host in [
            "127.0.0.1:8420",
            "localhost:8420",
            "LOCALHOST",
            "[::1]:8420",
            "10.0.0.7",
            "depot.example:8420",
            "fleet.example",
        ] {
            assert_eq!(guard().check(&Method::GET, &headers(&[("host", host)]), false), Ok(()), "{host}");
        }
        for host in [
            "evil.example",
            "evil.example:8420",
            "127.0.0.1.evil.example",
            "localhost.evil.example",
            "",
            "[evil",
            "[localhost]",
            "[::1].evil.example",
        ] {
            assert_eq!(guard().check(&Method::GET, &headers(&[("host", host)]), false), Err(Refusal::Host), "{host}");
        }
        assert_eq!(guard().check(&Method::GET, &HeaderMap::new(), false), Err(Refusal::Host));
    }

    #[test]
    fn data_needs_the_token_and_all_of_it() {
        let get = |reported: Option<&str>| {
            let mut all = headers(&[("host", "localhost")]);
            reported.map(|reported| all.insert(header::AUTHORIZATION, HeaderValue::from_str(reported).unwrap()));
            guard().check(&Method::GET, &all, true)
        };
        assert_eq!(get(Some(&bearer())), Ok(()));
        let (shorter, longer, other) = (&bearer()[..22], bearer() + "0", bearer().replace('f', "e"));
        for wrong in [None, Some(""), Some(TOKEN), Some("Bearer "), Some(shorter), Some(&longer), Some(&other)] {
            assert_eq!(get(wrong), Err(Refusal::Token), "{wrong:?}");
        }
    }

    #[test]
    fn an_origin_that_is_no_text_is_not_one_that_is_absent() {
        let token = bearer();
        let mut all = headers(&[("host", "localhost"), ("authorization", &token)]);
        assert_eq!(guard().check(&Method::GET, &all, true), Ok(()));
        all.insert(header::ORIGIN, HeaderValue::from_bytes(b"http://\xff").unwrap());
        assert_eq!(guard().check(&Method::GET, &all, true), Err(Refusal::Origin));
    }

    #[test]
    fn a_change_comes_from_the_page_itself() {
        let own = [
            ("host", "localhost:1"),
            ("origin", "http://localhost:1"),
            (HEADER, "1"),
            ("sec-fetch-site", "same-origin"),
        ];
        let mut all = own.to_vec();
        let token = bearer();
        all.push(("authorization", &token));
        assert_eq!(guard().check(&Method::POST, &headers(&all), true), Ok(()));
        for left_out in 1..3 {
            let mut some = all.clone();
            some.remove(left_out);
            assert_eq!(guard().check(&Method::POST, &headers(&some), true), Err(Refusal::Origin), "{some:?}");
        }
        for (place, wrong) in [
            (1, "http://evil.example"),
            (1, "https://localhost:1"),
            (1, "http://localhost:2"),
            (1, "null"),
            (3, "cross-site"),
            (3, "same-site"),
        ] {
            let mut some = all.clone();
            some[place].1 = wrong;
            assert_eq!(guard().check(&Method::POST, &headers(&some), true), Err(Refusal::Origin), "{some:?}");
        }
        let foreign = headers(&[("host", "localhost:1"), ("origin", "http://evil.example"), ("authorization", &token)]);
        assert_eq!(guard().check(&Method::GET, &foreign, true), Err(Refusal::Origin), "another page that reads");
        assert_eq!(guard().check(&Method::GET, &foreign, false), Ok(()), "a file is no secret");
    }

    /// Whatever a proxy has made of the host's name.
    #[test]
    fn a_change_may_come_from_a_proxys_page() {
        let token = bearer();
        for host in ["127.0.0.1:8420", "localhost:8420", "fleet.example", "depot.example"] {
            let from = |origin| {
                let all = [("host", host), ("origin", origin), (HEADER, "1"), ("authorization", &*token)];
                guard().check(&Method::POST, &headers(&all), true)
            };
            assert_eq!(from("https://fleet.example"), Ok(()), "{host}");
            for other in [
                "http://fleet.example",
                "https://fleet.example:8443",
                "https://fleet.example.evil",
                "https://depot.example",
            ] {
                assert!(from(other) == Err(Refusal::Origin) || other == format!("http://{host}"), "{host} {other}");
            }
        }
    }

    #[test]
    fn an_origin_is_taken_as_browsers_write_it() {
        let read = |text: &str| text.parse::<Outside>().map(|outside| (outside.origin.clone(), outside.url()));
        for (text, origin, url) in [
            ("https://fleet.example", "https://fleet.example", "https://fleet.example/"),
            ("HTTPS://Fleet.Example:443/", "https://fleet.example", "https://fleet.example/"),
            ("http://fleet.example:80/hall/2", "http://fleet.example", "http://fleet.example/hall/2/"),
            ("http://[::1]:8080/", "http://[::1]:8080", "http://[::1]:8080/"),
        ] {
            assert_eq!(read(text), Ok((origin.to_owned(), url.to_owned())), "{text}");
        }
        for wrong in [
            "",
            "fleet.example",
            "ftp://fleet.example",
            "https://",
            "https://:80",
            "http://a[::1]:443",
            "https:///x",
            "https://a@b",
            "https://a:x",
            "https://a:99999",
            "https://a b",
            "https://a/?x",
            "https://a/#x",
            "https://a?x",
        ] {
            assert!(read(wrong).is_err(), "{wrong}");
        }
    }
}
