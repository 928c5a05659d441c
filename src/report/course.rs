//! Reduces the states of a run to its start, its deepest insertion, its end and the maximum values.

use ipc_types::messages::{Breach, MAX_TENDONS, State};
use ipc_types::scene::Scene;
use markups::vector::{cross, dot, length, minus};
use simulation::manipulator_parameters;

use super::anatomy::Anatomy;
use super::outcome::{ClearanceWatch, PlanSummary, PlanWatch};
use super::summary::{DrillingSummary, ToolSummary, ratio};

/// The plane in which the tool bends, at the start of the run.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Plane {
    origin_m: [f64; 3],
    bend_axis: [f64; 3],
    insertion_axis: [f64; 3],
}

impl Plane {
    /// The plane through the first state's burr centre, spanned by its base's +x (toward tendon 0) and +z
    /// (insertion).
    pub fn of(state: &State) -> Plane {
        let q = state.t_world_base.orientation_xyzw;
        let (bend_axis, insertion_axis) = (rotate(q, [1.0, 0.0, 0.0]), rotate(q, [0.0, 0.0, 1.0]));
        Plane { origin_m: state.t_world_burr.position_m, bend_axis, insertion_axis }
    }

    /// Coordinates of a world point along the bend and insertion axes, mm.
    pub fn project_mm(&self, point_m: [f64; 3]) -> [f64; 2] {
        let away = minus(point_m, self.origin_m);
        [self.bend_axis, self.insertion_axis].map(|axis| dot(axis, away) * 1e3)
    }
}

/// Rotates a vector by a quaternion x y z w: v + 2w (u × v) + 2 u × (u × v).
fn rotate(q: [f64; 4], v: [f64; 3]) -> [f64; 3] {
    let u = [q[0], q[1], q[2]];
    let uv = cross(u, v);
    let uuv = cross(u, uv);
    [0, 1, 2].map(|i| v[i] + 2.0 * (q[3] * uv[i] + uuv[i]))
}

/// Returns the distance between two points, m.
pub fn distance_m(a: [f64; 3], b: [f64; 3]) -> f64 {
    length(minus(a, b))
}

/// Maximum values over a run.
#[derive(Debug, Clone, Copy, Default, PartialEq)]
pub struct Peaks {
    /// Tension of any tendon.
    pub tension_n: f64,
    /// Maxima of drilling.
    pub drilling: DrillingSummary,
    /// Ticks with at least one contact.
    pub ticks_in_contact: u64,
    /// Maximum distance of the tip from its start.
    pub tip_travel_m: f64,
    /// Ticks with at least one flexure at its stop.
    pub ticks_on_stops: u64,
}

impl Peaks {
    /// Adds a state of a run that started at this tip, with a tool whose flexures bend up to `stop_rad`.
    fn add(&mut self, state: &State, first_tip_m: [f64; 3], stop_rad: f64) {
        let joints = (state.joint_count as usize).min(state.joint_position_rad.len());
        let on_stop = state.joint_position_rad[..joints].iter().any(|angle| angle.abs() >= stop_rad);
        self.ticks_on_stops += u64::from(on_stop);
        self.tip_travel_m = self.tip_travel_m.max(distance_m(first_tip_m, state.t_world_tip.position_m));
        // f64::max ignores NaN.
        let tendons = (state.tendon_count as usize).min(MAX_TENDONS);
        self.tension_n = state.tendon_tension_n[..tendons].iter().copied().fold(self.tension_n, f64::max);
        let most = &mut self.drilling;
        most.max_burr_force_n = most.max_burr_force_n.max(state.burr_force_n);
        most.max_wall_force_n = most.max_wall_force_n.max(state.wall_force_n);
        let [x, y, z] = state.flange_wrench.force_n;
        most.max_flange_force_n = most.max_flange_force_n.max((x * x + y * y + z * z).sqrt());
        most.max_stop_excess_deg = most.max_stop_excess_deg.max(state.stop_excess_rad.to_degrees());
        let listed = (state.contact_count as usize).min(state.contacts.len());
        let forces = state.contacts[..listed].iter().map(|contact| contact.normal_force_n);
        most.max_contact_force_n = forces.fold(most.max_contact_force_n, f64::max);
        most.max_contacts = most.max_contacts.max(state.contact_total);
        self.ticks_in_contact += u64::from(state.contact_total > 0);
    }
}

