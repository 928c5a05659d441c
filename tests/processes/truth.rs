//! Scenes whose true world differs from the one that plan and controllers assume.

use std::path::Path;

use sim::{Drive, SharedScene, Sim};
use trabecula::report::course::Course;

const TARGET_MM: [f64; 3] = [5.0, 0.0, 8.0];
/// The block is uniform within this shift, so that the burr meets the same bone when the block is moved by
/// whole voxels.
const SHIFT_MM: [f64; 3] = [-1.0, 2.0, 1.0];

/// Returns the burr's final position and the error in the run's summary, mm. No session: a row of a sweep
/// equals a run (`sweeps.rs`).
fn end(settings: &[&str]) -> ([f64; 3], f64) {
    let scene = Path::new(env!("CARGO_MANIFEST_DIR")).join("configs/examples/truth.toml");
    let settings: Vec<String> = settings.iter().map(|setting| (*setting).to_owned()).collect();
    let shared = SharedScene::load(Some(&scene), &settings, None).unwrap();
    let (mut sim, mut course) =
        (Sim::new(&shared, &Drive::Nothing).unwrap(), Course::of(shared.scene(), None));
    course.add(sim.state());
    for _ in 0..shared.scene().tick_count() {
        sim.step(&[], 1).unwrap();
        course.add(sim.state());
    }
    let error_mm = course.tool().unwrap().target_error_mm.unwrap();
    (sim.state().t_world_burr.position_m.map(|x| x * 1e3), error_mm)
}

fn distance(a: [f64; 3], b: [f64; 3]) -> f64 {
    (0..3).map(|axis| (a[axis] - b[axis]).powi(2)).sum::<f64>().sqrt()
}

/// A controller that follows the plan drills the same hole wherever the uniform bone lies, and is evaluated
/// against the bone's true position.
#[test]
fn a_registration_error_is_felt_in_the_error_and_not_known_to_the_controller() {
    let planned = "truth.registration_error_deg=[0.0, 0.0, 0.0]";
    let (burr_mm, error_mm) = end(&[planned, "truth.registration_error_mm=[0.0, 0.0, 0.0]"]);
    assert!((distance(burr_mm, TARGET_MM) - error_mm).abs() < 1e-6, "{burr_mm:?}, {error_mm}");
    let (moved_mm, moved_error_mm) = end(&[planned, "truth.registration_error_mm=[-1.0, 2.0, 1.0]"]);
    let true_mm = core::array::from_fn(|axis| TARGET_MM[axis] + SHIFT_MM[axis]);
    assert!((distance(moved_mm, true_mm) - moved_error_mm).abs() < 1e-6, "{moved_mm:?}, {moved_error_mm}");
    // The tool enters the block a millimetre later, and leaves no wall: the rest is the grid's rounding.
    assert!(distance(burr_mm, moved_mm) < 0.1, "{burr_mm:?}, {moved_mm:?}");
    assert!(moved_error_mm > 1.5, "{moved_error_mm}");
}

/// Shape feedback compensates for a tool that is stiffer than the calibration; the plan alone does not.
#[test]
fn a_stiffer_tool_misses_by_the_plan_alone_and_not_with_feedback() {
    let rest = [
        "truth.registration_error_mm=[0.0, 0.0, 0.0]",
        "truth.registration_error_deg=[0.0, 0.0, 0.0]",
        "truth.manipulator.stiffness_scale=1.3",
    ];
    let [(_, open_mm), (_, closed_mm)] = ["none", "shape"].map(|feedback| {
        let feedback = format!("controller.0.curved_drilling.feedback={feedback:?}");
        end(&[rest[0], rest[1], rest[2], &feedback])
    });
    assert!(closed_mm < 0.5 * open_mm, "open loop {open_mm:.3} mm, with feedback {closed_mm:.3} mm");
}
