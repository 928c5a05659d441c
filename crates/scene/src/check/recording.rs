//! Checks what is recorded.

use super::Checker;
use crate::error::SceneError;
use crate::model::Scene;

pub(super) fn check(scene: &Scene, checker: &Checker) -> Result<(), SceneError> {
    let recording = &scene.recording;
    if recording.ring_s == 0.0 {
        return match recording.triggers.is_empty() {
            true => Ok(()),
            false => Err(checker.invalid("recording.triggers", "needs `recording.ring_s`, which they save")),
        };
    }
    if recording.keyframe_interval_s == 0.0 {
        let problem = "needs keyframes, at which its logs begin; set `recording.keyframe_interval_s`";
        return Err(checker.invalid("recording.ring_s", problem));
    }
    checker.at_most("recording.keyframe_interval_s", recording.keyframe_interval_s, recording.ring_s)?;
    checker.at_most("recording.after_s", recording.after_s, recording.ring_s)
}
