//! Dimensions, stiffnesses, masses and solver settings of a manipulator.

use nalgebra::Vector3;
use scene::{Cutter, STANDARD_RADII};
use serde::{Deserialize, Serialize};

use super::MAX_LINKS;
use super::error::ManipulatorError;
use super::flexure::{Notch, StiffnessRatios};
use super::outer_tube::OuterTube;

/// How a step is integrated.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
pub enum Integrator {
    /// First order. Damps modes that the step does not resolve, and never diverged in the stress matrix.
    LinearlyImplicitEuler,
    /// Second-order Rosenbrock (ROS2, Verwer et al. 1999, SIAM J. Sci. Comput. 20(4), gamma = 1 - 1/sqrt 2)
    /// in free motion. Linearly implicit Euler takes the step instead if there is a contact or joint-stop
    /// candidate, if a tendon with friction reverses, starts or stops sliding, or if the embedded error
    /// estimate exceeds [`ManipulatorParameters::hybrid_tolerance_rad`].
    Hybrid,
}

/// Parameters of all tendons that have none of their own, and the antagonist pair: tendon 0 runs on the +x
/// side of the base frame and bends toward +x (positive joint angles), tendon 1 runs on the -x side.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct TendonParameters {
    /// Distance of the pair's channels from the tool axis, m.
    pub offset_m: f64,
    /// Free length of the tendon across one flexure, hole to hole, at zero bend, m. The chord between the
    /// holes is `gap cos(q/2) -+ 2 offset sin(q/2)`.
    pub gap_m: f64,
    /// Axial stiffness of the whole tendon from actuator to anchor, N/m.
    pub stiffness_n_per_m: f64,
    /// Capstan friction coefficient between tendon and channel; 0 is frictionless.
    pub friction_coefficient: f64,
    /// Sliding distance over which friction builds up from zero to full (Dahl pre-sliding), m. A reversal of
    /// capstan friction takes twice this distance.
    pub presliding_m: f64,
}

/// Where a tendon runs.
#[derive(Debug, Clone, PartialEq, Eq, Default, PartialOrd)]
pub struct TendonReach {
    /// The first flexure that it bends, from 0.
    pub from: usize,
    /// The flexure behind the last that it bends; `None` if it ends at the tip.
    pub to: Option<usize>,
}

/// A tendon in a channel parallel to the tool's axis, or winding about it.
#[derive(Debug, Clone, PartialEq, Default)]
pub struct TendonRoute {
    /// Channel, (x, y) from the tool axis in the base frame, m. Only the spatial rungs bend along y.
    pub channel_m: [f64; 2],
    /// The flexures that it bends. In front of them a sheath holds it, behind them it ends.
    pub reach: TendonReach,
    /// Angle by which the channel turns about the tool's axis, from x toward y, per length from half way
    /// before the first flexure that it bends on, rad/m; 0: parallel to the axis. Only the spatial rungs
    /// twist: see `manipulator::helix`.
    pub twist_rad_per_m: f64,
    /// Its own axial stiffness, N/m, in place of that of all.
    pub stiffness_n_per_m: Option<f64>,
    /// Its own capstan friction coefficient, in place of that of all.
    pub friction_coefficient: Option<f64>,
}

impl From<[f64; 2]> for TendonRoute {
    /// Along the whole tool.
    fn from(channel_m: [f64; 2]) -> Self {
        Self { channel_m, ..Self::default() }
    }
}

/// Contact model and its solver.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct ContactParameters {
    /// Coulomb coefficient of the shaft and segment spheres, and of a burr that stands still.
    pub friction_coefficient: f64,
    /// Coulomb coefficient of a burr that turns. It slides about its own axis, which leaves no dry friction
    /// to resist the feed: 0.
    pub burr_friction_coefficient: f64,
    /// Stiffness of one contact, N/m: the overlap at rest is force / stiffness.
    pub stiffness_n_per_m: f64,
    /// Maximum speed at which overlap beyond what the contact force explains is pushed out, m/s; at most 0.05
    /// mm a step.
    pub push_out_speed_m_per_s: f64,
    /// Maximum number of Newton iterations of the contact solver.
    pub max_iterations: usize,
    /// The solver stops when no contact misses its law by more than this speed, m/s.
    pub tolerance_m_per_s: f64,
}

