//! A contact problem for other simulators: the tool with 27 flexures in a winding tunnel, its burr pulled
//! sideways.
//!
//! Each sphere is between its own two planes; contacts are frictionless springs. Every program starts
//! straight, where the tunnel overlaps the tool by up to 0.08 mm, increases the pull slowly and waits for
//! rest. Each `NAME_contact.py` in the folder gets `contact.json` and prints one line per run: `contact NAME
//! CONTACTS DAMPING_RATIO DT_MS US_PER_MS ANGLE...` (rad, base to tip). All are evaluated here, by these
//! angles alone.

use std::f64::consts::PI;
use std::fmt::Write as _;
use std::path::Path;
use std::time::Instant;

use nalgebra::{Isometry3, Unit, Vector2, Vector3};
use serde_json::json;
use simulation::contact_plane::ContactPlane;
use simulation::manipulator::{
    AnyManipulator, BaseMotion, Integrator, Manipulator, ManipulatorError, ManipulatorModel,
    ManipulatorParameters, Rung, StepInput, TendonCommand, Wrench,
};
use trabecula::failure::Failure;

use crate::charts::peers::{new_input, run, scripts};
use crate::effort::Effort;

/// Suffix of the scripts for this problem.
pub(super) const SUFFIX: &str = "_contact";
/// Spheres between walls, on every third link from the tip and on every link: 10 and 30 contacts.
const SPHERES: [(usize, usize); 2] = [(5, 3), (15, 1)];
/// Lateral distance of the tunnel's centre line from the axis.
const AMPLITUDE_M: f64 = 0.1e-3;
const WAVE_LENGTH_M: f64 = 12.0e-3;
/// Where the tunnel crosses the axis.
const CROSSING_M: f64 = 36.0e-3;
/// Clearance on both sides of a sphere in the middle of the tunnel.
const CLEARANCE_M: f64 = 20.0e-6;
const TIP_FORCE_N: f64 = 4.0;
const RAMP_S: f64 = 0.3;
const DURATION_S: f64 = 1.0;
/// Damping ratio of the first mode, and step, ms: critical as in the other problems, then the tool's own.
const SETTINGS: [(f64, f64); 3] = [(1.0, 1.0), (0.05, 1.0), (0.05, 0.25)];
/// Settings of the reference run.
const REFERENCE: (f64, f64) = (1.0, 0.05);
/// Errors below this count as equal: they are residual motion and rounding.
const EQUAL_UM: f64 = 0.01;

/// A plane in contact with one sphere, in the bending plane (x, z).
struct ContactWall {
    link: usize,
    point_m: Vector2<f64>,
    /// Normal, toward the sphere.
    normal: Vector2<f64>,
}

/// The tool and its walls.
struct Case {
    tool: ManipulatorParameters,
    walls: Vec<ContactWall>,
}

/// A pose of the chain according to the stated laws.
#[derive(Debug, Clone, Copy, PartialEq)]
struct Pose {
    tip_m: Vector2<f64>,
    most_overlap_m: f64,
    pressing: usize,
    /// Largest torque of a hinge not balanced by springs, contacts and the full load.
    unbalanced_nm: f64,
}

/// Final state reached by a program.
#[derive(Debug, Clone, PartialEq)]
pub(super) struct Rest {
    name: String,
    contacts: usize,
    damping_ratio: f64,
    dt_ms: f64,
    us_per_ms: f64,
    pose: Pose,
    /// Distance from the reference.
    error_um: f64,
    /// Its cost divided by that of our cheapest run with no larger error; ours is timed before and after it.
    cost_ratio: Option<f64>,
}

impl Case {
    fn new((spheres, every): (usize, usize)) -> Case {
        let tool = tool();
        let (wave, last) = (2.0 * PI / WAVE_LENGTH_M, tool.joint_positions_m.len() - 1);
        let along_m = sphere_along_m(&tool);
        let mut walls = Vec::new();
        for link in (0..spheres).map(|number| last - every * number) {
            let z = tool.joint_positions_m[link] + along_m[link];
            let phase = wave * (z - CROSSING_M);
            let across = Vector2::new(1.0, -AMPLITUDE_M * wave * phase.cos()).normalize();
            for normal in [across, -across] {
                let middle_m = Vector2::new(AMPLITUDE_M * phase.sin(), z);
                let point_m = middle_m - normal * (CLEARANCE_M + tool.segment_sphere_radius_m);
                walls.push(ContactWall { link, point_m, normal });
            }
        }
        Case { tool, walls }
    }

