//! Which program has a port of this host, and how many files it may open, as far as /proc lets one see.

use std::fs;

use cara_std::is_hidden;

/// Sockets in the system's tables that are looked at.
const MOST_SOCKETS: usize = 65_536;

/// A program that has the port.
#[derive(Clone, Debug, PartialEq, Eq)]
pub(crate) struct Holder {
    pub(crate) pid: u32,
    pub(crate) name: String,
}

/// Open files of a program.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) struct Files {
    /// Most that it may have open.
    pub(crate) limit: u64,
    /// Those that it has open.
    pub(crate) open: u64,
}

/// The programs that have a UDP port, without those whose descriptors this user may not see.
pub(crate) fn holders(port: u16) -> Vec<Holder> {
    who_has(["/proc/net/udp", "/proc/net/udp6"], port)
}

/// The open files of the one program that has a TCP port.
pub(crate) fn files_of_tcp_port(port: u16) -> Option<Files> {
    match who_has(["/proc/net/tcp", "/proc/net/tcp6"], port).as_slice() {
        [one] => files(one.pid),
        _ => None,
    }
}

fn files(pid: u32) -> Option<Files> {
    let limits = fs::read_to_string(format!("/proc/{pid}/limits")).ok()?;
    let limit = soft_limit(&limits)?;
    let open = fs::read_dir(format!("/proc/{pid}/fd")).ok()?.count();
    Some(Files { limit, open: u64::try_from(open).ok()? })
}

/// The soft limit of open files in a process's table of limits.
fn soft_limit(limits: &str) -> Option<u64> {
    let line = limits.lines().find_map(|line| line.strip_prefix("Max open files"))?;
    match line.split_whitespace().next()? {
        "unlimited" => Some(u64::MAX),
        number => number.parse().ok(),
    }
}

fn who_has(tables: [&str; 2], port: u16) -> Vec<Holder> {
    let tables = tables.map(|table| fs::read_to_string(table).unwrap_or_default());
    let inodes: Vec<u64> = tables.iter().flat_map(|table| inodes(table, port)).collect();
    if inodes.is_empty() {
        return Vec::new();
    }
    let processes = fs::read_dir("/proc").into_iter().flatten().flatten();
    let pids = processes.filter_map(|entry| entry.file_name().to_str()?.parse::<u32>().ok());
    pids.filter(|pid| has(*pid, &inodes)).map(|pid| Holder { pid, name: name(pid) }).collect()
}

/// Inodes of the sockets of a table that are bound to `port`.
fn inodes(table: &str, port: u16) -> Vec<u64> {
    let lines = table.lines().skip(1).take(MOST_SOCKETS);
    lines
        .filter_map(|line| {
            let mut words = line.split_whitespace().skip(1);
            let (_, bound) = words.next()?.rsplit_once(':')?;
            let inode = words.nth(7)?.parse().ok()?;
            (u16::from_str_radix(bound, 16).ok()? == port).then_some(inode)
        })
        .collect()
}

fn has(pid: u32, inodes: &[u64]) -> bool {
    let descriptors = fs::read_dir(format!("/proc/{pid}/fd")).into_iter().flatten().flatten();
    descriptors.filter_map(|entry| fs::read_link(entry.path()).ok()).any(|target| {
        let inode = target.to_str().and_then(|text| text.strip_prefix("socket:[")?.strip_suffix(']')?.parse().ok());
        inode.is_some_and(|inode| inodes.contains(&inode))
    })
}

/// The program's name, without what could forge a line of the output.
fn name(pid: u32) -> String {
    let name = fs::read_to_string(format!("/proc/{pid}/comm")).unwrap_or_default();
    name.trim().chars().filter(|c| !is_hidden(*c)).collect()
}

#[cfg(test)]
mod tests {
    use super::*;
    use std::net::UdpSocket;

    #[test]
    fn the_own_process_is_found_by_its_port() {
        let socket = UdpSocket::bind("127.0.0.1:0").unwrap();
        let port = socket.local_addr().unwrap().port();
        let found = holders(port);
        assert_eq!(found.iter().map(|holder| holder.pid).collect::<Vec<_>>(), [std::process::id()]);
        assert!(!found[0].name.is_empty());
    }

    #[test]
    fn the_open_files_of_the_own_process_are_counted() {
        let listener = std::net::TcpListener::bind("127.0.0.1:0").unwrap();
        let files = files_of_tcp_port(listener.local_addr().unwrap().port()).unwrap();
        assert!(files.open > 3 && files.open < files.limit, "{files:?}");
        let table =
            "Limit Soft Hard Units\nMax open files            1024                 4096                 files\n";
        assert_eq!(soft_limit(table), Some(1024));
        assert_eq!(soft_limit("Max open files unlimited unlimited files"), Some(u64::MAX));
        assert_eq!(soft_limit("Max open files"), None);
    }

    #[test]
    fn a_table_is_read_line_by_line() {
        let table = "  sl  local_address rem_address   st tx_queue rx_queue tr tm->when retrnsmt   uid  timeout inode\n\
                      12: 00000000:55D2 00000000:0000 07 00000000:00000000 00:00000000 00000000  0        0 4711 2 0 0\n\
                     nonsense\n\
                      13: 0100007F:0035 00000000:0000 07 00000000:00000000 00:00000000 00000000  0        0 4712 2 0 0\n";
        assert_eq!(inodes(table, 0x55D2), [4711]);
        assert_eq!(inodes(table, 53), [4712]);
        assert!(inodes(table, 1).is_empty());
    }
}
