//! Converts a tool description to manipulator parameters.

use core::f64::consts::PI;

use scene::{FlexurePlace, ToolDescription, ToolFlexure, ToolOuterTube};

use crate::manipulator::{
    MAX_SHAFT_SPHERES, ManipulatorParameters, Notch, OuterTube, Section, StiffnessRatios, TendonParameters,
    TendonReach, TendonRoute, pitch_m,
};

/// Returns the parameters of a described tool. Anything that the description omits, such as the contact
/// model, comes from the standard tool.
///
/// The bending stiffness of a flexure is the first available of: its own value; that of its notches, `E`
/// times [`Notch::unit_stiffness`]; that of a section of round tube, `k = E I / length` with `I = pi/4
/// (r_o^4 - r_i^4)`. The other freedoms follow from the notches or the tube by [`StiffnessRatios`]. A drive
/// shaft acts in parallel with the tube: see [`beside_shaft`].
pub(super) fn described(tool: &ToolDescription) -> ManipulatorParameters {
    let places = tool.flexures();
    let radii = tool.radii();
    let tube_radii_m = [radii.tube_outer_m, radii.tube_inner_m];
    let joints_m: Vec<f64> = places.iter().map(|place| place.at_mm * 1e-3).collect();
    let first_m = joints_m.first().copied().unwrap_or(0.0);
    let material = Material {
        tube_radii_m,
        poisson_ratio: tool.tube.poisson_ratio,
        youngs_modulus_pa: tool.tube.youngs_modulus_gpa.map_or(0.0, |modulus| modulus * 1e9),
    };
    let density = tool.tube.linear_density_kg_per_m;
    let mut rest: Vec<f64> = places.iter().map(|place| place.flexure.rest_deg * PI / 180.0).collect();
    let (mut joint_stiffness_nm_per_rad, mut ratios): (Vec<f64>, Vec<StiffnessRatios>) =
        (0..places.len()).map(|index| material.flexure(&places, &joints_m, index)).unzip();
    let bending_nm2 = tool.drive_shaft.as_ref().map_or(0.0, |shaft| shaft.bending_stiffness_nm2);
    if bending_nm2 > 0.0 {
        for (index, ratio) in ratios.iter_mut().enumerate() {
            let length_m = ToolDescription::length_mm(&places, index).unwrap_or(f64::INFINITY) * 1e-3;
            let flexure = (&mut joint_stiffness_nm_per_rad[index], &mut rest[index], ratio);
            beside_shaft(bending_nm2 / length_m, flexure);
        }
    }
    let spheres = shaft_spheres(tool, first_m);
    ManipulatorParameters {
        joint_stiffness_nm_per_rad,
        joint_rest_rad: if rest.iter().all(|angle| *angle == 0.0) { Vec::new() } else { rest },
        section: Section::Ratios(ratios),
        poisson_ratio: tool.tube.poisson_ratio,
        joint_limit_rad: tool.stop.angle_deg * PI / 180.0,
        joint_stop_stiffness_nm_per_rad: tool.stop.stiffness_nm_per_rad,
        tip_offset_m: tool.burr.offset_mm * 1e-3,
        linear_density_kg_per_m: density,
        tube_radii_m,
        burr_mass_kg: tool.burr.mass_g / 1e3,
        shaft_mass_kg: tool.shaft.mass_g.map_or(density * first_m, |mass_g| mass_g / 1e3),
        shaft_centre_m: tool.shaft.centre_mm.map_or(0.5 * first_m, |centre_mm| centre_mm / 1e3),
        damping_ratio: tool.damping_ratio,
        mount_stiffness_n_per_m: [tool.mount_stiffness_n_per_m; 3],
        shaft_sphere_count: spheres.count,
        shaft_sphere_span_m: spheres.span_m,
        shaft_sphere_radius_m: radii.tube_outer_m,
        segment_sphere_radius_m: radii.tube_outer_m,
        cutter: radii.cutter,
        tendon: TendonParameters {
            offset_m: 0.0,
            gap_m: tool.tendon_cable.gap_mm / 1e3,
            stiffness_n_per_m: tool.tendon_cable.stiffness_n_per_m,
            friction_coefficient: tool.tendon_cable.friction,
            presliding_m: tool.tendon_cable.presliding_mm / 1e3,
        },
        outer_tube: tool.outer_tube.as_ref().map(outer_tube),
        tendon_routes: Some(tool.tendon.iter().map(route).collect()),
        joint_positions_m: joints_m,
        ..ManipulatorParameters::jhu_27()
    }
}