    fn pose(&self, angles_rad: &[f64]) -> Pose {
        let lengths_m = lengths_m(&self.tool);
        let (mut at_m, mut angle, mut hinges) =
            (Vector2::new(0.0, self.tool.joint_positions_m[0]), 0.0, Vec::new());
        for (turn, length_m) in angles_rad.iter().zip(&lengths_m) {
            angle += turn;
            let axis = Vector2::new(angle.sin(), angle.cos());
            hinges.push((at_m, axis));
            at_m += axis * *length_m;
        }
        let stiffness = &self.tool.joint_stiffness_nm_per_rad;
        let mut unbalanced: Vec<f64> = angles_rad.iter().zip(stiffness).map(|(q, k)| -q * k).collect();
        let mut press = |link: usize, point_m: Vector2<f64>, force_n: Vector2<f64>| {
            for (torque, (hinge_m, _)) in unbalanced.iter_mut().zip(&hinges).take(link + 1) {
                let arm = point_m - hinge_m;
                *torque += arm.y * force_n.x - arm.x * force_n.y;
            }
        };
        press(hinges.len() - 1, at_m, Vector2::new(TIP_FORCE_N, 0.0));
        let (along_m, contact) = (sphere_along_m(&self.tool), &self.tool.contact);
        let (mut most_overlap_m, mut pressing) = (0.0f64, 0);
        for ContactWall { link, point_m, normal } in &self.walls {
            let centre_m = hinges[*link].0 + hinges[*link].1 * along_m[*link];
            let overlap_m = self.tool.segment_sphere_radius_m - normal.dot(&(centre_m - point_m));
            if overlap_m > 0.0 {
                pressing += 1;
                most_overlap_m = most_overlap_m.max(overlap_m);
                press(*link, centre_m, normal * (contact.stiffness_n_per_m * overlap_m));
            }
        }
        let largest =
            |most: f64, torque: &f64| if torque.is_nan() { f64::NAN } else { most.max(torque.abs()) };
        Pose { tip_m: at_m, most_overlap_m, pressing, unbalanced_nm: unbalanced.iter().fold(0.0, largest) }
    }

    /// Runs our planar rung to rest; returns the angles, and the median time of a simulated millisecond, µs.
    fn ours(&self, damping_ratio: f64, dt_ms: f64) -> Result<(Vec<f64>, f64), ManipulatorError> {
        let (dt_s, base) = (dt_ms * 1e-3, BaseMotion::at_rest(Isometry3::identity()));
        let parameters = ManipulatorParameters { damping_ratio, ..self.tool.clone() };
        let mut tool = AnyManipulator::new(Rung::Planar, parameters, &base)?;
        let (mut contacts, mut times_us) = (Vec::with_capacity(self.walls.len()), Vec::new());
        for step in 1..=(DURATION_S / dt_s).round() as usize {
            let pull_n = TIP_FORCE_N * (step as f64 * dt_s / RAMP_S).min(1.0);
            let began = Instant::now();
            self.planes(&tool, &mut contacts);
            let input = StepInput {
                base,
                tendon: TendonCommand::Force([0.0, 0.0]),
                tip_wrench: Wrench { force_n: Vector3::x() * pull_n, ..Wrench::zero() },
                contacts: &contacts,
            };
            tool.step(dt_s, &input)?;
            times_us.push(began.elapsed().as_secs_f64() * 1e6);
        }
        times_us.sort_by(f64::total_cmp);
        let median_us = times_us.get(times_us.len() / 2).copied().unwrap_or(0.0);
        Ok((tool.joint_positions_rad().to_vec(), median_us / dt_ms))
    }

