//! The command line as a whole: options, verbs, and the help that all of them share.

use std::process::ExitCode;

use clap::{Command, CommandFactory, FromArgMatches, Parser, Subcommand};

use crate::{commands, node};
use cara_tools::exit::{self, EXIT_CODES, Ended};
use cara_tools::global::Global;

/// Shows and calls the nodes of a CARA fleet, through the m_unit that runs on this host or as an m_unit itself.
#[derive(Parser)]
#[command(name = "cara", version, max_term_width = 100, subcommand_required = true)]
pub(crate) struct CommandLine {
    #[command(flatten)]
    pub(crate) global: Global,
    #[command(subcommand)]
    pub(crate) verb: Verb,
}

#[derive(Subcommand)]
pub(crate) enum Verb {
    Scan(commands::scan::Arguments),
    Functions(commands::functions::Arguments),
    Orders(commands::orders::Arguments),
    Call(commands::call::Arguments),
    Publish(commands::publish::Arguments),
    Stop(commands::stop::Stop),
    Reset(commands::stop::Reset),
    Retire(commands::retire::Arguments),
    ForgetClaim(commands::forget_claim::Arguments),
    Set(commands::set::Arguments),
    Watch(commands::watch::Arguments),
    Top(commands::top::Arguments),
    Stream(commands::stream::Arguments),
    Counters(commands::counters::Arguments),
    Ping(commands::ping::Arguments),
    Web(cara_web::Arguments),
    Node(node::Arguments),
    Doctor(cara_doctor::Arguments),
    Keys(cara_keys::Arguments),
    Access(commands::access::Arguments),
    Provision(cara_provision::Arguments),
    Completions(commands::completions::Arguments),
    Man(commands::man::Arguments),
}

/// The command with the exit codes in the long help of each verb.
pub(crate) fn command() -> Command {
    CommandLine::command().after_long_help(EXIT_CODES).mut_subcommands(|verb| {
        let own = verb.get_after_help().map(|text| format!("{text}\n\n"));
        verb.after_long_help(own.unwrap_or_default() + EXIT_CODES)
    })
}

/// What the user typed; or the exit code when that was a wish for help, or a mistake, which has been printed.
pub(crate) fn parse() -> Result<CommandLine, ExitCode> {
    let parsed = command().try_get_matches().and_then(|matches| CommandLine::from_arg_matches(&matches));
    parsed.map_err(|error| {
        let json = std::env::args_os().any(|argument| argument == "--json");
        if json && error.use_stderr() {
            return exit::report(&Ended::usage(error.to_string().trim()), json);
        }
        // A closed pipe is no error.
        let _ = error.print();
        ExitCode::from(u8::try_from(error.exit_code()).unwrap_or(2))
    })
}

#[cfg(test)]
mod tests {
    #[test]
    fn the_command_line_is_sound() {
        super::command().debug_assert();
    }
}