/// What a flexure is, besides its bending stiffness.
#[derive(Debug, Clone, PartialEq)]
pub enum Section {
    /// A piece of a round tube without notches.
    Tube,
    /// Given by its ratios, one entry per flexure: see [`ManipulatorParameters::set_notch`].
    Ratios(Vec<StiffnessRatios>),
}

/// Moment modes of the rung `modal` unless others are asked for: with five, the standard tool is at rest
/// within 25 µm of all its flexures.
pub const STANDARD_MOMENT_MODES: usize = 5;

/// Complete definition of a continuum manipulator, for every rung. SI units.
///
/// Base frame: +z is the insertion axis along the straight tool, +x the bending direction toward tendon 0,
/// and in the planar rungs every flexure turns about +y. The origin is the flange.
#[derive(Debug, Clone, PartialEq)]
pub struct ManipulatorParameters {
    /// z of each flexure centre on the straight tool, in the base frame, strictly increasing, m.
    pub joint_positions_m: Vec<f64>,
    /// Bending stiffness of each flexure, N m/rad.
    pub joint_stiffness_nm_per_rad: Vec<f64>,
    /// Bend of each flexure without load, rad: that of a pre-curved tube, in the bending plane. Empty for a
    /// straight tool.
    pub joint_rest_rad: Vec<f64>,
    /// Where the stiffness of a flexure in its other freedoms comes from. Used by the spatial rungs only.
    pub section: Section,
    /// Lateral stiffness of each flexure divided by its bending stiffness, in place of that of `section`.
    pub lateral_stiffness_ratio: Option<f64>,
    /// Torsional stiffness of each flexure divided by its bending stiffness, in place of that of `section`.
    pub torsion_stiffness_ratio: Option<f64>,
    /// Poisson's ratio nu.
    pub poisson_ratio: f64,
    /// Joint stop of each flexure, to either side of its rest angle, rad.
    pub joint_limit_rad: f64,
    /// Stiffness of the stop, N m/rad.
    pub joint_stop_stiffness_nm_per_rad: f64,
    /// From the last flexure centre to the burr centre, m. The tip frame sits at the burr centre, which is
    /// that of its front ball.
    pub tip_offset_m: f64,
    /// Mass per length of the flexible tube, kg/m.
    pub linear_density_kg_per_m: f64,
    /// Outer and inner radius of the tube, m. They set the links' rotary inertia and, with `section`, the
    /// stiffness of a flexure but for bending, which `joint_stiffness_nm_per_rad` gives.
    pub tube_radii_m: [f64; 2],
    /// Mass of the burr, a solid, kg.
    pub burr_mass_kg: f64,
    /// Mass of the rigid shaft before the first flexure, kg.
    pub shaft_mass_kg: f64,
    /// z of the shaft's centre of mass in the base frame, m.
    pub shaft_centre_m: f64,
    /// Damping ratio of the first bending mode; each flexure has the Kelvin-Voigt damping (2 ratio / omega_1)
    /// k.
    pub damping_ratio: f64,
    /// Stiffness of the tool mount along base x, y and z, N/m.
    pub mount_stiffness_n_per_m: [f64; 3],
    /// Damping ratio of the tool's total mass on the mount, 1 = critical.
    pub mount_damping_ratio: f64,
    /// Gravity in world axes, m/s^2.
    pub gravity_m_per_s2: Vector3<f64>,
    /// Number of proxy spheres on the shaft.
    pub shaft_sphere_count: usize,
    /// z of the first and of the last shaft sphere, in the base frame, m.
    pub shaft_sphere_span_m: [f64; 2],
    /// Radius of the shaft spheres, m.
    pub shaft_sphere_radius_m: f64,
    /// Radius of the segment spheres, one in the middle of each segment, m.
    pub segment_sphere_radius_m: f64,
    /// The burr.
    pub cutter: Cutter,
    /// The tendons.
    pub tendon: TendonParameters,
    /// The tendons' routes, none for a tool without tendons; `None` for the antagonist pair.
    pub tendon_routes: Option<Vec<TendonRoute>>,
    /// The tube out of which the tool slides, if there is one.
    pub outer_tube: Option<OuterTube>,
    /// The contact model.
    pub contact: ContactParameters,
    /// How a step is integrated.
    pub integrator: Integrator,
    /// Error per joint and step, rad, above which [`Integrator::Hybrid`] repeats the step with linearly
    /// implicit Euler.
    pub hybrid_tolerance_rad: f64,
    /// Number of moment modes, 2 to 8. Used by the rung `modal` only; a tool of fewer flexures has one mode
    /// each.
    pub moment_modes: usize,
}

