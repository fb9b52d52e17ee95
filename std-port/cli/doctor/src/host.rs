//! What on this host keeps every node away: interfaces, broadcasts, firewall, descriptors.

use std::collections::BTreeSet;
use std::io::ErrorKind;

use cara_std::Interfaces;
use cara_std::survey::Reach;

use super::evidence::Evidence;
use super::finding::{Finding, Id};
use super::holder::Holder;
use super::running::Running;

/// Own broadcasts that are sent before one that does not come back means something.
const ENOUGH: u32 = 2;
/// Descriptors that a unit needs beside those of its nodes: pending links, sockets, files.
const OTHER_DESCRIPTORS: u64 = 96;
/// Descriptors that a unit keeps for its operators: with no more than these left it drops new connections.
const KEPT_DESCRIPTORS: u64 = 20;

/// The port of broadcasts could not be opened.
pub(crate) fn port_in_use(port: u16, holders: &[Holder]) -> Finding {
    let who: Vec<String> = holders.iter().map(|holder| format!("{} (process {})", holder.name, holder.pid)).collect();
    let found = match who.is_empty() {
        true => format!("UDP port {port} belongs to a program that does not share it and that this user may not see"),
        false => format!("UDP port {port} belongs to {}, which does not share it", who.join(", ")),
    };
    let advice = "stop that program, or give it another port; as long as it runs no unit of this host starts \
                  (run the doctor as root to see whose it is, if it is not named)";
    Finding::error(Id::PortInUse, found, advice).about(format!("UDP port {port}")).certain(true)
}

/// What keeps nodes of the network from being heard here, the gravest first.
pub(crate) fn check(seen: &Evidence) -> Vec<Finding> {
    let no_way = if seen.interfaces == Interfaces::All { no_interface(seen) } else { loopback_only(seen) };
    let mut found: Vec<Finding> = no_way.into_iter().collect();
    // The port of the other mode does not matter where the mode is known, or suggested by keys.
    let any_port = seen.mode.is_none() && !seen.keys.has;
    let matters = |reach: &&Reach| reach.interface.up && (any_port || reach.port == seen.port);
    let own_way: Vec<&Reach> = seen.reach.iter().filter(matters).collect();
    found.extend(own_way.iter().filter_map(|reach| send_refused(reach)));
    found.extend(own_way.iter().filter_map(|reach| broadcast_lost(reach)));
    found.extend(seen.running.iter().filter_map(exhausted));
    found
}

fn loopback_only(seen: &Evidence) -> Option<Finding> {
    seen.loopback_by_environment.then(|| {
        Finding::error(
            Id::LoopbackOnly,
            "the environment variable CARA_INTERFACES keeps this command to loopback, and units that are started with it",
            "unset CARA_INTERFACES, here and where the manager is started",
        )
    })
}

/// Nodes on other hosts need an interface beside loopback; on a host without one units still meet each other.
fn no_interface(seen: &Evidence) -> Option<Finding> {
    let real: Vec<&Reach> = seen.reach.iter().filter(|reach| !reach.interface.address.is_loopback()).collect();
    let names = |reaches: &[&Reach]| {
        let named = reaches.iter().map(|reach| format!("{} ({})", reach.interface.name, reach.interface.address));
        // Each is there once for each port.
        named.collect::<BTreeSet<_>>().into_iter().collect::<Vec<_>>().join(", ")
    };
    if real.is_empty() {
        let devices = match seen.devices.is_empty() {
            true => "the system has no network device beside loopback".to_owned(),
            false => format!("none of the network devices ({}) has an IPv4 address", seen.devices.join(", ")),
        };
        return Some(
            Finding::error(
                Id::NoInterface,
                devices,
                "give the device an IPv4 address and a netmask (DHCP, or `ip address add ADDRESS/24 dev NAME`) and switch it on (`ip link set NAME up`)",
            )
            // Without loopback there is not even a node of this host to be heard.
            .certain(seen.reach.is_empty()),
        );
    }
    let up: Vec<&Reach> = real.iter().copied().filter(|reach| reach.interface.up).collect();
    if up.is_empty() {
        return Some(Finding::error(
            Id::InterfaceDown,
            format!("{}: down, or without a carrier", names(&real)),
            "check cable and switch, or the Wi-Fi; `ip link set NAME up` if it was switched off",
        ));
    }
    up.iter().all(|reach| reach.interface.broadcast.is_none()).then(|| {
        Finding::error(
            Id::NoBroadcastAddress,
            format!("{}: point-to-point, or a network of one address, which carries no broadcasts", names(&up)),
            "use an interface of a network with a broadcast address, or tell s_units their manager's address",
        )
    })
}

