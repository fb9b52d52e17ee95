//! Clicks through `cara web` in a browser, as an operator would: vehicles that move, a form filled wrongly and rightly, a stop of
//! all, a vehicle that dies, a manager that hangs and dies, a server that dies; then the warehouse at work. Any other outcome ends
//! it with an error.

mod browser;
mod proxy;
mod stage;
mod warehouse;

use std::path::PathBuf;
use std::time::{Duration, Instant};

use anyhow::{Context, Result, ensure};
use cara_processes::ticker::Ticker;
use clap::Parser;
use serde_json::Value;

use browser::{Browser, DESKTOP, TABLET};
use stage::{AGVS, PATIENCE, Stage, excuse};

/// Clicks through `cara web` in a headless Chromium.
#[derive(Parser)]
struct Options {
    /// Where the programs `cara`, `agv` and `warehouse` are; where this one is unless told.
    #[arg(long, value_name = "FOLDER")]
    programs: Option<PathBuf>,
    /// Write screenshots into this folder.
    #[arg(long, value_name = "FOLDER")]
    write: Option<PathBuf>,
    /// Instead of all that, keep the page open for so many minutes while a warehouse works in which everything fails, and print
    /// what it takes.
    #[arg(long)]
    minutes: Option<u32>,
    /// With so many vehicles.
    #[arg(long, default_value_t = 200, requires = "minutes")]
    vehicles: u32,
}

/// Pages beside the first one, which have all other connections that Chromium makes to a server.
const PAGES: usize = 5;

/// What the page says where a lease has ended by itself, also before the vehicle drove, and where one that has just ended is in the
/// way of a call.
const STOPPED: [&str; 5] = ["It stopped there", "Unattended", "Expired", "Busy", "NotReady"];
/// How often a call is made again: not so often that a vehicle comes far whose lease is not kept.
const AGAIN: usize = 5;

fn main() -> Result<()> {
    let options = Options::parse();
    let own = std::env::current_exe()?.parent().context("a program is in a folder")?.to_owned();
    let programs = options.programs.unwrap_or(own);
    tokio::runtime::Builder::new_current_thread().enable_all().build()?.block_on(async {
        if let Some(minutes) = options.minutes {
            let browser = Browser::start(None).await?;
            warehouse::watch(&browser, &programs, options.vehicles, minutes).await?;
            return browser.close().await;
        }
        let mut stage = Stage::start(&programs)?;
        let url = stage.start_web()?;
        let browser = Browser::start(options.write.as_deref()).await?;
        look(&browser, &mut stage, &url).await?;
        command(&browser).await?;
        managers(&browser, &stage).await?;
        pictures(&browser).await?;
        tablet(&browser).await?;
        widths(&browser, &url).await?;
        stop(&browser).await?;
        crowd(&browser, &url).await?;
        let (_, key) = url.split_once('#').context("the address has a key")?;
        roles(&browser, &stage).await?;
        proxy::stop(&browser, &stage, key).await?;
        browser.open("about:blank").await?;
        browser.open(&url).await?;
        lose(&browser, &mut stage).await?;
        browser.check_faults().await?;
        values(&browser, &mut stage).await?;
        drop(stage);
        warehouse::look(&browser, &programs).await?;
        browser.close().await
    })
}

/// The place of a vehicle in the table of nodes.
fn place(agv: &str) -> String {
    let row = format!("[...document.querySelectorAll('#nodes tr')].find((row) => row.innerText.startsWith('{agv}/'))");
    format!("{row}?.children[3].textContent")
}