/// Flexure centres of the BIGSS/JHU manipulator from its base, mm ("From the CAD", `create_snake_yaml.py`,
/// htp2/continuum-manip-volumetric-drilling-plugin).
const JHU_JOINTS_MM: [f64; 27] = [
    36.02972, 37.35460, 38.66981, 39.97534, 41.27119, 42.55736, 43.83386, 45.10068, 46.35782, 47.60529,
    48.84308, 50.07119, 51.28962, 52.49838, 53.69746, 54.88686, 56.06659, 57.23664, 58.39701, 59.54771,
    60.68872, 61.82167, 62.95139, 64.08112, 65.21084, 66.34056, 67.47028,
];

/// Finite-element flexure stiffnesses of the same tool, N m/degree, proximal to distal
/// (`replace_cm_joint_properties.py`).
const JHU_STIFFNESS_NM_PER_DEG: [f64; 27] = [
    0.013685109,
    0.013281173,
    0.012877237,
    0.0124733,
    0.012069364,
    0.011665428,
    0.011261491,
    0.010857555,
    0.010453619,
    0.010049683,
    0.009645746,
    0.00924181,
    0.008837874,
    0.008433938,
    0.008030001,
    0.007626065,
    0.007222129,
    0.006818192,
    0.006414256,
    0.00601032,
    0.005606384,
    0.005336815,
    0.005336815,
    0.005336815,
    0.005336815,
    0.005336815,
    0.005336815,
];

/// Mean distance of a flexure from its neighbours, m; 0 for the only one. `joints_m`: places of all of them.
pub(crate) fn pitch_m(joints_m: &[f64], index: usize) -> f64 {
    let last = joints_m.len().saturating_sub(1);
    let (from, to) = (index.saturating_sub(1), (index + 1).min(last));
    (joints_m[to] - joints_m[from]) / (to - from).max(1) as f64
}

/// The ratios of flexures at `joints_m` between notches; the pitch of a flexure is the mean of those on
/// either side.
fn notched(
    notch: &Notch,
    joints_m: &[f64],
    tube_radii_m: [f64; 2],
    poisson_ratio: f64,
) -> Vec<StiffnessRatios> {
    (0..joints_m.len())
        .map(|i| notch.unit_stiffness(pitch_m(joints_m, i), tube_radii_m, poisson_ratio).ratios())
        .collect()
}

