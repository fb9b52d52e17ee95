//! Two hosts and a cable of a given rate between them, on one machine: a network namespace for each host, a pair of virtual
//! Ethernet devices, and a token bucket at each end that lets no more than the rate through. Needs root, `ip`, `tc` and
//! `unshare`. Nothing has to be removed: a namespace ends with its last user.

use std::fs::File;
use std::io::Read;
use std::net::Ipv4Addr;
use std::os::fd::AsFd;
use std::process::{Child, Command, Stdio};

use anyhow::{Context, Result, ensure};
use rustix::thread::{LinkNameSpaceType, move_into_link_name_space};

use crate::network::{find, paths, run};

/// One end of a cable. Whatever a thread starts after [`enter`](Host::enter) runs on this host.
pub struct Host {
    namespace: File,
    address: Ipv4Addr,
}

/// Two hosts, joined.
pub struct Cable {
    /// Both ends are alike.
    pub hosts: [Host; 2],
}

impl Cable {
    /// Lets `mbit` million bits a second through in each direction, and keeps what would wait for more than 50 ms out.
    pub fn lay(mbit: u32) -> Result<Self> {
        if let Some(absent) = ["unshare", "ip", "tc"].into_iter().find(|program| !find(program)) {
            anyhow::bail!("the program `{absent}` is not installed");
        }
        let holders = [Holder::start()?, Holder::start()?];
        let host = |number: usize| Host { namespace: holders[number].namespace(), address: ADDRESSES[number] };
        let hosts = [host(0), host(1)];
        hosts[0].run(&format!("ip link add wire type veth peer name wire netns {}", holders[1].0.id()))?;
        for host in &hosts {
            // Frames of the size that a cable carries, so that the bucket sees what it would see there.
            host.run("ip link set wire gso_max_segs 1")?;
            host.run(&format!("ip address add {}/24 broadcast + dev wire", host.address))?;
            host.run("ip link set wire up")?;
            // As small a bucket as a frame and the kernel's clock allow: what it holds passes at once.
            let burst = 1_600.max(mbit * 1_000_000 / 8 / 4_000);
            host.run(&format!("tc qdisc add dev wire root tbf rate {mbit}mbit burst {burst} latency 50ms"))?;
        }
        Ok(Self { hosts })
    }
}

/// Both in a network that nothing else can reach.
const ADDRESSES: [Ipv4Addr; 2] = [Ipv4Addr::new(10, 77, 0, 1), Ipv4Addr::new(10, 77, 0, 2)];

impl Host {
    /// Its address on the cable.
    pub fn address(&self) -> Ipv4Addr {
        self.address
    }

    /// The address of the first host, where a server listens.
    pub fn server(&self) -> Ipv4Addr {
        ADDRESSES[0]
    }

    /// This thread is on this host from now on, as are the processes and threads that it starts.
    pub fn enter(&self) -> Result<()> {
        move_into_link_name_space(self.namespace.as_fd(), Some(LinkNameSpaceType::Network)).context("entering a host")
    }

    /// Runs a command there, as `ip link set wire down`; an error unless it succeeds.
    pub fn run(&self, words: &str) -> Result<()> {
        std::thread::scope(|scope| {
            let there = scope.spawn(|| self.enter().and_then(|()| run(words)));
            there.join().expect("running a command does not panic")
        })
    }
}

/// A process that holds a fresh namespace until it is open here.
struct Holder(Child);

impl Holder {
    fn start() -> Result<Self> {
        let mut command = Command::new("unshare");
        command.args(["--net", "sh", "-c", "ip link set lo up && echo && read end"]).env("PATH", paths());
        let child = command.stdin(Stdio::piped()).stdout(Stdio::piped()).stderr(Stdio::null()).spawn();
        let mut holder = Self(child.context("cannot start `unshare`")?);
        let mut output = holder.0.stdout.take().context("the holder has an output")?;
        ensure!(output.read(&mut [0])? == 1, "this user may not make a network: it takes root");
        Ok(holder)
    }

    fn namespace(&self) -> File {
        File::open(format!("/proc/{}/ns/net", self.0.id())).expect("a running process has a network")
    }
}

impl Drop for Holder {
    fn drop(&mut self) {
        // It reads until its input ends.
        drop(self.0.stdin.take());
        let _ = self.0.wait();
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use std::io::Write;
    use std::net::{TcpListener, TcpStream};

    #[test]
    fn what_one_host_sends_arrives_at_the_other() {
        let cable = match Cable::lay(100) {
            Ok(cable) => cable,
            Err(reason) => {
                assert!(std::env::var_os("CI").is_none(), "{reason:#}");
                return eprintln!("skipped: {reason:#}");
            }
        };
        let [one, other] = &cable.hosts;
        let listener = std::thread::scope(|scope| {
            scope.spawn(|| one.enter().and_then(|()| Ok(TcpListener::bind((one.address(), 7))?))).join().unwrap()
        });
        let listener = listener.unwrap();
        std::thread::scope(|scope| {
            scope.spawn(|| {
                other.enter().unwrap();
                TcpStream::connect((one.address(), 7)).unwrap().write_all(b"ping").unwrap();
            });
            let mut text = String::new();
            listener.accept().unwrap().0.read_to_string(&mut text).unwrap();
            assert_eq!(text, "ping");
        });
        // This thread is on neither of them.
        assert!(TcpListener::bind((one.address(), 8)).is_err());
    }
}