fn send_refused(reach: &Reach) -> Option<Finding> {
    let kind = reach.refused.filter(|_| reach.sent == 0)?;
    let name = &reach.interface.name;
    let (found, advice) = match kind {
        ErrorKind::PermissionDenied => (
            format!("the system does not let broadcasts to UDP port {} out of {name}", reach.port),
            format!(
                "let UDP port {} out in this host's firewall (`nft list ruleset`, `iptables -S OUTPUT`)",
                reach.port
            ),
        ),
        kind => (
            format!("the system does not take broadcasts on {name}: {kind}"),
            format!("look at the routes of {name} (`ip route`), and whether its address and netmask are right"),
        ),
    };
    Some(Finding::error(Id::SendRefused, found, advice).about(name).certain(kind == ErrorKind::PermissionDenied))
}

/// A running unit whose broadcasts the system does not take, where the doctor's own have not shown it already.
pub(crate) fn unit_refused(seen: &Evidence, unit: &Running) -> Vec<Finding> {
    let shown =
        |name: &str| seen.reach.iter().any(|reach| reach.interface.name == name && send_refused(reach).is_some());
    let refused = unit.unit.interfaces.iter().filter(|interface| interface.up && !shown(&interface.name));
    let reported = refused.filter_map(|interface| {
        let found = format!(
            "a broadcast of {} did not leave through {}: {}",
            unit.name(),
            interface.name,
            interface.refused.as_ref()?
        );
        let advice =
            "look at this host's firewall for outgoing packets (`nft list ruleset`) and at the routes (`ip route`)";
        Some(Finding::warning(Id::SendRefused, found, advice).about(&interface.name))
    });
    reported.collect()
}

fn broadcast_lost(reach: &Reach) -> Option<Finding> {
    (reach.sent >= ENOUGH && reach.heard == 0).then(|| {
        let name = &reach.interface.name;
        let found =
            format!("{} broadcasts left through {name}, and none came back to another socket of this host", reach.sent);
        let advice = format!(
            "let UDP port {} in in this host's firewall, broadcasts included (`nft list ruleset`, `iptables -S INPUT`)",
            reach.port
        );
        Finding::error(Id::BroadcastLost, found, advice).about(name)
    })
}

/// Units of this host may know the answer, and cannot be asked.
pub(crate) fn control_refused(seen: &Evidence) -> Option<Finding> {
    let reason = seen.control_refused.as_ref()?;
    let found = format!("units of this host could not be asked: {reason}");
    let advice = "run the doctor as the user whose units they are, or set CARA_CONTROL_DIR as it is set for them";
    Some(Finding::warning(Id::ControlRefused, found, advice))
}

/// A unit that has no descriptor left for one more node.
pub(crate) fn exhausted(running: &Running) -> Option<Finding> {
    let files = running.files?;
    (files.open.saturating_add(KEPT_DESCRIPTORS) >= files.limit)
        .then(|| descriptors(running, files.open, files.limit, Finding::error))
}

/// A unit whose limit is below what its nodes may need.
pub(crate) fn few_descriptors(running: &Running) -> Option<Finding> {
    let files = running.files?;
    let needed = u64::from(running.unit.constraints.maximum_nodes).saturating_add(OTHER_DESCRIPTORS);
    (files.limit < needed && exhausted(running).is_none())
        .then(|| descriptors(running, files.open, files.limit, Finding::warning))
}

/// What is in force is not what the file says.
pub(crate) fn access_table(unit: &Running) -> Option<Finding> {
    let wrong = unit.own_counter("AccessFileWrong").is_some_and(|wrong| wrong > 0);
    wrong.then(|| {
        let found = "its access table has a mistake, so that the table before it is in force";
        let advice = "correct the file: `cara access check FILE` tells each mistake, as the unit's log does; it is taken \
                      over by itself";
        Finding::warning(Id::AccessTable, found, advice).about(unit.name())
    })
}

/// After its next start it obeys an earlier manager again.
pub(crate) fn claim_not_stored(unit: &Running) -> Option<Finding> {
    let failed = unit.own_counter("ClaimsNotKept").is_some_and(|failed| failed > 0);
    failed.then(|| {
        let found = "it obeys a manager whose claim it could not store, or not within two seconds, and forgets it when it ends";
        let advice = "look at its folder of state (CARA_STATE): whether there is space, who may write there, and whether the disk hangs; \
                      the unit's log has the error";
        Finding::warning(Id::ClaimNotStored, found, advice).about(unit.name())
    })
}

fn descriptors(running: &Running, open: u64, limit: u64, finding: fn(Id, String, String) -> Finding) -> Finding {
    let maximum = running.unit.constraints.maximum_nodes;
    let found = format!(
        "{} may have {limit} files open and has {open}; with maximum_nodes {maximum} it needs up to {}",
        running.name(),
        u64::from(maximum).saturating_add(OTHER_DESCRIPTORS)
    );
    let advice = "raise the hard limit where it is started: `ulimit -Hn`, or LimitNOFILE= of its service";
    finding(Id::FewDescriptors, found, advice.into()).about(running.name())
}

#[cfg(test)]
mod tests {
    use cara_std::control::protocol::InterfaceInfo;

    use super::super::evidence::samples::{evidence, reach, running};
    use super::super::running::{Counted, Files};
    use super::*;

    fn ids(seen: &Evidence) -> Vec<Id> {
        check(seen).iter().map(|finding| finding.id).collect()
    }

