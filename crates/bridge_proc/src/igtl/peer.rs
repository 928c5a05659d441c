//! A connected peer: what is queued for it, what it has requested, and whether it may control the run.

use std::collections::VecDeque;
use std::sync::atomic::{AtomicBool, AtomicU64, AtomicUsize, Ordering};
use std::sync::{Arc, Mutex, PoisonError};

use openigtlink::{Body, HeaderVersion, Message, Status, StatusCode};

use super::Permission;
use super::connection::MOST_COMPLAINTS;
use super::incoming::Request;
use super::outbox::Outbox;

/// Maximum number of peers that control the run at a time.
pub(crate) const MOST_OWNERS: usize = 16;
/// Maximum number of a peer's requests that wait for the bridge; further ones are rejected.
const MOST_REQUESTS: usize = 64;

/// Grants control. All peers share it.
#[derive(Debug)]
pub(crate) struct Gate {
    permission: Permission,
    owners: AtomicUsize,
}

impl Gate {
    pub(crate) fn new(permission: Permission) -> Arc<Gate> {
        Arc::new(Gate { permission, owners: AtomicUsize::new(0) })
    }

    /// Takes one of the owners' slots; returns whether there was one.
    fn enter(&self) -> bool {
        let more = |owners| (owners < MOST_OWNERS).then_some(owners + 1);
        self.owners.fetch_update(Ordering::Relaxed, Ordering::Relaxed, more).is_ok()
    }
}

/// A connected peer. One that may control the run and has used that right is an owner; all others are
/// watchers.
#[derive(Debug)]
pub(crate) struct Peer {
    pub(crate) outbox: Outbox,
    gate: Arc<Gate>,
    is_owner: AtomicBool,
    requests: Mutex<VecDeque<Request>>,
    refused: AtomicU64,
    /// Whether the peer's messages have header version 2; until one arrives 1, which every receiver
    /// understands.
    has_version_2: AtomicBool,
}

impl Peer {
    pub(crate) fn new(gate: Arc<Gate>) -> Peer {
        Peer {
            outbox: Outbox::default(),
            gate,
            is_owner: AtomicBool::new(false),
            requests: Mutex::default(),
            refused: AtomicU64::new(0),
            has_version_2: AtomicBool::new(false),
        }
    }

    /// Queues a permitted request for the bridge and rejects any other. Permission is checked here, before
    /// anything is queued, so that a peer without it takes no room and no time from the owners.
    pub(crate) fn submit(&self, request: Request) {
        if let Request::Token(given) = &request {
            return self.present(given);
        }
        match &self.gate.permission {
            Permission::WatchOnly => {
                let why =
                    "this bridge is read-only; start it with --control-token-file or --control-by-anyone";
                return self.refuse(StatusCode::AccessDenied, why);
            }
            Permission::Token(_) if !self.is_owner() => {
                let why = "send the control token first, as a STRING named Token";
                return self.refuse(StatusCode::AccessDenied, why);
            }
            Permission::Anyone if !self.own() => return self.refuse_owner(),
            Permission::Token(_) | Permission::Anyone => {}
        }
        let mut waiting = self.requests.lock().unwrap_or_else(PoisonError::into_inner);
        if waiting.len() >= MOST_REQUESTS {
            drop(waiting);
            return self.refuse(StatusCode::NotReady, "too many pending requests");
        }
        waiting.push_back(request);
    }

    fn present(&self, given: &str) {
        match &self.gate.permission {
            Permission::Token(token) if is_same(token, given) => match self.own() {
                true => self.answer("Token", StatusCode::Ok, "control granted to this connection"),
                false => self.refuse_owner(),
            },
            Permission::Anyone => self.answer("Token", StatusCode::Ok, "no token required"),
            _ => self.refuse(StatusCode::AccessDenied, "Token: wrong token"),
        }
    }

    fn refuse_owner(&self) {
        let why = format!("too many peers: {MOST_OWNERS} control the run, which is the limit");
        self.refuse(StatusCode::NotReady, &why);
    }

    /// Makes the peer an owner if there is room; returns whether it is one. Only its reader calls this.
    fn own(&self) -> bool {
        let is_owner = self.is_owner() || self.gate.enter();
        self.is_owner.store(is_owner, Ordering::Relaxed);
        is_owner
    }

    /// Returns whether the peer controls the run.
    pub(crate) fn is_owner(&self) -> bool {
        self.is_owner.load(Ordering::Relaxed)
    }

