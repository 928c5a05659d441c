//! Dimensions, stiffnesses, masses and solver settings of a manipulator.

use nalgebra::Vector3;
use scene::{Cutter, STANDARD_RADII};
use serde::{Deserialize, Serialize};

use super::MAX_LINKS;
use super::error::ManipulatorError;
use super::flexure::{Notch, StiffnessRatios};
use super::outer_tube::OuterTube;

/// Integration method of a step.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
pub enum Integrator {
    /// First order. Damps modes that the step does not resolve; never diverged in the stress tests.
    LinearlyImplicitEuler,
    /// Second-order Rosenbrock (ROS2, Verwer et al. 1999, SIAM J. Sci. Comput. 20(4), gamma = 1 - 1/sqrt 2)
    /// in free motion. Linearly implicit Euler takes the step instead if there is a contact or joint-stop
    /// candidate, if a tendon with friction reverses, starts or stops sliding, or if the embedded error
    /// estimate exceeds [`ManipulatorParameters::hybrid_tolerance_rad`].
    Hybrid,
}

/// Default parameters of all tendons, and the antagonist pair: tendon 0 runs on the +x side of the base frame
/// and bends toward +x (positive joint angles), tendon 1 runs on the -x side.
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

/// Range of flexures that a tendon bends.
#[derive(Debug, Clone, PartialEq, Eq, Default, PartialOrd)]
pub struct TendonReach {
    /// The first flexure that the tendon bends, from 0.
    pub from: usize,
    /// The flexure after the last that the tendon bends; `None` if it ends at the tip.
    pub to: Option<usize>,
}

/// A tendon in a channel parallel to the tool axis, or winding around it.
#[derive(Debug, Clone, PartialEq, Default)]
pub struct TendonRoute {
    /// Channel position (x, y) relative to the tool axis in the base frame, m. Only the spatial rungs bend
    /// along y.
    pub channel_m: [f64; 2],
    /// The flexures that it bends. Before them it runs in a sheath; after them it ends.
    pub reach: TendonReach,
    /// Winding rate of the channel about the tool axis, from x toward y, rad/m, starting halfway before the
    /// first flexure that it bends; 0 if parallel to the axis. Supported by the spatial rungs only; see
    /// `manipulator::helix`.
    pub twist_rad_per_m: f64,
    /// Axial stiffness, N/m, which overrides that of [`TendonParameters`].
    pub stiffness_n_per_m: Option<f64>,
    /// Capstan friction coefficient, which overrides that of [`TendonParameters`].
    pub friction_coefficient: Option<f64>,
}

impl From<[f64; 2]> for TendonRoute {
    /// A tendon along the whole tool.
    fn from(channel_m: [f64; 2]) -> Self {
        Self { channel_m, ..Self::default() }
    }
}

/// Contact model and its solver.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct ContactParameters {
    /// Coulomb coefficient of the shaft and segment spheres, and of a stationary burr.
    pub friction_coefficient: f64,
    /// Coulomb coefficient of a turning burr: 0, because its surface slides about its own axis, which leaves
    /// no dry friction to resist the feed.
    pub burr_friction_coefficient: f64,
    /// Stiffness of one contact, N/m: the overlap at rest is force / stiffness.
    pub stiffness_n_per_m: f64,
    /// Maximum speed at which overlap beyond what the contact force explains is pushed out, m/s; at most 0.05
    /// mm per step.
    pub push_out_speed_m_per_s: f64,
    /// Maximum number of Newton iterations of the contact solver.
    pub max_iterations: usize,
    /// Speed, m/s, by which contacts may violate their law when the solver stops.
    pub tolerance_m_per_s: f64,
}

/// Cross-section of a flexure, which determines its stiffness other than bending.
#[derive(Debug, Clone, PartialEq)]
pub enum Section {
    /// A section of round tube without notches.
    Tube,
    /// Given by stiffness ratios, one entry per flexure; see [`ManipulatorParameters::set_notch`].
    Ratios(Vec<StiffnessRatios>),
}

/// Default number of moment modes of the modal rung: with five, the standard tool at rest is within 25 µm of
/// the planar chain.
pub const STANDARD_MOMENT_MODES: usize = 5;

