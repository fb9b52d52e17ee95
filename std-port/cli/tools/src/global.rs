//! Options of every verb: the unit that is asked, the identity that asks, and the form of the output.

use std::path::PathBuf;
use std::time::Duration;

use cara_std::Interfaces;
use clap::Args;

use crate::exit::Ended;
use crate::keys::Keys;
use crate::name_and_id::NameAndId;

/// How long a command as a manager waits for nodes, unless told.
const WAIT: Duration = Duration::from_secs(5);

/// The heading of the options that all verbs share.
pub const SHARED_OPTIONS: &str = "Options of every verb";

/// Options of every verb.
#[derive(Args, Clone, Debug)]
#[command(next_help_heading = SHARED_OPTIONS)]
pub struct Global {
    /// Print JSON: one object, or one a line where several come; an error as an object on standard error.
    #[arg(long, global = true)]
    pub json: bool,
    /// Ask this one of the units that run on this host; its name suffices where no other has it.
    #[arg(long, global = true, value_name = "NAME[/ID]")]
    pub unit: Option<String>,
    /// Ask the unit with this control socket.
    #[arg(long, global = true, value_name = "PATH")]
    pub socket: Option<PathBuf>,
    /// Be this m_unit for the time of the command. Refused while a unit of that identity runs on this host.
    #[arg(id = "act_as", long = "as", global = true, value_name = "NAME/ID")]
    pub act_as: Option<NameAndId>,
    /// With --as: how long to wait for the nodes that the command is about [default: 5s].
    #[arg(long, global = true, value_name = "TIME", value_parser = crate::units::parse_time)]
    wait: Option<Duration>,
    /// With --as: the TCP port for nodes that are told their manager's address; a free one unless told.
    #[arg(long, global = true, value_name = "PORT")]
    pub as_port: Option<u16>,
    /// The fleet to be in; 0 unless told.
    #[arg(long, global = true, value_name = "NUMBER")]
    pub fleet: Option<u32>,
    /// The UDP port of broadcasts; 21971 unless told, 21970 in plain mode.
    #[arg(long, global = true, value_name = "PORT")]
    pub discovery_port: Option<u16>,
    /// With --as, and for `node`: the file with the unit's keys, instead of where they are looked for.
    #[arg(long, global = true, value_name = "FILE")]
    pub key_file: Option<PathBuf>,
    /// With --as, and for `node`, `scan` and `doctor`: plain mode, without keys, where every host on the network can
    /// read what units say and speak as any of them. It meets units in plain mode alone.
    #[arg(long, global = true)]
    pub insecure: bool,
    /// Use loopback only.
    #[arg(long, global = true)]
    pub loopback: bool,
}

impl Global {
    /// Which options go together is looked at here: clap does it for those before the verb, and those behind it, apart.
    pub fn check(&self) -> anyhow::Result<()> {
        let (unit, socket, own) = (self.unit.is_some(), self.socket.is_some(), self.act_as.is_some());
        let wrong = [
            (unit && socket, "--unit and --socket both say which unit is asked: leave one away"),
            (
                (unit || socket) && own,
                "--as is for a unit of this command, and --unit and --socket for one that runs: leave one away",
            ),
            (self.wait.is_some() && !own, "--wait is for a unit of this command: say which with --as NAME/ID"),
            (self.as_port.is_some() && !own, "--as-port is for a unit of this command: say which with --as NAME/ID"),
            (self.insecure && self.key_file.is_some(), "--insecure is for a unit without keys: leave --key-file away"),
        ];
        wrong.into_iter().find(|(is_wrong, _)| *is_wrong).map_or(Ok(()), |(_, text)| Err(Ended::usage(text)))
    }

    /// Where to look for nodes: what the options say, or else the environment.
    pub fn interfaces(&self) -> Interfaces {
        if self.loopback { Interfaces::Loopback } else { Interfaces::from_environment() }
    }

    /// The keys of the command's unit, where the options say something about them.
    pub fn keys(&self) -> Option<Keys> {
        if self.insecure { Some(Keys::Insecure) } else { self.key_file.clone().map(Keys::File) }
    }

    /// How long a command as a manager waits for nodes.
    pub fn wait(&self) -> Duration {
        self.wait.unwrap_or(WAIT)
    }
}
