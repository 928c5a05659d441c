//! X-ray frames: the DRR process in the world, and the controllers that see its frames.

use delivery::x_ray::FrameMark;
use messages::{ControllerIndex, Part};

use super::{LAUNCHER_NOTICES_NS, World};
use crate::actors::Consumer;
use crate::drr::QueuePass;

impl World {
    /// Processes a consumer's queues; returns the time until which it is then blocked, as the DRR process is
    /// by its renderer.
    pub(super) fn stands_still_until(&mut self, part: Part) -> Option<u64> {
        if part != Part::Drr {
            return None;
        }
        let looked = self.drr.as_mut()?.look(self.now_ns.get(), &mut self.frames);
        self.hand_out_frames();
        self.deliver_frame_history();
        match looked {
            Ok(QueuePass::Done) => None,
            Ok(QueuePass::Blocked { until_ns }) => Some(until_ns),
            Err(lost) => {
                self.frames.failed(&lost);
                self.kill(Part::Drr, LAUNCHER_NOTICES_NS);
                None
            }
        }
    }

    /// Programs request frames, which wakes the DRR process if it sleeps.
    pub(super) fn frames_asked(&mut self, index: usize) {
        let now_ns = self.now_ns.get();
        self.asked += 1;
        let Some(drr) = &mut self.drr else { return };
        let (tick, controllers) = (self.newest_tick.unwrap_or(0), self.controllers.len());
        let asked = self.plan.x_ray.asks[index].requests(controllers, tick, &mut self.frame_requests);
        asked.into_iter().for_each(|asked| drr.receive_request(asked));
        let is_drr = |consumer: &&Consumer| consumer.part == Part::Drr;
        // It would also find a waiting state there.
        if self.consumers.iter().find(is_drr).is_some_and(|consumer| consumer.asleep && consumer.waiting == 0)
        {
            drr.take_requests(now_ns, &mut self.frames);
        }
        self.hand_out_frames();
    }

    /// Ends the run: the DRR process shows the last state and answers every request, unless it is dead. If
    /// it was asked to end, it refuses the waiting requests.
    pub fn finish_frames(&mut self) {
        let Some(mut drr) = self.drr.take() else { return };
        if self.end_requested {
            return drr.end(&mut self.frames);
        }
        let mut now_ns = self.now_ns.get();
        loop {
            match drr.look(now_ns, &mut self.frames) {
                Ok(QueuePass::Done) => break,
                Ok(QueuePass::Blocked { until_ns }) => now_ns = until_ns,
                Err(lost) => return self.frames.failed(&lost),
            }
        }
        let (tick, controllers) = (self.newest_tick.unwrap_or(0), self.controllers.len());
        let late = self.plan.x_ray.asks.get(self.asked);
        let late = late.map(|ask| ask.requests(controllers, tick, &mut self.frame_requests));
        drr.finish(now_ns, late.unwrap_or_default(), &mut self.frames);
        // A run can be stopped before its first state.
        if let Some(tick) = self.newest_tick {
            self.frames.ended(tick);
        }
        self.drr = Some(drr);
        self.hand_out_frames();
    }

    /// Puts published frames into the queues of the controllers that see them.
    fn hand_out_frames(&mut self) {
        let published = self.drr.as_mut().map(|drr| drr.take_published());
        for frame in published.into_iter().flatten() {
            self.deliver_frame_history();
            self.seen_frames.published(frame);
            self.newest_frame = Some(frame);
            ControllerIndex::first(self.controllers.len()).for_each(|index| self.deliver_frame(index, frame));
            self.viewer.iter_mut().for_each(|viewer| viewer.receive_frame());
        }
    }

    /// Controllers that have connected since then get the newest frame.
    fn deliver_frame_history(&mut self) {
        for index in ControllerIndex::first(self.controllers.len()) {
            let controller = &mut self.controllers[index.slot()];
            let Some(sight) = controller.sight.as_mut().filter(|_| controller.alive) else { continue };
            if std::mem::take(&mut sight.wants_history)
                && let Some(frame) = self.newest_frame
            {
                self.deliver_frame(index, frame);
            }
        }
    }

    fn deliver_frame(&mut self, index: ControllerIndex, frame: FrameMark) {
        let controller = &mut self.controllers[index.slot()];
        let Some(sight) = controller.sight.as_mut().filter(|_| controller.alive) else { return };
        self.seen_frames.delivered(index, frame);
        if let Some(dropped) = sight.receive(frame) {
            self.seen_frames.dropped(index, dropped);
        }
    }

    /// Checks that a controller that waits for a frame waits for one that will arrive.
    pub(super) fn check_frame_waits(&mut self) {
        let controllers = ControllerIndex::first(self.controllers.len()).zip(&self.controllers);
        for (index, controller) in controllers.filter(|(_, c)| c.alive) {
            if let Some(sight) = &controller.sight
                && let Some(tick) = sight.waits_at
                && sight.is_empty()
                && !sight.wants_history
            {
                self.seen_frames.waits(index, tick);
            }
        }
    }
}
