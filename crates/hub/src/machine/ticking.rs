//! Executes a tick.

use messages::{
    ArmProtectiveStop, CommandSource, ControllerIndex, EventCode, MAX_CONTROLLERS, Phase, Plant, Reset,
    Severity, Tick, TickTiming,
};
use scene::Mode;

use super::control::StatusTiming;
use super::{Hub, HubError, Outcome, Stage, Step, lane_failed};
use crate::environment::{Environment, Note};
use crate::pacing::Start;
use crate::run_lane::LaneError;

impl<P: Plant> Hub<P> {
    pub(super) fn make_tick<E: Environment>(&mut self, env: &mut E, start: Start) -> Outcome<Step, P, E> {
        let start_ns = env.now_ns();
        let reset = if std::mem::take(&mut self.reset_asked) { Reset::Yes } else { Reset::No };
        let made = self.tick;
        let latched = self.latch.latch(made, reset);
        let marks = self.lane.tick(&mut self.plant, &latched, env, |env| env.now_ns());
        let marks = marks.map_err(lane_failed(made))?;
        self.tick += 1;
        self.after_state_published(env, marks.published_ns);
        self.publish_keyframe(env)?;
        self.plant.make_room();
        let done_ns = env.now_ns();
        if self.settings.mode == Mode::Lockstep {
            // Here it delays no controller, unlike at the start of a tick: the controllers have their state.
            env.tick_made(&mut self.timing);
        }
        let mut timing = TickTiming {
            tick: latched.tick,
            start_ns,
            wake_lateness_ns: start.lateness_ns,
            latch_ns: marks.latched_ns - start_ns,
            step_ns: marks.stepped_ns - marks.latched_ns,
            publish_ns: done_ns - marks.stepped_ns,
            missed: u32::from(start.missed),
            late_controllers: self.late_controllers(),
            ..self.timing
        };
        for (slot, controller) in timing.round_trip_ns.iter_mut().zip(&mut self.controllers) {
            *slot = std::mem::take(&mut controller.round_trip_ns);
        }
        env.send_timing(&timing)?;
        if reset == Reset::Yes {
            let text = format!("reset: tick {made} began from the initial state");
            let (severity, code) = (Severity::Info, EventCode::Reset);
            env.send_event(&Note { tick: self.tick, severity, code, text: &text })?;
            self.invalid_told = false;
            self.creation_told = false;
        }
        self.report_sources(env, made)?;
        self.report_refusals(env)?;
        self.report_shortfall(env, made)?;
        self.report_arm_entry(env)?;
        self.report_breach(env)?;
        self.report_approaches(env)?;
        self.report_protective_stop(env)?;
        self.report_invalid_model(env)?;
        self.report_energy_created(env)?;
        self.steps_left = self.steps_left.saturating_sub(1);
        self.send_status(env, Phase::Running, StatusTiming::IfDueAt(done_ns))?;
        Ok((Stage::TickDue, None))
    }

    /// Starts the round-trip clocks at `published_ns`, after a state is published, and wakes sleeping
    /// controllers.
    pub(super) fn after_state_published<E: Environment>(&mut self, env: &mut E, published_ns: u64) {
        self.published_ns = published_ns;
        env.wake_controllers();
    }

    /// Publishes a keyframe if one is due. A state that does not fit is skipped; this is reported once.
    fn publish_keyframe<E: Environment>(&mut self, env: &mut E) -> Outcome<(), P, E> {
        match self.lane.keyframe_if_due(&self.plant, env) {
            Ok(()) => Ok(()),
            Err(LaneError::Output(cause)) => Err(HubError::Environment(cause)),
            Err(LaneError::Plant(_)) if self.keyframe_refused => Ok(()),
            Err(LaneError::Plant(cause)) => {
                self.keyframe_refused = true;
                let text = format!("no keyframe from tick {} on: {cause}", self.tick);
                let (severity, code) = (Severity::Warning, EventCode::CapacityReached);
                Ok(env.send_event(&Note { tick: self.tick, severity, code, text: &text })?)
            }
        }
    }