    fn planes(&self, tool: &AnyManipulator, out: &mut Vec<ContactPlane>) {
        out.clear();
        let spheres = tool.proxy_spheres();
        for ContactWall { link, point_m, normal } in &self.walls {
            // Without a shaft, sphere i is that of link i.
            let sphere = &spheres[*link];
            let point_m = Vector3::new(point_m.x, 0.0, point_m.y);
            let normal = Unit::new_unchecked(Vector3::new(normal.x, 0.0, normal.y));
            let gap_m = normal.dot(&(sphere.centre_m - point_m)) - sphere.radius_m;
            out.push(ContactPlane::hard(*link, point_m, normal, gap_m));
        }
    }
}

/// Returns the standard tool on a rigid mount, without burr and friction.
fn tool() -> ManipulatorParameters {
    let mut tool = ManipulatorParameters::jhu_27();
    tool.integrator = Integrator::LinearlyImplicitEuler;
    tool.mount_stiffness_n_per_m = [1e9; 3];
    tool.joint_limit_rad = 3.0;
    tool.burr_mass_kg = 0.0;
    tool.shaft_sphere_count = 0;
    tool.contact.friction_coefficient = 0.0;
    tool
}

fn lengths_m(tool: &ManipulatorParameters) -> Vec<f64> {
    let gaps = tool.joint_positions_m.windows(2).map(|pair| pair[1] - pair[0]);
    gaps.chain([tool.tip_offset_m]).collect()
}

/// Returns the distance of each link's sphere from its hinge. The last one equals the one before it: the rest
/// is the burr's shank.
fn sphere_along_m(tool: &ManipulatorParameters) -> Vec<f64> {
    let mut along: Vec<f64> = lengths_m(tool).iter().map(|length| 0.5 * length).collect();
    let last = along.len() - 1;
    along[last] = along[last - 1].min(along[last]);
    along
}

/// Returns the input of the scripts.
fn input(problem: &Problem) -> Result<String, ManipulatorError> {
    let tool = tool();
    let base = BaseMotion::at_rest(Isometry3::identity());
    let first_hz = Manipulator::new(tool.clone(), &base)?.first_natural_frequency_hz();
    let lengths_m = lengths_m(&tool);
    let mass_kg: Vec<f64> = lengths_m.iter().map(|length| tool.linear_density_kg_per_m * length).collect();
    let [outer, inner] = tool.tube_radii_m;
    let inertia_kg_m2: Vec<f64> = mass_kg
        .iter()
        .zip(&lengths_m)
        .map(|(mass, length)| mass * (length * length / 12.0 + 0.25 * (outer * outer + inner * inner)))
        .collect();
    let wall = |w: &ContactWall| {
        json!({
            "link": w.link, "point_m": w.point_m.as_slice(), "normal": w.normal.as_slice(),
        })
    };
    let walls: Vec<Vec<_>> =
        problem.cases.iter().map(|(case, _)| case.walls.iter().map(wall).collect()).collect();
    Ok(json!({
        "first_hinge_m": tool.joint_positions_m[0],
        "length_m": lengths_m,
        "mass_kg": mass_kg,
        "inertia_kg_m2": inertia_kg_m2,
        "stiffness_nm_per_rad": tool.joint_stiffness_nm_per_rad,
        // Multiplied by stiffness and damping ratio, this is a hinge's damper.
        "damping_s": 1.0 / (PI * first_hz),
        "sphere_along_m": sphere_along_m(&tool),
        "sphere_radius_m": tool.segment_sphere_radius_m,
        "contact_stiffness_n_per_m": tool.contact.stiffness_n_per_m,
        "tip_force_n": TIP_FORCE_N,
        "ramp_s": RAMP_S,
        "seconds": DURATION_S,
        "settings": problem.settings,
        "cases": walls,
    })
    .to_string())
}

/// The cases with their reference tips, and the settings.
struct Problem {
    cases: Vec<(Case, Vector2<f64>)>,
    settings: Vec<(f64, f64)>,
}

