//! Checks whether a scene is feasible: whether its numbers and its geometry make sense together.
//!
//! Ranges of single keys and relations between keys are checked when a scene is parsed (`scene`). Here the
//! tool is placed where the scene puts it, next to the bone and the bodies. A scene that cannot work is
//! [`Verdict::Impossible`]; one that works but is most likely a mistake is [`Verdict::Unlikely`]. [`RULES`]
//! lists all rules; values outside the validated ranges are in `ranges`.

mod controllers;
mod geometry;
mod ranges;

use std::fmt::{self, Display, Formatter};

use scene::{Controller, Drives, Scene};

use super::{CtView, Simulation, SimulationError};
pub use ranges::validated_range;

/// Consequence of a finding.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Verdict {
    /// The scene cannot work and is rejected.
    Impossible,
    /// The scene works but is most likely a mistake: the user is warned.
    Unlikely,
}

/// A problem in a scene.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Finding {
    /// Its consequence.
    pub verdict: Verdict,
    /// The scene key.
    pub key: &'static str,
    /// Description of the problem, and what is allowed or expected.
    pub problem: String,
}

impl Display for Finding {
    fn fmt(&self, f: &mut Formatter<'_>) -> fmt::Result {
        write!(f, "`{}` {}", self.key, self.problem)
    }
}

/// A scene and its simulation at tick 0.
struct Start<'a> {
    scene: &'a Scene,
    simulation: Simulation<'a>,
    /// Distance of the burr's surface from the nearest bone, m; negative if bone is within the burr's radius.
    /// `None` without bone.
    burr_gap_m: Option<f64>,
    program_exists: &'a dyn Fn(&str) -> bool,
}

/// A rule that a scene may violate.
struct Rule {
    verdict: Verdict,
    key: &'static str,
    find: fn(&Start) -> Option<String>,
}

const fn impossible(key: &'static str, find: fn(&Start) -> Option<String>) -> Rule {
    Rule { verdict: Verdict::Impossible, key, find }
}

const fn unlikely(key: &'static str, find: fn(&Start) -> Option<String>) -> Rule {
    Rule { verdict: Verdict::Unlikely, key, find }
}

/// All rules, in the order in which findings are reported.
const RULES: [Rule; 27] = [
    impossible("controller.command", controllers::program_is_missing),
    impossible("volume.bone_threshold_hu", geometry::nothing_to_drill),
    unlikely("volume.bone_threshold_hu", geometry::no_bone),
    impossible("tool.burr_start_mm", geometry::start_in_metres),
    impossible("tool.burr_start_mm", controllers::feed_ends_before_bone),
    unlikely("tool.burr_start_mm", geometry::start_far_from_bone),
    unlikely("tool.burr_start_mm", geometry::burr_in_bone),
    unlikely("tool.burr_start_mm", geometry::shaft_in_bone),
    impossible("predrill.diameter_mm", geometry::hole_thinner_than_tool),
    unlikely("predrill.diameter_mm", geometry::hole_thinner_than_burr),
    unlikely("manipulator.burr_diameter_mm", geometry::burr_thinner_than_tool),
    unlikely("manipulator.tool.burr.tip_diameter_mm", geometry::tip_thinner_than_voxels),
    unlikely("manipulator.tool.tendon", geometry::tendon_outside_tube),
    impossible("body.position_mm", geometry::body_in_tool),
    impossible("arm.model", controllers::no_arm_to_move),
    impossible("arm.initial_joints_deg", controllers::no_path_from_singular_start),
    unlikely("arm.initial_joints_deg", controllers::singular_start),
    impossible("arm.model", controllers::feed_beyond_arm),
    impossible("arm.max_speed_mm_per_s", controllers::feed_faster_than_arm),
    unlikely("arm.tool_position_mm", geometry::arm_in_bone),
    unlikely("arm.tool_position_mm", geometry::arm_in_bone_at_end),
    impossible("controller.curved_drilling.target_mm", controllers::target_out_of_reach),
    unlikely("run.dt_ms", controllers::long_step_in_bone),
    unlikely("manipulator.integrator", controllers::long_step_of_pre_curved_tool),
    unlikely("manipulator.model", controllers::modes_on_stops),
    unlikely("run.duration_s", controllers::run_shorter_than_plan),
    unlikely("drr.rate_hz", controllers::frame_rate_is_rounded),
];