    /// Reports when a controller's command starts being held or is replaced by the safe one; see
    /// [`LateNotes`](crate::late_notes::LateNotes).
    fn report_sources<E: Environment>(&mut self, env: &mut E, made: Tick) -> Outcome<(), P, E> {
        for (index, controller) in ControllerIndex::first(self.controllers.len()).zip(&self.controllers) {
            let source = self.latch.source(index);
            let before = std::mem::replace(&mut self.sources[index.slot()], source);
            let [held, safe] = &mut self.late_notes[index.slot()];
            let (notes, severity, code, what) = if source == CommandSource::Safe
                && before != CommandSource::Safe
                && self.settings.mode == Mode::Realtime
            {
                let what = "late for longer than `run.hold_ticks`: burr off, arm stopped";
                (safe, Severity::Warning, EventCode::SafeCommand, what)
            } else if source == CommandSource::Held && before == CommandSource::Fresh {
                (held, Severity::Info, EventCode::CommandHeld, "late: its last command is held")
            } else {
                continue;
            };
            if let Some(more) = notes.add(made, self.settings.period_ns) {
                let text = format!("controller `{}` is {what}{more}", controller.name);
                env.send_event(&Note { tick: made, severity, code, text: &text })?;
            }
        }
        Ok(())
    }

    fn report_refusals<E: Environment>(&mut self, env: &mut E) -> Outcome<(), P, E> {
        for refusal in self.plant.refusals() {
            self.refused_commands += u64::from(!refusal.stopped_later);
            let controller = &mut self.controllers[refusal.controller.slot()];
            // Rate-limited: an unreachable goal can repeat at every tick.
            if !controller.warnings.allows(env.now_ns()) {
                continue;
            }
            let (name, end) = (&controller.name, if refusal.stopped_later { "" } else { "; refused" });
            let text = format!("controller `{name}`: command {}: {}{end}", refusal.sequence, refusal.reason);
            let (severity, code) = (Severity::Warning, EventCode::CommandRefused);
            env.send_event(&Note { tick: self.tick, severity, code, text: &text })?;
        }
        Ok(())
    }

    /// Reports a part of the arm that has entered bone. Needs no rate limit, because the plant checks each
    /// part only a few times a second.
    fn report_arm_entry<E: Environment>(&mut self, env: &mut E) -> Outcome<(), P, E> {
        let Some(entry) = self.plant.arm_entry() else { return Ok(()) };
        let depth_mm = entry.depth_m * 1e3;
        let text = format!(
            "the arm's {} is {depth_mm:.0} mm inside bone; its collisions are not simulated",
            entry.part
        );
        let (severity, code) = (Severity::Warning, EventCode::ArmInBone);
        Ok(env.send_event(&Note { tick: self.tick, severity, code, text: &text })?)
    }

    /// Reports that the tool has left the bone. Needs no rate limit, because the plant reports each part at
    /// most once a second.
    fn report_breach<E: Environment>(&mut self, env: &mut E) -> Outcome<(), P, E> {
        let Some(breach) = self.plant.breach() else { return Ok(()) };
        let (severity, code) = (Severity::Warning, EventCode::Breach);
        Ok(env.send_event(&Note { tick: self.tick, severity, code, text: &breach.to_string() })?)
    }

    /// Reports the critical structures that the tool came close to or entered, at once, then once a second.
    fn report_approaches<E: Environment>(&mut self, env: &mut E) -> Outcome<(), P, E> {
        for approach in self.plant.approaches() {
            let [margin, breach] = &mut self.approach_notes[approach.index];
            let (notes, code) = match approach.has_entered {
                true => (breach, EventCode::StructureBreach),
                false => (margin, EventCode::StructureMargin),
            };
            if let Some(more) = notes.add(self.tick, self.settings.period_ns) {
                let text = format!("{approach}{more}");
                env.send_event(&Note { tick: self.tick, severity: Severity::Warning, code, text: &text })?;
            }
        }
        Ok(())
    }

