//! What the command line asks for, checked before anything listens: an address beyond this host is served with a token and TLS
//! or not at all.

use std::net::{SocketAddr, TcpListener};
use std::os::unix::fs::MetadataExt;
use std::path::Path;
use std::sync::Arc;

use cara_map::Grid;
use cara_tools::exit::Ended;
use cara_tools::files;
use tokio_rustls::TlsAcceptor;
use tokio_rustls::rustls::ServerConfig;
use tokio_rustls::rustls::crypto::ring;
use tokio_rustls::rustls::pki_types::pem::PemObject;
use tokio_rustls::rustls::pki_types::{CertificateDer, PrivateKeyDer};

use crate::Arguments;
use crate::guard::{Guard, Outside};
use crate::users::User;
use crate::{map, users};

/// Bytes of a key that is drawn.
const DRAWN: usize = 16;
/// Longest token, certificate and key, in bytes.
const FILE_MOST: u64 = 64 * 1024;

/// A server that is ready to serve.
pub(crate) struct Prepared {
    pub(crate) listener: TcpListener,
    pub(crate) tls: Option<TlsAcceptor>,
    pub(crate) guard: Guard,
    pub(crate) map: Option<Grid>,
    address: SocketAddr,
    drawn: Option<String>,
    outside: Option<Outside>,
}

impl Prepared {
    /// Where the page is; behind a proxy, at the first address of that. A key that was drawn stands behind `#`, which browsers
    /// keep to themselves.
    pub(crate) fn url(&self) -> String {
        let key = self.drawn.as_ref().map(|key| format!("#{key}")).unwrap_or_default();
        self.outside.as_ref().map_or_else(|| self.own(), Outside::url) + &key
    }

    /// Where a proxy finds it, if there is one.
    pub(crate) fn for_a_proxy(&self) -> Option<String> {
        self.outside.is_some().then(|| self.own())
    }

    fn own(&self) -> String {
        let scheme = if self.tls.is_some() { "https" } else { "http" };
        format!("{scheme}://{}/", self.address)
    }
}

/// Reads the files, checks what belongs together, and opens the port.
pub(crate) fn prepare(arguments: Arguments) -> anyhow::Result<Prepared> {
    let Arguments { listen, token_file, cert, key, host_name, origin, background } = arguments;
    if !listen.ip().is_loopback() && (token_file.is_none() || cert.is_none()) {
        return Err(Ended::usage(format!(
            "{listen} can be reached from other hosts, and who reaches it commands the fleet: give it a token and TLS. Write a \
             token into a file (`(umask 077; openssl rand -hex 32 > token)`), get a certificate for this host's name \
             (for a trial: `openssl req -x509 -newkey ec -pkeyopt ec_paramgen_curve:P-256 -nodes -days 30 -subj /CN=NAME \
             -addext subjectAltName=DNS:NAME -keyout key.pem -out cert.pem`), and add --token-file token --cert cert.pem --key \
             key.pem --host-name NAME; or listen on 127.0.0.1, and reach it with `ssh -L`"
        )));
    }
    let tls = match (&cert, &key) {
        (Some(cert), Some(key)) => Some(tls(cert, key)?),
        _ => None,
    };
    let (users, drawn) = match token_file {
        Some(file) => (users_of(&file)?, None),
        None => {
            let mut bytes = [0; DRAWN];
            getrandom::fill(&mut bytes)
                .map_err(|error| anyhow::anyhow!("the system has no random numbers: {error}"))?;
            let key = hex::encode(bytes);
            (vec![User::only(key.clone())], Some(key))
        }
    };
    let map = background.map(|file| background_of(&file)).transpose()?;
    let listener = TcpListener::bind(listen).map_err(|error| {
        Ended::failed("NotListening", format!("cannot listen on {listen}: {error}; choose another port with --listen"))
    })?;
    listener.set_nonblocking(true)?;
    let address = listener.local_addr()?;
    let guard = Guard::new(users, tls.is_some(), &host_name, &origin);
    Ok(Prepared { listener, tls, guard, map, address, drawn, outside: origin.into_iter().next() })
}

/// Checks that nobody but its owner may read a file. Of one that is a secret: what is none is left as it is.
fn private_file(path: &Path) -> anyhow::Result<()> {
    let shown = path.display();
    let mode = path.metadata().map_err(|error| Ended::usage(format!("cannot read {shown}: {error}")))?.mode();
    match mode & 0o077 {
        0 => Ok(()),
        _ => Err(Ended::usage(format!("others than its owner may read {shown}: `chmod 600 {shown}`"))),
    }
}

fn bytes(path: &Path) -> anyhow::Result<Vec<u8>> {
    let shown = path.display();
    let (bytes, is_longer) =
        files::read(path, FILE_MOST).map_err(|error| Ended::usage(format!("cannot read {shown}: {error}")))?;
    if is_longer {
        return Err(Ended::usage(format!("{shown} is longer than {FILE_MOST} bytes: it is no such file")));
    }
    Ok(bytes.to_vec())
}

fn users_of(path: &Path) -> anyhow::Result<Vec<User>> {
    let users = users::read(path, &String::from_utf8(bytes(path)?).unwrap_or_default())?;
    private_file(path)?;
    Ok(users)
}

fn tls(cert: &Path, key: &Path) -> anyhow::Result<TlsAcceptor> {
    let chain: Vec<CertificateDer<'static>> =
        CertificateDer::pem_slice_iter(&bytes(cert)?)
            .collect::<Result<_, _>>()
            .map_err(|error| Ended::usage(format!("{} has no certificate as PEM: {error}", cert.display())))?;
    let private = PrivateKeyDer::from_pem_slice(&bytes(key)?)
        .map_err(|error| Ended::usage(format!("{} has no private key as PEM: {error}", key.display())))?;
    private_file(key)?;
    let config = ServerConfig::builder_with_provider(Arc::new(ring::default_provider()))
        .with_safe_default_protocol_versions()?
        .with_no_client_auth()
        .with_single_cert(chain, private)
        .map_err(|error| Ended::usage(format!("{} and {} cannot be used: {error}", cert.display(), key.display())))?;
    Ok(TlsAcceptor::from(Arc::new(config)))
}

fn background_of(path: &Path) -> anyhow::Result<Grid> {
    let shown = path.display();
    let (bytes, is_longer) =
        files::read(path, map::LONGEST).map_err(|error| Ended::usage(format!("cannot read {shown}: {error}")))?;
    if is_longer {
        return Err(Ended::usage(format!("{shown} is longer than {} bytes: cut the map", map::LONGEST)));
    }
    let text = String::from_utf8_lossy(&bytes);
    map::read(&text).map_err(|mistake| Ended::usage(format!("{shown}: {mistake}")))
}