/// Deflection of the mount under load.
const SAME_DEPTH_MM: f64 = 0.02;

/// Accumulates the states of a run for its summary.
#[derive(Debug, Clone, Default)]
pub struct Course {
    /// Whether the start of the run is not in the log.
    pub begins_late: bool,
    /// Number of states after the initial one.
    pub ticks: u64,
    /// The first state.
    pub first: Option<Box<State>>,
    /// The last state.
    pub last: Option<Box<State>>,
    /// The last state at the deepest insertion, before the tool retracts, if it does.
    pub deepest: Option<Box<State>>,
    deepest_mm: f64,
    /// Maximum values.
    pub peaks: Peaks,
    /// Angle at which a flexure of the scene's tool reaches its stop.
    stop_rad: Option<f64>,
    /// True position of the burr's target in the bone, world frame.
    pub target_m: Option<[f64; 3]>,
    voxel_volume_mm3: Option<f64>,
    watch: PlanWatch,
    /// Least clearances of the critical structures.
    pub clearances: ClearanceWatch,
    /// Volume of the removed bone outside of all targets; `None` without a target.
    healthy_removed_mm3: Option<f64>,
    /// Area of the outer surface removed other than at the entry; `None` without a volume.
    breach_area_mm2: Option<f64>,
    /// The first `KEPT_BREACHES` breaches of the bone, one line each.
    pub breaches: Vec<String>,
    /// Number of breaches of the bone.
    pub breach_count: u64,
}

/// Number of breaches whose text is kept.
const KEPT_BREACHES: usize = 5;

impl Course {
    /// Creates an empty course for a scene, with the voxel spacing of its volume.
    pub fn of(scene: &Scene, spacing_m: Option<[f64; 3]>) -> Course {
        let target_mm = scene.controller.iter().find_map(|c| c.curved_drilling.as_ref()?.target_mm);
        let tool = manipulator_parameters(scene).ok();
        Course {
            stop_rad: tool.as_ref().map(|tool| tool.joint_limit_rad),
            watch: PlanWatch::of(scene, tool.as_ref()),
            clearances: ClearanceWatch::of(scene),
            target_m: target_mm.map(|target_mm| scene.in_bone_mm(target_mm).map(|x| x * 1e-3)),
            voxel_volume_mm3: spacing_m.map(|edges_m| edges_m.iter().map(|edge_m| 1e3 * edge_m).product()),
            ..Course::default()
        }
    }

    /// Notes that the start of the run is not in the log (`recording.ring_s`), so that the run is not
    /// compared with its plan.
    pub fn begin_late(&mut self) {
        (self.begins_late, self.target_m, self.watch) = (true, None, PlanWatch::default());
    }

    /// Adds the next state.
    pub fn add(&mut self, state: &State) {
        let first = match &self.first {
            Some(first) => {
                self.ticks += 1;
                first
            }
            None => {
                if self.begins_late {
                    self.watch.begin_late(state);
                }
                self.first.insert(Box::new(*state))
            }
        };
        self.peaks.add(state, first.t_world_tip.position_m, self.stop_rad.unwrap_or(f64::INFINITY));
        self.watch.add(state);
        let plane = Plane::of(first);
        let [_, depth_mm] = plane.project_mm(state.t_world_base.position_m);
        if self.deepest.is_none() || depth_mm >= self.deepest_mm - SAME_DEPTH_MM {
            self.deepest_mm = if self.deepest.is_none() { depth_mm } else { self.deepest_mm.max(depth_mm) };
            let [_, start_mm] = plane.project_mm(first.t_world_base.position_m);
            self.watch.note_deepest(self.deepest_mm - start_mm);
            put(&mut self.deepest, state);
        }
        put(&mut self.last, state);
    }

