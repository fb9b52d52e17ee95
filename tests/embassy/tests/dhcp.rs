//! A unit whose network stack gets its address by DHCP, from a server on another board.

use std::cell::Cell;
use std::net::Ipv4Addr;
use std::rc::Rc;

use cara_core::distribution::identity::Identity;
use cara_core::time::Duration;
use cara_embassy::{Config, Handle, Limits, Resources, Security, UnitEvent, resources};
use cara_embassy_host::{Bench, Board, keys};
use embassy_net::udp::{PacketMetadata, UdpSocket};
use smoltcp::wire::{DhcpMessageType, DhcpPacket, DhcpRepr};

const LONG: Duration = Duration::from_secs(60);

/// Leases the address in the cell to every client.
fn serve(board: &Board, given: Rc<Cell<Ipv4Addr>>) {
    let (stack, own) = (board.stack(), board.address());
    board.spawn(async move {
        let meta = || -> &'static mut [PacketMetadata] { Box::leak(Box::new([PacketMetadata::EMPTY; 4])) };
        let room = || -> &'static mut [u8] { Box::leak(Box::new([0; 2_048])) };
        let mut socket = UdpSocket::new(stack, meta(), room(), meta(), room());
        socket.bind(67).expect("the port is free");
        let mut bytes = [0; 1_500];
        loop {
            let Ok((length, _)) = socket.recv_from(&mut bytes).await else { continue };
            let packet = DhcpPacket::new_checked(&bytes[..length]).expect("a board asks soundly");
            let asked = DhcpRepr::parse(&packet).expect("a board asks soundly");
            let message_type = match asked.message_type {
                DhcpMessageType::Discover => DhcpMessageType::Offer,
                _ => DhcpMessageType::Ack,
            };
            let answer = DhcpRepr {
                message_type,
                your_ip: given.get(),
                server_ip: own,
                server_identifier: Some(own),
                subnet_mask: Some(Ipv4Addr::new(255, 255, 0, 0)),
                lease_duration: Some(3_600),
                client_identifier: None,
                requested_ip: None,
                parameter_request_list: None,
                max_size: None,
                ..asked
            };
            let mut out = vec![0; answer.buffer_len()];
            answer.emit(&mut DhcpPacket::new_unchecked(&mut out[..])).expect("there is room");
            socket.send_to(&out, (Ipv4Addr::BROADCAST, 68)).await.expect("it has a network");
        }
    });
}

const LIMITS: Limits = Limits { links: 3, message_size: 256, ..Limits::S_UNIT };

fn start(board: &Board, config: Config) -> Handle {
    let memory: &'static mut resources!((), LIMITS) = Box::leak(Box::new(Resources::new()));
    let (unit, mut runner) = cara_embassy::new(board.network(), memory, config, ()).unwrap();
    board.spawn(async move { runner.run().await });
    unit
}

#[test]
fn a_unit_joins_with_the_address_that_it_is_given_and_again_with_another() {
    let bench = Bench::new(21);
    let depot = bench.board();
    let manager = Identity::m_unit("manager", 1).unwrap();
    let manager = start(&depot, Config::m_unit("manager", 1, proof(&manager)).unwrap());
    let board = bench.board_on_dhcp();
    let agv = Identity::s_unit("agv", 7).unwrap();
    let agv = start(&board, Config::s_unit("agv", 7, "manager", 1, proof(&agv)).unwrap());
    bench.run_for(Duration::from_secs(5));
    assert!(!agv.is_connected(), "nobody has given it an address");
    let given = Rc::new(Cell::new(Ipv4Addr::new(10, 77, 5, 5)));
    serve(&depot, Rc::clone(&given));
    let address = || manager.peer("agv").ok().and_then(|peer| peer.address()).map(|address| *address.ip());
    assert!(bench.run_until(|| address() == Some(given.get()), LONG));

    // The cable is pulled, and where it is plugged in again another address is given.
    board.set_cable(false);
    assert!(bench.run_until(|| !agv.is_connected() && !manager.is_connected(), LONG));
    given.set(Ipv4Addr::new(10, 77, 6, 6));
    board.set_cable(true);
    assert!(bench.run_until(|| address() == Some(given.get()), LONG));
    let reported = Rc::new(Cell::new(0));
    let recorded = Rc::clone(&reported);
    board.spawn(async move {
        loop {
            if matches!(agv.next_event().await, UnitEvent::NetworkChanged { .. }) {
                recorded.set(recorded.get() + 1);
            }
        }
    });
    bench.run_for(Duration::from_millis(10));
    assert!(reported.get() >= 2, "it was gone, and there was another one");
}

fn proof(own: &Identity) -> Security {
    keys(0, own, 0, own.id().into())
}
