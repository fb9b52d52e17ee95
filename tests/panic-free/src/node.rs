//! The node: discovery, admission, the table of nodes; its datagrams.

use cara_core::counters::Counter;
use cara_core::distribution::connection_handler::{Known, Node, NodeConfig, NodeCounter, NodeStorage};
use cara_core::distribution::datagram::{self, Announce, Datagram, WhoHas};
use cara_core::distribution::hello::Manager;
use cara_core::distribution::identity::Identity;
use cara_core::distribution::presence::Presence;
use core::mem::MaybeUninit;
use core::net::SocketAddrV4;

use crate::host::AnyMailman;
use crate::linkage::{drain, keep, unknown, unknown_slice, unknown_text};
use crate::secure::AnyCodes;
use crate::services::Any;

type AnyNode = Node<Any>;

fn node() -> &'static mut AnyNode {
    unknown()
}

fn identity() -> &'static Identity {
    unknown()
}

entry!(node_made, {
    let config = unknown::<Option<NodeConfig<SocketAddrV4>>>().take();
    let storage = unknown::<Option<NodeStorage<Any>>>().take();
    if let (Some(config), Some(storage)) = (config, storage) {
        unknown::<MaybeUninit<AnyNode>>().write(Node::new(*unknown(), config, storage));
    }
});

entry!(node_asked, {
    let node = node();
    keep((node.identity(), node.fleet(), node.epoch(), node.constraints(), node.next_deadline(), node.searches_at()));
    keep((node.connected(), node.number_of_s_units(), node.number_of_m_units()));
    drain(node.findings());
});

entry!(node_set, {
    node().set_constraints(*unknown());
    keep((node().nonce(), node().hello(*unknown(), *unknown(), *unknown())));
    node().choose(unknown_slice());
    node().expect(*unknown());
});

entry!(node_grown, {
    node().grow(unknown_slice(), unknown_slice(), unknown_slice());
});

entry!(node_polled, {
    keep(node().poll(*unknown(), &mut AnyMailman, &AnyCodes));
    node().broadcast(*unknown());
    node().network_changed(*unknown());
});

entry!(node_hears, {
    node().datagram(*unknown(), *unknown(), unknown_slice(), &AnyCodes);
    keep((node().take_duplicate(), node().asked_by().map(|(who, from)| (who.id(), from))));
    node().set_claim(*unknown());
    node().take_over(*unknown());
    node().keep_obeyed(*unknown(), unknown(), *unknown());
    node().claim_kept(unknown(), *unknown(), *unknown());
    node().left_unread();
    node().claims_by_key();
    node().store_claims();
    keep((node().claim(), node().take_claim_event(), node().obeyed(unknown())));
    node().stand_by(*unknown());
    node().not_raised(*unknown());
    keep((node().is_standby(), node().starts_above(), node().lead(*unknown(), *unknown())));
    keep((node().has_rival(), node().handed_over(unknown()), node().take_hand_over()));
    node().belong_to(unknown(), unknown());
});

entry!(node_dials, {
    node().dialing(Some(identity()), *unknown());
    node().dial_failed(*unknown(), Some(identity()));
    node().left(*unknown(), *unknown(), *unknown());
});

entry!(node_lists, {
    let node = node();
    drain(node.nodes());
    drain(node.s_units());
    drain(node.m_units());
    drain(node.find_address(*unknown()));
    keep((node.s_unit(*unknown()), node.m_unit(*unknown()), node.node(identity()), node.node_of(*unknown())));
    keep((node.find(unknown_text()), node.find_id(*unknown())));
    let known: &Known<SocketAddrV4> = unknown();
    keep((known.is_joined(), known.state(), known.link(), known.index(), known.under()));
});

entry!(node_counters, {
    let counter: NodeCounter = *unknown();
    keep((node().counters.value(counter), counter.help()));
    drain(node().counters.iter());
});

entry!(managers, {
    keep(Manager::new(unknown_text(), *unknown()));
    keep(unknown::<Manager>().is(identity()));
});

entry!(datagrams, {
    keep(Datagram::decode(unknown_slice(), *unknown(), &AnyCodes));
    keep(datagram::Header::decode(unknown_slice()));
    keep(unknown::<datagram::Header>().read(unknown_slice()));
    keep(datagram::for_session(unknown_slice(), *unknown(), *unknown()));
    keep(unknown::<WhoHas>().encode(*unknown(), &AnyCodes, unknown_slice()));
    keep(unknown::<Announce>().encode(*unknown(), &AnyCodes, unknown::<Option<Identity>>().as_ref(), unknown_slice()));
    keep(datagram::short_hash(identity()));
});

entry!(presence, {
    let presence = unknown::<Presence>();
    keep(presence.question(&AnyCodes, unknown()));
    keep(presence.hear(*unknown::<SocketAddrV4>(), unknown_slice(), &AnyCodes, unknown()));
});
