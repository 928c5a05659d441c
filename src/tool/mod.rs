//! Describes the tool's dimensions.

pub mod response;
pub mod source;

use std::fmt::Write;

use ipc_types::scene::{Cutter, Scene, ToolDriveShaft};
use serde::Serialize;
use simulation::manipulator::ManipulatorParameters;
use simulation::manipulator_parameters;

use crate::failure::Failure;

/// A dimension of the tool.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct Dimension {
    /// Name, ending in the unit.
    pub name: &'static str,
    /// Value.
    pub value: f64,
    /// Description.
    pub text: &'static str,
}

/// Name, value and description of a dimension.
type Entry = (&'static str, f64, &'static str);

/// Returns the length of a burr from front to back, m.
fn length_m(cutter: &Cutter) -> f64 {
    let back_m = cutter.balls().last().map_or(0.0, |ball| ball.radius_m);
    cutter.front_radius_m() + cutter.span_m() + back_m
}

/// Returns the dimensions of a scene's straight tool in its base frame, whose z axis points along the tool
/// from the flange.
pub fn dimensions(scene: &Scene) -> Result<Vec<Dimension>, Failure> {
    let tool = manipulator_parameters(scene).map_err(Failure::bad_input)?;
    let first_m = tool.joint_positions_m.first().copied().unwrap_or(0.0);
    let burr_m = tool.burr_centre_m();
    let joints = tool.joint_positions_m.len();
    let mut all: Vec<Entry> = vec![
        ("length_mm", 1e3 * (burr_m + tool.cutter.front_radius_m()), "from the flange to the burr's front"),
        (
            "burr_centre_mm",
            1e3 * burr_m,
            "from the flange to the burr's centre, which starts at `burr_start_mm`",
        ),
        ("rigid_shaft_mm", 1e3 * first_m, "from the flange to the first flexure; this part does not bend"),
        (
            "flexible_mm",
            1e3 * tool.flexible_length_m(),
            "from the first flexure to the burr's centre; this part bends",
        ),
        (
            "tube_outer_mm",
            2e3 * tool.tube_radii_m[0],
            "outer diameter of the tube; minimum diameter of a pilot hole",
        ),
        ("tube_inner_mm", 2e3 * tool.tube_radii_m[1], "inner diameter of the tube"),
        ("burr_mm", 2e3 * tool.cutter.widest_radius_m(), "largest diameter of the burr"),
        ("burr_length_mm", 1e3 * length_m(&tool.cutter), "from the front of the burr to its back"),
        ("burr_balls", tool.cutter.balls().len() as f64, "number of balls that make up the burr"),
        ("flexures", joints as f64, "number of flexures"),
        (
            "flexure_stop_deg",
            tool.joint_limit_rad.to_degrees(),
            "angle of each flexure at its stop, in either direction",
        ),
        (
            "most_bend_deg",
            joints as f64 * tool.joint_limit_rad.to_degrees(),
            "bend of the whole tool with all flexures at their stops",
        ),
    ];
    if tool.tendon_routes.is_none() {
        all.push((
            "tendon_offset_mm",
            1e3 * tool.tendon.offset_m,
            "distance of the standard pair of tendons from the axis",
        ));
    }
    if let Some(outer) = scene.manipulator.outer_tube() {
        all.extend([
            ("outer_tube_end_mm", outer.end_mm, "from the flange to the end of the outer tube"),
            (
                "outer_tube_outer_mm",
                outer.outer_diameter_mm,
                "outer diameter of the outer tube; minimum diameter of a pilot hole where it enters",
            ),
            ("travel_mm", outer.travel_mm, "maximum length that the tool slides out of the outer tube"),
        ]);
    }
    if let Some(shaft) = scene.manipulator.tool.as_ref().and_then(|tool| tool.drive_shaft.as_ref()) {
        all.extend(drive_shaft(shaft, &tool, scene.manipulator.burr_stall_torque_nmm));
    }
    Ok(all.into_iter().map(|(name, value, text)| Dimension { name, value, text }).collect())
}

/// Adds the dimensions of the drive shaft and the resulting properties of the burr.
fn drive_shaft(
    shaft: &ToolDriveShaft,
    tool: &ManipulatorParameters,
    scene_stall_nmm: Option<f64>,
) -> Vec<Entry> {
    let mut all = Vec::new();
    if shaft.bending_stiffness_nm2 > 0.0 {
        let text = "bending stiffness E I of the drive shaft, which adds to that of each flexure";
        all.push(("shaft_bending_nmm2", 1e6 * shaft.bending_stiffness_nm2, text));
    }
    if let Some(torsional_nm2) = shaft.torsional_stiffness_nm2 {
        let length_m = shaft.length_mm.map_or(tool.burr_centre_m(), |mm| mm * 1e-3);
        let inertia_kg_m2 = tool.burr_mass_kg * tool.cutter.solid().along_m2;
        let frequency_hz = (torsional_nm2 / length_m / inertia_kg_m2).sqrt() / core::f64::consts::TAU;
        let wind_up_deg = (1e-3 * length_m / torsional_nm2).to_degrees();
        all.push(("shaft_wind_up_deg", wind_up_deg, "wind-up of the drive shaft under 1 N mm"));
        all.push(("shaft_torsion_hz", frequency_hz, "torsional oscillation of the burr on the shaft"));
    }
    if let Some(stall_nmm) = scene_stall_nmm.or(shaft.stall_torque_nmm) {
        all.push(("stall_torque_nmm", stall_nmm, "stall torque of the burr's motor"));
    }
    if shaft.friction_torque_nmm > 0.0 {
        let text = "friction torque of the drive shaft in the tube";
        all.push(("shaft_friction_nmm", shaft.friction_torque_nmm, text));
    }
    all
}

/// Formats the dimensions as a section of the scene reference.
pub fn reference(scene: &Scene) -> Result<String, Failure> {
    let mut text = "\n## The tool's dimensions\n\nDimensions of the standard tool; `trabecula tool show SCENE` prints those of a scene's own tool. Distances are along the straight tool.\n\n\
                    | dimension | value | meaning |\n|---|---|---|\n"
        .to_owned();
    for Dimension { name, value, text: what } in dimensions(scene)? {
        // Writing to a string cannot fail.
        let _ = writeln!(text, "| `{name}` | {} | {what} |", rounded(value));
    }
    Ok(text)
}

/// Rounds a value to a hundredth.
pub fn rounded(value: f64) -> f64 {
    (value * 100.0).round() / 100.0
}