/// What is seen without a click.
async fn look(browser: &Browser, stage: &mut Stage, url: &str) -> Result<()> {
    let (page, key) = url.split_once('#').context("the address has a key")?;
    browser.open(page).await?;
    browser.says("#login", "Token").await?;
    browser.fill("#token", "0000").await?;
    browser.click("#login button").await?;
    browser.says("#login-error", "not the right one").await?;
    browser.fill("#token", key).await?;
    browser.click("#login button").await?;
    browser.wait("the key opens the page", "!document.querySelector('#login').open").await?;
    browser.open("about:blank").await?;
    browser.open(url).await?;
    let count = AGVS.len();
    browser.says("#count", &format!("{count} of {count} connected")).await?;
    ensure!(
        !browser.run("return location.href").await?.as_str().unwrap_or("#").contains('#'),
        "the key stays in the address"
    );
    browser.says("#link", "live").await?;
    browser.says("#unit", "depot/1").await?;
    measure(browser).await?;
    stage.drive()?;
    for agv in ["agv-2", "agv-3"] {
        let has_left = format!("({}) && !{}.startsWith('0.00, 0.00')", place(agv), place(agv));
        driving(browser, stage, &format!("{agv} is on its way"), &has_left).await?;
    }
    browser.run(&format!("window.before = {}", place("agv-2"))).await?;
    driving(browser, stage, "agv-2 moves", &format!("{} !== before", place("agv-2"))).await?;
    driving(browser, stage, "an order runs", &shown("#orders tr", "runs")).await?;
    browser.says("#map-about", "25 × 14 cells").await?;
    browser
        .wait("round trips are measured", "/[µm]s/.test(document.querySelector('#nodes td.number').textContent)")
        .await?;
    accessible(browser).await
}

/// That an element is shown with a text in it.
fn shown(selector: &str, text: &str) -> String {
    format!(
        "[...document.querySelectorAll('{selector}')].some((one) => one.checkVisibility() && one.innerText.includes('{text}'))"
    )
}

/// Waits until an expression is true in the page, while vehicles drive that commands hold.
async fn driving(browser: &Browser, stage: &mut Stage, what: &str, expression: &str) -> Result<()> {
    let started = Instant::now();
    while browser.run(&format!("return Boolean({expression})")).await? != true && started.elapsed() < PATIENCE {
        stage.drive_on()?;
        tokio::time::sleep(Duration::from_millis(100)).await;
    }
    browser.wait(what, expression).await
}

/// Calls what a form offers. The ticker tells from then on whether the host may have ended it.
async fn call(browser: &Browser, form: &str) -> Result<Ticker> {
    let ticker = Ticker::start();
    browser.click(&format!("{form} button.primary")).await?;
    Ok(ticker)
}

/// Waits until an expression is true in the page, while a form holds what it called. A host that stands still for longer than the
/// lease ends it, which is right: then it is called again. What ends without that is an error.
async fn keep_held(browser: &Browser, form: &str, ticker: &mut Ticker, what: &str, expression: &str) -> Result<()> {
    let stopped = STOPPED.map(|text| shown(&format!("{form} .outcome"), text)).join(" || ");
    let ended =
        format!("document.querySelector('{form} button.primary').textContent.startsWith('Call ') && ({stopped})");
    for _ in 0..AGAIN {
        browser.wait(what, &format!("({expression}) || ({ended})")).await?;
        if browser.run(&format!("return Boolean({expression})")).await? == true {
            return Ok(());
        }
        if browser.run(&format!("return Boolean({ended})")).await? == true {
            excuse(ticker, form)?;
            *ticker = call(browser, form).await?;
        }
    }
    browser.wait(what, expression).await
}

/// Releases what a form holds. A click that comes when it has just ended calls again.
async fn release(browser: &Browser, form: &str, ticker: &mut Ticker) -> Result<()> {
    let note = format!(
        "const button = document.querySelector('{form} button.primary');
        button.addEventListener('click', () => {{ window.clicked = button.textContent; }}, {{ capture: true, once: true }})"
    );
    let held = shown(&format!("{form} .outcome"), "held, as long as this page is shown");
    for _ in 0..AGAIN {
        keep_held(browser, form, ticker, "it is held", &held).await?;
        browser.run(&note).await?;
        let clicked = call(browser, form).await?;
        if browser.run("return window.clicked").await? == "Release" {
            break;
        }
        excuse(ticker, form)?;
        *ticker = clicked;
    }
    browser.says(&format!("{form} .outcome"), "released").await
}

