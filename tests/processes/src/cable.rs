//! Two hosts and a cable of a given rate between them, on one machine: a network namespace for each host, a pair of virtual
//! Ethernet devices, and a token bucket at each end that lets no more than the rate through. Needs root, `ip`, `tc` and
//! `unshare`, and `nft` for a cable that loses frames. Nothing has to be removed: a namespace ends with its last user.

use std::io::Read;
use std::net::Ipv4Addr;
use std::ops::Deref;
use std::process::{Child, Command, Stdio};

use anyhow::{Context, Result, ensure};

use crate::network::{Namespace, filter, find, paths};

/// One end of a cable. Whatever a thread starts after [`enter`](Namespace::enter) runs on this host.
pub struct Host {
    namespace: Namespace,
    address: Ipv4Addr,
}

/// What a cable carries.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Wire {
    /// So many million bits a second in each direction; what would wait for more than 50 ms is kept out.
    pub mbit: u32,
    /// Of a hundred packets so many are lost, at random, where they arrive.
    pub loss_percent: u32,
}

/// Two hosts, joined.
pub struct Cable {
    /// Both ends are alike.
    pub hosts: [Host; 2],
}

impl Cable {
    /// Makes two hosts and joins them.
    pub fn lay(wire: Wire) -> Result<Self> {
        let Wire { mbit, loss_percent } = wire;
        let needs = ["unshare", "ip", "tc", "nft"].into_iter().take(3 + usize::from(loss_percent > 0));
        if let Some(absent) = needs.into_iter().find(|program| !find(program)) {
            anyhow::bail!("the program `{absent}` is not installed");
        }
        let holders = [Holder::start()?, Holder::start()?];
        let host = |number: usize| {
            let namespace = Namespace::of(holders[number].id())?;
            anyhow::Ok(Host { namespace, address: ADDRESSES[number] })
        };
        let hosts = [host(0)?, host(1)?];
        hosts[0].run(&format!("ip link add wire type veth peer name wire netns {}", holders[1].id()))?;
        for host in &hosts {
            // Frames of the size that a cable carries, so that the bucket sees what it would see there.
            host.run("ip link set wire gso_max_segs 1")?;
            host.run(&format!("ip address add {}/24 broadcast + dev wire", host.address))?;
            host.run("ip link set wire up")?;
            // As small a bucket as a frame and the kernel's clock allow: what it holds passes at once.
            let burst = 1_600.max(mbit * 1_000_000 / 8 / 4_000);
            host.run(&format!("tc qdisc add dev wire root tbf rate {mbit}mbit burst {burst} latency 50ms"))?;
            if loss_percent > 0 {
                let lost = format!("iifname wire numgen random mod 100 < {loss_percent} drop");
                host.within(|| filter("ip cable", "input", &lost))?;
            }
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
}

impl Deref for Host {
    type Target = Namespace;

    fn deref(&self) -> &Namespace {
        &self.namespace
    }
}

/// A process that holds a fresh namespace until it is open here.
pub(crate) struct Holder(Child);

impl Holder {
    pub(crate) fn start() -> Result<Self> {
        let mut command = Command::new("unshare");
        command.args(["--net", "sh", "-c", "ip link set lo up && echo && read end"]).env("PATH", paths());
        let child = command.stdin(Stdio::piped()).stdout(Stdio::piped()).stderr(Stdio::null()).spawn();
        let mut holder = Self(child.context("cannot start `unshare`")?);
        let mut output = holder.0.stdout.take().context("the holder has an output")?;
        ensure!(output.read(&mut [0])? == 1, "this user may not make a network: it takes root");
        Ok(holder)
    }

    pub(crate) fn id(&self) -> u32 {
        self.0.id()
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
    use std::net::{TcpListener, TcpStream, UdpSocket};
    use std::time::Duration;

    fn lay(wire: Wire) -> Option<Cable> {
        let laid = Cable::lay(wire);
        if let Err(reason) = &laid {
            crate::skip(format_args!("{reason:#}"));
        }
        laid.ok()
    }

    #[test]
    fn a_cable_that_loses_half_of_all_packets_does_so() {
        let Some(cable) = lay(Wire { mbit: 100, loss_percent: 50 }) else { return };
        let [one, other] = &cable.hosts;
        let bind = |host: &Host| host.within(|| Ok(UdpSocket::bind((host.address(), 7))?)).unwrap();
        let (from, to) = (bind(one), bind(other));
        to.set_nonblocking(true).unwrap();
        let mut arrived = 0;
        for _ in 0..400 {
            from.send_to(b"ping", (other.address(), 7)).unwrap();
            // Behind a veth device a packet is there, or lost, when it has been sent, but for what the bucket keeps.
            std::thread::sleep(Duration::from_micros(100));
            arrived += u32::from(to.recv(&mut [0; 8]).is_ok());
        }
        std::thread::sleep(Duration::from_millis(50));
        while to.recv(&mut [0; 8]).is_ok() {
            arrived += 1;
        }
        assert!((100..=300).contains(&arrived), "{arrived} of 400");
    }

    #[test]
    fn what_one_host_sends_arrives_at_the_other() {
        let Some(cable) = lay(Wire { mbit: 100, loss_percent: 0 }) else { return };
        let [one, other] = &cable.hosts;
        let listener = one.within(|| Ok(TcpListener::bind((one.address(), 7))?)).unwrap();
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
