//! Where a session meets the hub of its unit: the only place.

use super::{Event, Phase, Remote, Session};
use crate::distribution::connection_handler::{Admission, Directive};
use crate::error::Refusal;
use crate::host::secure::Secure;
use crate::services::{Context, Port};

impl<P: Port> Session<P> {
    /// The peer has said who it is, or has proven it: what becomes of the link?
    pub(super) fn consult(&mut self, cx: &mut Context<'_, P>) -> Option<Event> {
        let Some(remote) = &self.remote else { return None };
        let (now, link, from, hello) = (cx.now, self.link.id(), self.peer_address, &remote.hello);
        let mut admission = Admission::Wait;
        cx.hub.enter(&mut |hub| admission = hub.node.admit(now, link, from, hello));
        match admission {
            Admission::Accept => return self.admitted(cx),
            Admission::Refuse(refusal) => self.refuse(cx, refusal),
            Admission::Wait => {}
        }
        None
    }

    /// The key of the pair, with which each end is to prove who it is. The link ends where there is none.
    pub(super) fn credentials(&mut self, cx: &mut Context<'_, P>) -> Option<<P::Cipher as Secure>::Credentials> {
        let Remote { hello, .. } = self.remote.as_ref()?;
        let credentials = cx.keys.credentials(hello);
        if credentials.is_none() {
            let (now, from) = (cx.now, self.peer_address);
            cx.hub.enter(&mut |hub| hub.node.refuse_without_key(now, from, &hello.identity));
            self.refuse(cx, Refusal::NoKey);
        }
        credentials
    }

    /// The peer is alive, for which the hub may have asked.
    pub(super) fn show_life(&mut self, cx: &mut Context<'_, P>) {
        if core::mem::take(&mut self.challenged) && !self.has_given_way(cx) {
            let (now, link) = (cx.now, self.link.id());
            cx.hub.enter(&mut |hub| hub.node.challenge_answered(now, link));
        }
    }

    /// Does what the hub wants of this link because of another one. What it comes too late for, it passes over.
    pub fn direct(&mut self, cx: &mut Context<'_, P>, directive: Directive) -> Option<Event> {
        match directive {
            Directive::Challenge => self.challenge(cx),
            Directive::Yield => self.give_way(cx),
            Directive::Admit => return self.admitted(cx),
            Directive::Refuse(refusal) => self.refuse(cx, refusal),
            Directive::Close(reason) => self.close(cx, reason),
        }
        None
    }

    /// The hub has taken the peer, which is told what is published to it.
    fn admitted(&mut self, cx: &mut Context<'_, P>) -> Option<Event> {
        if self.phase != Phase::Deciding {
            return None;
        }
        self.accept(cx);
        if self.phase != Phase::Live {
            return None;
        }
        self.joined = true;
        if self.is_advertised(cx) {
            self.pump(cx);
        } else {
            self.publish(cx);
        }
        Some(Event::Joined)
    }

    /// Makes what the hub has published to the peer visible to it, as it is now and as far as the access table lets it be
    /// seen. Returns the serial that comes back with [`Event::Acknowledged`].
    pub fn publish(&mut self, cx: &mut Context<'_, P>) -> u32 {
        let Some(remote) = &self.remote else { return 0 };
        let (functions, publishing, identity) = (cx.functions, &mut self.publishing, &remote.hello.identity);
        cx.hub.enter(&mut |hub| {
            // What was hidden since the last time is withdrawn: a change that comes before the link is live reaches it only here.
            for slot in publishing.all_slots() {
                let is_visible = hub.publications.is_visible(identity, slot);
                publishing.want(slot, functions.generation(slot).filter(|_| is_visible));
            }
            publishing.version = hub.publications.version();
        });
        self.end_of_changes(cx)
    }

    /// Whether anything was published since the last [`publish`](Self::publish) here: where others publish meanwhile, a port
    /// looks once more when they find the link.
    pub fn is_behind(&self, cx: &mut Context<'_, P>) -> bool {
        let mut newest = self.publishing.version;
        cx.hub.enter(&mut |hub| newest = hub.publications.version());
        newest != self.publishing.version
    }
}
