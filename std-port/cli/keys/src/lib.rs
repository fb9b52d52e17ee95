//! `cara keys`: makes the keys of a fleet and of its nodes. The work is in `cara_std::keys`; `report` reports changes
//! and next steps, and `show` the state, never a key.

mod report;
mod show;

use report::Done;

use std::collections::BTreeSet;
use std::path::{Path, PathBuf};
use std::process::ExitCode;

use cara_core::distribution::identity::{Fleet, Identity, Role};
use cara_std::keys::location::own_folder;
use cara_std::keys::{FleetError, FleetKeys, KeyError, Members, Store, full_name, parse_node};

use cara_tools::exit::{Ended, Exit};
use cara_tools::global::Global;
use cara_tools::interrupt::Asked;
use cara_tools::keys::failed;
use cara_tools::name_and_id::{NameAndId, quoted};

/// Makes the keys of a fleet and of its nodes, shows whose there are, takes nodes out, and changes keys.
///
/// A fleet has one root, from which the keys of all nodes come; it stays in its folder. Each node has a file, which is
/// brought to where the node runs.
#[derive(clap::Args)]
#[command(
    flatten_help = true,
    after_help = "\
cara keys new-fleet --fleet 7 depot/1@m_unit agv-17/17
cara keys derive --fleet 7 agv-18/18
cara keys revoke --fleet 7 agv-17/17
cara keys rotate --fleet 7 --finish"
)]
pub struct Arguments {
    #[command(subcommand)]
    action: Action,
    /// The folder with the fleet's root [default: cara/keys in XDG_CONFIG_HOME or ~/.config; or CARA_KEYS].
    #[arg(long, global = true, value_name = "FOLDER")]
    dir: Option<PathBuf>,
}

#[derive(clap::Subcommand)]
enum Action {
    /// Draws the root of a fleet that has none yet, and makes the keys of its first nodes.
    NewFleet(Nodes),
    /// Makes the keys of nodes, or writes again what is missing, and updates the files of those that they talk to.
    Derive(Nodes),
    /// Shows the fleet's nodes, or what is in the file of one; fingerprints and never keys.
    Show {
        /// The file of a node, or the node as for `revoke`.
        file: Option<PathBuf>,
    },
    /// Takes nodes out: begins a generation of keys that they have nothing of.
    Revoke {
        /// NAME/ID of an s_unit, NAME/ID@m_unit of an m_unit; NAME where no other node has it.
        #[arg(required = true, value_name = "NODE")]
        nodes: Vec<String>,
    },
    /// Changes all keys, in three steps: begins a generation that all nodes take beside the one in use.
    Rotate {
        /// The second step, when all nodes have their files: the new generation is used, and the older one still taken.
        #[arg(long)]
        switch: bool,
        /// The last step, when all nodes have their files: the older generation ends.
        #[arg(long, conflicts_with = "switch")]
        finish: bool,
    },
}

/// Nodes that are added.
#[derive(clap::Args)]
struct Nodes {
    /// NAME/ID of an s_unit, NAME/ID@m_unit of an m_unit.
    #[arg(value_name = "NODE", value_parser = parse_new)]
    nodes: Vec<Identity>,
    /// The m_unit that these s_units belong to, NAME where no other has it; may be repeated. Unless told, the only one of the
    /// fleet.
    #[arg(long, value_name = "NAME[/ID]")]
    manager: Vec<String>,
}

/// A name that looks like another node's NAME/ID would hide that one.
fn parse_new(text: &str) -> Result<Identity, &'static str> {
    let identity = parse_node(text)?;
    match identity.name().contains('/') {
        true => Err("a new node's name has no slash: NAME/ID of another node could be the same"),
        false => Ok(identity),
    }
}

/// Does what the command line asks, and prints it.
pub fn run(arguments: Arguments, global: &Global) -> anyhow::Result<ExitCode> {
    let folder = || arguments.dir.clone().or_else(own_folder).ok_or_else(|| Ended::usage("say where: --dir FOLDER"));
    match &arguments.action {
        Action::NewFleet(nodes) => new_fleet(nodes, folder()?, global)?,
        Action::Derive(nodes) => derive(nodes, folder()?, global)?,
        Action::Show { file: Some(file) } => show::ring(&file_of(file, global, folder), global)?,
        Action::Show { file: None } => show::fleet(&open(folder()?, global)?, global)?,
        Action::Revoke { nodes } => revoke(nodes, folder()?, global)?,
        Action::Rotate { switch: true, .. } => Step::Switch.make(folder()?, global)?,
        Action::Rotate { finish: true, .. } => Step::Finish.make(folder()?, global)?,
        Action::Rotate { .. } => Step::Begin.make(folder()?, global)?,
    }
    Ok(Exit::Done.into())
}

