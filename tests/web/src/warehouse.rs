//! The warehouse of the examples at work, and `cara web` started as the warehouse says.

use std::fs;
use std::os::unix::fs::PermissionsExt;
use std::path::Path;
use std::time::{Duration, Instant};

use anyhow::{Context, Result, ensure};
use cara_processes::Process;
use tempfile::TempDir;

use crate::browser::Browser;
use crate::stage::PATIENCE;

const VEHICLES: usize = 20;
/// So many that all vehicles are at work until the test ends.
const ORDERS: usize = 400;

/// Its processes.
struct Warehouse {
    /// With the address of the page.
    url: String,
    web: Process,
    // It ends what it has started when it is gone.
    run: Process,
    folder: TempDir,
}

impl Warehouse {
    fn start(programs: &Path, folder: TempDir, arguments: &[&str]) -> Result<Self> {
        fs::set_permissions(folder.path(), fs::Permissions::from_mode(0o700))?;
        let place = folder.path().display();
        // What a run leaves behind that is killed goes with this folder.
        let variables = [format!("CARA_CONTROL_DIR={place}"), format!("TMPDIR={place}")];
        let start = |name: &str, arguments: &[&str]| {
            let program = programs.join(name).display().to_string();
            let variables = variables.iter().map(String::as_str);
            Process::start(name, Path::new("env"), variables.chain([&*program]).chain(arguments.iter().copied()))
        };
        let mut run = start("warehouse", arguments)?;
        let reported = run.expect("to watch: cara ", PATIENCE)?.text;
        let reported = reported.split_once("to watch: cara ").context("it says how to watch")?.1;
        // The path of the map, which stands last, may have spaces.
        let arguments: Vec<_> = reported.splitn(7, ' ').chain(["--listen", "127.0.0.1:0"]).collect();
        run.expect("commands them", PATIENCE)?;
        let mut web = start("cara", &arguments)?;
        let line = web.expect("the page is at ", PATIENCE)?.text;
        let url = line.rsplit(' ').next().context("it names an address")?.to_owned();
        Ok(Self { url, web, run, folder })
    }
}

/// A parcel from one of the rows between the shelves to another one, all over the floor.
fn order(number: usize) -> String {
    let (pick, drop) = (7 * number % 24, (11 * number + 5) % 24);
    let (from, to) = [(0, 9), (4, 15), (8, 1), (13, 5)][number % 4];
    format!("{pick},{from} {drop},{to}\n")
}

/// What is wrong on the map: each cell and each vehicle is looked for where it is to be drawn, among the pixels.
const WRONG: &str = "
    window.wrong = () => {
        const canvas = document.querySelector('#map');
        const { width, height, rows } = page.background;
        const [ratio, wide, high] = [canvas.width / canvas.clientWidth, canvas.clientWidth, canvas.clientHeight];
        const scale = Math.min((wide - 24) / width, (high - 24) / height);
        const middle = (x, y) => [wide / 2 + (x - (width - 1) / 2) * scale, high / 2 + (y - (height - 1) / 2) * scale];
        const pixels = canvas.getContext('2d').getImageData(0, 0, canvas.width, canvas.height).data;
        const offset = (x, y) => (Math.round(y * ratio) * canvas.width + Math.round(x * ratio)) * 4;
        const at = (x, y) => pixels.subarray(offset(x, y), offset(x, y) + 3).join();
        const rgb = (name) => page.colour(name).match(/\\d+/g).slice(0, 3).join();
        const [wall, ...vehicle] = ['wall', 'accent', 'moving', 'warn'].map(rgb);
        const isShelf = (x, y) => rows[y]?.[x] === '@';
        const found = [];
        // A name may be written over the last row of shelves.
        for (let y = 0; y < height; y++) for (let x = 0; x < width; x++) {
            if (isShelf(x, y) && isShelf(x, y + 1) && at(...middle(x, y)) !== wall) found.push(`no shelf at ${x},${y}`);
        }
        const vehicles = page.nodes().filter((one) => one.pose);
        for (const { name, pose } of vehicles) {
            const [px, py] = middle(pose.x, pose.y);
            const near = [-6, -3, 0, 3, 6].flatMap((dy) => [-6, -3, 0, 3, 6].map((dx) => at(px + dx, py + dy)));
            if (!near.some((colour) => vehicle.includes(colour))) found.push(`${name} is not drawn at ${pose.x},${pose.y}`);
            if (rows[Math.round(pose.y)]?.[Math.round(pose.x)] !== '.') found.push(`${name} is on no free cell: ${pose.x},${pose.y}`);
        }
        if (vehicles.length !== VEHICLES) found.push(`${vehicles.length} vehicles`);
        return found;
    };
    return Promise.all(['state', 'dom', 'api'].map((name) => import(`/${name}.js`))).then(async ([{ nodes }, { colour }, api]) => {
        const begun = new Map(nodes().map(({ name, pose }) => [name, pose]));
        const far = (pose, from) => Math.abs(pose.x - from.x) + Math.abs(pose.y - from.y);
        window.page = { nodes, colour, begun, far, background: await api.map() };
    });";