impl Problem {
    fn new(effort: Effort) -> Result<Problem, ManipulatorError> {
        let few = if effort == Effort::Quick { 1 } else { SETTINGS.len() };
        let mut cases = Vec::new();
        for spheres in SPHERES.into_iter().take(few) {
            let case = Case::new(spheres);
            let (angles_rad, _) = case.ours(REFERENCE.0, REFERENCE.1)?;
            let tip_m = case.pose(&angles_rad).tip_m;
            cases.push((case, tip_m));
        }
        Ok(Problem { cases, settings: SETTINGS[..few].to_vec() })
    }

    /// Parses a run's line; `None` for any other text.
    fn read(&self, line: &str) -> Option<Rest> {
        let words: Vec<&str> = line.split_whitespace().collect();
        let ["contact", name, rest @ ..] = words.as_slice() else { return None };
        let numbers: Vec<f64> = rest.iter().map_while(|word| word.parse().ok()).collect();
        let [contacts, damping_ratio, dt_ms, us_per_ms, angles_rad @ ..] = numbers.as_slice() else {
            return None;
        };
        self.judge(name, *contacts as usize, (*damping_ratio, *dt_ms), (*us_per_ms, angles_rad))
    }

    fn judge(
        &self,
        name: &str,
        contacts: usize,
        (damping_ratio, dt_ms): (f64, f64),
        (us_per_ms, angles_rad): (f64, &[f64]),
    ) -> Option<Rest> {
        let (case, tip_m) = self.cases.iter().find(|(case, _)| case.walls.len() == contacts)?;
        if angles_rad.len() != case.tool.joint_positions_m.len() {
            return None;
        }
        let pose = case.pose(angles_rad);
        let error_um = (pose.tip_m - tip_m).norm() * 1e6;
        let name = name.to_owned();
        Some(Rest { name, contacts, damping_ratio, dt_ms, us_per_ms, pose, error_um, cost_ratio: None })
    }

    fn ours(&self) -> Result<Vec<Rest>, Failure> {
        let mut all = Vec::new();
        for (case, _) in &self.cases {
            for &(damping_ratio, dt_ms) in &self.settings {
                let (angles_rad, us_per_ms) = case.ours(damping_ratio, dt_ms).map_err(failed)?;
                let setting = (damping_ratio, dt_ms);
                all.extend(self.judge("planar euler", case.walls.len(), setting, (us_per_ms, &angles_rad)));
            }
        }
        Ok(all)
    }
}

fn failed(cause: ManipulatorError) -> Failure {
    Failure::failed(cause.to_string())
}

/// Runs our rung and every script. A script that cannot be installed or run is reported, not a failure.
///
/// # Errors
/// No folder of scripts, or a file that cannot be written.
pub(super) fn measure(folder: &Path, out: &Path, effort: Effort) -> Result<Vec<Rest>, Failure> {
    let work = std::path::absolute(out.join("peers-physics"));
    let work = work.map_err(|cause| Failure::failed(format!("{}: {cause}", out.display())))?;
    let files = new_input(&work)?;
    let problem = Problem::new(effort).map_err(failed)?;
    let text = input(&problem).map_err(failed)?;
    output_file::write(&files.path().join("contact.json"), text)?;
    let mut all = problem.ours()?;
    all.iter().for_each(|own| say!("{}", own.line()));
    for (name, script) in scripts(folder)?.into_iter().filter(|(name, _)| name.ends_with(SUFFIX)) {
        let mut own = problem.ours()?;
        let printed = match run(&script, &name, &work, files.path()) {
            Ok(printed) => printed,
            Err(reason) => {
                say!("peer {name}: not measured ({reason})");
                continue;
            }
        };
        for (before, after) in own.iter_mut().zip(problem.ours()?) {
            before.us_per_ms = 0.5 * (before.us_per_ms + after.us_per_ms);
        }
        for mut peer in printed.lines().filter_map(|line| problem.read(line)) {
            peer.compare(&own);
            say!("{}", peer.line());
            all.push(peer);
        }
    }
    Ok(all)
}