/// Returns the problems of a scene, in the order of the rules. Without a CT, the rules about bone are
/// skipped.
///
/// `program_exists` returns whether the first word of a `controller.command` can be started.
///
/// # Errors
/// [`SimulationError`]: the simulation rejects the scene.
pub fn findings(
    scene: &Scene,
    ct: Option<CtView<'_>>,
    program_exists: &dyn Fn(&str) -> bool,
) -> Result<Vec<Finding>, SimulationError> {
    let mut boneless = scene.clone();
    if ct.is_none() {
        boneless.volume = None;
        boneless.predrill.clear();
    }
    let simulation = Simulation::new(&boneless, ct)?;
    let mut start = Start { scene, simulation, burr_gap_m: None, program_exists };
    start.burr_gap_m = start.burr_gap_m();
    let found = |rule: &Rule| {
        let problem = (rule.find)(&start)?;
        Some(Finding { verdict: rule.verdict, key: rule.key, problem })
    };
    Ok(RULES.iter().filter_map(found).chain(ranges::findings(scene)).collect())
}

/// Returns the simulated time that the built-in controllers of a scene need for their plans, s; 0 without a
/// plan.
pub fn planned_time_s(scene: &Scene) -> f64 {
    let sweeps = scene.controller.iter().filter_map(|controller| controller.tension_sweep.as_ref());
    let feeds = scene.controller.iter().filter_map(feed).map(|feed| feed.time_s);
    feeds.chain(sweeps.map(|sweep| sweep.duration_s())).fold(0.0, f64::max)
}

/// A straight or curved feed of a built-in controller.
struct Feed<'a> {
    table: &'static str,
    /// Scene key of its length.
    length_key: &'static str,
    length_mm: f64,
    /// The faster of the feed and the subsequent retraction, with its key.
    fastest_mm_s: (&'static str, f64),
    /// Simulated time of the feed and the subsequent retraction.
    time_s: f64,
    drives: &'a [Drives],
    /// Whether the arm moves; for a tube that is deployed, it does not.
    is_arms: bool,
}

impl<'a> Start<'a> {
    /// Returns the feeds of the scene's built-in controllers.
    fn feeds(&self) -> impl Iterator<Item = Feed<'a>> {
        self.scene.controller.iter().filter_map(feed)
    }

    /// Returns whether a controller moves a part. Holding, a tension sweep and a tube deployment keep the arm
    /// still.
    fn is_led(&self, part: Drives) -> bool {
        let is_still = |controller: &Controller| {
            controller.hold.is_some()
                || controller.tension_sweep.is_some()
                || controller.tube_deployment.is_some()
        };
        self.scene.controller.iter().any(|entry| entry.drives.contains(&part) && !is_still(entry))
    }
}

/// Scene key of the speed of a feed.
const FEED: &str = "feed_mm_per_s";

fn feed(controller: &Controller) -> Option<Feed<'_>> {
    let drives = controller.drives.as_slice();
    if let Some(plan) = &controller.curved_drilling {
        let time_s = plan.insertion_mm / plan.feed_mm_per_s + plan.retraction_mm / plan.retraction_mm_per_s;
        let (table, length_key) = ("controller.curved_drilling", "insertion_mm");
        let retracts_faster = plan.retraction_mm > 0.0 && plan.retraction_mm_per_s > plan.feed_mm_per_s;
        let fastest_mm_s = match retracts_faster {
            true => ("retraction_mm_per_s", plan.retraction_mm_per_s),
            false => (FEED, plan.feed_mm_per_s),
        };
        let length_mm = plan.insertion_mm;
        return Some(Feed { table, length_key, length_mm, fastest_mm_s, time_s, drives, is_arms: true });
    }
    if let Some(plan) = &controller.tube_deployment {
        let time_s = (plan.deployed_mm + plan.retraction_mm) / plan.feed_mm_per_s;
        let (table, length_key) = ("controller.tube_deployment", "deployed_mm");
        let (fastest_mm_s, length_mm) = ((FEED, plan.feed_mm_per_s), plan.deployed_mm);
        return Some(Feed { table, length_key, length_mm, fastest_mm_s, time_s, drives, is_arms: false });
    }
    let plan = controller.skiving.as_ref()?;
    Some(Feed {
        table: "controller.skiving",
        length_key: "depth_mm",
        length_mm: plan.depth_mm,
        fastest_mm_s: (FEED, plan.feed_mm_per_s),
        time_s: plan.depth_mm / plan.feed_mm_per_s,
        drives,
        is_arms: true,
    })
}