/// How much came over the wire, and when something was to be seen first.
pub(crate) async fn measure(browser: &Browser) -> Result<()> {
    let script =
        "const all = [...performance.getEntriesByType('navigation'), ...performance.getEntriesByType('resource')]
        .filter((entry) => !entry.name.includes('/api/'));
        return [all.reduce((sum, entry) => sum + entry.transferSize, 0), all.length,
            performance.getEntriesByName('first-contentful-paint')[0]?.startTime ?? null]";
    let found = browser.run(script).await?;
    println!(
        "first load: {} bytes in {} files, first contentful paint after {:.0} ms",
        found[0],
        found[1],
        found[2].as_f64().unwrap_or(f64::NAN)
    );
    let bytes = found[0].as_u64().context("the browser counts bytes")?;
    ensure!((1..100_000).contains(&bytes), "the first load takes {bytes} bytes");
    Ok(())
}

/// Everything that can be used has a name, and the page has its landmarks.
async fn accessible(browser: &Browser) -> Result<()> {
    let script = "const name = (element) => (element.getAttribute('aria-label') || element.innerText || element.title
            || element.labels?.[0]?.innerText || element.getAttribute('aria-labelledby') || '').trim();
        return [...document.querySelectorAll('button, input, select, textarea, canvas, section, dialog')]
            .filter((element) => !name(element)).map((element) => element.outerHTML.slice(0, 100))";
    let nameless = browser.run(script).await?;
    ensure!(nameless == Value::Array(Vec::new()), "without a name: {nameless}");
    let landmarks = "return ['header', 'main', 'h1', '#banner[role=alert]', '[role=log]', 'html[lang]']
        .every((selector) => document.querySelectorAll(selector).length === 1)";
    ensure!(browser.run(landmarks).await? == true, "a landmark is missing or there twice");
    Ok(())
}

/// A filter, a form filled wrongly and rightly, a hold.
async fn command(browser: &Browser) -> Result<()> {
    browser.press('/').await?;
    browser.run("window.filter = document.activeElement.id").await?;
    browser.wait("the slash goes to the filter", "filter === 'filter'").await?;
    browser.fill("#filter", "agv-3").await?;
    browser.wait("one node is left", "document.querySelectorAll('#nodes tr').length === 1").await?;
    browser.says("#nodes-about", "1 of 5").await?;
    browser.run("document.querySelector('#filter').value = ''; document.querySelector('#filter').oninput()").await?;
    browser.wait("all are back", "document.querySelectorAll('#nodes tr').length === 5").await?;
    browser.click("#nodes tr:first-child button").await?;
    browser.says("#node-title", "agv-1/11").await?;
    browser.says("#functions summary", "pos_info").await?;
    let form = open(browser, "go_to").await?;
    let [x, y] = [1, 2].map(|nth| format!("{form} .inputs input:nth-child({nth})"));
    browser.fill(&x, "1.5").await?;
    browser.says(&format!("{form} .field .error"), "element 2 is missing").await?;
    // So far that it is released before.
    browser.fill(&y, "900").await?;
    browser.says(&format!("{form} .field .error"), "“1.5” is no whole number").await?;
    browser.click(&format!("{form} button.primary")).await?;
    let asked = browser.run(&format!("return !document.querySelector('{form} .outcome').hidden")).await?;
    ensure!(asked == false, "a form with a mistake was sent");
    browser.fill(&x, "6").await?;
    browser.wait("the mistake is gone", &format!("document.querySelector('{form} .error').textContent === ''")).await?;
    browser.click(&format!("{form} details summary")).await?;
    browser.click(&format!("{form} .options label:nth-child(3) input")).await?;
    let mut ticker = call(browser, &form).await?;
    let held = shown(&format!("{form} .outcome"), "held, as long as this page is shown");
    keep_held(browser, &form, &mut ticker, "it is held", &held).await?;
    let has_left = format!("{} && !{}.startsWith('0.00, 0.00')", place("agv-1"), place("agv-1"));
    keep_held(browser, &form, &mut ticker, "agv-1 moves", &has_left).await?;
    let form = open(browser, "pos_info").await?;
    for nth in [1, 2] {
        browser.fill(&format!("{form} .inputs input:nth-child({nth})"), "0").await?;
    }
    browser.click(&format!("{form} button.primary")).await?;
    browser.says(&format!("{form} .outcome"), "position = [").await?;
    let form = open(browser, "go_to").await?;
    release(browser, &form, &mut ticker).await?;
    // The node refuses what the form cannot know.
    browser.fill(&x, "99999999").await?;
    let mut ticker = call(browser, &form).await?;
    let refused = shown(&format!("{form} .outcome.bad"), "Service (Failed, code 1)");
    keep_held(browser, &form, &mut ticker, "the node refuses", &refused).await
}

