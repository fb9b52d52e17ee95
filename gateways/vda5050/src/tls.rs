//! TLS 1.2 and 1.3 to the broker, and when the certificates of both ends expire.

use std::path::Path;
use std::sync::Arc;
use std::sync::atomic::{AtomicU64, Ordering};
use std::time::{Duration, SystemTime, UNIX_EPOCH};

use anyhow::{Context, Result, ensure};
use rustls::client::WebPkiServerVerifier;
use rustls::client::danger::{HandshakeSignatureValid, ServerCertVerified, ServerCertVerifier};
use rustls::pki_types::pem::PemObject;
use rustls::pki_types::{CertificateDer, PrivateKeyDer, ServerName, UnixTime};
use rustls::{ClientConfig, DigitallySignedStruct, Error, RootCertStore, SignatureScheme};

use crate::config;

/// Files of certificates are read so often.
const READ_AGAIN: Duration = Duration::from_secs(60);

/// Whose certificate.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Whose {
    /// The gateway's own, for this vehicle.
    Client,
    /// The broker's.
    Broker,
}

impl Whose {
    /// Both.
    pub const ALL: [Self; 2] = [Self::Client, Self::Broker];

    /// For people.
    pub const fn word(self) -> &'static str {
        match self {
            Self::Client => "client",
            Self::Broker => "broker",
        }
    }
}

/// When certificates expire.
#[derive(Debug, Default)]
pub struct Expiry([AtomicU64; 2]);

impl Expiry {
    /// When one expires, if there is one.
    pub fn of(&self, whose: Whose) -> Option<SystemTime> {
        let seconds = self.0[whose as usize].load(Ordering::Relaxed);
        (seconds != 0).then(|| UNIX_EPOCH + Duration::from_secs(seconds))
    }

    fn note(&self, whose: Whose, certificate: &CertificateDer<'_>) {
        let seconds = not_after(certificate).and_then(|end| end.duration_since(UNIX_EPOCH).ok());
        self.0[whose as usize].store(seconds.map_or(0, |seconds| seconds.as_secs()), Ordering::Relaxed);
    }

    /// The certificate's file may have been replaced since the connection was made.
    fn read_client(&self, broker: &config::Broker) {
        if let Some(first) = broker.certificate_file.as_deref().and_then(|file| certificates(file).ok()) {
            self.note(Whose::Client, &first[0]);
        }
    }
}

/// Reads all clients' certificates now and then, in a thread of its own: a disk that hangs holds up no vehicle.
pub fn watch(clients: Vec<(config::Broker, Arc<Expiry>)>) -> std::io::Result<()> {
    let watch = move || loop {
        std::thread::sleep(READ_AGAIN);
        clients.iter().for_each(|(broker, expiry)| expiry.read_client(broker));
    };
    std::thread::Builder::new().name("certificates".into()).spawn(watch).map(drop)
}

/// The TLS that a broker's settings ask for; its files are read now.
pub fn client(broker: &config::Broker, expiry: &Arc<Expiry>) -> Result<Option<ClientConfig>> {
    let Some(ca) = &broker.ca_file else { return Ok(None) };
    let mut roots = RootCertStore::empty();
    for certificate in certificates(ca)? {
        roots.add(certificate).with_context(|| ca.display().to_string())?;
    }
    let provider = Arc::new(rustls::crypto::ring::default_provider());
    let verifier = WebPkiServerVerifier::builder_with_provider(Arc::new(roots), provider.clone()).build()?;
    let builder = ClientConfig::builder_with_provider(provider).with_safe_default_protocol_versions()?;
    // The verifier is rustls' own; what it has accepted is looked at.
    let looking = Looking { verifier, expiry: expiry.clone() };
    let builder = builder.dangerous().with_custom_certificate_verifier(Arc::new(looking));
    let config = match (&broker.certificate_file, &broker.key_file) {
        (Some(certificate), Some(key)) => {
            let own = PrivateKeyDer::from_pem_file(key).with_context(|| format!("cannot read {}", key.display()))?;
            let chain = certificates(certificate)?;
            expiry.note(Whose::Client, &chain[0]);
            builder.with_client_auth_cert(chain, own)?
        }
        _ => builder.with_no_client_auth(),
    };
    Ok(Some(config))
}

/// At least one.
fn certificates(file: &Path) -> Result<Vec<CertificateDer<'static>>> {
    let read = CertificateDer::pem_file_iter(file).and_then(Iterator::collect);
    let certificates: Vec<_> = read.with_context(|| format!("cannot read certificates of {}", file.display()))?;
    ensure!(!certificates.is_empty(), "{} has no certificate", file.display());
    Ok(certificates)
}

#[derive(Debug)]
struct Looking {
    verifier: Arc<WebPkiServerVerifier>,
    expiry: Arc<Expiry>,
}

