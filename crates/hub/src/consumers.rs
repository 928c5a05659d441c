//! The parts that must take every state, and how far each one has got.

use messages::{Part, Tick};

use crate::environment::Environment;

/// Maximum number of reports read per poll.
const REPORTS_PER_POLL: usize = 64;

/// The parts that must take every state.
#[derive(Debug, Clone)]
pub(crate) struct Consumers {
    list: Vec<Consumer>,
    /// Reports from other programs already accounted for.
    foreign: u64,
}

#[derive(Debug, Clone, Copy)]
struct Consumer {
    part: Part,
    /// `None` until it connects.
    tick: Option<Tick>,
}

/// Which consumers the hub waits for.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum ConsumerSet {
    Everybody,
    Recorder,
}

impl Consumers {
    pub(crate) fn new(parts: &[Part]) -> Consumers {
        Consumers {
            list: parts.iter().map(|part| Consumer { part: *part, tick: None }).collect(),
            foreign: 0,
        }
    }

    /// Reads the reports that have arrived.
    pub(crate) fn update<E: Environment>(&mut self, env: &mut E) -> Result<(), E::Error> {
        for _ in 0..REPORTS_PER_POLL {
            let Some(report) = env.receive_report()? else { break };
            for consumer in self.list.iter_mut().filter(|consumer| consumer.part == report.part) {
                consumer.tick = Some(report.tick);
            }
        }
        Ok(())
    }

    /// Returns the number of reports since the last call that came from programs other than the consumers.
    pub(crate) fn new_foreign_reports<E: Environment>(&mut self, env: &E) -> u64 {
        let foreign = env.foreign_reports();
        foreign - std::mem::replace(&mut self.foreign, foreign)
    }

    /// Returns the first consumer that has not connected.
    pub(crate) fn missing(&self) -> Option<Part> {
        self.list.iter().find(|consumer| consumer.tick.is_none()).map(|consumer| consumer.part)
    }

    /// Returns the first of these consumers that has not taken the state of `tick`.
    pub(crate) fn behind(&self, tick: Tick, whom: ConsumerSet) -> Option<Part> {
        let mut these = self
            .list
            .iter()
            .filter(|consumer| whom == ConsumerSet::Everybody || consumer.part == Part::Recorder);
        these.find(|consumer| consumer.tick.is_none_or(|taken| taken < tick)).map(|consumer| consumer.part)
    }

    /// As [`behind`](Consumers::behind), but reads new reports first if they could change the answer.
    pub(crate) fn still_behind<E: Environment>(
        &mut self,
        env: &mut E,
        tick: Tick,
        whom: ConsumerSet,
    ) -> Result<Option<Part>, E::Error> {
        if self.behind(tick, whom).is_none() {
            return Ok(None);
        }
        self.update(env)?;
        Ok(self.behind(tick, whom))
    }
}