/// Which manager has which vehicle; one that does not answer is not known, and its name is text.
async fn managers(browser: &Browser, stage: &Stage) -> Result<()> {
    let _hangs = stage.hostile_socket()?;
    browser.click("#managers-look").await?;
    browser.says("#managers-about", "looked").await?;
    let rows = "[...document.querySelectorAll('#managers tr')].map((row) => [...row.children].map((cell) => cell.textContent))";
    let has = |manager: &str, s_unit: &str, state: &str| {
        format!(
            "{rows}.some((cells) => cells[0] === '{manager}' && cells[2] === '{s_unit}' && cells[3].startsWith('{state}'))"
        )
    };
    for (agv, id) in AGVS.iter().zip(11..) {
        browser.wait("a vehicle is at its manager", &has("depot/1", &format!("{agv}/{id}"), "connected")).await?;
    }
    let name = r"<img src=x onerror=alert(1)>\\u{202e}/9";
    browser.wait("a manager that hangs is not known", &has(name, "not known", "not asked: ")).await?;
    browser.wait("nothing becomes markup", "!document.querySelector('#managers img, #managers-remarks img')").await?;
    browser.says("#managers-remarks", "S_units that have joined are silent").await?;
    // That there is an earlier answer hides neither that they are asked again, nor that this failed.
    browser.click("#managers-look").await?;
    let about = "document.querySelector('#managers-about').innerText";
    let both = |text: &str| format!("{about}.includes('{text}') && / looked .* ago/.test({about})");
    browser.wait("managers are asked again", &both("listens for")).await?;
    browser.wait("they have answered", "!document.querySelector('#managers-look').disabled").await?;
    let cut = "window.reaches = fetch; \
               window.fetch = (path, how) => path === 'api/managers' ? Promise.reject(new Error('cut')) : reaches(path, how)";
    browser.run(cut).await?;
    browser.click("#managers-look").await?;
    browser.wait("a failure is told beside what was found before", &both("not reached: cut")).await?;
    browser.run("window.fetch = window.reaches").await?;
    browser.click("#managers-look").await?;
    browser.wait("an answer ends it", &format!("{about}.startsWith('looked ')")).await
}

/// Opens the form of a function of the chosen node. How it is found from then on.
async fn open(browser: &Browser, function: &str) -> Result<String> {
    let script = format!(
        "const found = [...document.querySelectorAll('details.function')].find((one) => one.querySelector('summary').firstChild.textContent === '{function}');
        found.id = 'form-{function}';
        if (!found.open) found.querySelector('summary').click();
        found.scrollIntoView({{ block: 'center' }});"
    );
    browser.run(&script).await?;
    Ok(format!("#form-{function}"))
}

