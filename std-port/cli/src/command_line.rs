//! The command line as a whole: options, verbs, and the help that all of them share.

use std::process::ExitCode;

use clap::{Command, CommandFactory, FromArgMatches, Parser, Subcommand};

use crate::{commands, node};
use cara_tools::exit::{self, EXIT_CODES, Ended};
use cara_tools::global::{Global, SHARED_OPTIONS};

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
    HandOver(commands::hand_over::Arguments),
    ForgetClaim(commands::forget_claim::Arguments),
    Set(commands::set::Arguments),
    Watch(commands::watch::Arguments),
    Top(commands::top::Arguments),
    Stream(commands::stream::Arguments),
    Logs(commands::logs::Arguments),
    Record(commands::record::Arguments),
    Replay(commands::replay::Arguments),
    BlackBox(commands::black_box::Arguments),
    Counters(commands::counters::Arguments),
    Ping(commands::ping::Arguments),
    Web(commands::web::Arguments),
    Node(node::Arguments),
    Line(cara_line::Arguments),
    Doctor(cara_doctor::Arguments),
    SupportBundle(commands::support_bundle::Arguments),
    Keys(cara_keys::Arguments),
    Access(commands::access::Arguments),
    Provision(cara_provision::Arguments),
    Completions(commands::completions::Arguments),
    Man(commands::man::Arguments),
}

/// The verbs as the help groups them.
const GROUPS: [(&str, &[&str]); 5] = [
    (
        "See",
        &[
            "scan",
            "functions",
            "orders",
            "watch",
            "top",
            "stream",
            "logs",
            "record",
            "replay",
            "black-box",
            "counters",
            "ping",
            "doctor",
            "support-bundle",
        ],
    ),
    ("Command", &["call", "stop", "reset", "publish", "set", "hand-over", "retire"]),
    ("Run", &["node", "web", "line"]),
    ("Set up", &["keys", "access", "provision", "forget-claim"]),
    ("Shell and manual", &["completions", "man"]),
];

/// The options and exit codes that all verbs share are in the help of `cara` alone.
const SHARED: &str = "Options of every verb and exit codes: cara --help";

/// The command, with its verbs in groups in the help.
pub(crate) fn command() -> Command {
    let mut command = CommandLine::command();
    let groups: Vec<_> = GROUPS.iter().map(|(title, verbs)| group(&command, title, verbs)).collect();
    let template = format!(
        "{{about-with-newline}}\n{{usage-heading}} {{usage}}\n\n{}\n\nOptions:\n{{options}}{{after-help}}",
        groups.join("\n\n")
    );
    command = command.help_template(template).after_long_help(EXIT_CODES);
    // From here on each verb has the options that all share, to be hidden.
    command.build();
    command.mut_subcommands(with_own_options)
}

/// A group of verbs as text, with the styles of the help.
fn group(command: &Command, title: &'static str, verbs: &[&str]) -> String {
    let found = command.get_subcommands().filter(|verb| verbs.contains(&verb.get_name())).cloned();
    let mut group = Command::new("cara").max_term_width(100).disable_help_flag(true).disable_help_subcommand(true);
    group = group.subcommand_help_heading(title).subcommands(found).help_template("{all-args}");
    group.render_help().ansi().to_string().trim_end().to_owned()
}

/// The help of a verb, and of those below it, without what all share.
fn with_own_options(verb: Command) -> Command {
    let own = verb.get_after_help().map(|text| format!("{text}\n\n")).unwrap_or_default();
    let verb = verb.after_help(own + SHARED).mut_args(|option| {
        let is_shared = option.get_help_heading() == Some(SHARED_OPTIONS);
        option.hide_short_help(is_shared).hide_long_help(is_shared)
    });
    verb.mut_subcommands(with_own_options)
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

    #[test]
    fn every_verb_is_in_one_group() {
        let command = super::command();
        let mut verbs: Vec<_> = command.get_subcommands().map(clap::Command::get_name).collect();
        verbs.retain(|verb| *verb != "help");
        let mut grouped: Vec<_> = super::GROUPS.iter().flat_map(|(_, verbs)| *verbs).copied().collect();
        verbs.sort_unstable();
        grouped.sort_unstable();
        assert_eq!(grouped, verbs);
    }
}
