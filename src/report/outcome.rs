//! What a run did, compared with what its scene planned: the same for a run that is over (its cautions) and
//! for one that is predicted (the findings of `scene check --simulate`).

use ipc_types::messages::{ArmProtectiveStop, SensorKind, SensorReading, State};
use ipc_types::scene::{Drives, Scene, StructureRole, planned_path_in_bone_mm};
use markups::vector::{dot, length, minus, plus};
use serde::{Deserialize, Serialize};
use simulation::arm::ArmParameters;
use simulation::manipulator::ManipulatorParameters;
use structures::Regions;

use super::course::{Course, distance_m};

/// Distance from the target, and from the planned path, above which a run is reported if its scene has no
/// `[tolerance]` for it, mm: a pilot hole of 7 mm around a tool of 6 mm leaves 0.5 mm to each side, and a
/// voxel of a CT is about 1 mm.
pub const MISS_MM: f64 = 2.0;
/// Feed by which a plan may fall short before it is reported, mm.
const FEED_MM: f64 = 0.5;
/// Force with which a burr that does not turn must press to be reported, N: a tool at rest on bone presses
/// with less.
const PRESSING_N: f64 = 5.0;
/// Distance within which the tip counts as at rest, m.
const STILL_M: f64 = 1e-6;
/// A tip that stays within this distance of its start has not moved.
const UNMOVED_M: f64 = 1e-5;
/// Time at rest at the end of a run that is reported, s, if it is also most of the run.
const IDLE_S: f64 = 60.0;
/// Force that is reported if the arm has no rated payload, N: 1 mm2 of cortical bone bears 0.2 kN.
const NO_ARM_BEARS_N: f64 = 1000.0;
/// Converts the arm's rated payload to the force above which a force is reported.
const GRAVITY_M_PER_S2: f64 = 9.81;

/// The largest value of a force in a run.
#[derive(Debug, Clone, Copy, Default, PartialEq, Serialize, Deserialize)]
pub struct ForcePeak {
    /// The force.
    pub force_n: f64,
    /// The tick after which it was found.
    pub tick: u64,
    /// Where it acted, world frame.
    pub place_mm: [f64; 3],
}

impl ForcePeak {
    fn add(&mut self, force_n: f64, state: &State, place_m: [f64; 3]) {
        if force_n > self.force_n {
            *self = ForcePeak { force_n, tick: state.tick, place_mm: place_m.map(|x| x * 1e3) };
        }
    }

    /// Returns `12.3 N at tick 40, (x, y, z) mm`.
    pub fn text(&self) -> String {
        let [x, y, z] = self.place_mm;
        format!("{:.1} N at tick {}, ({x:.1}, {y:.1}, {z:.1}) mm", self.force_n, self.tick)
    }
}

/// The largest forces of a run.
#[derive(Debug, Clone, Copy, Default, PartialEq, Serialize, Deserialize)]
pub struct ForcePeaks {
    /// Normal force of the burr, at its centre.
    pub burr: ForcePeak,
    /// Sum of the normal forces on the tool without the burr's, at the largest of them.
    pub walls: ForcePeak,
    /// Force of the tool on the flange, at the tool's base.
    pub flange: ForcePeak,
    /// Normal force of a single contact.
    pub contact: ForcePeak,
    /// Normal force of a burr that does not turn.
    pub idle_burr: ForcePeak,
}

impl ForcePeaks {
    fn add(&mut self, state: &State) {
        let burr_m = state.t_world_burr.position_m;
        self.burr.add(state.burr_force_n, state, burr_m);
        if state.burr_speed_rad_per_s == 0.0 {
            self.idle_burr.add(state.burr_force_n, state, burr_m);
        }
        self.flange.add(length(state.flange_wrench.force_n), state, state.t_world_base.position_m);
        let listed = (state.contact_count as usize).min(state.contacts.len());
        let contacts = state.contacts[..listed].iter();
        let by_force = |a: &&_, b: &&_| force_n(a).total_cmp(&force_n(b));
        if let Some(contact) = contacts.clone().max_by(by_force) {
            self.contact.add(contact.normal_force_n, state, contact.point_m);
        }
        let is_wall = |contact: &&ipc_types::messages::Contact| {
            contact.part() != Ok(ipc_types::messages::ContactPart::Burr)
        };
        let wall_m = contacts.filter(is_wall).max_by(by_force).map_or(burr_m, |contact| contact.point_m);
        self.walls.add(state.wall_force_n, state, wall_m);
    }
}