/// Light and dark, with vehicles in the aisles.
async fn pictures(browser: &Browser) -> Result<()> {
    let form = open(browser, "go_to").await?;
    browser.fill(&format!("{form} .inputs input:nth-child(1)"), "6").await?;
    let mut ticker = call(browser, &form).await?;
    let y_of = |agv: &str| format!("Number({}.split(',')[1])", place(agv));
    keep_held(browser, &form, &mut ticker, "agv-1 is in its aisle", &format!("{} > 3", y_of("agv-1"))).await?;
    let script = "document.querySelectorAll('details.function').forEach((one) => { one.open = one.id === 'form-go_to'; one.querySelector('details').open = false; });
        document.activeElement.blur(); scrollTo(0, 0)";
    browser.run(script).await?;
    for theme in ["light", "dark"] {
        browser.theme(theme).await?;
        // The tables are drawn four times a second.
        tokio::time::sleep(Duration::from_millis(600)).await;
        browser.shoot(theme).await?;
    }
    release(browser, &form, &mut ticker).await
}

async fn tablet(browser: &Browser) -> Result<()> {
    browser.press('t').await?;
    browser.resize(TABLET).await?;
    browser.wait("nothing is wider than a tablet", "document.documentElement.scrollWidth <= innerWidth").await?;
    browser.run("document.querySelector('#limits-title').parentElement.open = true").await?;
    browser.says("#limits", "connections of browsers").await?;
    browser.wait("limits are not wider either", "document.documentElement.scrollWidth <= innerWidth").await?;
    browser.resize(DESKTOP).await?;
    let fits = "document.documentElement.scrollWidth <= innerWidth";
    browser.wait("nor on a desktop", fits).await?;
    browser.run("document.querySelector('#limits-title').parentElement.open = false").await?;
    browser.resize(TABLET).await?;
    let in_view = "const box = document.querySelector('#stop-all').getBoundingClientRect(); scrollTo(0, 1e6);
        const then = document.querySelector('#stop-all').getBoundingClientRect();
        return [box, then].every(({ top, bottom, left, right }) => top >= 0 && left >= 0 && bottom <= innerHeight && right <= innerWidth)";
    ensure!(browser.run(in_view).await? == true, "stop-all is not in view on a tablet");
    browser.run("scrollTo(0, 0)").await?;
    browser.shoot("tablet").await?;
    browser.resize(DESKTOP).await
}

/// Nothing scrolls sideways, whatever is open, and the bar covers nothing that is scrolled to.
async fn widths(browser: &Browser, url: &str) -> Result<()> {
    const OPEN: &str = "document.querySelectorAll('details').forEach((one) => { one.open = true; })";
    const FITS: &str = "document.documentElement.scrollWidth <= document.documentElement.clientWidth";
    const BELOW_BAR: &str = "(document.querySelector('#nodes tr button').scrollIntoView(),
        document.querySelector('#nodes tr button').getBoundingClientRect().top >= document.querySelector('.bar').getBoundingClientRect().bottom)";
    let narrow = Browser::start_narrow(400).await?;
    narrow.open(url).await?;
    narrow.says("#nodes", "agv-1/11").await?;
    narrow.run("document.querySelector('#nodes tr button').click()").await?;
    narrow.wait("functions are shown", "document.querySelector('#functions summary')").await?;
    narrow.run(OPEN).await?;
    narrow.wait("400 pixels suffice", &format!("innerWidth === 400 && {FITS}")).await?;
    narrow.wait("a button that is scrolled to is below the bar", BELOW_BAR).await?;
    narrow.close().await?;
    browser.run(&format!("window.were = [...document.querySelectorAll('details[open]')]; {OPEN}")).await?;
    for width in [500, 640, 900, 1080, 1440, 1920] {
        browser.resize((width, 1180)).await?;
        browser.wait(&format!("{width} pixels suffice"), FITS).await?;
        browser.wait("a button that is scrolled to is below the bar", BELOW_BAR).await?;
    }
    browser.run("scrollTo(0, 0)").await?;
    browser.run("document.querySelectorAll('details').forEach((one) => { one.open = were.includes(one); })").await?;
    browser.resize(DESKTOP).await
}

