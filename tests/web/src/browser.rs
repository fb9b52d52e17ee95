//! A headless Chromium, driven through WebDriver.

use std::path::{Path, PathBuf};
use std::time::{Duration, Instant};

use anyhow::{Context, Result, bail};
use cara_processes::Process;
use fantoccini::actions::{InputSource, KeyAction, KeyActions};
use fantoccini::wd::WindowHandle;
use fantoccini::{Client, ClientBuilder, Locator};
use hyper_util::client::legacy::connect::HttpConnector;
use serde_json::{Value, json};
use tempfile::TempDir;

use crate::stage::PATIENCE;

/// Between two looks at the page.
const LOOK: Duration = Duration::from_millis(100);
/// Nothing of the system's, nothing of an earlier run, nothing from the network.
const ARGUMENTS: [&str; 9] = [
    "--headless",
    "--no-sandbox",
    "--disable-gpu",
    "--disable-quic",
    "--no-first-run",
    "--disable-background-networking",
    "--disable-component-update",
    "--disable-sync",
    "--hide-scrollbars",
];
pub(crate) const DESKTOP: (u32, u32) = (1440, 1180);
pub(crate) const TABLET: (u32, u32) = (820, 1180);

pub(crate) struct Browser {
    client: Client,
    /// Where screenshots are written, if they are.
    shots: Option<PathBuf>,
    _driver: Process,
    _profile: TempDir,
}

impl Browser {
    pub(crate) async fn start(shots: Option<&Path>) -> Result<Self> {
        Self::start_with(shots, json!({})).await
    }

    /// As wide as a telephone, which no window can be.
    pub(crate) async fn start_narrow(width: u32) -> Result<Self> {
        let screen = json!({ "width": width, "height": 800, "pixelRatio": 1, "touch": false });
        Self::start_with(None, json!({ "mobileEmulation": { "deviceMetrics": screen } })).await
    }

    async fn start_with(shots: Option<&Path>, mut options: Value) -> Result<Self> {
        let mut driver = Process::start("chromedriver", Path::new("chromedriver"), ["--port=0"])?;
        let line = driver.expect("started successfully on port ", PATIENCE)?.text;
        let port = line.rsplit(' ').next().unwrap_or_default().trim_end_matches('.');
        let profile = tempfile::tempdir()?;
        let mut arguments: Vec<String> = ARGUMENTS.map(str::to_owned).into();
        arguments.push(format!("--user-data-dir={}", profile.path().display()));
        arguments.push(format!("--window-size={},{}", DESKTOP.0, DESKTOP.1));
        options["args"] = json!(arguments);
        let wanted =
            [("browserName", json!("chrome")), ("goog:chromeOptions", options), ("acceptInsecureCerts", json!(true))];
        let wanted = wanted.map(|(name, value)| (name.to_owned(), value));
        let client = ClientBuilder::new(HttpConnector::new())
            .capabilities(wanted.into_iter().collect())
            .connect(&format!("http://127.0.0.1:{port}"))
            .await
            .context("the browser does not start")?;
        Ok(Self { client, shots: shots.map(Path::to_owned), _driver: driver, _profile: profile })
    }

    /// Opens the page, and notes from then on what goes wrong in it.
    pub(crate) async fn open(&self, url: &str) -> Result<()> {
        self.client.goto(url).await?;
        let note = "window.faults = [];
            addEventListener('error', (event) => faults.push(event.message));
            addEventListener('unhandledrejection', (event) => faults.push(String(event.reason)));
            document.addEventListener('securitypolicyviolation', (event) => faults.push('policy: ' + event.blockedURI));";
        self.run(note).await.map(drop)
    }

    /// Opens a page whose server may still be starting.
    pub(crate) async fn open_soon(&self, url: &str) -> Result<()> {
        let started = Instant::now();
        loop {
            match self.open(url).await {
                Err(_) if started.elapsed() < PATIENCE => tokio::time::sleep(LOOK).await,
                outcome => return outcome,
            }
        }
    }

    pub(crate) async fn window(&self) -> Result<WindowHandle> {
        Ok(self.client.window().await?)
    }

    /// Opens a page in a tab of its own, which commands go to then.
    pub(crate) async fn open_beside(&self, url: &str) -> Result<WindowHandle> {
        let window = self.client.new_window(true).await?.handle;
        self.switch(&window).await?;
        self.open(url).await?;
        Ok(window)
    }