fn force_n(contact: &ipc_types::messages::Contact) -> f64 {
    contact.normal_force_n
}

/// The clearance of a critical structure in a run.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct StructureSummary {
    /// Its name.
    pub name: String,
    /// Clearance that the tool should keep.
    pub margin_mm: f64,
    /// Least clearance of the tool; negative inside the structure. `None` without a reading.
    pub least_clearance_mm: Option<f64>,
    /// Tick of the least clearance.
    pub tick: u64,
    /// Ticks after which the tool was closer than the margin.
    pub ticks_within_margin: u64,
    /// Ticks after which the tool was inside.
    pub ticks_inside: u64,
    /// Whether the tool was to remove it.
    #[serde(default)]
    pub is_target: bool,
    /// Volume of the bone removed in it; `None` without a volume, and for a `built_in` structure.
    #[serde(default)]
    pub removed_mm3: Option<f64>,
    /// For a target, the share of its bone that was removed, without pilot holes.
    #[serde(default)]
    pub removed_share: Option<f64>,
}

impl StructureSummary {
    fn add(&mut self, tick: u64, clearance_m: f64) {
        let clearance_mm = clearance_m * 1e3;
        if self.least_clearance_mm.is_none_or(|least_mm| clearance_mm < least_mm) {
            (self.least_clearance_mm, self.tick) = (Some(clearance_mm), tick);
        }
        self.ticks_within_margin += u64::from(clearance_mm < self.margin_mm);
        self.ticks_inside += u64::from(clearance_mm < 0.0);
    }

    /// Returns what was removed in it, if anything, or if it is a target.
    pub fn removed_text(&self) -> Option<String> {
        let removed_mm3 = self.removed_mm3.filter(|mm3| *mm3 > 0.0 || self.is_target)?;
        let share =
            self.removed_share.map_or(String::new(), |share| format!(", {:.1} % of it", 100.0 * share));
        Some(format!("{}: {removed_mm3:.1} mm3{share}", self.name))
    }

    /// Returns the finding about it, if the tool came closer than the margin.
    fn finding(&self) -> Option<String> {
        let StructureSummary { name, margin_mm, tick, .. } = self;
        let least_mm = self.least_clearance_mm.filter(|least_mm| least_mm < margin_mm && !self.is_target)?;
        Some(match least_mm < 0.0 {
            true => format!("the tool entered `{name}`, up to {:.2} mm deep at tick {tick}", -least_mm),
            false => format!(
                "the clearance of `{name}` fell to {least_mm:.2} mm at tick {tick}; its margin is {margin_mm} mm"
            ),
        })
    }
}

/// Least clearances of the critical structures of a scene.
#[derive(Debug, Clone, Default)]
pub struct ClearanceWatch(Vec<StructureSummary>);

impl ClearanceWatch {
    pub(super) fn of(scene: &Scene) -> ClearanceWatch {
        let summary = |structure: &ipc_types::scene::Structure| StructureSummary {
            name: structure.name.clone(),
            margin_mm: structure.margin_mm,
            least_clearance_mm: None,
            tick: 0,
            ticks_within_margin: 0,
            ticks_inside: 0,
            is_target: structure.role == StructureRole::Target,
            removed_mm3: None,
            removed_share: None,
        };
        ClearanceWatch(scene.structure.iter().map(summary).collect())
    }

    /// Adds a reading, if it is one of clearances.
    pub fn add(&mut self, reading: &SensorReading) {
        if reading.kind() == Ok(SensorKind::Clearance) {
            let clearances = self.0.iter_mut().zip(reading.clearances_m());
            clearances.for_each(|(structure, clearance_m)| structure.add(reading.tick, clearance_m));
        }
    }

    /// Sets what was removed in each structure.
    pub(super) fn set_removed(&mut self, regions: &Regions, drilled: &[u32]) {
        for (summary, removal) in self.0.iter_mut().zip(regions.removals(drilled)) {
            summary.removed_mm3 = removal.map(|removal| removal.volume_mm3);
            summary.removed_share = removal.and_then(|removal| removal.share);
        }
    }

    /// Returns the summaries, in the scene's order.
    pub fn summaries(&self) -> &[StructureSummary] {
        &self.0
    }
}