impl ManipulatorParameters {
    /// The 27-flexure notched nitinol tool of BIGSS/JHU: OD 6 mm, ID 4 mm, tendon channels at 2.5 mm,
    /// burr 6.5 mm.
    ///
    /// Geometry and bending stiffness come from the tables above, the other stiffnesses from the notches
    /// ([`Notch::JHU`], nu = 0.33); masses assume a solid nitinol tube (6450 kg/m^3, 0.101 kg/m).
    /// `tendon.gap_m` is 0, as in the published prediction (8.65 degrees per newton): a gap of one full pitch
    /// bends about 1 % more. Tendon stiffness (a 0.35 mm steel cable of 0.3 m), damping ratio, stop stiffness
    /// and friction are assumptions: override them with measured values if you have them.
    pub fn jhu_27() -> Self {
        let joints: Vec<f64> = JHU_JOINTS_MM.iter().map(|z| z * 1e-3).collect();
        let stiffness =
            JHU_STIFFNESS_NM_PER_DEG.iter().map(|k| k * (180.0 / core::f64::consts::PI)).collect();
        let density = 0.101;
        let shaft_length = joints[0];
        let radii = [STANDARD_RADII.tube_outer_m, STANDARD_RADII.tube_inner_m];
        let poisson_ratio = 0.33;
        let section = Section::Ratios(notched(&Notch::JHU, &joints, radii, poisson_ratio));
        Self {
            joint_positions_m: joints,
            joint_stiffness_nm_per_rad: stiffness,
            joint_rest_rad: Vec::new(),
            section,
            lateral_stiffness_ratio: None,
            torsion_stiffness_ratio: None,
            poisson_ratio,
            joint_limit_rad: 5.0 * core::f64::consts::PI / 180.0,
            joint_stop_stiffness_nm_per_rad: 100.0,
            tip_offset_m: 4.0e-3,
            linear_density_kg_per_m: density,
            tube_radii_m: radii,
            burr_mass_kg: 1.0e-3,
            shaft_mass_kg: density * shaft_length,
            shaft_centre_m: 0.5 * shaft_length,
            damping_ratio: 0.05,
            mount_stiffness_n_per_m: [2.0e5; 3],
            mount_damping_ratio: 1.0,
            gravity_m_per_s2: Vector3::zeros(),
            shaft_sphere_count: 6,
            shaft_sphere_span_m: [0.0, 35.0e-3],
            shaft_sphere_radius_m: STANDARD_RADII.tube_outer_m,
            segment_sphere_radius_m: STANDARD_RADII.tube_outer_m,
            cutter: STANDARD_RADII.cutter,
            tendon: TendonParameters {
                offset_m: 2.5e-3,
                gap_m: 0.0,
                stiffness_n_per_m: 3.0e4,
                friction_coefficient: 0.0,
                presliding_m: 20.0e-6,
            },
            tendon_routes: None,
            outer_tube: None,
            contact: ContactParameters {
                friction_coefficient: 0.2,
                burr_friction_coefficient: 0.0,
                stiffness_n_per_m: 1.0e6,
                push_out_speed_m_per_s: 0.05,
                max_iterations: 64,
                tolerance_m_per_s: 1.0e-6,
            },
            integrator: Integrator::LinearlyImplicitEuler,
            hybrid_tolerance_rad: 0.005,
            moment_modes: STANDARD_MOMENT_MODES,
        }
    }

    /// A uniform beam of `length_m` and flexural rigidity `rigidity_nm2` (EI) as `joints` equal links with
    /// flexures at their centres: half a link precedes the first flexure and follows the last. A round tube,
    /// no shaft, no burr mass, stops out of reach; everything else as in [`Self::jhu_27`].
    pub fn uniform_beam(joints: usize, length_m: f64, rigidity_nm2: f64) -> Self {
        let pitch = length_m / joints as f64;
        Self {
            joint_positions_m: (0..joints).map(|i| (i as f64 + 0.5) * pitch).collect(),
            joint_stiffness_nm_per_rad: vec![rigidity_nm2 / pitch; joints],
            joint_rest_rad: Vec::new(),
            section: Section::Tube,
            joint_limit_rad: 3.0,
            tip_offset_m: 0.5 * pitch,
            burr_mass_kg: 0.0,
            shaft_mass_kg: 0.0,
            shaft_centre_m: 0.0,
            shaft_sphere_count: 0,
            ..Self::jhu_27()
        }
    }

