//! A unit's counters of discovery and membership. The doc comments of the variants are shown by `cara counters`.

crate::counters::counters! {
    /// A unit's counters of discovery and membership.
    pub enum NodeCounter[<NodeCounter as crate::counters::Counter>::ALL.len()] {
        /// Datagrams of another mode, or of no unit at all.
        DatagramMagic,
        /// Datagrams of another version.
        DatagramVersion,
        /// Datagrams of another fleet.
        DatagramFleet,
        /// Datagrams that could not be read; on boards also longer ones than there is room for, and on a line those to another port.
        DatagramMalformed,
        /// Searches and answers without the right code of the fleet.
        DatagramForged,
        /// Answers without the right code of this unit and their sender.
        DatagramNotForUs,
        /// Session datagrams for links that this unit does not have.
        DatagramUnknownLink,
        /// Searches sent.
        WhoHasSent,
        /// Searches of others heard.
        WhoHasHeard,
        /// Own searches put off because enough were heard.
        WhoHasDeferred,
        /// Answers sent to one node.
        AnnounceSent,
        /// Answers sent to all.
        AnnounceBroadcast,
        /// Answers heard.
        AnnounceHeard,
        /// Answers not sent because too many waited already.
        AnnounceDropped,
        /// Answers not sent because there is no key for the pair.
        AnnounceWithheld,
        /// Answers to another question than this unit's last one.
        Unasked,
        /// Nodes that a broadcast hinted at and that were asked by unicast.
        HintsAsked,
        /// Broadcasts of a wanted node whose address was asked a short while ago, or for which there was no room.
        HintsIgnored,
        /// Searches of others that did not defer this unit's own, because one of the same host did a short while ago.
        WhoHasUnheeded,
        /// Searches and answers that the network did not take.
        SendFailed,
        /// Datagrams older than what is known of their sender.
        Outdated,
        /// Searches for, and hellos to, another manager.
        WrongManager,
        /// Datagrams of another unit with this unit's own identity.
        OwnIdentity,
        /// Links dialled.
        Dialled,
        /// Links dialled that have not joined.
        DialFailed,
        /// Links taken.
        Joined,
        /// Items of a later version in searches and answers that were passed over.
        DatagramItemsSkipped,
        /// Links refused because of their version, or for want of a cipher suite in common.
        RefusedVersion,
        /// Links refused because of their fleet.
        RefusedFleet,
        /// Links refused because of their role.
        RefusedRole,
        /// Links refused because as many nodes are connected as may be.
        RefusedFull,
        /// Links refused because a live node has the same identity.
        RefusedDuplicate,
        /// Links refused because the two are connected already.
        RefusedConnected,
        /// Links refused because one end is plain and the other one secured.
        RefusedMode,
        /// Links refused because there is no key for the pair.
        RefusedKey,
        /// Links refused because the vehicle has obeyed a higher claim, or drives for another manager, or because this unit stands by.
        RefusedFenced,
        /// Nodes that said that they obey another manager of this unit's identity.
        Fenced,
        /// Questions for this unit's own identity, because another manager of it was obeyed.
        OwnIdentityAsked,
        /// Claims that are obeyed until this unit's next start, or were not raised, because they were not stored, or not in time.
        ClaimsNotKept,
        /// Links that were challenged to prove liveness, because another one had the same identity.
        Challenged,
        /// Nodes that came back with a new epoch.
        Restarted,
        /// Nodes forgotten to make room.
        Forgotten,
        /// Nodes heard for which the table has no room.
        TableFull,
        /// Links whose peers had sent nothing yet, ended in favour of newer ones.
        GaveWay,
    }
}