/// A run compared with its plan. Values that the scene does not define are null.
#[derive(Debug, Clone, Copy, Default, PartialEq, Serialize, Deserialize)]
pub struct PlanSummary {
    /// Largest distance of the burr's centre from the planned path, up to the deepest insertion.
    pub path_deviation_mm: Option<f64>,
    /// Where that was, as a length along the planned path from its begin.
    pub path_deviation_at_mm: Option<f64>,
    /// Least radius to which the tool was bent, at any flexure; none while straight.
    pub least_radius_mm: Option<f64>,
    /// Radius to which its stops let the tool bend.
    pub possible_radius_mm: Option<f64>,
    /// Radius of the planned arc; none without one.
    pub planned_radius_mm: Option<f64>,
    /// How far the tool's base was fed.
    pub fed_mm: f64,
    /// How far the scene's controller feeds it.
    pub planned_feed_mm: Option<f64>,
    /// Largest forces.
    pub forces: ForcePeaks,
    /// Number of protective stops of the arm.
    pub protective_stops: u64,
    /// Tick of the first one.
    pub first_stop_tick: Option<u64>,
    /// Ticks after which a contact force had reached the strength of the bone there.
    pub ticks_at_strength: u64,
    /// The last tick in which the tip moved.
    pub moved_until_tick: u64,
}

/// A planned path with its length at each point.
#[derive(Debug, Clone, Default)]
struct PlannedPath {
    points_m: Vec<[f64; 3]>,
    along_m: Vec<f64>,
}

impl PlannedPath {
    fn new(points_mm: &[[f64; 3]]) -> PlannedPath {
        let points_m: Vec<[f64; 3]> = points_mm.iter().map(|point| point.map(|x| x * 1e-3)).collect();
        let mut along_m = vec![0.0];
        for piece in points_m.windows(2) {
            along_m.push(along_m[along_m.len() - 1] + distance_m(piece[0], piece[1]));
        }
        PlannedPath { points_m, along_m }
    }

    /// Returns the distance of a point from the path, and the length along the path there, m.
    fn nearest_m(&self, point_m: [f64; 3]) -> Option<(f64, f64)> {
        let from_piece = |(index, piece): (usize, &[[f64; 3]])| {
            let (way, away) = (minus(piece[1], piece[0]), minus(point_m, piece[0]));
            let share = (dot(away, way) / dot(way, way).max(f64::MIN_POSITIVE)).clamp(0.0, 1.0);
            let along_m = self.along_m[index] + share * (self.along_m[index + 1] - self.along_m[index]);
            (distance_m(point_m, plus(piece[0], share, way)), along_m)
        };
        self.points_m.windows(2).enumerate().map(from_piece).min_by(|a, b| a.0.total_cmp(&b.0))
    }
}

/// Compares the states of a run with its plan.
#[derive(Debug, Clone, Default)]
pub struct PlanWatch {
    path: PlannedPath,
    /// Mean length of tube that each flexure bends, m.
    pitch_m: Vec<f64>,
    /// Where the burr was when its deviation was last measured.
    measured_m: Option<[f64; 3]>,
    /// Largest deviation so far and where, m.
    deviation_m: Option<(f64, f64)>,
    /// Position of the tip when it last moved.
    rest_m: [f64; 3],
    is_stopped: bool,
    most_curvature_per_m: f64,
    summary: PlanSummary,
}

/// Motion of the burr after which its deviation is measured again, m.
const MEASURED_M: f64 = 1e-5;

impl PlanWatch {
    /// Creates a watch for a scene with this tool.
    pub(super) fn of(scene: &Scene, tool: Option<&ManipulatorParameters>) -> PlanWatch {
        let path = planned_path_in_bone_mm(scene).map(|path| PlannedPath::new(&path)).unwrap_or_default();
        let pitch_m: Vec<f64> = tool.map(ManipulatorParameters::pitches_m).unwrap_or_default();
        let least_m = pitch_m.iter().copied().fold(f64::INFINITY, f64::min);
        let possible_m =
            tool.map(|tool| least_m / tool.joint_limit_rad).filter(|radius_m| radius_m.is_finite());
        let feed_mm = scene.controller.iter().find_map(|controller| {
            let drilling = controller.curved_drilling.as_ref().map(|plan| plan.insertion_mm);
            drilling.or_else(|| controller.skiving.as_ref().map(|plan| plan.depth_mm))
        });
        let summary = PlanSummary {
            possible_radius_mm: possible_m.map(|radius_m| radius_m * 1e3),
            planned_radius_mm: planned_radius_mm(scene),
            planned_feed_mm: feed_mm,
            ..PlanSummary::default()
        };
        PlanWatch { path, pitch_m, summary, ..PlanWatch::default() }
    }

