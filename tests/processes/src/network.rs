//! A network of one's own: the program runs itself again in a namespace, where it may do as it likes with interfaces,
//! addresses and firewalls, and meets nobody. It ends with the process.

use std::ffi::OsStr;
use std::process::{Command, ExitStatus, Stdio};

use anyhow::{Context, Result, bail, ensure};

/// Set inside.
const INSIDE: &str = "CARA_OWN_NETWORK";
/// Where Debian keeps `ip` and the like, which is not on everybody's path.
const PATHS: &str = "/usr/sbin:/sbin:/usr/local/sbin";

/// Where this program runs.
pub enum Own {
    /// In a network of its own: go on.
    Inside,
    /// It has run there, and ended.
    Ended(ExitStatus),
    /// The system does not let this user make one, or something is missing.
    Impossible(String),
}

/// Runs this program again, with these arguments, in a network of its own, unless it is there already. `needs` are
/// programs that must be there; with `tap`, the network must be able to hold virtual Ethernet devices.
pub fn own<A: AsRef<OsStr>>(arguments: impl IntoIterator<Item = A>, needs: &[&str], tap: bool) -> Result<Own> {
    if std::env::var_os(INSIDE).is_some() {
        run("ip link set lo up")?;
        return Ok(Own::Inside);
    }
    if let Some(absent) = ["unshare", "ip"].iter().chain(needs).find(|program| !is_there(program)) {
        return Ok(Own::Impossible(format!("the program `{absent}` is not installed")));
    }
    let trial = if tap { "ip tuntap add name trial mode tap" } else { "ip link set lo up" };
    let Some(kind) = KINDS.iter().find(|kind| works(unshare(kind).args(["sh", "-c", trial]))) else {
        return Ok(Own::Impossible(format!("`unshare` and then `{trial}` does not work for this user")));
    };
    let mut again = unshare(kind);
    again.arg(std::env::current_exe()?).args(arguments).env(INSIDE, "1");
    Ok(Own::Ended(again.status().context("cannot start `unshare`")?))
}

/// As root, and as a user who is root inside only.
const KINDS: [&[&str]; 2] = [&["--net"], &["--user", "--map-root-user", "--net"]];

fn unshare(kind: &[&str]) -> Command {
    let mut command = Command::new("unshare");
    command.env("PATH", paths()).args(["--fork", "--kill-child"]).args(kind);
    command
}

fn paths() -> String {
    std::env::var("PATH").map_or_else(|_| PATHS.to_owned(), |path| format!("{path}:{PATHS}"))
}

fn works(command: &mut Command) -> bool {
    command.stdout(Stdio::null()).stderr(Stdio::null()).status().is_ok_and(|status| status.success())
}

fn is_there(program: &str) -> bool {
    paths().split(':').any(|path| std::path::Path::new(path).join(program).is_file())
}

/// Runs a command of the namespace, as `ip link set tap0 up`; an error unless it succeeds.
pub fn run(words: &str) -> Result<()> {
    let mut words_of = words.split_whitespace();
    let Some(program) = words_of.next() else { bail!("nothing to run") };
    let status = Command::new(program).env("PATH", paths()).args(words_of).status();
    let status = status.with_context(|| format!("cannot start `{program}`"))?;
    ensure!(status.success(), "`{words}` failed: {status}");
    Ok(())
}
