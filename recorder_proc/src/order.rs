//! Puts the messages of a tick, which arrive on separate queues, into one order.

use std::collections::VecDeque;

use ipc_types::layout::Message;
use ipc_types::messages::{Latched, Removed, State};
use zerocopy::FromBytes;

/// A message whose partner has not come is written alone once this many of its kind wait: its partner is lost.
const MAX_WAITING: usize = 1024;

/// One message in the order of the log.
#[derive(Debug, Clone, PartialEq)]
pub(crate) enum Ordered {
    Latched(Box<Latched>),
    Removed(Vec<u8>),
    State(Box<State>),
}

/// Messages of each kind in order of arrival. Out come, tick by tick: `Latched` k, `Removed` k+1, `State` k+1, however
/// the three queues were interleaved.
#[derive(Debug, Default)]
pub(crate) struct TickOrder {
    latched: VecDeque<Box<Latched>>,
    removed: VecDeque<Vec<u8>>,
    states: VecDeque<Box<State>>,
    begun: bool,
}

impl TickOrder {
    pub fn latched(&mut self, latched: &Latched) {
        self.latched.push_back(Box::new(*latched));
    }

    pub fn removed(&mut self, message: &[u8]) {
        self.removed.push_back(message.to_vec());
    }

    pub fn state(&mut self, state: &State) {
        self.states.push_back(Box::new(*state));
    }

    /// The next messages in order; empty if the next tick's are not all there. With `last`, nothing more will come:
    /// what is there is handed out.
    pub fn next(&mut self, last: bool) -> Vec<Ordered> {
        if !self.begun {
            return self.begin(last);
        }
        match (self.latched.front(), self.states.front()) {
            (Some(latched), Some(state)) if latched.tick.wrapping_add(1) == state.tick => self.tick(last),
            (Some(latched), Some(state)) if latched.tick.wrapping_add(1) < state.tick => self.lone_latched(),
            (Some(_), Some(_)) => self.lone_state(last),
            (Some(_), None) if last || self.latched.len() > MAX_WAITING => self.lone_latched(),
            (None, Some(_)) if last || self.states.len() > MAX_WAITING => self.lone_state(last),
            (None, None) if last => self.removed.pop_front().map(Ordered::Removed).into_iter().collect(),
            _ => Vec::new(),
        }
    }

    /// The initial state comes before everything.
    fn begin(&mut self, last: bool) -> Vec<Ordered> {
        let waiting = self.latched.len().max(self.removed.len());
        if self.states.is_empty() && !last && waiting <= MAX_WAITING {
            return Vec::new();
        }
        self.begun = true;
        match self.states.front() {
            Some(state) if state.tick == 0 => {
                self.states.pop_front().map(Ordered::State).into_iter().collect()
            }
            _ => self.next(last),
        }
    }

    fn tick(&mut self, last: bool) -> Vec<Ordered> {
        let Some(removed) = self.removed_of_front_state(last) else { return Vec::new() };
        let latched = self.latched.pop_front().map(Ordered::Latched);
        let state = self.states.pop_front().map(Ordered::State);
        latched.into_iter().chain(removed.map(Ordered::Removed)).chain(state).collect()
    }

    fn lone_latched(&mut self) -> Vec<Ordered> {
        self.latched.pop_front().map(Ordered::Latched).into_iter().collect()
    }

    fn lone_state(&mut self, last: bool) -> Vec<Ordered> {
        let Some(removed) = self.removed_of_front_state(last) else { return Vec::new() };
        let state = self.states.pop_front().map(Ordered::State);
        removed.map(Ordered::Removed).into_iter().chain(state).collect()
    }

    /// The removal of the first waiting state: `None` to wait for it, `Some(None)` if there is none (to come).
    fn removed_of_front_state(&mut self, last: bool) -> Option<Option<Vec<u8>>> {
        let state = self.states.front()?;
        if state.removed_in_tick == 0 {
            return Some(None);
        }
        match self.removed.front() {
            Some(message) if tick_of(message) == Some(state.tick) => Some(self.removed.pop_front()),
            Some(_) => Some(None),
            None if last || self.states.len() > MAX_WAITING => Some(None),
            None => None,
        }
    }
}

fn tick_of(message: &[u8]) -> Option<u64> {
    debug_assert!(message.len() >= Removed::DESCRIPTION.size);
    Removed::read_from_prefix(message).ok().map(|(removed, _)| removed.tick)
}