    /// Notes the first state of a log that begins later than its run: what it shows may have begun before.
    pub(super) fn begin_late(&mut self, state: &State) {
        self.is_stopped = is_stopped(state);
    }

    /// Adds a state.
    pub(super) fn add(&mut self, state: &State) {
        self.summary.forces.add(state);
        self.summary.ticks_at_strength += u64::from(state.strength_share >= 1.0);
        let is_stopped = is_stopped(state);
        if is_stopped && !std::mem::replace(&mut self.is_stopped, is_stopped) {
            self.summary.protective_stops += 1;
            self.summary.first_stop_tick.get_or_insert(state.tick);
        }
        self.is_stopped = is_stopped;
        let tip_m = state.t_world_tip.position_m;
        if distance_m(tip_m, self.rest_m) > STILL_M {
            (self.rest_m, self.summary.moved_until_tick) = (tip_m, state.tick);
        }
        for (angle, pitch_m) in state.joint_position_rad.iter().zip(&self.pitch_m) {
            self.most_curvature_per_m = self.most_curvature_per_m.max(angle.abs() / pitch_m);
        }
        let burr_m = state.t_world_burr.position_m;
        if self.measured_m.is_none_or(|measured_m| distance_m(measured_m, burr_m) > MEASURED_M) {
            self.measured_m = Some(burr_m);
            if let Some((distance_m, along_m)) = self.path.nearest_m(burr_m)
                && self.deviation_m.is_none_or(|(most_m, _)| distance_m > most_m)
            {
                self.deviation_m = Some((distance_m, along_m));
            }
        }
    }

    /// Notes that the tool is at its deepest so far, having been fed this far.
    pub(super) fn note_deepest(&mut self, fed_mm: f64) {
        self.summary.fed_mm = fed_mm;
        let deviation_mm = self.deviation_m.map(|(far_m, along_m)| (far_m * 1e3, along_m * 1e3));
        (self.summary.path_deviation_mm, self.summary.path_deviation_at_mm) = deviation_mm.unzip();
    }

    /// Returns the comparison so far.
    pub fn summary(&self) -> PlanSummary {
        // A radius of more than 10 m is straight.
        let radius_mm = Some(1e3 / self.most_curvature_per_m).filter(|radius_mm| *radius_mm < 1e4);
        PlanSummary { least_radius_mm: radius_mm, ..self.summary }
    }
}

fn is_stopped(state: &State) -> bool {
    state.arm_protective_stop() == Ok(ArmProtectiveStop::Stopped)
}

/// Returns the radius of the arc from the start of the ramp to the target of curved drilling.
fn planned_radius_mm(scene: &Scene) -> Option<f64> {
    let plan = scene.controller.iter().find_map(|controller| controller.curved_drilling.as_ref())?;
    let along = markups::vector::unit(scene.tool.direction);
    let knee_mm = plus(scene.tool.burr_start_mm, plan.ramp_start_mm, along);
    let away = minus(plan.target_mm?, knee_mm);
    let ahead_mm = dot(away, along);
    let beside_mm = length(plus(away, -ahead_mm, along));
    let arc = markups::Arc::to(ahead_mm, beside_mm);
    let radius_mm = arc.length_mm / arc.turn_deg.to_radians();
    (radius_mm < 1e4).then_some(radius_mm)
}

/// Returns what is most likely wrong with a run, one line each.
pub fn findings(scene: &Scene, course: &Course) -> Vec<String> {
    let plan = course.plan();
    let mut found = beyond_tolerance(scene, course);
    found.extend(unchecked_tolerance(scene, course));
    found.extend(course.breaches.iter().cloned());
    found.extend(course.clearances.summaries().iter().filter_map(StructureSummary::finding));
    found.extend(
        [radius(&plan), stop(&plan), feed(&plan), idle_burr(&plan), force(scene, &plan), energy(course)]
            .into_iter()
            .flatten(),
    );
    found.extend(
        [tip_at_rest(scene, course), on_stops(course), idle_end(scene, course, &plan)].into_iter().flatten(),
    );
    found
}