impl Nodes {
    /// Says how the nodes are added to a fleet, in words that can be typed as they stand.
    fn of_fleet_that_is_there(&self, fleet: Fleet, folder: &Path) -> String {
        let mut command = format!("cara keys derive --fleet {}", fleet.0);
        if own_folder().is_none_or(|own| own != folder) {
            command += &format!(" --dir {}", quoted(&folder.display().to_string()));
        }
        self.nodes.iter().for_each(|node| command += &format!(" {}", quoted(&full_name(node))));
        self.manager.iter().for_each(|manager| command += &format!(" --manager {}", quoted(manager)));
        let root = folder.join(format!("fleet-{}.root", fleet.0));
        format!(
            "fleet {} is there already: `{command}` adds nodes to it, and another --fleet makes another one. If its root has \
             been read by others, move {} away: then new-fleet makes all keys anew",
            fleet.0,
            root.display()
        )
    }

    /// By name among the nodes that are added and those of the fleet.
    fn managers(&self, members: &Members) -> anyhow::Result<Vec<Identity>> {
        let known = members.nodes().iter().map(|member| &member.identity).chain(&self.nodes);
        let known: BTreeSet<_> =
            known.filter(|node| node.role() == Role::MUnit).map(|node| (node.name(), node.id())).collect();
        let named = |text: &String| {
            let wrong = |why: String| Ended::usage(format!("--manager {text}: {why}"));
            let of_name: Vec<_> = known.iter().filter(|(name, _)| name == text).collect();
            let (name, id) = match (text.parse::<NameAndId>(), of_name.as_slice()) {
                (Ok(NameAndId { name, id }), _) => (name, id),
                (Err(_), [(name, id)]) => ((*name).to_owned(), *id),
                (Err(error), []) => return Err(wrong(format!("no m_unit of the fleet has this name: {error}"))),
                (Err(_), several) => {
                    let names: Vec<_> = several.iter().map(|(name, id)| format!("{name}/{id}")).collect();
                    return Err(wrong(format!("write {}", names.join(" or "))));
                }
            };
            Identity::m_unit(&name, id).map_err(|error| wrong(error.to_string()))
        };
        self.manager.iter().map(named).collect()
    }
}

fn new_fleet(nodes: &Nodes, folder: PathBuf, global: &Global) -> anyhow::Result<()> {
    let fleet = Fleet(global.fleet.unwrap_or(0));
    // Before what is wrong with the nodes: advice on that names this verb, which fails as long as the fleet is there.
    if Store::fleets(&folder).contains(&fleet) {
        return Err(Ended::failed("Keys", nodes.of_fleet_that_is_there(fleet, &folder)));
    }
    let mut keys = FleetKeys::draw(fleet).map_err(failed)?;
    let managers = nodes.managers(keys.members())?;
    let added = keys.add_all(&nodes.nodes, &managers);
    added.map_err(|error| wrong(error.of_new_fleet()))?;
    let asked = Asked::catch()?;
    let made = Store::create_unless(&folder, keys, &|| asked.came());
    let (store, written) = made.map_err(|error| not_changed(error, &asked))?;
    report::print(Done::Made, &store, &written, global)
}

fn derive(nodes: &Nodes, folder: PathBuf, global: &Global) -> anyhow::Result<()> {
    let mut store = open(folder, global)?;
    let managers = nodes.managers(store.keys().members())?;
    store.keys_mut().add_all(&nodes.nodes, &managers).map_err(wrong)?;
    save(Done::Derived, &store, global)
}

/// Of nodes that were revoked already what was not written is, so that a command that stopped half-way can be repeated.
fn revoke(nodes: &[String], folder: PathBuf, global: &Global) -> anyhow::Result<()> {
    let mut store = open(folder, global)?;
    let members = store.keys().members();
    let nodes = nodes.iter().map(|node| member(members, node)).collect::<anyhow::Result<Vec<_>>>()?;
    let already = nodes.iter().all(|node| members.is_revoked(node));
    let done = if already { Done::RevokedAlready(&nodes) } else { Done::Revoked };
    store.keys_mut().revoke(&nodes).map_err(wrong)?;
    save(done, &store, global)
}

