//! Options that every verb has: which unit is asked, as whom, and in which form it is told.

use std::path::PathBuf;
use std::time::Duration;

use cara_std::Interfaces;
use clap::Args;

use crate::keys::Keys;
use crate::name_and_id::NameAndId;

/// How long a command as a manager waits for nodes, unless told.
const WAIT: Duration = Duration::from_secs(5);

/// Options of every verb.
#[derive(Args, Clone, Debug)]
#[command(next_help_heading = "Options of every verb")]
pub(crate) struct Global {
    /// Print JSON: one object, or one a line where several come; an error as an object on standard error.
    #[arg(long, global = true)]
    pub(crate) json: bool,
    /// Ask this one of the units that run on this host.
    #[arg(long, global = true, value_name = "NAME/ID", conflicts_with_all = ["socket", "act_as"])]
    pub(crate) unit: Option<NameAndId>,
    /// Ask the unit with this control socket.
    #[arg(long, global = true, value_name = "PATH", conflicts_with = "act_as")]
    pub(crate) socket: Option<PathBuf>,
    /// Be this m_unit for the time of the command. Refused while a unit of that identity runs on this host.
    #[arg(id = "act_as", long = "as", global = true, value_name = "NAME/ID")]
    pub(crate) act_as: Option<NameAndId>,
    /// With --as: how long to wait for the nodes that the command is about [default: 5s].
    #[arg(long, global = true, value_name = "TIME", value_parser = crate::units::parse_time, requires = "act_as")]
    wait: Option<Duration>,
    /// With --as: the TCP port for nodes that are told their manager's address; a free one unless told.
    #[arg(long, global = true, value_name = "PORT", requires = "act_as")]
    pub(crate) as_port: Option<u16>,
    /// The fleet to be in; 0 unless told.
    #[arg(long, global = true, value_name = "NUMBER")]
    pub(crate) fleet: Option<u32>,
    /// The UDP port of broadcasts; 21971 unless told, 21970 in plain mode.
    #[arg(long, global = true, value_name = "PORT")]
    pub(crate) discovery_port: Option<u16>,
    /// With --as, and for `node`: the file with the unit's keys, instead of where they are looked for.
    #[arg(long, global = true, value_name = "FILE")]
    pub(crate) key_file: Option<PathBuf>,
    /// With --as, and for `node`, `scan` and `doctor`: plain mode, without keys, where anybody on the network can read what
    /// units say and speak as any of them. It meets units in plain mode alone.
    #[arg(long, global = true, conflicts_with = "key_file")]
    pub(crate) insecure: bool,
    /// Use loopback only.
    #[arg(long, global = true)]
    pub(crate) loopback: bool,
}

impl Global {
    /// Where to look for nodes: what the options say, or else the environment.
    pub(crate) fn interfaces(&self) -> Interfaces {
        if self.loopback { Interfaces::Loopback } else { Interfaces::from_environment() }
    }

    /// The keys of the command's unit, where the options say something about them.
    pub(crate) fn keys(&self) -> Option<Keys> {
        if self.insecure { Some(Keys::Insecure) } else { self.key_file.clone().map(Keys::File) }
    }

    /// How long a command as a manager waits for nodes.
    pub(crate) fn wait(&self) -> Duration {
        self.wait.unwrap_or(WAIT)
    }
}
