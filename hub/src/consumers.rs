//! Who must take every state, and how far they are.

use messages::Part;

use crate::environment::Environment;

/// Reports that are taken in one look.
const REPORTS_PER_LOOK: usize = 64;

/// The parts that take every state.
#[derive(Debug, Clone)]
pub(crate) struct Consumers {
    list: Vec<Consumer>,
    /// Reports of other programs that have been mentioned.
    foreign: u64,
}

#[derive(Debug, Clone, Copy)]
struct Consumer {
    part: Part,
    /// None: not connected yet.
    tick: Option<u64>,
}

/// Whom the hub waits for.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum Whom {
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

    /// Takes in what they have reported.
    pub(crate) fn update<E: Environment>(&mut self, env: &mut E) -> Result<(), E::Error> {
        for _ in 0..REPORTS_PER_LOOK {
            let Some(report) = env.receive_report()? else { break };
            for consumer in self.list.iter_mut().filter(|consumer| consumer.part == report.part) {
                consumer.tick = Some(report.tick);
            }
        }
        Ok(())
    }

    /// Reports of programs that are no consumer, since this was asked last.
    pub(crate) fn new_foreign_reports<E: Environment>(&mut self, env: &E) -> u64 {
        let foreign = env.foreign_reports();
        foreign - std::mem::replace(&mut self.foreign, foreign)
    }

    /// The first one that has not connected.
    pub(crate) fn missing(&self) -> Option<Part> {
        self.list.iter().find(|consumer| consumer.tick.is_none()).map(|consumer| consumer.part)
    }

    /// The first one of these that has not taken the state of `tick`.
    pub(crate) fn behind(&self, tick: u64, whom: Whom) -> Option<Part> {
        let mut these =
            self.list.iter().filter(|consumer| whom == Whom::Everybody || consumer.part == Part::Recorder);
        these.find(|consumer| consumer.tick.is_none_or(|taken| taken < tick)).map(|consumer| consumer.part)
    }

    /// The same, with what they have reported since the last look where that may matter.
    pub(crate) fn still_behind<E: Environment>(
        &mut self,
        env: &mut E,
        tick: u64,
        whom: Whom,
    ) -> Result<Option<Part>, E::Error> {
        if self.behind(tick, whom).is_none() {
            return Ok(None);
        }
        self.update(env)?;
        Ok(self.behind(tick, whom))
    }
}
