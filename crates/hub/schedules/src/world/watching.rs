//! The viewer in the world, and its clients.

use super::{Event, World};
use crate::actors::Alarm;

impl World {
    /// Schedules the viewer's first pass, and when its clients connect, leave and change their subscriptions.
    pub(super) fn plan_watching(&mut self) {
        let Some(plan) = self.plan.viewer.clone() else { return };
        self.watcher_alarms = vec![Alarm::default(); plan.clients.len()];
        self.after(plan.look_ns, Event::ViewerLooks);
        for (index, client) in plan.clients.iter().enumerate() {
            self.after(client.joins_ns, Event::WatcherJoins(index));
            if let Some(leaves_ns) = client.leaves_ns {
                self.after(leaves_ns, Event::WatcherLeaves(index));
            }
            for (number, change) in client.changes.iter().enumerate() {
                self.after(change.at_ns, Event::WatcherChanges(index, number));
            }
        }
    }

    pub(super) fn viewer_looks(&mut self) {
        let now_ns = self.now_ns.get();
        if let Some(viewer) = &mut self.viewer {
            viewer.look(now_ns);
            let look_ns = self.plan.viewer.as_ref().map_or(0, |plan| plan.look_ns);
            self.after(look_ns, Event::ViewerLooks);
            self.wake_watchers();
        }
    }

    /// Handles an event of a client of the viewer.
    pub(super) fn watching_happens(&mut self, event: Event) {
        let now_ns = self.now_ns.get();
        let Some(viewer) = &mut self.viewer else { return };
        match event {
            Event::WatcherJoins(index) => {
                viewer.join(index);
                self.serve_soon(index, 0);
            }
            Event::WatcherLeaves(index) => viewer.leave(index),
            Event::WatcherServes(index, alarm) if self.watcher_alarms[index] == Alarm(alarm) => {
                if let Some(delay_ns) = viewer.serve(index, now_ns) {
                    self.serve_soon(index, delay_ns);
                }
            }
            Event::WatcherChanges(index, number) => {
                let client = self.plan.viewer.as_ref().map(|plan| &plan.clients[index]);
                if let Some(change) = client.map(|client| client.changes[number]) {
                    viewer.change(index, change);
                }
                self.wake_watchers();
            }
            _ => {}
        }
    }

    fn wake_watchers(&mut self) {
        for index in 0..self.watcher_alarms.len() {
            if self.viewer.as_mut().is_some_and(|viewer| viewer.wakes(index)) {
                self.serve_soon(index, 0);
            }
        }
    }

    fn serve_soon(&mut self, index: usize, delay_ns: u64) {
        self.watcher_alarms[index].0 += 1;
        self.after(delay_ns, Event::WatcherServes(index, self.watcher_alarms[index].0));
    }

    /// Ends the run: the remaining clients read to the end.
    pub fn finish_watching(&mut self) {
        if let Some(viewer) = &mut self.viewer {
            viewer.finish(self.now_ns.get());
        }
    }

    /// Returns the number of messages sent to the viewer's clients, and of missed ones reported to them.
    pub fn watched(&self) -> (u64, u64) {
        self.viewer.as_ref().map_or((0, 0), |viewer| (viewer.sent, viewer.missed))
    }

    /// Returns the first violated rule of all models.
    pub fn take_failure(&mut self) -> Option<String> {
        let viewer = self.viewer.as_mut().and_then(|viewer| {
            viewer.note_failures();
            viewer.failure.take()
        });
        let frames = self.frames.failure.take().or_else(|| self.seen_frames.failure.take());
        self.oracle.failure.take().or(frames).or(viewer)
    }
}