/// Each vehicle is drawn where it is, among the shelves, and they move between the cells.
pub(crate) async fn look(browser: &Browser, programs: &Path) -> Result<()> {
    let folder = tempfile::tempdir()?;
    let orders = folder.path().join("orders");
    fs::write(&orders, (0..ORDERS).map(order).collect::<String>())?;
    let (vehicles, orders) = (VEHICLES.to_string(), orders.display().to_string());
    let arguments = ["run", "--no-faults", "--vehicles", &vehicles, "--orders", &orders];
    let warehouse = Warehouse::start(programs, folder, &arguments)?;
    browser.open(&warehouse.url).await?;
    browser.says("#unit", "warehouse/1").await?;
    browser.says("#map-about", &format!("{VEHICLES} vehicles, 24 × 16 cells")).await?;
    browser.theme("light").await?;
    browser.run(&WRONG.replace("VEHICLES", &VEHICLES.to_string())).await?;
    let runs = "page.nodes().filter((one) => one.runs?.function === 'advance').length";
    browser.wait("half of the vehicles drive", &format!("{runs} >= {}", VEHICLES / 2)).await?;
    let between =
        "page.nodes().some(({ pose }) => pose && Math.abs(pose.x % 1 - 0.5) + Math.abs(pose.y % 1 - 0.5) < 0.8)";
    browser.wait("one is between two cells", between).await?;
    let far = "page.nodes().filter(({ name, pose }) => pose && page.far(pose, page.begun.get(name)) >= 6).length";
    browser.wait("half of them have come 6 cells far", &format!("{far} >= {}", VEHICLES / 2)).await?;
    browser.click("#nodes tr:first-child button").await?;
    browser.says("#node-title", "agv-1/").await?;
    browser.says("#functions summary", "advance").await?;
    let form = super::open(browser, "advance").await?;
    browser.says(&format!("{form} form p.help"), "Drives into a cell beside its own").await?;
    browser.says(&format!("{form} .field .label"), "int[2], cells").await?;
    browser.run(&format!("document.querySelector('{form} summary').click()")).await?;
    if let Err(error) = browser.wait("all are drawn where they are", "wrong().length === 0").await {
        return Err(error.context(browser.run("return wrong()").await?));
    }
    browser.run("document.activeElement.blur(); scrollTo(0, 0)").await?;
    browser.shoot("warehouse").await?;
    browser.check_faults().await
}

/// How often it is looked at what the page takes.
const LOOKED: Duration = Duration::from_secs(10);

/// Keeps the page open while the warehouse works and everything fails in it, until the run has judged itself.
pub(crate) async fn watch(browser: &Browser, programs: &Path, vehicles: u32, minutes: u32) -> Result<()> {
    let (count, span) = (vehicles.to_string(), minutes.to_string());
    let arguments = ["run", "--vehicles", &count, "--minutes", &span];
    let Warehouse { url, web, mut run, folder } = Warehouse::start(programs, tempfile::tempdir()?, &arguments)?;
    let began = Instant::now();
    browser.open(&url).await?;
    browser.says("#map-about", &format!("{vehicles} vehicles")).await?;
    println!("{vehicles} vehicles are on the map after {:.1} s", began.elapsed().as_secs_f64());
    crate::measure(browser).await?;
    let frames = "window.frames = 0; const count = () => { window.frames++; requestAnimationFrame(count) }; count()";
    browser.run(frames).await?;
    let (started, before) = (Instant::now(), cpu(web.id())?);
    let ended = "no process ended on its own";
    while !run.has(ended) {
        tokio::time::sleep(LOOKED).await;
        ensure!(started.elapsed() < Duration::from_secs(60) * (minutes + 6), "the warehouse does not end");
        let about = browser.run("return document.querySelector('#count').textContent").await?;
        println!("{:4.0} s  {}", started.elapsed().as_secs_f64(), about.as_str().unwrap_or("the page does not answer"));
    }
    let (took, used) = (started.elapsed(), cpu(web.id())?.saturating_sub(before));
    let drawn = browser.run("return window.frames").await?;
    let status = fs::read_to_string(format!("/proc/{}/status", web.id()))?;
    let resident = status.lines().find_map(|line| line.strip_prefix("VmRSS:")).unwrap_or("unknown").trim();
    run.lines().iter().skip_while(|line| !line.text.starts_with("time ")).for_each(|line| println!("{}", line.text));
    println!(
        "cara web: {:.3} processors, {resident}; the page was drawn {:.0} times a second",
        used.as_secs_f64() / took.as_secs_f64(),
        drawn.as_f64().unwrap_or(0.0) / took.as_secs_f64()
    );
    ensure!(run.wait(PATIENCE)?.success(), "the run was not as it has to be");
    drop(folder);
    Ok(())
}

/// CPU time of a process so far.
fn cpu(process: u32) -> Result<Duration> {
    let stat = fs::read_to_string(format!("/proc/{process}/stat"))?;
    // Behind the name in brackets, which may have spaces; in hundredths of a second.
    let fields: Vec<&str> = stat.rsplit_once(')').context("it has a name")?.1.split_whitespace().collect();
    let ticks: u64 = fields.get(11..13).context("it is short")?.iter().flat_map(|field| field.parse::<u64>()).sum();
    Ok(Duration::from_millis(ticks * 10))
}
