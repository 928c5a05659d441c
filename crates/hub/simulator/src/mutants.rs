//! Deliberately broken versions of the hub: each must be found by the schedules of ten thousand seeds.

/// One change of the hub's source that makes it wrong.
#[derive(Debug, Clone, Copy)]
pub struct Mutant {
    /// What is wrong then.
    pub name: &'static str,
    /// File below `crates/hub/src`.
    pub file: &'static str,
    /// Text that stands there once.
    pub right: &'static str,
    /// What stands there instead.
    pub wrong: &'static str,
}

const fn mutant(name: &'static str, file: &'static str, right: &'static str, wrong: &'static str) -> Mutant {
    Mutant { name, file, right, wrong }
}

/// All of them.
pub const MUTANTS: &[Mutant] = &[
    mutant(
        "the lead is off by one",
        "machine/mod.rs",
        "self.tick.saturating_sub(self.settings.lead_ticks)",
        "self.tick.saturating_sub(self.settings.lead_ticks + 1)",
    ),
    mutant(
        "a simulation that fails is told to nobody",
        "machine/failure.rs",
        "HubError::Plant { tick, cause } => Ok(Failure::Plant { tick, cause }),",
        "HubError::Plant { tick, cause } => Err(HubError::Plant { tick, cause }),",
    ),
    mutant(
        "a run that fails waits for no recorder",
        "machine/waiting.rs",
        "let is_behind = self.shown && self.consumers.behind(self.tick, Whom::Recorder).is_some();",
        "let is_behind = false;",
    ),
    mutant("a state wakes nobody", "machine/ticking.rs", "        env.wake_controllers();\n", ""),
    mutant(
        "a late command is held for ever",
        "latch.rs",
        "hold_ticks.is_some_and(|limit| age_ticks > limit)",
        "hold_ticks.is_some_and(|_| false)",
    ),
    mutant(
        "a late command is replaced a tick too soon",
        "latch.rs",
        "hold_ticks.is_some_and(|limit| age_ticks > limit)",
        "hold_ticks.is_some_and(|limit| age_ticks >= limit)",
    ),
    mutant(
        "a controller that has come back counts on",
        "machine/commands.rs",
        "            self.latch.connect(index);\n",
        "",
    ),
    mutant(
        "a pause keeps the steps that were asked for",
        "machine/control.rs",
        "ControlAction::Pause => (self.paused, self.steps_left) = (true, 0)",
        "ControlAction::Pause => self.paused = true",
    ),
    mutant(
        "a reset is made at every tick from then on",
        "machine/ticking.rs",
        "std::mem::take(&mut self.reset_asked)",
        "self.reset_asked",
    ),
    mutant(
        "lost time is made up for in a bunch of ticks",
        "pacing.rs",
        "            self.missed += 1;\n            self.next_ns = now_ns;\n",
        "            self.missed += 1;\n",
    ),
    mutant(
        "the end waits for nobody",
        "machine/waiting.rs",
        "self.consumers.behind(self.tick, Whom::Everybody)",
        "self.consumers.behind(Tick::START, Whom::Everybody)",
    ),
    mutant(
        "lockstep takes an old answer",
        "latch.rs",
        "command.state_tick == tick.0)",
        "command.state_tick + 1 >= tick.0)",
    ),
    mutant(
        "a stop during the wait for an answer is not heard",
        "machine/waiting.rs",
        "if self.ends(env) || self.rests() {\n                    return Ok((Stage::TickDue, None));",
        "if self.rests() {\n                    return Ok((Stage::TickDue, None));",
    ),
    mutant(
        "time in which the process was stopped counts as waiting",
        "patience.rs",
        "passed_ns.min(LONGEST_LOOK_NS).min(self.limit_ns / 2)",
        "passed_ns",
    ),
    mutant(
        "a keyframe's parts are not numbered on",
        "run_lane.rs",
        "            self.keyframe_parts += 1;\n",
        "            self.keyframe_parts = 1;\n",
    ),
    mutant(
        "voxels of a reset are forgotten",
        "run_lane.rs",
        "            restores = Restores::Drilled;\n",
        "",
    ),
    mutant(
        "warnings are not limited",
        "rate_limit.rs",
        "let allowed = self.sent < WARNINGS;",
        "let allowed = true;",
    ),
    mutant(
        "refused commands are latched all the same",
        "latch.rs",
        "        check(command, &slot.drives, slot.last_sequence, tick)?;\n",
        "",
    ),
    mutant(
        "one request for a frame too many waits",
        "x_ray/schedule.rs",
        "own >= MAX_WAITING_EACH",
        "own > MAX_WAITING_EACH",
    ),
    mutant(
        "a scheduled frame is a tick late",
        "x_ray/schedule.rs",
        "filter(|_| tick >= self.next_tick)",
        "filter(|_| tick > self.next_tick)",
    ),
    mutant(
        "a requested frame is a tick late",
        "x_ray/schedule.rs",
        "position(|waiting| waiting.request.tick <= tick.0)",
        "position(|waiting| waiting.request.tick < tick.0)",
    ),
    mutant(
        "the last state is not shown",
        "x_ray/schedule.rs",
        "self.shown_tick.replace(tick) == Some(tick);",
        "self.shown_tick.replace(tick).is_some();",
    ),
    mutant(
        "a frame shows the voxels that its own tick removed",
        "x_ray/removals.rs",
        "is_some_and(|batch| batch.tick <= tick)",
        "is_some_and(|batch| batch.tick < tick)",
    ),
    mutant(
        "predrilled voxels come back with a reset",
        "x_ray/removals.rs",
        "                self.since.voxels.clone_from(&self.predrilled);\n",
        "                self.since.voxels.clear();\n",
    ),
    mutant(
        "removed voxels that are lost with their states are not missed",
        "x_ray/removals.rs",
        "if received != before + 1 {",
        "if received <= before {",
    ),
    mutant(
        "a request that is due when the run ends has no frame",
        "x_ray/schedule.rs",
        "let due = self.scheduled(tick).or_else(|| self.requested(tick));\n",
        "let due = self.scheduled(tick);\n",
    ),
    mutant(
        "a request that waits when the run ends has no answer",
        "x_ray/schedule.rs",
        "self.requests.drain(..).map(refused).collect()",
        "self.requests.drain(..).map(refused).skip(1).collect()",
    ),
    mutant(
        "a request that comes when the run has ended waits for ever",
        "x_ray/schedule.rs",
        "        self.ended_at = Some(last_tick);\n",
        "",
    ),
    mutant(
        "who connects late waits for a frame that has passed",
        "x_ray/controller_frames.rs",
        "        self.due = self.due.filter(|due| frame.tick < *due);\n",
        "",
    ),
    mutant(
        "who has dropped a frame waits for the one before it",
        "x_ray/controller_frames.rs",
        "due.filter(is_to_come).filter(",
        "due.filter(",
    ),
    mutant(
        "in lockstep a frame is seen as soon as it is there",
        "x_ray/controller_frames.rs",
        "return FrameStep::Keep;",
        "return FrameStep::Show;",
    ),
    mutant(
        "one lost frame of a controller is not counted",
        "x_ray/controller_frames.rs",
        "saturating_sub(before + 1)",
        "saturating_sub(before + 2)",
    ),
    mutant(
        "a slow client of the viewer loses the newest message and not the oldest",
        "viewer/queue.rs",
        "self.stream.iter().position(",
        "self.stream.iter().rposition(",
    ),
    mutant(
        "a busy stream pushes out what a client of the viewer has of a quiet one",
        "viewer/queue.rs",
        "is_some_and(|count| *count > 1)",
        "is_some_and(|count| *count > 0)",
    ),
    mutant(
        "a client of the viewer is not told what it missed",
        "viewer/queue.rs",
        "            self.dropped += 1;\n",
        "",
    ),
    mutant(
        "one slot holds up the others of a client of the viewer",
        "viewer/queue.rs",
        "std::ops::Bound::Excluded(self.last_slot)",
        "std::ops::Bound::Included(self.last_slot)",
    ),
    mutant(
        "a client of the viewer pays for messages that it does not want any more",
        "viewer/queue.rs",
        "        self.stream_bytes = self.stream.iter().map(|message| message.payload.len()).sum();\n",
        "",
    ),
    mutant(
        "a client of the viewer that subscribes late gets nothing",
        "viewer/client.rs",
        "            self.queue.push(outgoing, policy, message.slot);\n",
        "",
    ),
    mutant(
        "the viewer keeps nothing of what nobody watches",
        "viewer/kept.rs",
        "        self.newest = Some(message);\n",
        "",
    ),
    mutant(
        "a model that is not valid is told of in every tick",
        "machine/ticking.rs",
        "        self.invalid_told = true;\n",
        "",
    ),
    mutant(
        "a model that is not valid is told of once, whatever is reset",
        "machine/ticking.rs",
        "            self.invalid_told = false;\n",
        "",
    ),
];

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn every_mutant_still_fits_the_source() {
        let hub = std::path::Path::new(env!("CARGO_MANIFEST_DIR")).join("../src");
        for mutant in MUTANTS {
            let text = std::fs::read_to_string(hub.join(mutant.file)).unwrap();
            assert_eq!(text.matches(mutant.right).count(), 1, "{}: {}", mutant.file, mutant.name);
        }
    }
}