    /// Adds the breach found after the last state, if any.
    pub fn note_breach(&mut self, breach: Option<&Breach>) {
        if let Some(breach) = breach {
            self.add_breach(self.last.as_ref().map_or(0, |state| state.tick), &breach.to_string());
        }
    }

    /// Adds a breach that was reported after a tick.
    pub fn add_breach(&mut self, tick: u64, text: &str) {
        self.breach_count += 1;
        if self.breaches.len() < KEPT_BREACHES {
            self.breaches.push(format!("tick {tick}: {text}"));
        }
    }

    /// Sets the voxels that the run drilled, once it has ended.
    pub fn note_drilled(&mut self, anatomy: &Anatomy, drilled: &[u32]) {
        if let Some(regions) = &anatomy.regions {
            self.clearances.set_removed(regions, drilled);
            self.healthy_removed_mm3 = regions.healthy_mm3(drilled);
        }
        self.breach_area_mm2 = anatomy.surface.as_ref().map(|surface| 1e6 * surface.removed_m2(drilled));
    }

    /// Returns the tool at the start and end, or `None` without a state.
    pub fn tool(&self) -> Option<ToolSummary> {
        let (first, last, deepest) = (self.first.as_ref()?, self.last.as_ref()?, self.deepest.as_ref()?);
        let burr_m = deepest.t_world_burr.position_m;
        Some(ToolSummary {
            tip_start_mm: first.t_world_tip.position_m.map(|x| x * 1e3),
            tip_deepest_mm: deepest.t_world_tip.position_m.map(|x| x * 1e3),
            tip_end_mm: last.t_world_tip.position_m.map(|x| x * 1e3),
            target_error_mm: self.target_m.map(|target_m| distance_m(target_m, burr_m) * 1e3),
            bend_deg: deepest.bend_rad.to_degrees(),
            max_tension_n: self.peaks.tension_n,
        })
    }

    /// Returns the comparison with the plan.
    pub fn plan(&self) -> PlanSummary {
        self.watch.summary()
    }

    /// Returns drilling and contact, or `None` without a state.
    pub fn drilling(&self) -> Option<DrillingSummary> {
        let (last, peaks) = (self.last.as_ref()?, &self.peaks);
        Some(DrillingSummary {
            removed_voxels: last.removed_total,
            removed_volume_mm3: self.voxel_volume_mm3.map(|volume| volume * last.removed_total as f64),
            cutting_energy_j: last.cutting_energy_j,
            healthy_removed_mm3: self.healthy_removed_mm3,
            breach_area_mm2: self.breach_area_mm2,
            crushing_energy_j: last.crushing_energy_j,
            contact_share: ratio(peaks.ticks_in_contact as f64, self.ticks as f64).unwrap_or(0.0).min(1.0),
            ..peaks.drilling
        })
    }
}

/// Copies a state, reusing the memory of the previous copy.
fn put(kept: &mut Option<Box<State>>, state: &State) {
    match kept {
        Some(kept) => **kept = *state,
        None => *kept = Some(Box::new(*state)),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_plane_follows_the_base() {
        // A half turn about x + z swaps x and z and negates y: insertion along world +x, bend along world +z.
        let h = std::f64::consts::FRAC_1_SQRT_2;
        let mut state = State::zeroed();
        state.t_world_base.orientation_xyzw = [h, 0.0, h, 0.0];
        state.t_world_burr.position_m = [0.1, 0.2, 0.3];
        let [bend_mm, insertion_mm] = Plane::of(&state).project_mm([0.105, 9.0, 0.301]);
        assert!(
            (bend_mm - 1.0).abs() < 1e-9 && (insertion_mm - 5.0).abs() < 1e-9,
            "{bend_mm} {insertion_mm}"
        );
    }
}
