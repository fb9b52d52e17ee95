//! Who may ask: a request must be for this host by address or by a name that was told (a page of another site whose name was made
//! to lead here has that name), must know the token, and if it changes something, must come from this page.

use std::net::IpAddr;
use std::sync::Arc;
use std::time::Duration;

use axum::extract::{Request, State};
use axum::http::{HeaderMap, HeaderName, HeaderValue, Method, StatusCode, header};
use axum::middleware::Next;
use axum::response::{IntoResponse, Response};
use subtle::ConstantTimeEq;
use tokio::time::sleep;

use crate::server::Shared;

/// In each request that changes something: a form of another site cannot set it.
pub(crate) const HEADER: &str = "x-cara";
/// A wrong token is answered after so long.
const WRONG_TOKEN: Duration = Duration::from_millis(500);

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
    token: String,
    scheme: &'static str,
    names: Vec<String>,
}

/// Why a request is refused.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum Refusal {
    Host,
    Origin,
    Token,
}

impl Guard {
    pub(crate) fn new(token: String, has_tls: bool, names: Vec<String>) -> Self {
        let scheme = if has_tls { "https" } else { "http" };
        Self { token, scheme, names: names.iter().map(|name| name.to_ascii_lowercase()).collect() }
    }

    /// Whether a request may pass. `for_data` is one that is not for the files of the page, which hold no secret.
    pub(crate) fn check(&self, method: &Method, headers: &HeaderMap, for_data: bool) -> Result<(), Refusal> {
        let host = text(headers, header::HOST).ok_or(Refusal::Host)?;
        if !self.is_this_host(host) {
            return Err(Refusal::Host);
        }
        if !self.is_from_here(method, headers, host) {
            return Err(Refusal::Origin);
        }
        if for_data && !self.has_token(headers) {
            return Err(Refusal::Token);
        }
        Ok(())
    }

    fn is_this_host(&self, host: &str) -> bool {
        let name = match host.strip_prefix('[').and_then(|rest| rest.split_once(']')) {
            Some((address, _)) => address,
            None => host.rsplit_once(':').map_or(host, |(name, _)| name),
        };
        let name = name.to_ascii_lowercase();
        name.parse::<IpAddr>().is_ok() || name == "localhost" || self.names.contains(&name)
    }

    fn is_from_here(&self, method: &Method, headers: &HeaderMap, host: &str) -> bool {
        let origin = text(headers, header::ORIGIN);
        let is_own = |origin: &str| origin == format!("{}://{host}", self.scheme);
        if method == Method::GET || method == Method::HEAD {
            return origin.is_none_or(is_own);
        }
        // A browser that tells more than the origin is believed where it says that the request is of another site.
        let site = text(headers, HeaderName::from_static("sec-fetch-site"));
        origin.is_some_and(is_own) && headers.contains_key(HEADER) && site.is_none_or(|site| site == "same-origin")
    }

    fn has_token(&self, headers: &HeaderMap) -> bool {
        let told =
            text(headers, header::AUTHORIZATION).and_then(|told| told.strip_prefix("Bearer ")).unwrap_or_default();
        told.as_bytes().ct_eq(self.token.as_bytes()).into()
    }
}

fn text(headers: &HeaderMap, name: HeaderName) -> Option<&str> {
    headers.get(name)?.to_str().ok()
}

/// The check of every request, and the headers of every answer.
pub(crate) async fn pass(State(shared): State<Arc<Shared>>, request: Request, next: Next) -> Response {
    let for_data = request.uri().path().starts_with("/api/");
    let mut response = match shared.guard.check(request.method(), request.headers(), for_data) {
        Ok(()) => next.run(request).await,
        Err(refusal) => refuse(&shared, refusal).await,
    };
    for (name, value) in HEADERS {
        response.headers_mut().insert(name, HeaderValue::from_static(value));
    }
    response
}

async fn refuse(shared: &Shared, refusal: Refusal) -> Response {
    let (status, text) = match refusal {
        Refusal::Host => {
            shared.limits.hosts.refuse();
            (
                StatusCode::MISDIRECTED_REQUEST,
                "the name in the address is not known here: start `cara web` with --host-name NAME",
            )
        }
        Refusal::Origin => {
            shared.limits.origins.refuse();
            (StatusCode::FORBIDDEN, "only the page of `cara web` itself may ask for this")
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
        Guard::new(TOKEN.to_owned(), false, vec!["Depot.example".to_owned()])
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
        for host in ["127.0.0.1:8420", "localhost:8420", "LOCALHOST", "[::1]:8420", "10.0.0.7", "depot.example:8420"] {
            assert_eq!(guard().check(&Method::GET, &headers(&[("host", host)]), false), Ok(()), "{host}");
        }
        for host in
            ["evil.example", "evil.example:8420", "127.0.0.1.evil.example", "localhost.evil.example", "", "[evil"]
        {
            assert_eq!(guard().check(&Method::GET, &headers(&[("host", host)]), false), Err(Refusal::Host), "{host}");
        }
        assert_eq!(guard().check(&Method::GET, &HeaderMap::new(), false), Err(Refusal::Host));
    }

    #[test]
    fn data_needs_the_token_and_all_of_it() {
        let get = |told: Option<&str>| {
            let mut all = headers(&[("host", "localhost")]);
            told.map(|told| all.insert(header::AUTHORIZATION, HeaderValue::from_str(told).unwrap()));
            guard().check(&Method::GET, &all, true)
        };
        assert_eq!(get(Some(&bearer())), Ok(()));
        let (shorter, longer, other) = (&bearer()[..22], bearer() + "0", bearer().replace('f', "e"));
        for wrong in [None, Some(""), Some(TOKEN), Some("Bearer "), Some(shorter), Some(&longer), Some(&other)] {
            assert_eq!(get(wrong), Err(Refusal::Token), "{wrong:?}");
        }
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
    }
}
