//! Puts a tick's messages in log order; they arrive on separate queues.

use std::collections::VecDeque;

use messages::services::{LATCHED, REMOVED, STATE};
use messages::{Latched, Removed, Reset, Restores, State};
use zerocopy::FromBytes;

/// Once this many messages of one kind wait, their counterpart counts as lost and the oldest is written
/// alone. The limit exceeds a queue's length because the recorder may drain one whole queue after a pause
/// before it reads the next.
const MAX_WAITING: usize = 2 * STATE.lossless_length;

const _: () = assert!(MAX_WAITING > LATCHED.lossless_length && MAX_WAITING > REMOVED.lossless_length);

/// Whether more messages can arrive.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum Supply {
    /// More can arrive; an incomplete tick waits for them.
    Open,
    /// No more can arrive; an incomplete tick is written as it is.
    Ended,
}

/// The first message of a tick in the log.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum Beginning {
    Latched,
    State,
}

/// One message in the order of the log.
#[derive(Debug, Clone, PartialEq)]
pub(crate) enum OrderedMessage {
    Latched(Box<Latched>),
    Removed(Vec<u8>),
    State(Box<State>),
}

/// Accepts the messages of each kind in order of arrival and returns them tick by tick: `Latched` k,
/// `Removed` k+1, `State` k+1, however the three queues were interleaved. `Removed` 0 and `State` 0 come
/// first.
#[derive(Debug, Default)]
pub(crate) struct TickOrder {
    latched: VecDeque<Box<Latched>>,
    removed: VecDeque<(Removed, Vec<u8>)>,
    states: VecDeque<Box<State>>,
    /// `removed_total` of the last state returned. The next state's total exceeds it by the sum of the
    /// removals in between.
    removed_total: u64,
    begun: bool,
}

impl TickOrder {
    pub fn latched(&mut self, latched: &Latched) {
        self.latched.push_back(Box::new(*latched));
    }

    pub fn removed(&mut self, message: &[u8]) {
        if let Ok((removed, _)) = Removed::read_from_prefix(message) {
            self.removed.push_back((removed, message.to_vec()));
        }
    }

    pub fn state(&mut self, state: &State) {
        self.states.push_back(Box::new(*state));
    }

    /// Returns the next messages in order; empty if the next tick is incomplete and more messages can arrive.
    pub fn next(&mut self, supply: Supply) -> Vec<OrderedMessage> {
        let has_ended = supply == Supply::Ended;
        match (self.latched.front(), self.states.front()) {
            (_, Some(state)) if !self.begun && state.tick == 0 => self.tick(Beginning::State, supply),
            (Some(latched), Some(state)) if latched.tick.checked_add(1) == Some(state.tick) => {
                self.tick(Beginning::Latched, supply)
            }
            (Some(latched), Some(state)) if latched.tick >= state.tick => self.tick(Beginning::State, supply),
            (Some(_), Some(_)) => self.lone_latched(),
            (Some(_), None) if has_ended => self.last_latched(),
            (Some(_), None) if self.latched.len() > MAX_WAITING => self.lone_latched(),
            (None, Some(_)) if has_ended || self.states.len() > MAX_WAITING => {
                self.tick(Beginning::State, supply)
            }
            (None, None) if has_ended => self
                .removed
                .pop_front()
                .map(|(_, bytes)| OrderedMessage::Removed(bytes))
                .into_iter()
                .collect(),
            _ => Vec::new(),
        }
    }

    /// Returns the first waiting state with its removals, preceded by the first waiting command if it belongs
    /// to the state.
    fn tick(&mut self, beginning: Beginning, supply: Supply) -> Vec<OrderedMessage> {
        let with_latched = beginning == Beginning::Latched;
        let latched = self.latched.front().filter(|_| with_latched);
        let reset = latched.map_or(Reset::No, |latched| latched.reset());
        let Some(count) = self.removals_of_front_state(reset, supply) else { return Vec::new() };
        let latched = if with_latched { self.latched.pop_front() } else { None };
        let mut out: Vec<OrderedMessage> = latched.map(OrderedMessage::Latched).into_iter().collect();
        out.extend(self.removed.drain(..count).map(|(_, bytes)| OrderedMessage::Removed(bytes)));
        if let Some(state) = self.states.pop_front() {
            self.removed_total = state.removed_total;
            out.push(OrderedMessage::State(state));
        }
        self.begun = true;
        out
    }

