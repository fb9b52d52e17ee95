//! The page behind nginx, as [web.md](../../../docs/web.md#behind-a-proxy) says, and as proxies are that nobody has told anything:
//! at the root and below a path, with and without TLS.

use std::net::{Ipv4Addr, TcpListener};
use std::path::Path;

use anyhow::{Context, Result};
use cara_processes::Process;

use crate::browser::Browser;
use crate::stage::{AGVS, Stage};

/// A way to the page.
struct Way {
    scheme: &'static str,
    path: &'static str,
    /// Its own lines in the server's block and in that of the path.
    server: &'static str,
    location: &'static str,
    /// Whether `cara web` has been told its origin.
    is_reported: bool,
}

/// As `docs/web.md` has it.
const DOCUMENTED: &str =
    "proxy_http_version 1.1; proxy_buffering off; proxy_read_timeout 1h; proxy_set_header Host $http_host;";
const WAYS: [Way; 6] = [
    Way { scheme: "http", path: "/", server: "", location: "", is_reported: true },
    Way { scheme: "https", path: "/", server: "", location: DOCUMENTED, is_reported: true },
    Way { scheme: "http", path: "/hall/2/", server: "", location: DOCUMENTED, is_reported: true },
    Way { scheme: "https", path: "/hall/2/", server: "", location: "", is_reported: true },
    Way { scheme: "https", path: "/", server: "", location: "", is_reported: false },
    Way { scheme: "http", path: "/", server: "location ~ [.]js$ { return 403; }", location: "", is_reported: true },
];

/// Ports of this test: of `cara web`, and of the ways to it.
pub(crate) struct Ports {
    pub(crate) web: u16,
    ways: Vec<u16>,
}

impl Ports {
    pub(crate) fn choose() -> Result<Self> {
        // Held until all are chosen, so that they differ.
        let held: Vec<_> =
            (0..=WAYS.len()).map(|_| TcpListener::bind((Ipv4Addr::LOCALHOST, 0))).collect::<Result<_, _>>()?;
        let mut ports = held.iter().map(|socket| Ok(socket.local_addr()?.port())).collect::<Result<Vec<u16>>>()?;
        Ok(Self { web: ports.swap_remove(0), ways: ports })
    }

    fn url(&self, number: usize) -> String {
        let Way { scheme, path, .. } = WAYS[number];
        format!("{scheme}://127.0.0.1:{}{path}", self.ways[number])
    }

    /// What `cara web` is told.
    pub(crate) fn origins(&self) -> Vec<String> {
        (0..WAYS.len())
            .filter(|number| WAYS[*number].is_reported)
            .map(|number| format!("--origin={}", self.url(number)))
            .collect()
    }

    fn configuration(&self, folder: &Path) -> String {
        let place = folder.display();
        let temporary = ["client_body", "proxy", "fastcgi", "uwsgi", "scgi"];
        let temporary: String = temporary.map(|what| format!("{what}_temp_path {place}/{what};\n")).concat();
        let servers: String = WAYS.iter().zip(&self.ways).map(|(way, port)| {
            let Way { scheme, path, server, location, .. } = way;
            let tls = if *scheme == "https" { " ssl" } else { "" };
            format!(
                "server {{ listen 127.0.0.1:{port}{tls}; ssl_certificate {place}/cert.pem; ssl_certificate_key {place}/key.pem; {server}
                    location {path} {{ proxy_pass http://127.0.0.1:{}/; {location} }} }}\n", self.web
            )
        }).collect();
        format!(
            "daemon off; master_process off; pid {place}/nginx.pid; error_log {place}/nginx.log;\nevents {{}}\nhttp {{\naccess_log off;\n{temporary}{servers}}}\n"
        )
    }
}

/// Stops all through each way that `cara web` was told; through the others the page says that it cannot.
pub(crate) async fn stop(browser: &Browser, stage: &Stage, key: &str) -> Result<()> {
    let folder = tempfile::tempdir()?;
    let rcgen::CertifiedKey { cert, signing_key } = rcgen::generate_simple_self_signed(["127.0.0.1".to_owned()])?;
    std::fs::write(folder.path().join("cert.pem"), cert.pem())?;
    std::fs::write(folder.path().join("key.pem"), signing_key.serialize_pem())?;
    let file = folder.path().join("nginx.conf");
    std::fs::write(&file, stage.ports.configuration(folder.path()))?;
    let log = folder.path().join("nginx.log");
    let (file, log) = (file.display().to_string(), log.display().to_string());
    let _nginx = Process::start("nginx", Path::new("nginx"), ["-c", &*file, "-e", &*log])?;
    let count = AGVS.len();
    for (number, way) in WAYS.iter().enumerate() {
        let url = format!("{}#{key}", stage.ports.url(number));
        println!("{url}");
        browser.open_soon(&url).await.with_context(|| std::fs::read_to_string(&log).unwrap_or_default())?;
        if !way.server.is_empty() {
            browser.says("#stop-all:disabled", "this page has not started").await?;
            continue;
        }
        browser.says("#link", "live").await?;
        if !way.is_reported {
            browser.says("#stop-all:disabled", "refused by the server").await?;
            browser
                .says("#banner", "STOP ALL does not work on this page.\n403: only the page of `cara web` itself")
                .await?;
            browser.says("#banner", &format!("--origin {}", stage.ports.url(number))).await?;
            continue;
        }
        browser.says("#count", &format!("{count} of {count} connected")).await?;
        browser.wait("a stop can be asked for", "document.querySelector('#stop-all:enabled')").await?;
        browser.click("#stop-all").await?;
        browser.says("#stop-summary", &format!("{count} of {count} acknowledged")).await?;
        browser.check_faults().await?;
    }
    Ok(())
}