impl Rest {
    fn compare(&mut self, own: &[Rest]) {
        let as_good = |own: &&Rest| {
            own.contacts == self.contacts && own.error_um <= (self.error_um * 1.01).max(EQUAL_UM)
        };
        let cheapest = own.iter().filter(as_good).map(|own| own.us_per_ms).min_by(f64::total_cmp);
        let is_comparable = self.takes_steps() && self.error_um.is_finite();
        self.cost_ratio = cheapest.filter(|_| is_comparable).map(|us| self.us_per_ms / us);
    }

    /// Whether the program takes steps; minimising the energy does not.
    fn takes_steps(&self) -> bool {
        self.dt_ms > 0.0
    }

    fn line(&self) -> String {
        let steps = format!(
            "damping ratio {:<4}, dt {:>5} ms: {:>8.2} us/ms",
            self.damping_ratio, self.dt_ms, self.us_per_ms
        );
        let steps = if self.takes_steps() { &steps } else { "statics, checks the reference" };
        let head = format!("contact {:>2}  {:<19} {steps}", self.contacts, self.name);
        if !self.error_um.is_finite() {
            return format!("{head}; lost");
        }
        let Pose { most_overlap_m, pressing, unbalanced_nm, .. } = self.pose;
        let ratio = self.cost_ratio.map_or(String::new(), |ratio| format!("; {ratio:.2} times ours"));
        format!(
            "{head}, tip error {:.5} um, overlap {:.3} um, {pressing} press, unbalanced {unbalanced_nm:.1e} \
             N m{ratio}",
            self.error_um,
            most_overlap_m * 1e6
        )
    }
}

/// Returns the lines of the CSV.
pub(super) fn csv(all: &[Rest]) -> String {
    let mut text = String::new();
    for rest in all {
        let is_lost = !rest.error_um.is_finite();
        let figures = [
            ("tip error (µm)", Some(rest.error_um)),
            ("largest overlap (µm)", Some(rest.pose.most_overlap_m * 1e6)),
            ("contacts that press", Some(rest.pose.pressing as f64)),
            ("unbalanced torque (N m)", Some(rest.pose.unbalanced_nm)),
            ("cost over ours at no larger error", rest.cost_ratio),
        ];
        let Rest { name, contacts, damping_ratio, dt_ms, us_per_ms, .. } = rest;
        let figures = figures.into_iter().take(if is_lost { 1 } else { usize::MAX });
        for (figure, value) in figures.filter_map(|(figure, value)| Some((figure, value?))) {
            // Writing to a String cannot fail.
            let _ = writeln!(
                text,
                "contact_{contacts},{name} at damping ratio \
                 {damping_ratio},27,{dt_ms},{us_per_ms:.3},{figure},{value:.6e}"
            );
        }
    }
    text
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_planar_rung_rests_where_the_stated_laws_balance() -> Result<(), ManipulatorError> {
        let problem = Problem::new(Effort::Quick)?;
        // Tip by SciPy's energy minimum, mm.
        let (case, tip_m) = &problem.cases[0];
        assert!((tip_m * 1e3 - Vector2::new(-0.045_077_95, 71.465_809_9)).norm() < 1e-5, "{tip_m}");
        let (angles_rad, _) = case.ours(1.0, 1.0)?;
        let pose = case.pose(&angles_rad);
        // The mount yields by a few tenths of a nanometre.
        assert!((pose.tip_m - tip_m).norm() < 1e-8 && pose.unbalanced_nm < 5e-5, "{pose:?}");
        assert_eq!(pose.pressing, 5);
        Ok(())
    }

    #[test]
    fn a_line_of_a_script_is_judged_by_its_angles() -> Result<(), ManipulatorError> {
        let problem = Problem::new(Effort::Quick)?;
        let angles = " 0".repeat(27);
        let rest = problem.read(&format!("contact straight 10 1.0 1.0 3.5{angles}")).expect("a run");
        assert!((rest.error_um - 45.3).abs() < 1.0 && rest.pose.most_overlap_m > 50e-6, "{rest:?}");
        assert_eq!(problem.read("contact short 10 1.0 1.0 3.5 0 0"), None);
        assert_eq!(problem.read("tip_force mujoco 8 1.0 5.0 10 0 0"), None);
        Ok(())
    }
}
