//! The list of the run's parts: how often each sends, and when it last did.

use std::collections::BTreeMap;
use std::time::{Duration, Instant};

use ipc_types::messages::Part as HubPart;
use ipc_types::scene::Scene;
use ipc_types::session::Session;
use serde_json::{Value, json};

use crate::board::Board;
use crate::channels::PARTS;

const PERIOD: Duration = Duration::from_secs(1);
/// A part without messages for longer than this is shown as silent.
const SILENT: Duration = Duration::from_secs(2);

#[derive(Debug, Clone, Copy, Default)]
struct PartActivity {
    count: usize,
    last: Option<Instant>,
}

/// Messages seen from each part since the last report.
#[derive(Debug)]
pub(super) struct Parts {
    parts: BTreeMap<String, PartActivity>,
    order: Vec<String>,
    since: Instant,
}

impl Parts {
    pub(super) fn new(scene: &Scene, session: &Session) -> Parts {
        let is_there = |part: &HubPart| match part {
            HubPart::Host => false,
            HubPart::Physics => true,
            HubPart::Drr => scene.drr.is_some(),
            HubPart::Recorder => session.announcement().recorder,
        };
        let own = HubPart::ALL.into_iter().filter(is_there).map(|part| part.name().to_owned());
        let order: Vec<String> = own.chain(scene.controller_names()).collect();
        let parts = order.iter().map(|name| (name.clone(), PartActivity::default())).collect();
        Parts { parts, order, since: Instant::now() }
    }

    /// Counts messages of a part.
    pub(super) fn count_messages(&mut self, name: &str, count: usize) {
        if let Some(part) = self.parts.get_mut(name).filter(|_| count > 0) {
            part.count += count;
            part.last = Some(Instant::now());
        }
    }

    /// Publishes the list once a second.
    pub(super) fn publish(&mut self, board: &Board) {
        let elapsed = self.since.elapsed();
        if elapsed < PERIOD {
            return;
        }
        self.since = Instant::now();
        let rows: Vec<Value> = self.order.iter().filter_map(|name| self.row(name, elapsed)).collect();
        board.publish_json(PARTS, &Value::Array(rows));
        self.parts.values_mut().for_each(|part| part.count = 0);
    }

    fn row(&self, name: &str, elapsed: Duration) -> Option<Value> {
        let part = self.parts.get(name)?;
        let age = part.last.map(|last| last.elapsed());
        let state = match age {
            None => "no messages yet",
            Some(age) if age > SILENT => "silent",
            Some(_) => "active",
        };
        let rate_hz = part.count as f64 / elapsed.as_secs_f64();
        let age_ms = age.map(|age| age.as_secs_f64() * 1e3);
        Some(json!({"name": name, "rate_hz": rate_hz, "age_ms": age_ms, "state": state}))
    }
}