/// Returns how a run missed its target or left its planned path by more than its scene allows.
pub fn beyond_tolerance(scene: &Scene, course: &Course) -> Vec<String> {
    let tolerance = scene.tolerance.unwrap_or_default();
    let plan = course.plan();
    let target = course.tool().and_then(|tool| tool.target_error_mm).and_then(|error_mm| {
        let (allowed_mm, key) = allowed(tolerance.target_mm, "target_mm");
        let text = format!("the burr ended {error_mm:.2} mm from the target, {key}");
        (error_mm > allowed_mm).then_some(text)
    });
    let path = plan.path_deviation_mm.zip(plan.path_deviation_at_mm).and_then(|(most_mm, at_mm)| {
        let (allowed_mm, key) = allowed(tolerance.path_deviation_mm, "path_deviation_mm");
        let text =
            format!("the burr left the planned path by {most_mm:.2} mm, {at_mm:.1} mm along it, {key}");
        (most_mm > allowed_mm).then_some(text)
    });
    target.into_iter().chain(path).collect()
}

/// Returns which tolerances of the scene were not checked, if the start of the run is not in the log.
fn unchecked_tolerance(scene: &Scene, course: &Course) -> Option<String> {
    let tolerance = scene.tolerance.filter(|_| course.begins_late)?;
    let set = [("target_mm", tolerance.target_mm), ("path_deviation_mm", tolerance.path_deviation_mm)];
    let set = set.into_iter().filter(|(_, most_mm)| most_mm.is_some());
    let named: Vec<String> = set.map(|(key, _)| format!("`tolerance.{key}`")).collect();
    (!named.is_empty())
        .then(|| format!("{} not checked: the start of the run was not kept", named.join(" and ")))
}

/// Whether the burr came within `tolerance.target_mm`, or else 2 mm, of the scene's target; false without
/// one.
pub fn reached_target(scene: &Scene, course: &Course) -> bool {
    let (allowed_mm, _) = allowed(scene.tolerance.unwrap_or_default().target_mm, "target_mm");
    course.tool().and_then(|tool| tool.target_error_mm).is_some_and(|error_mm| error_mm <= allowed_mm)
}

/// Whether a run exceeds a tolerance that its scene sets.
pub fn is_out_of_tolerance(scene: &Scene, course: &Course) -> bool {
    let tolerance = scene.tolerance.unwrap_or_default();
    let exceeds =
        |value: Option<f64>, most: Option<f64>| value.zip(most).is_some_and(|(value, most)| value > most);
    exceeds(course.tool().and_then(|tool| tool.target_error_mm), tolerance.target_mm)
        || exceeds(course.plan().path_deviation_mm, tolerance.path_deviation_mm)
}

fn allowed(tolerance_mm: Option<f64>, key: &str) -> (f64, String) {
    match tolerance_mm {
        Some(mm) => (mm, format!("`tolerance.{key}` is {mm}")),
        None => (MISS_MM, format!("more than {MISS_MM} mm (set `tolerance.{key}`)")),
    }
}

fn radius(plan: &PlanSummary) -> Option<String> {
    let (planned_mm, possible_mm) = plan.planned_radius_mm.zip(plan.possible_radius_mm)?;
    (planned_mm < possible_mm).then(|| {
        format!(
            "the planned arc has a radius of {planned_mm:.1} mm; the stops of the tool's flexures allow {possible_mm:.1} mm"
        )
    })
}

fn stop(plan: &PlanSummary) -> Option<String> {
    let (tick, count) = (plan.first_stop_tick?, plan.protective_stops);
    let times = if count == 1 { String::new() } else { format!(", {count} times in all") };
    Some(format!("the arm made a protective stop at tick {tick}{times}"))
}

fn feed(plan: &PlanSummary) -> Option<String> {
    let (fed_mm, planned_mm) = (plan.fed_mm, plan.planned_feed_mm?);
    (fed_mm < planned_mm - FEED_MM)
        .then(|| format!("the tool was fed {fed_mm:.1} mm of the {planned_mm:.1} mm planned"))
}

fn idle_burr(plan: &PlanSummary) -> Option<String> {
    let peak = &plan.forces.idle_burr;
    (peak.force_n > PRESSING_N)
        .then(|| format!("the burr pressed on bone without turning, with up to {}", peak.text()))
}