/// A stop of all by a click, a reset, and a stop by the keyboard.
async fn stop(browser: &Browser) -> Result<()> {
    let count = AGVS.len();
    let all = format!("{count} of {count} acknowledged");
    browser.click("#stop-all").await?;
    browser.says("#stop-summary", &all).await?;
    browser
        .wait(
            "each acknowledgement is shown",
            &format!("document.querySelectorAll('#stop-list li.good').length === {count}"),
        )
        .await?;
    browser.wait("all are shown as stopped", &format!("[...document.querySelectorAll('#nodes tr')].filter((row) => row.innerText.includes('stopped')).length === {count}")).await?;
    browser.shoot("stop").await?;
    browser.click("#reset-all").await?;
    browser.says("#confirm", "may move again").await?;
    browser.click("#confirm-yes").await?;
    browser.says("#stop-title", "Reset of all").await?;
    browser.says("#stop-summary", &all).await?;
    browser.press('S').await?;
    browser.says("#stop-title", "Stop of all").await?;
    browser.says("#stop-summary", &all).await?;
    browser.click("#doctor").await?;
    browser.says("#doctor-about", "looked").await?;
    browser.wait("the doctor's findings are shown", "document.querySelector('#findings li')").await
}

/// Whole numbers in a record keep their digits, and members their order, to the node and back.
async fn values(browser: &Browser, stage: &mut Stage) -> Result<()> {
    stage.start_box()?;
    browser.open("about:blank").await?;
    browser.open(&stage.start_web()?).await?;
    browser.wait("the box has joined", "[...document.querySelectorAll('#nodes tr')].some((row) => row.innerText.startsWith('box/20') && row.innerText.includes('connected'))").await?;
    browser.fill("#filter", "box").await?;
    browser.wait("one node is left", "document.querySelectorAll('#nodes tr').length === 1").await?;
    browser.click("#nodes tr:first-child button").await?;
    browser.says("#functions summary", "load").await?;
    browser.says("#nodes td.warn", "s behind").await?;
    browser.says("#alarms li", "box/20 clock").await?;
    browser.says("#node-facts", "Clock").await?;
    let form = open(browser, "load").await?;
    let load = r#"{"stamp":1460549358372198212,"at":[{"x":-9223372036854775808},{"x":9007199254740993}],"kg":1.0}"#;
    browser.fill(&format!("{form} textarea"), load).await?;
    browser.click(&format!("{form} button.primary")).await?;
    let shown = format!("document.querySelector('{form} .outcome').innerText.replace(/\\s/g, '')");
    browser.wait("the box has got each digit", &format!("{shown}.startsWith('l={load}')")).await?;
    browser.check_faults().await
}

/// A user who may look: what else the page could do is disabled, but for a stop.
async fn roles(browser: &Browser, stage: &Stage) -> Result<()> {
    let (_web, url) = stage.start_web_for("see lobby 0123456789abcdef\n")?;
    browser.open(&format!("{url}#0123456789abcdef")).await?;
    browser.says("#me", "lobby may look and stop").await?;
    browser.says("#nodes", "agv-1/11").await?;
    browser.click("#nodes tr:first-child button").await?;
    browser.says("#functions summary", "go_to").await?;
    let form = open(browser, "go_to").await?;
    browser.says(&form, "Your role, see, may not call this: it needs operate.").await?;
    browser.says(&format!("{form} button.primary:disabled"), "Call go_to").await?;
    browser
        .wait(
            "nor reset",
            "document.querySelector('#reset-all:disabled') && document.querySelector('#node-reset:disabled')",
        )
        .await?;
    browser.wait("a stop can be asked for", "document.querySelector('#stop-all:enabled')").await?;
    browser.click("#stop-all").await?;
    browser.says("#stop-summary", &format!("{0} of {0} acknowledged", AGVS.len())).await?;
    browser.check_faults().await
}