/// Complete definition of a continuum manipulator for all rungs, in SI units.
///
/// Base frame: +z is the insertion axis along the straight tool, +x the bending direction toward tendon 0,
/// and in the planar rungs every flexure turns about +y. The origin is the flange.
#[derive(Debug, Clone, PartialEq)]
pub struct ManipulatorParameters {
    /// z of each flexure centre on the straight tool, in the base frame, strictly increasing, m.
    pub joint_positions_m: Vec<f64>,
    /// Bending stiffness of each flexure, N m/rad.
    pub joint_stiffness_nm_per_rad: Vec<f64>,
    /// Unloaded bend of each flexure of a pre-curved tube, in the bending plane, rad. Empty for a straight
    /// tool.
    pub joint_rest_rad: Vec<f64>,
    /// Source of the stiffness of a flexure in its other freedoms. Used by the spatial rungs only.
    pub section: Section,
    /// Lateral stiffness of each flexure divided by its bending stiffness; overrides that of `section`.
    pub lateral_stiffness_ratio: Option<f64>,
    /// Torsional stiffness of each flexure divided by its bending stiffness; overrides that of `section`.
    pub torsion_stiffness_ratio: Option<f64>,
    /// Poisson's ratio nu.
    pub poisson_ratio: f64,
    /// Joint stop of each flexure, on both sides of its rest angle, rad.
    pub joint_limit_rad: f64,
    /// Stiffness of the stop, N m/rad.
    pub joint_stop_stiffness_nm_per_rad: f64,
    /// Distance from the last flexure centre to the burr centre, m. The tip frame is at the burr centre,
    /// which is that of its front ball.
    pub tip_offset_m: f64,
    /// Mass per length of the flexible tube, kg/m.
    pub linear_density_kg_per_m: f64,
    /// Outer and inner radius of the tube, m. They determine the links' rotary inertia and, with `section`,
    /// the stiffness of a flexure except for bending, which is `joint_stiffness_nm_per_rad`.
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
    /// The tendons' routes; empty for a tool without tendons, `None` for the antagonist pair.
    pub tendon_routes: Option<Vec<TendonRoute>>,
    /// The outer tube out of which the tool slides, if any.
    pub outer_tube: Option<OuterTube>,
    /// The contact model.
    pub contact: ContactParameters,
    /// Integration method of a step.
    pub integrator: Integrator,
    /// Error per joint and step, rad, above which [`Integrator::Hybrid`] repeats the step with linearly
    /// implicit Euler.
    pub hybrid_tolerance_rad: f64,
    /// Number of moment modes, 2 to 8. Used by the modal rung only; a tool with fewer flexures has one mode
    /// per flexure.
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

/// Returns the mean distance of a flexure from its neighbours, m; 0 for the only one. `joints_m` holds the
/// positions of all of them.
pub(crate) fn pitch_m(joints_m: &[f64], index: usize) -> f64 {
    let last = joints_m.len().saturating_sub(1);
    let (from, to) = (index.saturating_sub(1), (index + 1).min(last));
    (joints_m[to] - joints_m[from]) / (to - from).max(1) as f64
}

/// Returns the ratios of flexures at `joints_m` between notches; the pitch of a flexure is the mean of those
/// on both sides.
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
    /// Returns the length of tube that each flexure bends, m: the mean of its distances from its neighbours.
    pub fn pitches_m(&self) -> Vec<f64> {
        (0..self.joint_positions_m.len()).map(|index| pitch_m(&self.joint_positions_m, index)).collect()
    }

    /// Returns the 27-flexure notched nitinol tool of BIGSS/JHU: OD 6 mm, ID 4 mm, tendon channels at 2.5 mm,
    /// burr 6.5 mm.
    ///
    /// Geometry and bending stiffness come from the tables above, the other stiffnesses from the notches
    /// ([`Notch::JHU`], nu = 0.33); masses assume a solid nitinol tube (6450 kg/m^3, 0.101 kg/m).
    /// `tendon.gap_m` is 0, an assumption that gives 8.65 degrees per newton: a gap of one full pitch bends
    /// about 1 % more. Tendon stiffness (a 0.35 mm steel cable of 0.3 m), damping ratio, stop stiffness
    /// and friction are assumptions; override them with measured values if available.
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