    /// Reports each protective stop of the arm.
    fn report_protective_stop<E: Environment>(&mut self, env: &mut E) -> Outcome<(), P, E> {
        let state = self.plant.state();
        let is_stopped = state.arm_protective_stop() == Ok(ArmProtectiveStop::Stopped);
        if is_stopped == std::mem::replace(&mut self.is_stopped, is_stopped) || !is_stopped {
            return Ok(());
        }
        let [x, y, z] = state.flange_wrench.force_n;
        let cause = match self.plant.approaches().iter().find(|approach| approach.stops) {
            Some(approach) => format!("the tool is too close to `{}`", approach.structure),
            None => format!("{:.1} N on its flange", (x * x + y * y + z * z).sqrt()),
        };
        let text = format!("protective stop of the arm: {cause}; it accepts only `hold`");
        let (severity, code) = (Severity::Warning, EventCode::ProtectiveStop);
        Ok(env.send_event(&Note { tick: self.tick, severity, code, text: &text })?)
    }

    /// Reports the first tick after which the tool's model is invalid. `State.stop_excess_rad` shows how it
    /// continues.
    fn report_invalid_model<E: Environment>(&mut self, env: &mut E) -> Outcome<(), P, E> {
        if self.invalid_told {
            return Ok(());
        }
        let Some(past) = self.plant.invalid_flexure() else { return Ok(()) };
        self.invalid_told = true;
        let (model, number, excess_deg) = (past.model, past.flexure + 1, past.excess_rad.to_degrees());
        let text = format!(
            "the model {model} is not valid while a flexure is past its stop: flexure {number} from the base \
             is {excess_deg:.3} degrees past it; use planar, or reduce the load"
        );
        let (severity, code) = (Severity::Warning, EventCode::ModelNotValid);
        Ok(env.send_event(&Note { tick: self.tick, severity, code, text: &text })?)
    }

    /// Reports the first tick that created energy. `State.energy_created_j` shows how it continues.
    fn report_energy_created<E: Environment>(&mut self, env: &mut E) -> Outcome<(), P, E> {
        let created_j = self.plant.state().energy_created_j;
        if self.creation_told || created_j <= 0.0 {
            return Ok(());
        }
        self.creation_told = true;
        let text = format!(
            "a tick created {:.3} mJ of energy: forces and motions may not be physical; use a shorter time step",
            created_j * 1e3
        );
        let (severity, code) = (Severity::Warning, EventCode::EnergyCreated);
        Ok(env.send_event(&Note { tick: self.tick, severity, code, text: &text })?)
    }

    /// Reports what exceeded the tick's capacity: at once, then once a second.
    fn report_shortfall<E: Environment>(&mut self, env: &mut E, made: Tick) -> Outcome<(), P, E> {
        let (voxels, contacts) = (self.plant.uncut_voxels(), self.plant.left_out_contacts());
        for (count, shortfall, what) in [
            (voxels, &mut self.uncut_voxels, "out of memory: {} voxels under the burr could not be cut"),
            (contacts, &mut self.left_out_contacts, "contact capacity reached: {} contacts exert no force"),
        ] {
            if count == 0 {
                continue;
            }
            shortfall.total += count as u64;
            if let Some(more) = shortfall.notes.add(made, self.settings.period_ns) {
                let what = what.replace("{}", &count.to_string());
                let text = format!("{what}; {} so far{more}", shortfall.total);
                let (severity, code) = (Severity::Warning, EventCode::CapacityReached);
                env.send_event(&Note { tick: made, severity, code, text: &text })?;
            }
        }
        Ok(())
    }

    /// Returns a bit mask of the controllers whose command is not from this tick: bit i for controller i.
    fn late_controllers(&self) -> u32 {
        let all = ControllerIndex::first(self.controllers.len().min(MAX_CONTROLLERS));
        let late = all.filter(|index| self.latch.source(*index) != CommandSource::Fresh);
        late.fold(0, |bits, index| bits | 1 << index.slot())
    }
}