    /// The same tool with `links` equal links over its flexible length, 1 to 64.
    ///
    /// The flexible length extends half a pitch beyond the first and the last flexure. Each original
    /// flexure's compliance is spread evenly over its cell, which reaches halfway to both neighbours. A new
    /// flexure gets the compliance of its link and sits at that compliance's centroid, so a small tip load
    /// moves the tip as before. The other freedoms' compliances and the rest angles are spread and summed
    /// alike.
    ///
    /// # Errors
    /// The number of links or a parameter is out of range; a tendon begins or ends within a link.
    pub fn with_links(&self, links: usize) -> Result<Self, ManipulatorError> {
        self.validate()?;
        if !(1..=MAX_LINKS).contains(&links) {
            return Err(ManipulatorError::Length { field: "links", given: links, expected: "1 to 64" });
        }
        let z = &self.joint_positions_m;
        let n = z.len();
        let burr = self.burr_centre_m();
        let edges = self.cell_edges_m();
        let (start, end) = (edges[0], edges[n]);
        let share = |k: usize| start + (end - start) * k as f64 / links as f64;
        let (mut positions, mut stiffness, mut ratios, mut rest) =
            (Vec::new(), Vec::new(), Vec::new(), Vec::new());
        for i in 0..links {
            let (from, to) = (share(i), share(i + 1));
            let (mut compliance, mut moment, mut parts, mut bend) = (0.0, 0.0, Vec::new(), 0.0);
            for j in 0..n {
                let (a, b) = (from.max(edges[j]), to.min(edges[j + 1]));
                if b > a {
                    let c = (b - a) / (edges[j + 1] - edges[j]) / self.joint_stiffness_nm_per_rad[j];
                    compliance += c;
                    moment += c * 0.5 * (a + b);
                    parts.push((c, self.stiffness_ratios(j)));
                    bend += (b - a) / (edges[j + 1] - edges[j]) * self.rest_rad(j);
                }
            }
            positions.push(moment / compliance);
            stiffness.push(1.0 / compliance);
            rest.push(bend);
            ratios.push(StiffnessRatios::in_series(&parts));
        }
        let tip_offset_m = burr - positions[links - 1];
        // Joint stop and tendon gap scale with the length of tube.
        let pitch_ratio = n as f64 / links as f64;
        let mut tendon = self.tendon;
        tendon.gap_m *= pitch_ratio;
        let section = match &self.section {
            Section::Tube => Section::Tube,
            Section::Ratios(_) => Section::Ratios(ratios),
        };
        let shares: Vec<f64> = (0..=links).map(share).collect();
        let tendon_routes = self.routes_over(&edges, &shares)?;
        Ok(Self {
            joint_positions_m: positions,
            joint_stiffness_nm_per_rad: stiffness,
            joint_rest_rad: if self.joint_rest_rad.is_empty() { Vec::new() } else { rest },
            tendon_routes,
            section,
            joint_limit_rad: (self.joint_limit_rad * pitch_ratio).min(3.1),
            joint_stop_stiffness_nm_per_rad: self.joint_stop_stiffness_nm_per_rad / pitch_ratio,
            tip_offset_m,
            tendon,
            ..self.clone()
        })
    }

