//! The queue of calls from clients to the data source, and the requests' owners.

use std::sync::mpsc::{Receiver, SyncSender, TryRecvError, TrySendError, sync_channel};

use tokio::sync::oneshot;

use crate::services::{Outcome, Reply, Request};

/// A request and the channel for its reply.
#[derive(Debug)]
pub struct Call {
    /// The request.
    pub request: Request,
    /// Receives the reply.
    pub answer: oneshot::Sender<Outcome>,
    /// Whether its sender has presented the token.
    pub is_owner: bool,
}

impl Call {
    /// Replies. The client may have disconnected.
    pub fn reply(self, reply: Reply) {
        let _ = self.answer.send(Ok(reply));
    }

    /// Rejects the request with a reason. The client may have disconnected.
    pub fn refuse(self, why: &str) {
        let _ = self.answer.send(Err(why.to_owned()));
    }
}

/// The sending side of a queue of calls.
#[derive(Debug, Clone)]
pub struct CallSender {
    owners: SyncSender<Call>,
    watchers: SyncSender<Call>,
}

/// The receiving side of a queue of calls. Owners and watchers have a bounded queue each, and the owners' is
/// read first, so that no number of watchers keeps an owner's command out.
#[derive(Debug)]
pub struct Calls {
    owners: Receiver<Call>,
    watchers: Receiver<Call>,
}

/// Creates a queue with room for `capacity` calls of owners and `capacity` calls of watchers.
pub fn call_queue(capacity: usize) -> (CallSender, Calls) {
    let (to_owners, owners) = sync_channel(capacity);
    let (to_watchers, watchers) = sync_channel(capacity);
    (CallSender { owners: to_owners, watchers: to_watchers }, Calls { owners, watchers })
}

impl CallSender {
    /// Queues a call.
    ///
    /// # Errors
    /// The call, if its queue is full or the data source has ended.
    #[expect(clippy::result_large_err, reason = "the call comes back, to be refused")]
    pub fn try_send(&self, call: Call) -> Result<(), TrySendError<Call>> {
        if call.is_owner { self.owners.try_send(call) } else { self.watchers.try_send(call) }
    }
}

impl Calls {
    /// Removes the next call.
    ///
    /// # Errors
    /// No call is waiting, or the server has ended.
    pub fn try_recv(&self) -> Result<Call, TryRecvError> {
        self.owners.try_recv().or_else(|_| self.watchers.try_recv())
    }

    /// Removes the calls that are waiting.
    pub fn try_iter(&self) -> impl Iterator<Item = Call> + '_ {
        core::iter::from_fn(|| self.try_recv().ok())
    }
}