/// More pages of one browser than it has connections to a server: a stop gets its own.
async fn crowd(browser: &Browser, url: &str) -> Result<()> {
    let count = AGVS.len();
    let first = browser.window().await?;
    browser.click("#reset-all").await?;
    browser.click("#confirm-yes").await?;
    browser.says("#stop-summary", &format!("{count} of {count} acknowledged")).await?;
    let mut others = Vec::new();
    for _ in 0..PAGES {
        others.push(browser.open_beside(url).await?);
        browser.says("#link", "live").await?;
    }
    browser.switch(&first).await?;
    // Timed by the page, since the looks at it from here take their time.
    let note = "window.took = null;
        const panel = document.querySelector('#stop-panel');
        document.querySelector('#stop-all').addEventListener('click', () => {
            const clicked = performance.now();
            const look = () => { if (panel.classList.contains('done')) window.took ??= performance.now() - clicked; };
            new MutationObserver(look).observe(panel, { attributes: true });
        }, { capture: true, once: true })";
    browser.run(note).await?;
    let ticker = Ticker::start();
    browser.click("#stop-all").await?;
    browser.says("#stop-title", "Stop of all").await?;
    browser.says("#stop-summary", &format!("{count} of {count} acknowledged")).await?;
    browser.wait("the stop is done", "took !== null").await?;
    let took = browser.run("return took").await?.as_f64().context("the page has timed it")?;
    let (took, held_up) = (Duration::from_secs_f64(took / 1e3), ticker.together());
    // Those that are hidden give their connections up after 10 s.
    ensure!(took < Duration::from_secs(4) + held_up, "the stop has waited for a connection: {took:?}");
    println!("stopped beside {PAGES} more pages after {took:?}");
    for window in others {
        browser.switch(&window).await?;
        browser.shut().await?;
    }
    browser.switch(&first).await
}

/// A vehicle that dies, a manager that hangs, dies and comes back, a server that dies.
async fn lose(browser: &Browser, stage: &mut Stage) -> Result<()> {
    browser.run("scrollTo(0, 0)").await?;
    stage.kill_a_vehicle()?;
    browser.says("#nodes tr.lost .state", "LOST").await?;
    browser.says("#count.bad", "4 of 5 connected").await?;
    browser.says("#alarms li", "agv-5/15 is lost").await?;
    browser.click("#alarms-all").await?;
    browser
        .wait(
            "it stays until it has ended",
            "/agv-5.15 is lost[^]*acknowledged 20/.test(document.querySelector('#alarms').innerText)",
        )
        .await?;
    browser.click("#stop-all").await?;
    browser.says("#stop-summary.bad", "4 of 5 acknowledged").await?;
    browser.says("#stop-list li.bad", "NOT REACHED").await?;
    stage.freeze_manager()?;
    browser.says("#banner", "The manager does not answer. What is shown is old.").await?;
    stage.thaw_manager()?;
    browser.wait("a manager that goes on is live", "document.querySelector('#banner').hidden").await?;
    let ended = "/The manager is lost[^]*until 20/.test(document.querySelector('#alarms').innerText)";
    browser.wait("its alarm has an end, and is to be acknowledged", ended).await?;
    browser.click("#alarms-all").await?;
    browser
        .wait("what has ended and was seen goes", "!document.querySelector('#alarms').innerText.includes('manager')")
        .await?;
    stage.kill_manager()?;
    browser.says("#banner", "The manager is lost. What is shown is old.").await?;
    browser.wait("old data is grey and has its age", "document.body.classList.contains('stale') && document.querySelector('#map-stale').innerText.startsWith('as it was')").await?;
    browser.says("#nodes .state", "was connected").await?;
    browser.click("#stop-all").await?;
    browser.says("#stop-summary.bad", "THE STOP FAILED").await?;
    browser.says("#stop-summary", "Use the vehicles’ own emergency stop.").await?;
    browser.shoot("lost").await?;
    stage.start_manager()?;
    browser
        .wait(
            "a new manager is found",
            "document.querySelector('#banner').hidden && !document.body.classList.contains('stale')",
        )
        .await?;
    browser.says("#count", "4 of").await?;
    stage.kill_web()?;
    browser.says("#banner", "No connection to cara web. What is shown is old.").await?;
    browser.says("#stop-note", "no connection").await?;
    browser.click("#stop-all").await?;
    browser.says("#stop-summary.bad", "THE STOP FAILED: the server of this page was not reached").await
}
