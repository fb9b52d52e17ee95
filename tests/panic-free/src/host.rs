//! Host infrastructure: frames, links, liveness.

use core::net::{SocketAddr, SocketAddrV4};

use cara_core::error::CloseReason;
use cara_core::host::connections::{Inbound, Link, Liveness, Span};
use cara_core::host::endpoint::Endpoint;
use cara_core::host::frame::{self, ChunkWriter, Chunking, Frame};
use cara_core::host::mailman::{LinkId, Mailman};
use cara_core::storage::{Lent, Pool};

use crate::linkage::{drain, keep, unknown, unknown_slice};
use crate::secure::AnyCipher;

/// A network that does anything.
pub struct AnyMailman;

impl Mailman<SocketAddrV4> for AnyMailman {
    fn write(&mut self, link: LinkId, slices: &[&[u8]]) -> Result<usize, CloseReason> {
        keep((link, slices));
        *unknown()
    }

    fn send_to(&mut self, to: SocketAddrV4, datagram: &[u8]) -> bool {
        keep((to, datagram));
        *unknown()
    }

    fn broadcast(&mut self, datagram: &[u8]) -> bool {
        keep(datagram);
        *unknown()
    }
}

type AnyLink = Link<Lent, AnyCipher>;

entry!(frames, {
    keep(Frame::parse(unknown_slice()));
    keep(frame::encode(unknown(), *unknown(), unknown_slice()));
    keep(frame::first_frame_length(unknown_slice()));
});

entry!(chunks, {
    let chunking: &Chunking = unknown();
    keep(chunking.framed_length(*unknown()));
    if let Some(mut writer) = ChunkWriter::new(unknown_slice(), *chunking, *unknown(), *unknown()) {
        writer.put(unknown_slice());
        keep(writer);
    }
});

entry!(link_made, {
    keep(AnyLink::new(*unknown(), AnyCipher, unknown_slice(), *unknown(), *unknown()));
});

entry!(link_receives, {
    let link: &mut AnyLink = unknown();
    keep(link.receive(unknown::<Pool<Lent>>(), unknown_slice()));
    if let Inbound::Message(_, span) = unknown() {
        keep(link.view(span.last(*unknown()), unknown_slice()));
    }
    keep(link.view(*unknown::<Span>(), unknown_slice()));
});

entry!(link_sends, {
    let link: &mut AnyLink = unknown();
    let pool: &mut Pool<Lent> = unknown();
    keep(link.send_frame(unknown()));
    keep(link.flush(&mut AnyMailman, pool));
    keep((link.wants_to_write(), link.id()));
});

entry!(link_set, {
    let link: &mut AnyLink = unknown();
    link.release(unknown::<Pool<Lent>>());
});

entry!(link_counters, {
    let link: &mut AnyLink = unknown();
    link.counters.add(*unknown(), *unknown());
    link.counters.count(*unknown());
    link.counters.merge(unknown());
    keep(link.counters.value(*unknown()));
    drain(link.counters.iter());
});

entry!(liveness, {
    let mut liveness = Liveness::new(*unknown(), *unknown());
    liveness.heard(*unknown());
    keep((
        liveness.hears(),
        liveness.is_heard(),
        liveness.is_silent(),
        liveness.is_deaf(),
        liveness.stream_silent_for(*unknown()),
    ));
    keep((liveness.deadline(), liveness.poll(*unknown(), *unknown())));
});

fn any_endpoint<E: Endpoint>(endpoint: &E) {
    keep((endpoint.port(), endpoint.at_port(*unknown()), endpoint.is_of_host(unknown())));
    keep((endpoint.is_loopback(), endpoint.host_bits()));
}

entry!(endpoints, {
    any_endpoint::<SocketAddrV4>(unknown());
    any_endpoint::<SocketAddr>(unknown());
});