/// The node that is meant: by its full name, or by a name that only one node of the fleet has.
fn member(members: &Members, meant: &str) -> anyhow::Result<Identity> {
    let mut named: Vec<_> = members.nodes().iter().map(|member| &member.identity).collect();
    named.retain(|node| node.name() == meant);
    if named.is_empty() {
        named.extend(members.revoked().iter().map(|revoked| &revoked.identity).filter(|node| node.name() == meant));
    }
    match (parse_node(meant), named.as_slice()) {
        (Ok(identity), _) => Ok(identity),
        (Err(_), [only]) => Ok((*only).clone()),
        (Err(error), []) => Err(Ended::usage(format!("no node of the fleet is called `{meant}`: {error}"))),
        (Err(_), several) => {
            let names: Vec<_> = several.iter().map(|node| full_name(node)).collect();
            Err(Ended::usage(format!("several nodes are called `{meant}`: write {}", names.join(" or "))))
        }
    }
}

/// The file itself, or that of the node of this name where there is no such file.
fn file_of(named: &Path, global: &Global, folder: impl Fn() -> anyhow::Result<PathBuf>) -> PathBuf {
    let of_node = || {
        let store = open(folder().ok()?, global).ok()?;
        let node = member(store.keys().members(), named.to_str()?).ok()?;
        Some(store.file_of(&node))
    };
    if named.exists() {
        named.to_owned()
    } else {
        of_node().filter(|file| file.exists()).unwrap_or_else(|| named.to_owned())
    }
}

/// A step of a change of keys.
#[derive(Clone, Copy)]
enum Step {
    Begin,
    Switch,
    Finish,
}

impl Step {
    /// Makes the step, or completes it where it stopped half-way. Where another one did, that comes first.
    fn make(self, folder: PathBuf, global: &Global) -> anyhow::Result<()> {
        let mut store = open(folder, global)?;
        if !store.is_behind().map_err(failed)? {
            self.change(store.keys_mut()).map_err(wrong)?;
            return save(Done::Stepped, &store, global);
        }
        let members = store.keys().members();
        if !self.is_last(members) {
            return Err(wrong(FleetError::Behind(members.fleet())));
        }
        save(Done::SteppedAlready, &store, global)
    }

    fn change(self, keys: &mut FleetKeys) -> Result<(), FleetError> {
        match self {
            Self::Begin => keys.rotate(),
            Self::Switch => keys.switch(),
            Self::Finish => keys.finish(),
        }
    }

    /// Whether it is the one that was made last.
    fn is_last(self, members: &Members) -> bool {
        let started = members.beside().map(|beside| beside > members.generation());
        match self {
            Self::Begin => started == Some(true),
            Self::Switch => started == Some(false),
            Self::Finish => started.is_none(),
        }
    }
}

fn save(done: Done<'_>, store: &Store, global: &Global) -> anyhow::Result<()> {
    let asked = Asked::catch()?;
    let written = store.save_unless(&|| asked.came()).map_err(|error| not_changed(error, &asked))?;
    report::print(done, store, &written, global)
}

/// The keys of the fleet that is meant: of the only one in the folder, unless one is named.
fn open(folder: PathBuf, global: &Global) -> anyhow::Result<Store> {
    let fleet = match (global.fleet, Store::fleets(&folder).as_slice()) {
        (Some(fleet), _) => Fleet(fleet),
        (None, [only]) => *only,
        (None, []) => Fleet(0),
        (None, several) => {
            let options: Vec<_> = several.iter().map(|fleet| format!("--fleet {}", fleet.0)).collect();
            let text = format!("{} has several fleets: say {}", folder.display(), options.join(" or "));
            return Err(Ended::usage(text));
        }
    };
    Store::open(&folder, fleet).map_err(failed)
}

fn not_changed(error: KeyError, asked: &Asked) -> anyhow::Error {
    match error {
        KeyError::Stopped => Ended { exit: asked.exit(), text: error.to_string(), name: "Stopped".into() }.into(),
        error => failed(error),
    }
}

fn wrong(error: FleetError) -> anyhow::Error {
    Ended::usage(error.to_string())
}