impl ServerCertVerifier for Looking {
    fn verify_server_cert(
        &self,
        end_entity: &CertificateDer<'_>,
        intermediates: &[CertificateDer<'_>],
        server_name: &ServerName<'_>,
        ocsp_response: &[u8],
        now: UnixTime,
    ) -> Result<ServerCertVerified, Error> {
        let verified = self.verifier.verify_server_cert(end_entity, intermediates, server_name, ocsp_response, now)?;
        self.expiry.note(Whose::Broker, end_entity);
        Ok(verified)
    }

    fn verify_tls12_signature(
        &self,
        message: &[u8],
        certificate: &CertificateDer<'_>,
        signed: &DigitallySignedStruct,
    ) -> Result<HandshakeSignatureValid, Error> {
        self.verifier.verify_tls12_signature(message, certificate, signed)
    }

    fn verify_tls13_signature(
        &self,
        message: &[u8],
        certificate: &CertificateDer<'_>,
        signed: &DigitallySignedStruct,
    ) -> Result<HandshakeSignatureValid, Error> {
        self.verifier.verify_tls13_signature(message, certificate, signed)
    }

    fn supported_verify_schemes(&self) -> Vec<SignatureScheme> {
        self.verifier.supported_verify_schemes()
    }
}

/// The end of a certificate's validity (RFC 5280, 4.1): Certificate, TBSCertificate, then version, serial number, algorithm and
/// issuer are skipped.
fn not_after(certificate: &[u8]) -> Option<SystemTime> {
    /// Tags of DER.
    const SEQUENCE: u8 = 0x30;
    const VERSION: u8 = 0xa0;
    const UTC_TIME: u8 = 0x17;
    const GENERALIZED_TIME: u8 = 0x18;
    fn inside(bytes: &[u8]) -> Option<&[u8]> {
        match Element::read(bytes) {
            Some((Element { tag: SEQUENCE, content }, _)) => Some(content),
            _ => None,
        }
    }
    let mut rest = inside(inside(certificate)?)?;
    let (first, behind) = Element::read(rest)?;
    if first.tag == VERSION {
        rest = behind;
    }
    for _ in 0..3 {
        rest = Element::read(rest)?.1;
    }
    let (_, behind) = Element::read(inside(rest)?)?;
    let end = Element::read(behind)?.0;
    let digits = std::str::from_utf8(end.content).ok().filter(|text| text.is_ascii())?;
    // RFC 5280, 4.1.2.5.1: years from 50 on are of the last century.
    let century = if digits.get(..2)? < "50" { "20" } else { "19" };
    let digits = match end.tag {
        UTC_TIME => format!("{century}{digits}"),
        GENERALIZED_TIME => digits.to_owned(),
        _ => return None,
    };
    let part = |from: usize, to: usize| digits.get(from..to);
    let (date, time) = ([part(0, 4)?, part(4, 6)?, part(6, 8)?], [part(8, 10)?, part(10, 12)?, part(12, 14)?]);
    humantime::parse_rfc3339(&format!("{}T{}Z", date.join("-"), time.join(":"))).ok()
}

/// A tag and what it is of, in DER.
struct Element<'d> {
    tag: u8,
    content: &'d [u8],
}

impl<'d> Element<'d> {
    /// The first element, and what is behind it.
    fn read(bytes: &'d [u8]) -> Option<(Self, &'d [u8])> {
        let (&tag, bytes) = bytes.split_first()?;
        let (&short, bytes) = bytes.split_first()?;
        let (length, bytes) = match short {
            0..=0x7f => (usize::from(short), bytes),
            0x81..=0x83 => {
                let (long, bytes) = bytes.split_at_checked(usize::from(short & 0x7f))?;
                (long.iter().fold(0, |length, byte| length << 8 | usize::from(*byte)), bytes)
            }
            _ => return None,
        };
        let (content, bytes) = bytes.split_at_checked(length)?;
        Some((Self { tag, content }, bytes))
    }
}

#[cfg(test)]
mod tests {
    use std::process::{Command, Stdio};

    use rustls::pki_types::CertificateDer;
    use rustls::pki_types::pem::PemObject;

    use super::not_after;

    /// Certificates of OpenSSL: before and after 2050 the time has another form.
    #[test]
    fn the_end_of_a_certificate_is_read() {
        let folder = tempfile::tempdir().unwrap();
        for (days, more) in [(1, "rsa:2048"), (400, "rsa:2048"), (20_000, "ed25519")] {
            let mut command = Command::new("openssl");
            command
                .args(["req", "-x509", "-nodes", "-subj", "/CN=x", "-keyout", "key", "-out", "pem", "-newkey", more]);
            command.args(["-days", &days.to_string()]).current_dir(&folder).stderr(Stdio::null());
            assert!(command.status().unwrap().success());
            let told = Command::new("openssl")
                .args(["x509", "-noout", "-enddate", "-dateopt", "iso_8601", "-in", "pem"])
                .current_dir(&folder)
                .output()
                .unwrap();
            let told = String::from_utf8(told.stdout).unwrap();
            let told = told.trim().strip_prefix("notAfter=").unwrap().replace(' ', "T");
            let certificate = CertificateDer::from_pem_file(folder.path().join("pem")).unwrap();
            let read = not_after(&certificate).unwrap();
            assert_eq!(humantime::format_rfc3339(read).to_string(), told);
            // Cut anywhere before its end, or with any other byte, it is no reason to panic.
            for length in 0..certificate.len() {
                let _ = not_after(&certificate[..length]);
                let mut other = certificate.to_vec();
                other[length] ^= 0xff;
                let _ = not_after(&other);
            }
        }
    }
}
