//! Deliberately broken versions of `hub` and `delivery`: the schedules of ten thousand seeds must find each.

/// One change of a source that makes it wrong.
#[derive(Debug, Clone, Copy)]
pub struct Mutant {
    /// What is wrong then.
    pub name: &'static str,
    /// File below `crates`.
    pub file: &'static str,
    /// Text that stands there once.
    pub right: &'static str,
    /// What stands there instead.
    pub wrong: &'static str,
}

/// Declares the mutants: what is wrong, in which file, and the text that is replaced by another.
macro_rules! mutants {
    ($($name:literal in $file:literal: $right:literal => $wrong:literal;)*) => {
        /// All of them.
        pub const MUTANTS: &[Mutant] =
            &[$(Mutant { name: $name, file: $file, right: $right, wrong: $wrong },)*];
    };
}

mutants! {
    "the lead is off by one" in "hub/src/machine/mod.rs":
        "self.tick.saturating_sub(self.settings.lead_ticks)"
        => "self.tick.saturating_sub(self.settings.lead_ticks + 1)";
    "a simulation that fails is told to nobody" in "hub/src/machine/failure.rs":
        "HubError::Plant { tick, cause } => Ok(Failure::Plant { tick, cause }),"
        => "HubError::Plant { tick, cause } => Err(HubError::Plant { tick, cause }),";
    "a run that fails waits for no recorder" in "hub/src/machine/waiting.rs":
        "let is_behind = self.shown && self.consumers.behind(self.tick, Whom::Recorder).is_some();"
        => "let is_behind = false;";
    "a state wakes nobody" in "hub/src/machine/ticking.rs": "        env.wake_controllers();\n" => "";
    "a late command is held for ever" in "hub/src/latch.rs":
        "hold_ticks.is_some_and(|limit| age_ticks > limit)" => "hold_ticks.is_some_and(|_| false)";
    "a late command is replaced a tick too soon" in "hub/src/latch.rs":
        "hold_ticks.is_some_and(|limit| age_ticks > limit)"
        => "hold_ticks.is_some_and(|limit| age_ticks >= limit)";
    "a controller that has come back counts on" in "hub/src/machine/commands.rs":
        "            self.latch.connect(index);\n" => "";
    "a pause keeps the steps that were asked for" in "hub/src/machine/control.rs":
        "ControlAction::Pause => (self.paused, self.steps_left) = (true, 0)"
        => "ControlAction::Pause => self.paused = true";
    "a reset is made at every tick from then on" in "hub/src/machine/ticking.rs":
        "std::mem::take(&mut self.reset_asked)" => "self.reset_asked";
    "lost time is made up for in a bunch of ticks" in "hub/src/pacing.rs":
        "            self.missed += 1;\n            self.next_ns = now_ns;\n"
        => "            self.missed += 1;\n";
    "the end waits for nobody" in "hub/src/machine/waiting.rs":
        "self.consumers.behind(self.tick, Whom::Everybody)"
        => "self.consumers.behind(Tick::START, Whom::Everybody)";
    "lockstep takes an old answer" in "hub/src/latch.rs":
        "command.state_tick == tick.0)" => "command.state_tick + 1 >= tick.0)";
    "a stop during the wait for an answer is not heard" in "hub/src/machine/waiting.rs":
        "if self.ends(env) || self.rests() {\n                    return Ok((Stage::TickDue, None));"
        => "if self.rests() {\n                    return Ok((Stage::TickDue, None));";
    "time in which the process was stopped counts as waiting" in "hub/src/patience.rs":
        "passed_ns.min(LONGEST_LOOK_NS).min(self.limit_ns / 2)" => "passed_ns";
    "a keyframe's parts are not numbered on" in "hub/src/run_lane.rs":
        "            self.keyframe_parts += 1;\n" => "            self.keyframe_parts = 1;\n";
    "voxels of a reset are forgotten" in "hub/src/run_lane.rs":
        "            restores = Restores::Drilled;\n" => "";
    "warnings are not limited" in "hub/src/rate_limit.rs":
        "let allowed = self.sent < WARNINGS;" => "let allowed = true;";
    "refused commands are latched all the same" in "hub/src/latch.rs":
        "        self.check(controller, command, tick)?;\n" => "";
    "one request for a frame too many waits" in "delivery/src/x_ray/schedule.rs":
        "own >= MAX_WAITING_EACH" => "own > MAX_WAITING_EACH";
    "a scheduled frame is a tick late" in "delivery/src/x_ray/schedule.rs":
        "filter(|_| tick >= self.next_tick)" => "filter(|_| tick > self.next_tick)";
    "a requested frame is a tick late" in "delivery/src/x_ray/schedule.rs":
        "position(|waiting| waiting.request.tick <= tick.0)"
        => "position(|waiting| waiting.request.tick < tick.0)";
    "the last state is not shown" in "delivery/src/x_ray/schedule.rs":
        "self.shown_tick.replace(tick) == Some(tick);" => "self.shown_tick.replace(tick).is_some();";
    "a frame shows the voxels that its own tick removed" in "delivery/src/x_ray/removals.rs":
        "is_some_and(|batch| batch.tick <= tick)" => "is_some_and(|batch| batch.tick < tick)";
    "predrilled voxels come back with a reset" in "delivery/src/x_ray/removals.rs":
        "                self.since.voxels.clone_from(&self.predrilled);\n"
        => "                self.since.voxels.clear();\n";
    "removed voxels that are lost with their states are not missed" in "delivery/src/x_ray/removals.rs":
        "if received != before + 1 {" => "if received <= before {";
    "a request that is due when the run ends has no frame" in "delivery/src/x_ray/schedule.rs":
        "let due = self.scheduled(tick).or_else(|| self.requested(tick));\n"
        => "let due = self.scheduled(tick);\n";
    "a request that waits when the run ends has no answer" in "delivery/src/x_ray/schedule.rs":
        "self.requests.drain(..).map(refused).collect()"
        => "self.requests.drain(..).map(refused).skip(1).collect()";
    "a request that comes when the run has ended waits for ever" in "delivery/src/x_ray/schedule.rs":
        "        self.ended_at = Some(last_tick);\n" => "";
    "who connects late waits for a frame that has passed" in "delivery/src/x_ray/controller_frames.rs":
        "        self.due = self.due.filter(|due| frame.tick < *due);\n" => "";
    "who has dropped a frame waits for the one before it" in "delivery/src/x_ray/controller_frames.rs":
        "due.filter(is_to_come).filter(" => "due.filter(";
    "in lockstep a frame is seen as soon as it is there" in "delivery/src/x_ray/controller_frames.rs":
        "return FrameStep::Keep;" => "return FrameStep::Show;";
    "one lost frame of a controller is not counted" in "delivery/src/x_ray/controller_frames.rs":
        "saturating_sub(before + 1)" => "saturating_sub(before + 2)";
    "a slow client of the viewer loses the newest message and not the oldest"
        in "delivery/src/viewer/queue.rs":
        "self.stream.iter().position(" => "self.stream.iter().rposition(";
    "a busy stream pushes out what a client of the viewer has of a quiet one"
        in "delivery/src/viewer/queue.rs":
        "is_some_and(|count| *count > 1)" => "is_some_and(|count| *count > 0)";
    "a client of the viewer is not told what it missed" in "delivery/src/viewer/queue.rs":
        "            self.dropped += 1;\n" => "";
    "one slot holds up the others of a client of the viewer" in "delivery/src/viewer/queue.rs":
        "std::ops::Bound::Excluded(self.last_slot)" => "std::ops::Bound::Included(self.last_slot)";
    "a client of the viewer pays for messages that it does not want any more"
        in "delivery/src/viewer/queue.rs":
        "        self.stream_bytes = self.stream.iter().map(|message| message.payload.len()).sum();\n" => "";
    "a client of the viewer that subscribes late gets nothing" in "delivery/src/viewer/client.rs":
        "            self.queue.push(outgoing, policy, message.slot);\n" => "";
    "the viewer keeps nothing of what nobody watches" in "delivery/src/viewer/kept.rs":
        "        self.newest = Some(message);\n" => "";
    "a model that is not valid is told of in every tick" in "hub/src/machine/ticking.rs":
        "        self.invalid_told = true;\n" => "";
    "a model that is not valid is told of once, whatever is reset" in "hub/src/machine/ticking.rs":
        "            self.invalid_told = false;\n" => "";
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn every_mutant_still_fits_the_source() {
        let crates = std::path::Path::new(env!("CARGO_MANIFEST_DIR")).join("../..");
        for mutant in MUTANTS {
            let text = std::fs::read_to_string(crates.join(mutant.file)).unwrap();
            assert_eq!(text.matches(mutant.right).count(), 1, "{}: {}", mutant.file, mutant.name);
        }
    }
}