    #[test]
    fn a_host_in_order_has_no_findings() {
        assert_eq!(ids(&evidence()), []);
    }

    #[test]
    fn each_way_to_have_no_interface_is_told_apart() {
        let mut seen = evidence();
        seen.reach = vec![reach("lo", "127.0.0.1")];
        assert_eq!(ids(&seen), [Id::NoInterface]);
        seen.reach = vec![reach("eth0", "10.0.0.1")];
        seen.reach[0].interface.up = false;
        assert_eq!(ids(&seen), [Id::InterfaceDown]);
        seen.reach[0].interface.up = true;
        seen.reach[0].interface.broadcast = None;
        assert_eq!(ids(&seen), [Id::NoBroadcastAddress]);
        seen.interfaces = Interfaces::Loopback;
        seen.reach = vec![reach("lo", "127.0.0.1")];
        assert_eq!(ids(&seen), [], "whoever says --loopback means it");
        seen.loopback_by_environment = true;
        assert_eq!(ids(&seen), [Id::LoopbackOnly]);
    }

    #[test]
    fn a_broadcast_that_is_not_sent_and_one_that_does_not_come_back_are_told_apart() {
        let mut seen = evidence();
        seen.reach[0].heard = 0;
        assert_eq!(ids(&seen), [Id::BroadcastLost]);
        seen.reach.push(Reach { port: 21_970, ..seen.reach[0].clone() });
        assert_eq!(ids(&seen), [Id::BroadcastLost], "there are keys, and the other port is that of plain mode");
        seen.keys.has = false;
        assert_eq!(ids(&seen), [Id::BroadcastLost; 2]);
        seen.reach.truncate(1);
        seen.reach[0].sent = 1;
        assert_eq!(ids(&seen), [], "one may get lost");
        seen.reach[0].sent = 0;
        seen.reach[0].refused = Some(ErrorKind::PermissionDenied);
        assert_eq!(ids(&seen), [Id::SendRefused]);
    }

    #[test]
    fn a_broadcast_of_a_unit_that_did_not_leave_is_told_once() {
        let mut seen = evidence();
        let mut unit = running("boss", 1);
        let refused = Some("permission denied".to_owned());
        let interface =
            InterfaceInfo { name: "eth0".into(), address: "10.0.0.1".into(), broadcast: None, up: true, refused };
        unit.unit.interfaces = vec![InterfaceInfo { refused: None, ..interface.clone() }];
        assert_eq!(unit_refused(&seen, &unit), []);
        unit.unit.interfaces = vec![interface];
        let found = unit_refused(&seen, &unit);
        assert!(found.len() == 1 && found[0].id == Id::SendRefused && found[0].found.contains("boss/1"), "{found:?}");
        (seen.reach[0].sent, seen.reach[0].refused) = (0, Some(ErrorKind::PermissionDenied));
        assert_eq!(unit_refused(&seen, &unit), [], "the doctor's own have shown it");
    }

    #[test]
    fn descriptors_are_compared_with_the_nodes_that_may_come() {
        let mut unit = running("boss", 1);
        assert_eq!(few_descriptors(&unit), None, "what cannot be seen is not found");
        unit.files = Some(Files { limit: 100, open: 20 });
        assert_eq!(few_descriptors(&unit).unwrap().id, Id::FewDescriptors);
        assert_eq!(exhausted(&unit), None);
        unit.files = Some(Files { limit: 1024, open: 20 });
        assert_eq!(few_descriptors(&unit), None);
        unit.files = Some(Files { limit: 100, open: 79 });
        assert_eq!((exhausted(&unit), few_descriptors(&unit).is_some()), (None, true));
        unit.files = Some(Files { limit: 100, open: 80 });
        assert_eq!((exhausted(&unit).unwrap().id, few_descriptors(&unit)), (Id::FewDescriptors, None));
    }

    #[test]
    fn the_holder_of_the_port_is_named() {
        let finding = port_in_use(5, &[Holder { pid: 77, name: "other".into() }]);
        assert!(finding.found.contains("other (process 77)") && finding.found.contains("port 5"));
        assert!(port_in_use(5, &[]).found.contains("may not see"));
    }

    #[test]
    fn a_table_that_is_not_in_force_is_told() {
        let mut unit = running("manager", 1);
        let count = |wrong| vec![Counted { node: None, counters: vec![("AccessFileWrong".into(), wrong)] }];
        assert_eq!(access_table(&unit), None, "an older unit counts nothing");
        unit.counters = count(0);
        assert_eq!(access_table(&unit), None);
        unit.counters = count(1);
        let found = access_table(&unit).unwrap();
        assert_eq!((found.id, found.about.as_deref()), (Id::AccessTable, Some("manager/1")));
        assert_eq!(claim_not_stored(&unit), None);
        unit.counters[0].counters = vec![("ClaimsNotKept".into(), 1)];
        let found = claim_not_stored(&unit).unwrap();
        assert_eq!((found.id, found.about.as_deref()), (Id::ClaimNotStored, Some("manager/1")));
    }
}
