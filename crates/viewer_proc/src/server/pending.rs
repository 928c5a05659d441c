//! Pending connections: connections that have not presented the token, such as an incomplete request or a
//! page file in transit. Anyone can open them, so their number is limited and a new one evicts an old one:
//! idle connections lock no client out.

use std::cell::RefCell;
use std::collections::HashMap;
use std::net::IpAddr;
use std::rc::Rc;

use tokio::task::AbortHandle;

/// Maximum number of pending connections at a time.
pub const MAX_PENDING: usize = 64;

#[derive(Debug)]
struct Entry {
    number: u64,
    peer: IpAddr,
    task: Option<AbortHandle>,
}

#[derive(Debug, Default)]
struct List {
    /// Oldest first.
    entries: Vec<Entry>,
    next: u64,
}

/// The server's pending connections.
#[derive(Debug, Clone, Default)]
pub(super) struct PendingConnections(Rc<RefCell<List>>);

/// A connection's slot among the pending connections, until dropped.
#[derive(Debug)]
pub(super) struct PendingConnection {
    list: PendingConnections,
    number: u64,
}

impl PendingConnections {
    /// Admits a pending connection. At the limit, closes the oldest one of the address that has the most.
    pub fn admit(&self, peer: IpAddr) -> PendingConnection {
        let mut list = self.0.borrow_mut();
        if list.entries.len() >= MAX_PENDING
            && let Some(index) = oldest_of_most(&list.entries)
        {
            let closed = list.entries.remove(index);
            closed.task.iter().for_each(AbortHandle::abort);
        }
        let number = list.next;
        list.next += 1;
        list.entries.push(Entry { number, peer, task: None });
        PendingConnection { list: self.clone(), number }
    }

    /// Registers the task that serves a pending connection.
    pub fn is_served_by(&self, number: u64, task: AbortHandle) {
        if let Some(entry) = self.0.borrow_mut().entries.iter_mut().find(|entry| entry.number == number) {
            entry.task = Some(task);
        }
    }
}

fn oldest_of_most(entries: &[Entry]) -> Option<usize> {
    let mut counts: HashMap<IpAddr, usize> = HashMap::new();
    entries.iter().for_each(|entry| *counts.entry(entry.peer).or_default() += 1);
    let most = counts.values().copied().max()?;
    entries.iter().position(|entry| counts.get(&entry.peer) == Some(&most))
}

impl PendingConnection {
    /// Returns the pending connection's number.
    pub fn number(&self) -> u64 {
        self.number
    }
}

impl Drop for PendingConnection {
    fn drop(&mut self) {
        self.list.0.borrow_mut().entries.retain(|entry| entry.number != self.number);
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_oldest_connection_of_the_busiest_address_makes_room() {
        let pending = PendingConnections::default();
        let peer = |last: u8| IpAddr::from([127, 0, 0, last]);
        let other = pending.admit(peer(2));
        let mut of_one: Vec<PendingConnection> =
            (0..MAX_PENDING - 1).map(|_| pending.admit(peer(1))).collect();
        let numbers = || pending.0.borrow().entries.iter().map(|entry| entry.number).collect::<Vec<u64>>();
        of_one.push(pending.admit(peer(1)));
        assert_eq!(numbers().len(), MAX_PENDING);
        assert!(numbers().contains(&other.number()) && !numbers().contains(&of_one[0].number()));
        let third = pending.admit(peer(3));
        assert!(numbers().contains(&other.number()) && !numbers().contains(&of_one[1].number()));
        drop(of_one);
        assert_eq!(numbers(), [other.number(), third.number()]);
    }
}