/// Adds a drive shaft to a flexure: two beams in parallel bend by the same angle, so `k = k_tube + E I /
/// length`, in and across the plane. The shaft slides and turns in the tube, so stretch, shear and torsion
/// remain those of the tube: their ratios to the bending stiffness decrease. The unloaded shaft is straight,
/// and the two rest where their moments cancel: `q_0 = q_tube k_tube / k`.
fn beside_shaft(
    shaft_nm_per_rad: f64,
    (stiffness, rest, ratios): (&mut f64, &mut f64, &mut StiffnessRatios),
) {
    let whole = *stiffness + shaft_nm_per_rad;
    let share = *stiffness / whole;
    *rest *= share;
    *ratios = StiffnessRatios {
        lateral: share * ratios.lateral + shaft_nm_per_rad / whole,
        torsion: share * ratios.torsion,
        axial_per_m2: share * ratios.axial_per_m2,
        shear_toward_per_m2: share * ratios.shear_toward_per_m2,
        shear_across_per_m2: share * ratios.shear_across_per_m2,
    };
    *stiffness = whole;
}

/// Returns an outer tube in SI units; `I = pi/4 (r_o^4 - r_i^4)`.
fn outer_tube(tube: &ToolOuterTube) -> OuterTube {
    let [outer_radius_m, inner_radius_m] =
        [tube.outer_diameter_mm, tube.inner_diameter_mm].map(|mm| mm / 2e3);
    let [outer, inner] = [outer_radius_m, inner_radius_m].map(|r| r * r * r * r);
    let bending_nm2 = tube.youngs_modulus_gpa * 1e9 * 0.25 * PI * (outer - inner);
    OuterTube { end_m: tube.end_mm * 1e-3, outer_radius_m, bending_nm2 }
}

/// Returns a tendon's twist in SI units.
pub(super) fn twist_rad_per_m(twist_deg_per_mm: Option<f64>) -> f64 {
    twist_deg_per_mm.unwrap_or(0.0) * (PI / 180.0) * 1e3
}

fn route(tendon: &scene::ToolTendon) -> TendonRoute {
    TendonRoute {
        channel_m: [tendon.toward_mm / 1e3, tendon.across_mm / 1e3],
        reach: TendonReach { from: tendon.from_flexure - 1, to: tendon.to_flexure },
        twist_rad_per_m: twist_rad_per_m(tendon.twist_deg_per_mm),
        stiffness_n_per_m: tendon.stiffness_n_per_m,
        friction_coefficient: tendon.friction,
    }
}

struct Spheres {
    count: usize,
    span_m: [f64; 2],
}

/// Returns as many spheres as diameters fit, so that neighbours touch; on a long shaft, those next to the
/// flexures.
fn shaft_spheres(tool: &ToolDescription, first_m: f64) -> Spheres {
    let diameter_m = tool.tube.outer_diameter_mm / 1e3;
    let to_m = tool.shaft.contact_to_mm.map_or(first_m, |to_mm| to_mm / 1e3);
    let longest_m = (MAX_SHAFT_SPHERES - 1) as f64 * diameter_m;
    let from_m = tool.shaft.contact_from_mm.map_or((to_m - longest_m).max(0.0), |from_mm| from_mm / 1e3);
    let count = libm::round((to_m - from_m) / diameter_m).max(1.0);
    Spheres { count: (count as usize).min(MAX_SHAFT_SPHERES), span_m: [from_m, to_m] }
}

/// Material and cross-section that determine a flexure's stiffness.
struct Material {
    tube_radii_m: [f64; 2],
    poisson_ratio: f64,
    youngs_modulus_pa: f64,
}

impl Material {
    fn notch(flexure: &ToolFlexure) -> Option<Notch> {
        let (width_mm, past_axis_mm) = flexure.notch_width_mm.zip(flexure.notch_past_axis_mm)?;
        Some(Notch { width_m: width_mm * 1e-3, past_axis_m: past_axis_mm * 1e-3 })
    }

    /// Returns the bending stiffness of a flexure, N m/rad, and the ratios of its other freedoms to it.
    fn flexure(&self, places: &[FlexurePlace], joints_m: &[f64], index: usize) -> (f64, StiffnessRatios) {
        let flexure = places[index].flexure;
        let notched = Material::notch(flexure).map(|notch| {
            notch.unit_stiffness(pitch_m(joints_m, index), self.tube_radii_m, self.poisson_ratio)
        });
        let stiffness_nm_per_rad = match (flexure.stiffness_nm_per_deg, &notched) {
            (Some(own), _) => own * (180.0 / PI),
            (None, Some(unit)) => self.youngs_modulus_pa * unit.bending_nm_per_rad,
            (None, None) => {
                let [outer, inner] = self.tube_radii_m.map(|r| r * r * r * r);
                let length_m = ToolDescription::length_mm(places, index).unwrap_or(f64::INFINITY) * 1e-3;
                self.youngs_modulus_pa * 0.25 * PI * (outer - inner) / length_m
            }
        };
        let tube = || StiffnessRatios::tube(self.tube_radii_m, self.poisson_ratio);
        (stiffness_nm_per_rad, notched.map_or_else(tube, |unit| unit.ratios()))
    }
}
