//! Hosts at one switch, on one machine: a bridge in the network of this process, which [`own`](crate::network::own) made, and a
//! namespace for each host. The switch can drop what a host sends, what it is sent, or both, and no host notices that by its link.

use anyhow::Result;

use crate::cable::Holder;
use crate::network::{Namespace, filter};

/// Hosts, joined. All of it ends with this process and those on the hosts.
pub struct Switch {
    own: Namespace,
    /// Whatever a thread starts after [`enter`](Namespace::enter) runs on that host.
    pub hosts: Vec<Namespace>,
}

impl Switch {
    /// So many hosts.
    pub fn of(hosts: usize) -> Result<Self> {
        let mut switch = Self { own: Namespace::of(std::process::id())?, hosts: Vec::new() };
        switch.own.run("ip link add switch type bridge")?;
        switch.own.run("ip link set switch up")?;
        for number in 0..hosts {
            let holder = Holder::start()?;
            let host = Namespace::of(holder.id())?;
            switch.own.run(&format!("ip link add port{number} type veth peer name wire netns {}", holder.id()))?;
            switch.own.run(&format!("ip link set port{number} master switch up"))?;
            host.run(&format!("ip address add 10.77.0.{}/24 broadcast + dev wire", number + 1))?;
            host.run("ip link set wire up")?;
            switch.hosts.push(host);
        }
        Ok(switch)
    }

    /// Drops what this host sends, or is sent, until [`mend`](Self::mend).
    pub fn cut(&self, host: usize, sent: bool, received: bool) -> Result<()> {
        let rules = [(sent, "iifname"), (received, "oifname")].into_iter().filter(|(is_cut, _)| *is_cut);
        let rules: Vec<_> = rules.map(|(_, way)| format!("{way} port{host} drop")).collect();
        self.own.within(|| filter("bridge cut", "forward", &rules.join("\n")))
    }

    /// All frames pass again.
    pub fn mend(&self) -> Result<()> {
        self.own.run("nft delete table bridge cut")
    }
}
