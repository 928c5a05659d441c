//! The closed loop on X-ray images: the reference controller steers by the frames of the DRR process.

use std::path::Path;

use crate::common::logs::{assert_replays, read};
use crate::common::program::Place;

/// The target of the scene with shape feedback, reached using the frames. The published system claims a tip
/// within 3 mm; here half of that is required, as with the measured shape.
#[test]
fn image_feedback_in_lockstep_ends_near_its_target() {
    let configs = Path::new(env!("CARGO_MANIFEST_DIR")).join("configs");
    let text = std::fs::read_to_string(configs.join("curved_shape_feedback.toml")).unwrap();
    let calibration = configs.join("calibration/tension_sweep.csv");
    let frames = "
[drr]
rate_hz = 10.0
isocentre_mm = [0.0, 0.0, 0.0]
columns = 128
rows = 128
pixel_pitch_mm = 0.7
photons_per_pixel = 5000.0
threads = 1
";
    let scene = text
        .replace("feedback = \"shape\"", "feedback = \"image\"")
        .replace("feed_mm_per_s = 2.0", "feed_mm_per_s = 4.0")
        .replace("duration_s = 13.0", "duration_s = 7.0")
        .replace("\"calibration/tension_sweep.csv\"", &format!("{calibration:?}"));
    let place = Place::new();
    let ended = place.complete(&format!("{scene}{frames}"));
    let log = read(&ended.folder);
    let last = log.ticks.last().unwrap().state;
    let target_mm = [5.0, 0.0, 8.0];
    let off_mm = |axis: usize| last.t_world_burr.position_m[axis] * 1e3 - target_mm[axis];
    let miss_mm = (0..3).map(|axis| off_mm(axis).powi(2)).sum::<f64>().sqrt();
    println!("{miss_mm:.2} mm from the target; {} voxels drilled", last.removed_total);
    assert!(last.removed_total > 1_000, "{} voxels drilled", last.removed_total);
    assert!(miss_mm < 1.5, "{miss_mm} mm from the target");
    let forces = log.ticks.iter().map(|tick| tick.latched.commands[0].command.tendon_force_n[0]);
    assert!(forces.fold(0.0, f64::max) > 1.0, "the tendon has been pulled");
    assert_replays(&ended.folder);
}
