//! The hub's view of its surroundings: its ports, and what it publishes.

use hub::{Environment, IncomingMessage, Note, Outputs, Report, Start};
use messages::{
    Blame, Command, ControllerIndex, Keyframe, Latched, Removed, RunControl, RunControlReply, RunStatus,
    SensorReading, State, TickTiming,
};

use super::{Event, Viewer, World};
use crate::oracle::PlantPlan;
use crate::plan::US;

impl Outputs for World {
    type Error = String;

    fn send_latched(&mut self, latched: &Latched) -> Result<(), String> {
        let (refuses, fails) = (self.plant.refuses.get(), self.plant.fails.get());
        self.oracle.latch(latched, PlantPlan { refuses, fails }, self.now_ns.get());
        if let Some(recording) = &mut self.recording {
            recording.latch(latched);
        }
        Ok(())
    }

    fn send_removed(&mut self, removed: &Removed, voxels: &[u32]) -> Result<(), String> {
        self.oracle.removed(removed, voxels);
        self.frames.removed(removed.restores(), voxels);
        if let Some(drr) = &mut self.drr {
            drr.receive_removed(removed, voxels, &mut self.frames);
        }
        if let Some(recording) = &mut self.recording {
            recording.removed(removed, voxels);
        }
        Ok(())
    }

    fn send_reading(&mut self, reading: &SensorReading) -> Result<(), String> {
        self.oracle.reading(reading);
        if let Some(recording) = &mut self.recording {
            recording.reading(reading);
        }
        Ok(())
    }

    fn send_state(&mut self, state: &State) -> Result<(), String> {
        self.newest_tick = Some(state.tick);
        self.controllers.iter_mut().for_each(|controller| controller.see(state.tick));
        self.consumers.iter_mut().for_each(|consumer| consumer.waiting += 1);
        self.oracle.state(state, self.now_ns.get());
        self.frames.state();
        self.viewer.iter_mut().for_each(Viewer::receive_state);
        if let Some(drr) = &mut self.drr {
            drr.receive_state(state);
        }
        if let Some(Err(error)) = self.recording.as_mut().map(|recording| recording.state(state)) {
            self.oracle.fail(format!("the recording: {error}"));
        }
        Ok(())
    }

    fn send_keyframe(&mut self, keyframe: &Keyframe, part: &[u8]) -> Result<(), String> {
        self.oracle.keyframe(keyframe, part);
        if let Some(recording) = &mut self.recording {
            recording.keyframe(keyframe, part);
        }
        Ok(())
    }
}

impl Environment for World {
    fn now_ns(&self) -> u64 {
        // Reading the clock takes a moment.
        self.now_ns.set(self.now_ns.get() + 50);
        self.now_ns.get()
    }

    fn end_requested(&self) -> bool {
        self.end_requested
    }

    fn receive_command(
        &mut self,
        controller: ControllerIndex,
    ) -> Result<Option<IncomingMessage<Command>>, String> {
        self.moment();
        let Some((incoming, form)) = self.controllers[controller.slot()].commands.pop_front() else {
            return Ok(None);
        };
        self.oracle.command(controller, &incoming, form);
        Ok(Some(incoming))
    }

    fn receive_control(&mut self) -> Result<Option<IncomingMessage<RunControl>>, String> {
        self.moment();
        self.oracle.passed_over();
        let incoming = self.control.pop_front();
        if let Some(incoming) = &incoming {
            self.oracle.request(incoming, self.now_ns.get());
        }
        Ok(incoming)
    }

    fn receive_report(&mut self) -> Result<Option<Report>, String> {
        self.moment();
        let report = self.reports.pop_front();
        if let Some(report) = report {
            self.oracle.report(report);
        }
        Ok(report)
    }

    fn foreign_reports(&self) -> u64 {
        self.foreign
    }

    fn send_status(&mut self, status: &RunStatus) -> Result<(), String> {
        self.oracle.status(status);
        Ok(())
    }

    fn send_timing(&mut self, timing: &TickTiming) -> Result<(), String> {
        self.oracle.timing(timing);
        Ok(())
    }

    fn send_control_reply(&mut self, reply: &RunControlReply) -> Result<(), String> {
        self.oracle.reply(reply, self.now_ns.get());
        Ok(())
    }

    fn send_event(&mut self, note: &Note<'_>) -> Result<(), String> {
        self.oracle.event(note, self.now_ns.get());
        Ok(())
    }

    fn leave_blame(&mut self, blame: &Blame) {
        self.oracle.blame(blame);
    }

    fn wake_controllers(&mut self) {
        for index in ControllerIndex::first(self.controllers.len()) {
            if self.controllers[index.slot()].asleep {
                self.controllers[index.slot()].asleep = false;
                let delay_ns = self.random.u64(..40 * US);
                self.look_soon(index, delay_ns);
            }
        }
    }

    fn wake_consumers(&mut self) {
        for index in 0..self.consumers.len() {
            if self.consumers[index].asleep {
                self.consumers[index].asleep = false;
                self.consumers[index].alarm.0 += 1;
                let (alarm, delay_ns) = (self.consumers[index].alarm.0, self.random.u64(..40 * US));
                self.after(delay_ns, Event::ConsumerLooks(index, alarm));
            }
        }
    }

    fn deliver_state_history(&mut self) -> Result<(), String> {
        let Some(tick) = self.newest_tick else { return Ok(()) };
        for index in ControllerIndex::first(self.controllers.len()) {
            if self.controllers[index.slot()].alive && self.controllers[index.slot()].wants_history {
                self.controllers[index.slot()].see(tick);
                // Its first poll of the queue happens once the state is there.
                self.controllers[index.slot()].asleep = false;
                self.look_soon(index, 0);
            }
        }
        Ok(())
    }

    fn deliver_status_history(&mut self) -> Result<(), String> {
        Ok(())
    }

    fn tick_begins(&mut self, start_ns: u64, start: Start, _timing: &mut TickTiming) {
        self.oracle.tick_begins(start_ns, start);
    }
}