    /// The tendons' routes over links between `after` in place of flexures between `before`, m.
    fn routes_over(
        &self,
        before: &[f64],
        after: &[f64],
    ) -> Result<Option<Vec<TendonRoute>>, ManipulatorError> {
        let Some(routes) = &self.tendon_routes else { return Ok(None) };
        let same_m = 1e-9;
        let edge = |flexure: usize| {
            let z_m = before.get(flexure).copied().unwrap_or(f64::NAN);
            after.iter().position(|edge_m| (edge_m - z_m).abs() < same_m).ok_or(ManipulatorError::OutOfRange {
                field: "links",
                value: (after.len() - 1) as f64,
                allowed: "a number of links of which none is bent in part only by a tendon that begins or ends in it",
            })
        };
        let moved = |route: &TendonRoute| {
            let to = route.reach.to.map(edge).transpose()?;
            let from = if route.reach.from == 0 { 0 } else { edge(route.reach.from)? };
            Ok(TendonRoute { reach: TendonReach { from, to }, ..*route })
        };
        routes.iter().map(moved).collect::<Result<Vec<_>, _>>().map(Some)
    }

    /// Bend of flexure `joint` without load, rad; 0 past the end.
    pub fn rest_rad(&self, joint: usize) -> f64 {
        self.joint_rest_rad.get(joint).copied().unwrap_or(0.0)
    }

    /// Takes the stiffness of every flexure but for bending from notches of this shape in a tube of
    /// `tube_radii_m`. A web's height follows from the distances to the neighbouring flexures.
    pub fn set_notch(&mut self, notch: &Notch) {
        let ratios = notched(notch, &self.joint_positions_m, self.tube_radii_m, self.poisson_ratio);
        self.section = Section::Ratios(ratios);
    }

    /// Stiffness of flexure `joint` in its other freedoms over its bending stiffness. The last flexure's past
    /// the end.
    pub fn stiffness_ratios(&self, joint: usize) -> StiffnessRatios {
        let tube = || StiffnessRatios::tube(self.tube_radii_m, self.poisson_ratio);
        let own = match &self.section {
            Section::Tube => tube(),
            Section::Ratios(ratios) => ratios.get(joint).or(ratios.last()).copied().unwrap_or_else(tube),
        };
        StiffnessRatios {
            lateral: self.lateral_stiffness_ratio.unwrap_or(own.lateral),
            torsion: self.torsion_stiffness_ratio.unwrap_or(own.torsion),
            ..own
        }
    }

    /// Distance of the burr's centre from the base, along the straight tool, m.
    pub fn burr_centre_m(&self) -> f64 {
        self.joint_positions_m.last().copied().unwrap_or(0.0) + self.tip_offset_m
    }

    /// Length that bends, from the first flexure to the burr's centre, m.
    pub fn flexible_length_m(&self) -> f64 {
        let z = &self.joint_positions_m;
        z.first().zip(z.last()).map_or(0.0, |(first, last)| last - first) + self.tip_offset_m
    }

    /// Radius of the tool where it is widest, but for the burr, m: of its tube, or of the one that it slides
    /// out of.
    pub fn widest_tube_m(&self) -> f64 {
        self.outer_tube.map_or(self.tube_radii_m[0], |outer| outer.outer_radius_m)
    }

    /// Number of tendons.
    pub fn tendon_count(&self) -> usize {
        self.tendon_routes.as_ref().map_or(2, Vec::len)
    }

    /// Boundaries of the cells of tube that the flexures represent, one more than there are flexures, m.
    pub(super) fn cell_edges_m(&self) -> Vec<f64> {
        (0..=self.joint_positions_m.len()).map(|edge| self.cell_edge_m(edge)).collect()
    }

    /// One of [`Self::cell_edges_m`]: half way between two flexures, and as far beyond the outer ones.
    pub(super) fn cell_edge_m(&self, edge: usize) -> f64 {
        let z = &self.joint_positions_m;
        let n = z.len();
        let burr = self.burr_centre_m();
        let first = if n > 1 { z[1] - z[0] } else { 2.0 * self.tip_offset_m.min(z[0]) };
        let last = if n > 1 { z[n - 1] - z[n - 2] } else { first };
        match edge {
            0 => (z[0] - 0.5 * first).max(0.0),
            _ if edge < n => 0.5 * (z[edge - 1] + z[edge]),
            _ => (z[n - 1] + 0.5 * last).min(burr),
        }
    }
}