    /// Returns a uniform beam of `length_m` and flexural rigidity `rigidity_nm2` (EI) as `joints` equal links
    /// with flexures at their centres: half a link precedes the first flexure and follows the last. It has a
    /// round tube, no shaft, no burr mass and stops out of reach; everything else is as in [`Self::jhu_27`].
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

    /// Returns the same tool with `links` equal links over its flexible length, 1 to 64.
    ///
    /// The flexible length extends half a pitch beyond the first and the last flexure. Each original
    /// flexure's compliance is spread evenly over its cell, which reaches halfway to both neighbours. A new
    /// flexure gets the compliance of its link and is placed at the centroid of that compliance, so a small
    /// tip load moves the tip as before. The other freedoms' compliances and the rest angles are spread and
    /// summed in the same way.
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
        // Joint stop and tendon gap scale with the length of tube per flexure.
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

    /// Returns the tendons' routes over links between `after` instead of flexures between `before`, m.
    fn routes_over(
        &self,
        before: &[f64],
        after: &[f64],
    ) -> Result<Option<Vec<TendonRoute>>, ManipulatorError> {
        let Some(routes) = &self.tendon_routes else { return Ok(None) };
        let same_m = 1e-9;
        let edge = |flexure: usize| {
            let z_m = before.get(flexure).copied().unwrap_or(f64::NAN);
            after.iter().position(|edge_m| (edge_m - z_m).abs() < same_m).ok_or(
                ManipulatorError::OutOfRange {
                    field: "links",
                    value: (after.len() - 1) as f64,
                    allowed: "a number of links such that tendons begin and end only at link boundaries",
                },
            )
        };
        let moved = |route: &TendonRoute| {
            let to = route.reach.to.map(edge).transpose()?;
            let from = if route.reach.from == 0 { 0 } else { edge(route.reach.from)? };
            Ok(TendonRoute { reach: TendonReach { from, to }, ..*route })
        };
        routes.iter().map(moved).collect::<Result<Vec<_>, _>>().map(Some)
    }

    /// Returns the unloaded bend of flexure `joint`, rad; 0 past the end.
    pub fn rest_rad(&self, joint: usize) -> f64 {
        self.joint_rest_rad.get(joint).copied().unwrap_or(0.0)
    }

    /// Sets the stiffness of every flexure except for bending from notches of this shape in a tube of
    /// `tube_radii_m`. A web's height follows from the distances to the neighbouring flexures.
    pub fn set_notch(&mut self, notch: &Notch) {
        let ratios = notched(notch, &self.joint_positions_m, self.tube_radii_m, self.poisson_ratio);
        self.section = Section::Ratios(ratios);
    }

    /// Returns the stiffness of flexure `joint` in its other freedoms over its bending stiffness; past the
    /// end, that of the last flexure.
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

    /// Returns the distance of the burr's centre from the base, along the straight tool, m.
    pub fn burr_centre_m(&self) -> f64 {
        self.joint_positions_m.last().copied().unwrap_or(0.0) + self.tip_offset_m
    }

    /// Returns the flexible length, from the first flexure to the burr centre, m.
    pub fn flexible_length_m(&self) -> f64 {
        let z = &self.joint_positions_m;
        z.first().zip(z.last()).map_or(0.0, |(first, last)| last - first) + self.tip_offset_m
    }

    /// Returns the maximum radius of the tool excluding the burr, m: that of its tube, or of the outer tube.
    pub fn widest_tube_m(&self) -> f64 {
        self.outer_tube.map_or(self.tube_radii_m[0], |outer| outer.outer_radius_m)
    }

    /// Returns the number of tendons.
    pub fn tendon_count(&self) -> usize {
        self.tendon_routes.as_ref().map_or(2, Vec::len)
    }

    /// Returns the boundaries of the sections of tube that the flexures represent, one more than there are
    /// flexures, m.
    pub(super) fn cell_edges_m(&self) -> Vec<f64> {
        (0..=self.joint_positions_m.len()).map(|edge| self.cell_edge_m(edge)).collect()
    }

    /// Returns one of [`Self::cell_edges_m`]: halfway between two flexures, and the same distance beyond the
    /// outer ones.
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
