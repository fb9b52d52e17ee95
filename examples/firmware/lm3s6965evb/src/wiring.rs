//! What every image of the board starts with: its network, or its serial line without IP.

pub use cara_vehicle::tasks::NO_ROOM;

#[cfg(not(feature = "line"))]
pub use ip::{Sockets, network};
#[cfg(feature = "line")]
pub use line::{Sockets, network};

#[cfg(not(feature = "line"))]
mod ip {
    use cara_embassy::Network;
    use cara_settings::Settings;
    use embassy_executor::Spawner;
    use embassy_net::Runner;
    pub use embassy_net::StackResources as Sockets;

    use super::NO_ROOM;
    #[cfg(not(feature = "slip"))]
    use super::ethernet::{Driver, start};
    #[cfg(feature = "slip")]
    use super::serial::{Driver, start};

    /// Starts the controller and the network of the settings. Once per image.
    pub fn network<const SOCKETS: usize>(
        spawner: Spawner,
        settings: &Settings,
        sockets: &'static mut Sockets<SOCKETS>,
        noise: u64,
    ) -> Result<Network<SOCKETS>, &'static str> {
        let (network, runner) = cara_vehicle::network(start(spawner)?, settings, sockets, noise);
        spawner.spawn(run(runner).map_err(|_| NO_ROOM)?);
        Ok(network)
    }

    #[embassy_executor::task]
    async fn run(mut runner: Runner<'static, Driver>) -> ! {
        runner.run().await
    }
}

#[cfg(not(any(feature = "line", feature = "slip")))]
mod ethernet {
    use embassy_executor::Spawner;
    use static_cell::ConstStaticCell;

    use crate::ethernet::Ethernet;

    pub(super) type Driver = &'static mut Ethernet;

    pub(super) fn start(_: Spawner) -> Result<Driver, &'static str> {
        static ETHERNET: ConstStaticCell<Ethernet> = ConstStaticCell::new(Ethernet::new());
        let ethernet = ETHERNET.take();
        ethernet.start();
        Ok(ethernet)
    }
}

#[cfg(all(feature = "slip", not(feature = "line")))]
mod serial {
    use cara_vehicle::slip::{self, Incoming, Memory, Outgoing};
    use embassy_executor::Spawner;
    use static_cell::ConstStaticCell;

    use super::NO_ROOM;
    use crate::uart::{self, Receiver, Sender};

    pub(super) type Driver = slip::Slip;

    pub(super) fn start(spawner: Spawner) -> Result<Driver, &'static str> {
        static MEMORY: ConstStaticCell<Memory> = ConstStaticCell::new(Memory::new());
        let (slip, incoming, outgoing) = slip::new(MEMORY.take());
        let (receiver, sender) = uart::start();
        spawner.spawn(receive(incoming, receiver).map_err(|_| NO_ROOM)?);
        spawner.spawn(send(outgoing, sender).map_err(|_| NO_ROOM)?);
        Ok(slip)
    }

    #[embassy_executor::task]
    async fn receive(line: Incoming, uart: Receiver) -> ! {
        line.run(uart).await
    }

    #[embassy_executor::task]
    async fn send(line: Outgoing, uart: Sender) -> ! {
        line.run(uart).await
    }
}

#[cfg(feature = "line")]
mod line {
    use cara_embassy::line::{self, Incoming, Line, Memory, Outgoing};
    use cara_settings::Settings;
    use embassy_executor::Spawner;
    use static_cell::ConstStaticCell;

    use super::NO_ROOM;
    use crate::uart::{self, BAUD, Receiver, Sender};

    /// A line has none.
    pub struct Sockets<const SOCKETS: usize>(());

    impl<const SOCKETS: usize> Sockets<SOCKETS> {
        /// None.
        #[expect(clippy::new_without_default, reason = "as those of a network")]
        pub const fn new() -> Self {
            Self(())
        }
    }

    /// Starts the line. Once per image.
    pub fn network<const SOCKETS: usize>(
        spawner: Spawner,
        _: &Settings,
        _: &'static mut Sockets<SOCKETS>,
        noise: u64,
    ) -> Result<Line, &'static str> {
        static MEMORY: ConstStaticCell<Memory> = ConstStaticCell::new(Memory::new());
        let (line, incoming, outgoing) = line::new(MEMORY.take(), BAUD, noise);
        let (receiver, sender) = uart::start();
        spawner.spawn(receive(incoming, receiver).map_err(|_| NO_ROOM)?);
        spawner.spawn(send(outgoing, sender).map_err(|_| NO_ROOM)?);
        Ok(line)
    }

    #[embassy_executor::task]
    async fn receive(line: Incoming, uart: Receiver) -> ! {
        line.run(uart).await
    }

    #[embassy_executor::task]
    async fn send(line: Outgoing, uart: Sender) -> ! {
        line.run(uart).await
    }
}