fn force(scene: &Scene, plan: &PlanSummary) -> Option<String> {
    let arm = ArmParameters::of(&scene.arm, scene.dt_s());
    let most_n = arm.payload_kg.map_or(NO_ARM_BEARS_N, |payload_kg| payload_kg * GRAVITY_M_PER_S2);
    let limit = if arm.payload_kg.is_some() { "the arm's payload" } else { "what bone or a small arm bears" };
    let forces = &plan.forces;
    let named = [
        ("burr", &forces.burr),
        ("contact", &forces.contact),
        ("walls", &forces.walls),
        ("flange", &forces.flange),
    ];
    let (what, peak) = named.into_iter().max_by(|a, b| a.1.force_n.total_cmp(&b.1.force_n))?;
    (peak.force_n > most_n)
        .then(|| format!("{what} force reached {}, above {limit}: {most_n:.1} N", peak.text()))
}

fn energy(course: &Course) -> Option<String> {
    let created_mj = 1e3 * course.last.as_ref()?.energy_created_j;
    (created_mj > 0.0).then(|| {
        format!(
            "{created_mj:.3} mJ of energy created: not physical; use a shorter time step or a heavier tool"
        )
    })
}

fn tip_at_rest(scene: &Scene, course: &Course) -> Option<String> {
    let mut drives = scene.controller.iter().flat_map(|controller| &controller.drives);
    let is_driven = drives.any(|part| matches!(part, Drives::Tendon | Drives::Arm | Drives::Tube));
    let travel_m = course.peaks.tip_travel_m;
    (course.ticks > 0 && !course.begins_late && is_driven && travel_m < UNMOVED_M)
        .then(|| format!("the tip never moved more than {:.4} mm from its start", travel_m * 1e3))
}

fn on_stops(course: &Course) -> Option<String> {
    let share = 100.0 * (course.peaks.ticks_on_stops as f64 / course.ticks.max(1) as f64).min(1.0);
    (course.peaks.ticks_on_stops > 0)
        .then(|| format!("the tool was at its stops in {share:.1} % of the ticks and could not bend further"))
}

