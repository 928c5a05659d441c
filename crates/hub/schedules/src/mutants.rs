//! Deliberately broken versions of `hub` and `delivery`: the schedules of ten thousand seeds must detect
//! each.

/// A change of the source that introduces a fault.
#[derive(Debug, Clone, Copy)]
pub struct Mutant {
    /// The fault it introduces.
    pub name: &'static str,
    /// File below `crates`.
    pub file: &'static str,
    /// Text that occurs there exactly once.
    pub right: &'static str,
    /// Text that replaces it.
    pub wrong: &'static str,
}

/// Declares the mutants: name of the fault, file, and the text with its replacement.
macro_rules! mutants {
    ($($name:literal in $file:literal: $right:literal => $wrong:literal;)*) => {
        /// All mutants.
        pub const MUTANTS: &[Mutant] =
            &[$(Mutant { name: $name, file: $file, right: $right, wrong: $wrong },)*];
    };
}

mutants! {
    "the lead is off by one" in "hub/src/machine/mod.rs":
        "self.tick.saturating_sub(self.settings.lead_ticks)"
        => "self.tick.saturating_sub(self.settings.lead_ticks + 1)";
    "a failed simulation is not reported" in "hub/src/machine/failure.rs":
        "HubError::Plant { tick, cause } => Ok(Failure::Plant { tick, cause }),"
        => "HubError::Plant { tick, cause } => Err(HubError::Plant { tick, cause }),";
    "a failed run does not wait for its recorder" in "hub/src/machine/waiting.rs":
        "let is_behind = self.shown && self.consumers.behind(self.tick, ConsumerSet::Recorder).is_some();"
        => "let is_behind = false;";
    "a state wakes no controller" in "hub/src/machine/ticking.rs": "        env.wake_controllers();\n" => "";
    "a late command is held forever" in "hub/src/latch.rs":
        "hold_ticks.is_some_and(|limit| age_ticks > limit)" => "hold_ticks.is_some_and(|_| false)";
    "a late command is replaced a tick too soon" in "hub/src/latch.rs":
        "hold_ticks.is_some_and(|limit| age_ticks > limit)"
        => "hold_ticks.is_some_and(|limit| age_ticks >= limit)";
    "a reconnected controller keeps its sequence number" in "hub/src/machine/commands.rs":
        "            self.latch.connect(index);\n" => "";
    "a pause keeps the pending steps" in "hub/src/machine/control.rs":
        "ControlAction::Pause => (self.paused, self.steps_left) = (true, 0)"
        => "ControlAction::Pause => self.paused = true";
    "a reset repeats at every following tick" in "hub/src/machine/ticking.rs":
        "std::mem::take(&mut self.reset_asked)" => "self.reset_asked";
    "lost time is made up by a burst of ticks" in "hub/src/pacing.rs":
        "            self.missed += 1;\n            self.next_ns = now_ns;\n"
        => "            self.missed += 1;\n";
    "the end waits for no consumer" in "hub/src/machine/waiting.rs":
        "self.consumers.behind(self.tick, ConsumerSet::Everybody)"
        => "self.consumers.behind(Tick::START, ConsumerSet::Everybody)";
    "lockstep takes an old answer" in "hub/src/latch.rs":
        "command.state_tick == tick.0)" => "command.state_tick + 1 >= tick.0)";
    "a stop during the wait for an answer is ignored" in "hub/src/machine/waiting.rs":
        "if self.ends(env) || self.rests() {\n                    return Ok((Stage::TickDue, None));"
        => "if self.rests() {\n                    return Ok((Stage::TickDue, None));";
    "time in which the process was stopped counts as waiting" in "hub/src/patience.rs":
        "passed_ns.min(LONGEST_LOOK_NS).min(self.limit_ns / 2)" => "passed_ns";
    "a keyframe's parts are not numbered consecutively" in "hub/src/run_lane.rs":
        "            self.keyframe_parts += 1;\n" => "            self.keyframe_parts = 1;\n";
    "voxels of a reset are forgotten" in "hub/src/run_lane.rs":
        "            restores = Restores::Drilled;\n" => "";
    "warnings are not limited" in "hub/src/rate_limit.rs":
        "let allowed = self.sent < WARNINGS;" => "let allowed = true;";
    "a refused command is not reported" in "hub/src/machine/commands.rs":
        "                    self.warn(env, index, EventCode::CommandRefused, &text)?;\n"
        => "                    drop(text);\n";
    "refused commands are latched anyway" in "hub/src/latch.rs":
        "        self.check(controller, command, tick)?;\n" => "";
    "one frame request too many is queued" in "delivery/src/x_ray/schedule.rs":
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
    "removed voxels that are lost with their states are not detected" in "delivery/src/x_ray/removals.rs":
        "if received != before + 1 {" => "if received <= before {";
    "a request due at the end of the run gets no frame" in "delivery/src/x_ray/schedule.rs":
        "let due = self.scheduled(tick).or_else(|| self.requested(tick));\n"
        => "let due = self.scheduled(tick);\n";
    "a request waiting at the end of the run gets no answer" in "delivery/src/x_ray/schedule.rs":
        "self.requests.drain(..).map(refused).collect()"
        => "self.requests.drain(..).map(refused).skip(1).collect()";
    "a request that arrives after the end waits forever" in "delivery/src/x_ray/schedule.rs":
        "        self.ended_at = Some(last_tick);\n" => "";
    "a late controller waits for a frame that has passed" in "delivery/src/x_ray/controller_frames.rs":
        "        self.due = self.due.filter(|due| frame.tick < *due);\n" => "";
    "a controller that dropped a frame waits for the one before it"
        in "delivery/src/x_ray/controller_frames.rs":
        "due.filter(is_to_come).filter(" => "due.filter(";
    "in lockstep a frame is seen as soon as it arrives" in "delivery/src/x_ray/controller_frames.rs":
        "return FrameStep::Keep;" => "return FrameStep::Show;";
    "one lost frame of a controller is not counted" in "delivery/src/x_ray/controller_frames.rs":
        "saturating_sub(before + 1)" => "saturating_sub(before + 2)";
    "a slow client of the viewer loses the newest message instead of the oldest"
        in "delivery/src/viewer/queue.rs":
        "self.stream.iter().position(" => "self.stream.iter().rposition(";
    "a busy stream evicts a quiet one's messages for a client of the viewer"
        in "delivery/src/viewer/queue.rs":
        "is_some_and(|count| *count > 1)" => "is_some_and(|count| *count > 0)";
    "missed messages are not reported to a client of the viewer" in "delivery/src/viewer/queue.rs":
        "            self.dropped += 1;\n" => "";
    "one slot holds up the others of a client of the viewer" in "delivery/src/viewer/queue.rs":
        "std::ops::Bound::Excluded(self.last_slot)" => "std::ops::Bound::Included(self.last_slot)";
    "a client of the viewer is charged for messages that it unsubscribed from"
        in "delivery/src/viewer/queue.rs":
        "        self.stream_bytes = self.stream.iter().map(|message| message.payload.len()).sum();\n" => "";
    "a client of the viewer that subscribes late gets nothing" in "delivery/src/viewer/client.rs":
        "            self.queue.push(outgoing, policy, message.slot);\n" => "";
    "the viewer keeps no message of an unwatched channel" in "delivery/src/viewer/kept.rs":
        "        self.newest = Some(message);\n" => "";
    "an invalid model is reported in every tick" in "hub/src/machine/ticking.rs":
        "        self.invalid_told = true;\n" => "";
    "an invalid model is reported only once, despite a reset" in "hub/src/machine/ticking.rs":
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
