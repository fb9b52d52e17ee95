//! Where a command listens that looks at a network, and the keys that it has for that.

use cara_std::survey::{Ports, Standing, Survey, SurveyKeys};
use cara_std::{Fleet, PLAIN_PORT};

use crate::global::Global;

/// Most fleets that are asked where none is named.
const MOST_FLEETS: usize = 8;

/// The ports of both modes, or the one that is told, or with `--insecure` that of plain mode.
pub fn ports(global: &Global) -> Ports {
    match global.discovery_port {
        Some(port) => Ports::One(port),
        None if global.insecure => Ports::One(PLAIN_PORT),
        None => Ports::Usual,
    }
}

/// The keys of `--key-file`, or all that are found where keys are looked for; none with `--insecure`.
pub fn keys(global: &Global) -> anyhow::Result<SurveyKeys> {
    match &global.key_file {
        _ if global.insecure => Ok(SurveyKeys::default()),
        Some(path) => SurveyKeys::of_file(path).map_err(crate::keys::failed),
        None => Ok(SurveyKeys::gather()),
    }
}

/// The fleets that are meant: the one that is told, or 0 and those of which there are keys.
pub fn fleets(global: &Global, keys: &SurveyKeys) -> Vec<Fleet> {
    if let Some(fleet) = global.fleet {
        return vec![Fleet(fleet)];
    }
    let known = keys.fleets().into_iter().filter(|fleet| fleet.0 != 0);
    std::iter::once(Fleet(0)).chain(known).take(MOST_FLEETS).collect()
}

/// A survey with these keys.
pub fn open(global: &Global, keys: SurveyKeys) -> anyhow::Result<Survey> {
    Ok(Survey::open(global.interfaces(), ports(global))?.with_keys(keys))
}

/// How a user comes to keys with which a fleet can be asked.
pub fn how_to_get_keys(fleet: Fleet) -> String {
    let folder = cara_std::keys::location::own_folder();
    let folder = folder.map_or_else(|| "the folder of CARA_KEYS".to_owned(), |folder| folder.display().to_string());
    let fleet = fleet.0;
    format!(
        "make them with `cara keys new-fleet --fleet {fleet} MANAGER/ID@m_unit NODE/ID` if the fleet has none yet; if it has, \
         `cara keys derive --fleet {fleet}` on the host that has its root writes the files of its nodes: copy one into {folder}, or \
         name it with --key-file"
    )
}

/// What shows that a datagram comes from its fleet, and the generation of the key with which that was shown.
pub const fn shown_standing(standing: Standing) -> (&'static str, Option<u32>) {
    match standing {
        Standing::Plain => ("none", None),
        Standing::Proven { generation, .. } => ("fleet", Some(generation)),
        Standing::OtherKeys => ("other_keys", None),
        Standing::Unchecked => ("unchecked", None),
    }
}
