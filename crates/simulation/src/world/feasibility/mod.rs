//! Whether a scene makes sense: what its numbers and its geometry mean together.
//!
//! Ranges of single keys and relations of keys are checked when a scene is parsed (`scene`). Here the tool is
//! put where the scene puts it, beside the bone and the bodies. What cannot work is [`Verdict::Impossible`];
//! what works and is most likely a mistake is [`Verdict::Unlikely`]. [`RULES`] is the one list of both;
//! values for which nothing is claimed stand in `ranges`.

mod controllers;
mod geometry;
mod ranges;

use std::fmt::{self, Display, Formatter};

use scene::{Controller, Drives, Scene};

use super::{CtView, Simulation, SimulationError};

/// What becomes of a scene.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Verdict {
    /// It cannot work, and is refused.
    Impossible,
    /// It works, and is most likely a mistake: the user is warned.
    Unlikely,
}

/// What does not make sense in a scene.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Finding {
    /// What follows.
    pub verdict: Verdict,
    /// The key.
    pub key: &'static str,
    /// What it is, and what is allowed or expected.
    pub problem: String,
}

impl Display for Finding {
    fn fmt(&self, f: &mut Formatter<'_>) -> fmt::Result {
        write!(f, "`{}` {}", self.key, self.problem)
    }
}

/// A scene, built, at tick 0.
struct Start<'a> {
    scene: &'a Scene,
    simulation: Simulation<'a>,
    /// Of the burr's surface from the nearest bone, m; negative inside the burr's radius. `None` without
    /// bone.
    burr_gap_m: Option<f64>,
    program_exists: &'a dyn Fn(&str) -> bool,
}

/// A rule: what it finds of a scene, if anything.
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

/// Every rule, in the order in which findings are told.
const RULES: [Rule; 29] = [
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
    unlikely("controller.curved_drilling.target_mm", controllers::target_beyond_stops),
    unlikely("controller.curved_drilling.insertion_mm", controllers::insertion_shorter_than_arc),
    unlikely("run.dt_ms", controllers::long_step_in_bone),
    unlikely("manipulator.integrator", controllers::long_step_of_pre_curved_tool),
    unlikely("manipulator.model", controllers::modes_on_stops),
    unlikely("run.duration_s", controllers::run_shorter_than_plan),
    unlikely("drr.rate_hz", controllers::frame_rate_is_rounded),
];

/// What does not make sense in a scene, in the order of the rules. Without a CT the rules about bone are left
/// out.
///
/// `program_exists` says of the first word of a `controller.command` whether it can be started.
///
/// # Errors
/// [`SimulationError`]: the simulation refuses the scene.
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

/// A straight or curved feed that a built-in controller makes.
struct Feed<'a> {
    table: &'static str,
    /// The key of its length.
    length_key: &'static str,
    length_mm: f64,
    /// The faster of the feed and of the retraction after it, with its key.
    fastest_mm_s: (&'static str, f64),
    /// Simulated time of the feed and of the retraction after it.
    time_s: f64,
    drives: &'a [Drives],
    /// Whether it is the arm's; a tube slides out of a tool that stands.
    is_arms: bool,
}

impl<'a> Start<'a> {
    /// The feeds of the scene's built-in controllers.
    fn feeds(&self) -> impl Iterator<Item = Feed<'a>> {
        self.scene.controller.iter().filter_map(feed)
    }

    /// Whether a controller moves a part. Holding, the sweep of a tendon and a tube that slides keep the arm
    /// where it is.
    fn is_led(&self, part: Drives) -> bool {
        let is_still = |controller: &Controller| {
            controller.hold.is_some()
                || controller.tension_sweep.is_some()
                || controller.tube_deployment.is_some()
        };
        self.scene.controller.iter().any(|entry| entry.drives.contains(&part) && !is_still(entry))
    }
}

/// Key of the speed of a feed.
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