    /// Removes the oldest pending request and returns it.
    pub(crate) fn next_request(&self) -> Option<Request> {
        self.requests.lock().unwrap_or_else(PoisonError::into_inner).pop_front()
    }

    pub(crate) fn has_requests(&self) -> bool {
        !self.requests.lock().unwrap_or_else(PoisonError::into_inner).is_empty()
    }

    /// Answers with a STATUS.
    pub(crate) fn answer(&self, device: &str, code: StatusCode, text: &str) {
        let ascii: String =
            text.chars().map(|c| if c.is_ascii() && !c.is_ascii_control() { c } else { '?' }).collect();
        let status =
            Status { code, subcode: 0, error: String::new(), message: ascii.chars().take(500).collect() };
        if let Ok(message) = Message::new(device, Body::Status(status)) {
            self.outbox.put(message);
        }
    }

    /// Rejects a message. The number of answers is limited, in case of a flood.
    pub(crate) fn refuse(&self, code: StatusCode, text: &str) {
        if self.refused.fetch_add(1, Ordering::Relaxed) < MOST_COMPLAINTS {
            self.answer("Trabecula", code, text);
        }
    }

    /// Returns the number of messages rejected.
    pub(crate) fn refused(&self) -> u64 {
        self.refused.load(Ordering::Relaxed)
    }

    /// Records the header version that the peer uses.
    pub(crate) fn speaks(&self, version: HeaderVersion) {
        self.has_version_2.fetch_or(version == HeaderVersion::V2, Ordering::Relaxed);
    }

    /// The header version of messages to the peer.
    pub(crate) fn version(&self) -> HeaderVersion {
        if self.has_version_2.load(Ordering::Relaxed) { HeaderVersion::V2 } else { HeaderVersion::V1 }
    }
}

impl Drop for Peer {
    fn drop(&mut self) {
        if self.is_owner() {
            self.gate.owners.fetch_sub(1, Ordering::Relaxed);
        }
    }
}

/// Compares in constant time, so that the duration does not reveal where the tokens differ.
fn is_same(token: &str, given: &str) -> bool {
    let differ = token.bytes().zip(given.bytes()).fold(0, |differ, (a, b)| differ | (a ^ b));
    token.len() == given.len() && differ == 0
}

#[cfg(test)]
mod tests {
    use super::*;

    fn token() -> Request {
        Request::Token("c0ffee00".into())
    }

    #[test]
    fn a_peer_without_permission_queues_nothing() {
        let gate = Gate::new(Permission::Token("c0ffee00".into()));
        let (watcher, owner) = (Peer::new(Arc::clone(&gate)), Peer::new(gate));
        (0..1000).for_each(|_| watcher.submit(Request::Halt));
        watcher.submit(Request::Token("c0ffee".into()));
        assert_eq!((watcher.next_request(), watcher.refused()), (None, 1001));
        owner.submit(token());
        owner.submit(Request::Halt);
        assert_eq!((owner.next_request(), owner.refused()), (Some(Request::Halt), 0));
        let read_only = Peer::new(Gate::new(Permission::WatchOnly));
        read_only.submit(token());
        read_only.submit(Request::Stop);
        assert_eq!((read_only.next_request(), read_only.refused()), (None, 2));
    }

    #[test]
    fn each_owner_has_its_own_queue() {
        let gate = Gate::new(Permission::Anyone);
        let (flood, other) = (Peer::new(Arc::clone(&gate)), Peer::new(gate));
        (0..=MOST_REQUESTS).for_each(|_| flood.submit(Request::Pause));
        assert_eq!(flood.refused(), 1);
        other.submit(Request::Halt);
        assert_eq!((other.next_request(), other.refused()), (Some(Request::Halt), 0));
    }

    #[test]
    fn an_owners_slot_is_free_again_when_it_leaves() {
        let gate = Gate::new(Permission::Token("c0ffee00".into()));
        let mut owners: Vec<Peer> = (0..MOST_OWNERS).map(|_| Peer::new(Arc::clone(&gate))).collect();
        owners.iter().for_each(|owner| owner.submit(token()));
        assert!(owners.iter().all(Peer::is_owner));
        let late = Peer::new(gate);
        late.submit(token());
        assert!(!late.is_owner());
        owners.pop();
        late.submit(token());
        assert!(late.is_owner());
    }
}
