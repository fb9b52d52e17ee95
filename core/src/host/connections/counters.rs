//! What a link counts: one counter for each reason to drop, refuse or defer.

use crate::ability::{DETAILS, STREAMS};
use crate::counters::{Counter, counters};

counters! {
    /// What a link counts (paper: "message monitoring").
    pub enum LinkCounter[counted()] {
        /// Frames received.
        FramesReceived,
        /// Bytes received.
        BytesReceived,
        /// Messages received whole.
        MessagesReceived,
        /// Links ended because a frame was malformed, did not open, or was too long.
        FramesRefused,
        /// Messages accepted for sending.
        MessagesSent,
        /// Bytes that the network took.
        BytesSent,
        /// Items and frames of a later version that were passed over.
        ItemsSkipped,
        /// Frames of the protocol itself (keep-alives, renewals, close) that were dropped for want of space.
        FramesWithheld,
        /// Messages refused because the class's buffer was full or none was free.
        SendRefused,
        /// Times that reading paused because no message buffer was free.
        ReadPaused,
        /// Session datagrams received.
        DatagramsReceived,
        /// Session datagrams sent.
        DatagramsSent,
        /// Session datagrams that could not be read, or were not of this session.
        DatagramsDropped,
        /// Session datagrams that are not the peer's, or were changed on their way.
        DatagramsForged,
        /// Session datagrams that are duplicates, or older than the replay window.
        DatagramsRepeated,
        /// Links whose peers did not prove possession of the pair key.
        ProofsFailed,
        /// Rekeys of live links.
        KeysRenewed,
        /// Links that were ended in clear, by a peer that had not proven its identity.
        FarewellsInClear,
        /// Links refused because there is no key for the pair.
        KeysMissing,
        /// Keep-alives that did not come in time.
        KeepAlivesMissed,
        /// Times that no session datagram came for three keep-alives, so that the link does without them.
        DatagramsMissing,
        /// Links ended because their stream was dead while the peer was heard.
        StreamsDied,
        /// Requests sent.
        RequestsSent,
        /// Requests received.
        RequestsReceived,
        /// Requests given to a handler.
        RequestsRun,
        /// Requests refused because their id had been seen.
        RequestsRepeated,
        /// Requests refused because they were too old.
        RequestsExpired,
        /// Requests refused because as many waited as may.
        RequestsBusy,
        /// Requests refused because they came too soon.
        RequestsTooSoon,
        /// Requests refused because the access table does not allow them.
        RequestsForbidden,
        /// Requests that did not fit a published function.
        RequestsRejected,
        /// Requests of this unit that it did not send itself because of its own limits.
        RequestsWithheld,
        /// Calls that ended without an answer in time.
        CallsTimedOut,
        /// Calls that their callers gave up before the answer, and in time.
        CallsCancelled,
        /// Answers to calls that had ended already.
        RepliesLate,
        /// Answers that could not be sent.
        RepliesDropped,
        /// Functions of the peer's list that did not fit here.
        FunctionsSkipped,
        /// Functions that the peer published and the access table does not let it publish.
        FunctionsForbidden,
        /// Leases that ended without being renewed.
        LeasesExpired,
        /// Renewals that came for no running lease.
        RenewalsIgnored,
        /// Leases of calls of this unit that it renews no longer because newer calls of the same function took their places.
        RenewalsStopped,
        /// Leases of calls of this unit that it released because the peer answered no renewal for the length of the lease.
        RenewalsUnanswered,
        /// Requests that began before ones that had come earlier, by their deadlines.
        RequestsAhead,
        /// Requests refused while they waited, for others with earlier deadlines.
        RequestsDisplaced,
        /// Texts or values of failures that were cut or dropped, because they were too long or did not fit the signature.
        DetailsDropped,
        /// Progress of calls sent.
        ProgressSent,
        /// Progress of calls received.
        ProgressReceived,
        /// Progress received of calls that have ended, or that could not be read.
        ProgressDropped,
        /// Calls of the peer that it gave up while they ran.
        RunningCancelled,
        /// Cancellations of calls that had ended already.
        CancelsIgnored,
        /// Values of streams sent to a subscriber.
        SamplesSent,
        /// Values of streams received.
        SamplesReceived,
        /// Values of streams that a newer one replaced before they were due for a subscriber.
        SamplesReplaced,
        /// Values of streams received that this unit does not want, or cannot read.
        SamplesDropped,
        /// Subscriptions refused by the access table, or because the peer has as many as it may.
        SubscriptionsRefused,
    }
}

/// The counters of an ability that is off are left out, as far as they stand last.
const fn counted() -> usize {
    match (STREAMS, DETAILS) {
        (true, _) => <LinkCounter as Counter>::ALL.len(),
        (false, true) => LinkCounter::SamplesSent as usize,
        (false, false) => LinkCounter::DetailsDropped as usize,
    }
}