    pub(crate) async fn switch(&self, window: &WindowHandle) -> Result<()> {
        Ok(self.client.switch_to_window(window.clone()).await?)
    }

    /// Closes the tab that commands go to.
    pub(crate) async fn shut(&self) -> Result<()> {
        Ok(self.client.close_window().await?)
    }

    /// What went wrong in the page is a fault of it.
    pub(crate) async fn check_faults(&self) -> Result<()> {
        let faults = self.run("return faults").await?;
        if faults != json!([]) {
            bail!("the page had faults: {faults}");
        }
        Ok(())
    }

    pub(crate) async fn run(&self, script: &str) -> Result<Value> {
        self.client.execute(script, Vec::new()).await.with_context(|| format!("in `{script}`"))
    }

    /// Waits until an expression is true in the page.
    pub(crate) async fn wait(&self, what: &str, expression: &str) -> Result<()> {
        let started = Instant::now();
        while self.run(&format!("return Boolean({expression})")).await? != true {
            if started.elapsed() > PATIENCE {
                self.shoot("failed").await?;
                bail!("{what}: not so after {PATIENCE:?}: {expression}\n{}", self.text("body").await?);
            }
            tokio::time::sleep(LOOK).await;
        }
        println!("{what}");
        Ok(())
    }

    /// Waits until an element is shown with a text in it.
    pub(crate) async fn says(&self, selector: &str, text: &str) -> Result<()> {
        let (found, text_) = (json!(selector), json!(text));
        let expression = format!(
            "[...document.querySelectorAll({found})].some((element) => element.checkVisibility() && element.innerText.includes({text_}))"
        );
        self.wait(&format!("{selector} says `{text}`"), &expression).await
    }

    pub(crate) async fn text(&self, selector: &str) -> Result<String> {
        Ok(self.client.find(Locator::Css(selector)).await?.text().await?)
    }

    /// Clicks an element in the middle of the window, where nothing that stays at its edge covers it.
    pub(crate) async fn click(&self, selector: &str) -> Result<()> {
        self.run(&format!("document.querySelector({})?.scrollIntoView({{block: 'center'}})", json!(selector))).await?;
        let element = self.client.find(Locator::Css(selector)).await.with_context(|| selector.to_owned())?;
        element.click().await.with_context(|| format!("cannot click {selector}"))
    }

    /// Types into a field, in place of what stands there.
    pub(crate) async fn fill(&self, selector: &str, text: &str) -> Result<()> {
        let field = self.client.find(Locator::Css(selector)).await.with_context(|| selector.to_owned())?;
        field.clear().await?;
        field.send_keys(text).await?;
        Ok(())
    }

    /// Presses a key, with Shift where it is a capital letter.
    pub(crate) async fn press(&self, key: char) -> Result<()> {
        let shift = fantoccini::key::Key::Shift.into();
        let mut keys = KeyActions::new("keyboard".to_owned());
        if key.is_uppercase() {
            keys = keys.then(KeyAction::Down { value: shift });
        }
        keys = keys.then(KeyAction::Down { value: key }).then(KeyAction::Up { value: key });
        if key.is_uppercase() {
            keys = keys.then(KeyAction::Up { value: shift });
        }
        self.client.perform_actions(keys).await?;
        Ok(())
    }

    /// Chooses a theme of the page.
    pub(crate) async fn theme(&self, theme: &str) -> Result<()> {
        while self.run("return document.documentElement.dataset.theme").await? != theme {
            self.press('t').await?;
        }
        Ok(())
    }

    pub(crate) async fn resize(&self, (width, height): (u32, u32)) -> Result<()> {
        self.client.set_window_size(width, height).await?;
        Ok(())
    }

    /// Writes what is seen to a file, if that is wanted.
    pub(crate) async fn shoot(&self, name: &str) -> Result<()> {
        let Some(folder) = &self.shots else { return Ok(()) };
        std::fs::write(folder.join(format!("web-{name}.png")), self.client.screenshot().await?)?;
        Ok(())
    }

    pub(crate) async fn close(self) -> Result<()> {
        self.client.close().await?;
        Ok(())
    }
}
