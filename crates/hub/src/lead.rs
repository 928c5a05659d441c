//! How far the physics may run ahead of the recorder.

use messages::services::{FRAME, KEYFRAME, KEYFRAME_PART_BYTES, MAX_KEYFRAME_BYTES, RECORDER_QUEUE_TICKS};
use scene::{OnFull, Scene};

/// Returns the maximum lead in ticks, in real time, at which none of the recorder's queues overflows; `None`
/// if unlimited. At most a quarter of each per-tick queue, and half of the frame and keyframe queues.
pub fn recorder_lead_ticks(scene: &Scene) -> Option<u64> {
    if scene.recording.on_full == OnFull::Gap {
        return None;
    }
    let frame_ticks = scene.drr.as_ref().map(|drr| 1.0 / (drr.rate_hz * scene.dt_s()));
    let frames = frame_ticks.map(|ticks| (FRAME.lossless_length as f64 / 2.0 * ticks) as u64);
    let longest_parts = MAX_KEYFRAME_BYTES / KEYFRAME_PART_BYTES;
    let keyframes = (KEYFRAME.lossless_length / longest_parts / 2) as u64;
    let keyframes = scene.keyframe_period_ticks().map(|period_ticks| period_ticks * keyframes);
    let least = [frames, keyframes].into_iter().flatten().fold(RECORDER_QUEUE_TICKS / 4, u64::min);
    Some(least.max(1))
}

#[cfg(test)]
mod tests {
    use std::path::Path;

    use super::*;

    fn scene(more: &str) -> Scene {
        let text = format!(
            "name = \"a\"\n[run]\nmode = \"realtime\"\nduration_s = 1.0\n[tool]\n\
             burr_start_mm = [0.0, 0.0, 0.0]\n\
             direction = [0.0, 0.0, 1.0]\nbend_toward = [1.0, 0.0, 0.0]\n[[controller]]\nname = \"b\"\n\
             drives = [\"tendon\", \"arm\", \"burr\"]\nhold = {{ tension_n = 1.0 }}\n{more}"
        );
        Scene::parse(&text, Path::new("test")).unwrap()
    }

    #[test]
    fn a_physics_that_waits_for_the_recorder_stays_within_its_queues() {
        assert_eq!(recorder_lead_ticks(&scene("")), None, "in real time the tick comes first");
        let wait =
            |more: &str| recorder_lead_ticks(&scene(&format!("[recording]\non_full = \"wait\"\n{more}")));
        assert_eq!(wait(""), Some(RECORDER_QUEUE_TICKS / 4));
        // Two of the longest keyframes fit into their queue.
        assert_eq!(wait("keyframe_interval_s = 0.01"), Some(10));
        let frames = "[volume]\nphantom = \"block\"\n[drr]\nrate_hz = 100.0\nisocentre_mm = [0.0, 0.0, 0.0]\n\
                      columns = 16\nrows = 16\npixel_pitch_mm = 1.0\n";
        assert_eq!(wait(frames), Some(320));
    }
}