fn idle_end(scene: &Scene, course: &Course, plan: &PlanSummary) -> Option<String> {
    let (ticks, dt_s) = (course.ticks, scene.dt_s());
    let first_tick = course.first.as_ref().map_or(0, |state| state.tick);
    let moved_s = plan.moved_until_tick.saturating_sub(first_tick) as f64 * dt_s;
    let idle_s = ticks as f64 * dt_s - moved_s;
    (idle_s > IDLE_S && idle_s > moved_s)
        .then(|| format!("nothing moved in the last {idle_s:.0} s of {:.0} s", ticks as f64 * dt_s))
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::report::tests::synthetic;

    /// 40 mm straight, then a quarter turn of 30 mm radius.
    #[test]
    fn the_distance_from_a_path_is_that_from_its_nearest_point() {
        let arc = (0..=200).map(|step| {
            let angle = std::f64::consts::FRAC_PI_2 * f64::from(step) / 200.0;
            [30.0 * (1.0 - angle.cos()), 0.0, 40.0 + 30.0 * angle.sin()]
        });
        let path = PlannedPath::new(&[[0.0; 3]].into_iter().chain(arc).collect::<Vec<_>>());
        let quarter_m = 1e-3 * std::f64::consts::FRAC_PI_2 * 30.0;
        // 3 mm inside the arc at its middle, beside the line, and behind its end.
        let middle = 30.0 - (30.0 - 3.0) * std::f64::consts::FRAC_1_SQRT_2;
        for (point_mm, distance_m, along_m) in [
            ([middle, 0.0, 40.0 + 30.0 - middle], 3e-3, 0.04 + 0.5 * quarter_m),
            ([0.0, 2.0, 10.0], 2e-3, 0.01),
            ([35.0, 0.0, 70.0], 5e-3, 0.04 + quarter_m),
        ] {
            let found = path.nearest_m(point_mm.map(|x| x * 1e-3)).unwrap();
            // A chord of 0.24 mm lies 0.2 µm inside its arc, and its nearest point within half its length.
            assert!(
                (found.0 - distance_m).abs() < 1e-6 && (found.1 - along_m).abs() < 1.2e-4,
                "{point_mm:?}: {found:?}"
            );
        }
        assert_eq!(PlannedPath::default().nearest_m([0.0; 3]), None);
    }

    /// A course of the synthetic run's scene, with other text in it, over these states.
    fn course(change: (&str, &str), states: impl IntoIterator<Item = State>) -> (Scene, Course) {
        let text = synthetic::SCENE.replace(change.0, change.1);
        let scene = Scene::parse(&text, std::path::Path::new("scene.toml")).unwrap();
        let mut course = Course::of(&scene, None);
        states.into_iter().for_each(|state| course.add(&state));
        (scene, course)
    }

    fn states() -> Vec<State> {
        (0..=200).map(|tick| synthetic::state(tick, 200, &mut fastrand::Rng::with_seed(1))).collect()
    }

    /// The burr ends at (13.77, 0, 25.17) mm; its target is (12, 0, 27) mm.
    #[test]
    fn a_miss_is_reported_by_the_scenes_tolerance_or_from_2_mm_on() {
        let miss = |tolerance: &str| {
            let (scene, course) =
                course(("[tolerance]\ntarget_mm = 3.0\npath_deviation_mm = 5.0", tolerance), states());
            (beyond_tolerance(&scene, &course), is_out_of_tolerance(&scene, &course))
        };
        assert_eq!(miss("[tolerance]\ntarget_mm = 2.6\npath_deviation_mm = 100.0"), (vec![], false));
        let (found, is_out) = miss("[tolerance]\ntarget_mm = 2.5\npath_deviation_mm = 100.0");
        assert_eq!(
            (found.as_slice(), is_out),
            (&["the burr ended 2.54 mm from the target, `tolerance.target_mm` is 2.5".to_owned()][..], true)
        );
        let (found, is_out) = miss("");
        assert!(
            found[0].ends_with("from the target, more than 2 mm (set `tolerance.target_mm`)") && !is_out,
            "{found:?}"
        );
        // The synthetic burr does not leave its start along the feed.
        assert!(
            found[1].starts_with("the burr left the planned path by 4.88 mm, 16.9 mm along it"),
            "{found:?}"
        );
        let (found, is_out) = miss("[tolerance]\ntarget_mm = 100.0\npath_deviation_mm = 4.8");
        assert!(found.len() == 1 && is_out, "{found:?}");
    }

    /// 27 flexures, each bent by 0.8/27 rad: the shortest of them is bent to the least radius.
    #[test]
    fn the_radius_reached_is_that_of_the_flexures_and_a_tighter_plan_than_possible_is_reported() {
        let (scene, straight) = course(("", ""), states());
        let tool = simulation::manipulator_parameters(&scene).unwrap();
        let shortest_mm = 1e3 * tool.pitches_m().into_iter().fold(f64::INFINITY, f64::min);
        let plan = straight.plan();
        let near = |found: Option<f64>, expected: f64| {
            assert!((found.unwrap() - expected).abs() < 1e-3 * expected, "{found:?}, expected {expected}");
        };
        near(plan.least_radius_mm, shortest_mm * 27.0 / 0.8);
        near(plan.possible_radius_mm, shortest_mm / 5_f64.to_radians());
        // To (12, 0, 27) from the origin: (12² + 27²) / 24.
        near(plan.planned_radius_mm, 873.0 / 24.0);
        let (scene, tight) = course(("[12.0, 0.0, 27.0]", "[12.0, 0.0, 12.0]"), states());
        let found = findings(&scene, &tight);
        assert!(
            found.iter().any(|text| text.starts_with("the planned arc has a radius of 12.0 mm; the stops")),
            "{found:?}"
        );
    }

    #[test]
    fn the_least_clearance_of_a_structure_and_its_tick_are_kept() {
        let text = "[[structure]]\nname = \"nerve\"\nball = { centre_mm = [0.0, 0.0, 0.0], radius_mm = 1.0 }\n[[controller]]";
        let (scene, mut course) = course(("[[controller]]", text), states());
        let mut reading =
            SensorReading { kind: SensorKind::Clearance.code(), value_count: 2, ..SensorReading::zeroed() };
        for (tick, clearance_m) in [(1, 3e-3), (2, 1.5e-3), (3, -0.25e-3), (4, 1e-3)] {
            (reading.tick, reading.value[0]) = (tick, clearance_m);
            course.clearances.add(&reading);
        }
        let [nerve] = course.clearances.summaries() else { panic!() };
        assert_eq!((nerve.least_clearance_mm, nerve.tick), (Some(-0.25), 3));
        assert_eq!((nerve.ticks_within_margin, nerve.ticks_inside), (3, 1));
        let found = findings(&scene, &course);
        assert!(
            found.contains(&"the tool entered `nerve`, up to 0.25 mm deep at tick 3".to_owned()),
            "{found:?}"
        );
    }
}