    /// Returns the command after the last state. Commands of later ticks, whose states never arrived, are
    /// dropped so that the log does not end in a gap.
    fn last_latched(&mut self) -> Vec<OrderedMessage> {
        let first = self.lone_latched();
        self.latched.clear();
        first
    }

    fn lone_latched(&mut self) -> Vec<OrderedMessage> {
        self.begun = true;
        self.latched.pop_front().map(OrderedMessage::Latched).into_iter().collect()
    }

    /// Returns the number of waiting removals that belong before the first waiting state, or `None` if more
    /// are expected. Within a tick totals only grow, except at the first message after a reset, so the tick
    /// is complete when the state's total is reached.
    fn removals_of_front_state(&self, reset: Reset, supply: Supply) -> Option<usize> {
        let state = self.states.front()?;
        let of_tick = self.removed.iter().take_while(|(removed, _)| removed.tick <= state.tick).count();
        let messages = || self.removed.iter().take(of_tick).map(|(removed, _)| removed);
        let total = messages().next_back().map_or(self.removed_total, |removed| removed.removed_total);
        let restored =
            reset == Reset::No || messages().any(|removed| removed.restores() == Restores::Drilled);
        let complete = total == state.removed_total && restored;
        let hopeless =
            supply == Supply::Ended || of_tick < self.removed.len() || self.states.len() > MAX_WAITING;
        (complete || hopeless).then_some(of_tick)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Regression: a recorder that had to stop early had received more commands than states. It wrote all of
    /// them, and the log ended in a gap that no reader could pass.
    #[test]
    fn commands_whose_states_were_not_taken_do_not_follow_each_other_at_the_end() {
        let mut order = TickOrder::default();
        order.state(&State::zeroed());
        (0..5).for_each(|tick| order.latched(&Latched { tick, ..Latched::zeroed() }));
        order.state(&State { tick: 1, ..State::zeroed() });
        let mut out = Vec::new();
        loop {
            let next = order.next(Supply::Ended);
            if next.is_empty() {
                break;
            }
            out.extend(next);
        }
        let tick = |ordered: &OrderedMessage| match ordered {
            OrderedMessage::Latched(latched) => ("latched", latched.tick),
            OrderedMessage::State(state) => ("state", state.tick),
            OrderedMessage::Removed(_) => ("removed", 0),
        };
        let ticks: Vec<_> = out.iter().map(tick).collect();
        assert_eq!(ticks, [("state", 0), ("latched", 0), ("state", 1), ("latched", 1)]);
    }

    /// Regression: a recorder stopped for two seconds found one queue full, drained it, and wrote states
    /// without their commands once more than 1024 waited: a gap that no reader could pass.
    #[test]
    fn a_whole_queue_of_states_waits_for_its_commands() {
        let mut order = TickOrder::default();
        let ticks = STATE.lossless_length as u64;
        (0..=ticks).for_each(|tick| order.state(&State { tick, ..State::zeroed() }));
        assert_eq!(order.next(Supply::Open).len(), 1, "the first state has none");
        assert!(order.next(Supply::Open).is_empty(), "its commands come later");
        for tick in 0..ticks {
            order.latched(&Latched { tick, ..Latched::zeroed() });
            let next = order.next(Supply::Open);
            let is_pair = matches!(
                &next[..],
                [OrderedMessage::Latched(l), OrderedMessage::State(s)] if l.tick == tick && s.tick == tick + 1
            );
            assert!(is_pair, "tick {tick}: {} messages", next.len());
        }
    }
}
