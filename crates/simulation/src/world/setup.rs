//! Converts a scene to the components' parameters, in SI units.

use std::sync::Arc;

use messages::{ControllerIndex, State};
use nalgebra::{Isometry3, Matrix3, Rotation3, Translation3, UnitQuaternion, Vector3};
use scene::{
    Body, BodyMotion as SceneMotion, ContactVoxels as SceneContactVoxels, Cutter, DrillingLaw, Drives,
    Integrator as SceneIntegrator, ManipulatorRung, Removal as SceneRemoval, Scene, StartShape, Tool,
    ToolDriveShaft,
};

use super::burr_drive::{BurrDrive, BurrDriveState};
use super::drive_shaft::Torsion;
use super::move_tool::PLANES_PER_SPHERE;
use super::structures::StructureWatch;
use super::tendon_drive::TendonDrive;
use super::tool::{described, twist_rad_per_m};
use super::tube_drive::TubeDrive;
use super::{Bone, Driver, Hounsfield, Simulation, SimulationError, ToolEffort};
use crate::arm::{Arm, ArmParameters, Compliance, ComplianceParameters, initial_q_rad, place_base_for};
use crate::bone::twist_drill::{DrillPoint, TwistDrillLaw};
use crate::bone::{
    BoneField, BoneParameters, ContactBuffer, ContactKind, CuttingLaw, GridGeometry, Outside, Removal,
    VoxelIndex,
};
use crate::manipulator::{
    AnyManipulator, BaseMotion, Integrator, ManipulatorError, ManipulatorModel, ManipulatorParameters, Notch,
    Rung, TendonRoute,
};
use crate::rigid::{BodyMotion, BodyParameters, BodyShape, RigidScene};

const RAD_PER_DEG: f64 = core::f64::consts::PI / 180.0;

pub(super) fn build<'v>(
    scene: &Scene,
    ct: Option<(GridGeometry, Hounsfield<'v>)>,
) -> Result<Simulation<'v>, SimulationError> {
    let given = scene;
    let scene = &scene.as_it_is();
    let parameters = manipulator_parameters(scene)?;
    let t_world_base = tool_base(&scene.tool, &parameters);
    let arm = arm(scene, &t_world_base)?;
    // Use the arm's own forward kinematics, so that tick 1 does not start with a jump from rounding.
    let base = BaseMotion::at_rest(arm.state().t_world_tool);
    let cutter = parameters.cutter;
    let burr_drive = burr_drive(scene, &parameters);
    let compliance = compliance(scene, arm.parameters(), &parameters)?;
    let mut manipulator =
        AnyManipulator::new(rung(scene.manipulator.model.unwrap_or_default()), parameters, &base)?;
    if scene.tool.start_shape == Some(StartShape::Straight) {
        manipulator.straighten();
    }
    let sphere_count = manipulator.proxy_spheres().len();
    let (bone, predrilled) = match (&scene.volume, ct) {
        (None, _) => (None, Vec::new()),
        (Some(_), None) => return Err(SimulationError::VolumeMissing),
        (Some(_), Some(ct)) => {
            let (bone, predrilled) = bone(scene, ct, &cutter, PLANES_PER_SPHERE * sphere_count)?;
            (Some(bone), predrilled)
        }
    };
    let structure_watch = StructureWatch::new(given, bone.as_ref().map(|bone| &bone.outside))?;
    let has_fixture = structure_watch.fixture.is_some();
    let rigid = if scene.body.is_empty() {
        None
    } else {
        let bodies: Vec<BodyParameters> = scene.body.iter().map(body).collect();
        let gravity_m_per_s2 = Vector3::from(scene.gravity_m_per_s2);
        Some(RigidScene::new(&bodies, &gravity_m_per_s2, scene.dt_s(), sphere_count)?)
    };
    Ok(Simulation {
        dt_s: scene.dt_s(),
        max_flange_force_n: arm.parameters().protective_stop_n,
        arm,
        compliance,
        reach: vec![super::SearchRange::none(); sphere_count],
        effort: ToolEffort::default(),
        before: manipulator.snapshot(),
        manipulator,
        bone,
        rigid,
        driven_bodies: core::array::from_fn(|index| driven_body(scene, index)),
        tendon_controller: ControllerIndex::first(scene.controller.len())
            .find(|index| scene.controller[index.slot()].drives.contains(&Drives::Tendon)),
        planes: Vec::with_capacity(sphere_count * (PLANES_PER_SPHERE + scene.body.len())),
        tendon: TendonDrive::new(has_fixture),
        tube: scene.manipulator.outer_tube().map(TubeDrive::new),
        burr_drive,
        burr_speed_rad_per_s: 0.0,
        cutting_energy_j: 0.0,
        crushing_energy_j: 0.0,
        receding: super::RecessionState::default(),
        indentations: Vec::with_capacity(PLANES_PER_SPHERE * sphere_count),
        burr_contacts: Vec::with_capacity(PLANES_PER_SPHERE * cutter.balls().len()),
        balls_behind: Vec::with_capacity(cutter.balls().len()),
        uncut_voxels: 0,
        bone_is_frozen: false,
        left_out_contacts: 0,
        sensors: sensors::SensorArray::new(scene),
        state: State::zeroed(),
        predrilled,
        refusals: Vec::with_capacity(4 * messages::MAX_CONTROLLERS + 3),
        holder: scene.arm.holder(),
        arm_watch: super::ArmWatch::default(),
        breach_watch: super::BreachWatch::default(),
        structure_watch,
        arm_driver: Driver::default(),
        burr_driver: Driver::default(),
        tendon_driver: Driver::default(),
        arm_fault: None,
        initial: None,
    })
}

fn burr_drive(scene: &Scene, tool: &ManipulatorParameters) -> BurrDrive {
    let standard = CuttingLaw::default().cutting_friction;
    let shaft = scene.manipulator.tool.as_ref().and_then(|tool| tool.drive_shaft.as_ref());
    let own_stall_nmm = scene.manipulator.burr_stall_torque_nmm;
    BurrDrive {
        stall_torque_nm: own_stall_nmm
            .or_else(|| shaft.and_then(|shaft| shaft.stall_torque_nmm))
            .map(|torque| torque * 1e-3),
        stall_key: match own_stall_nmm {
            Some(_) => "manipulator.burr_stall_torque_nmm",
            None => "drive_shaft.stall_torque_nmm",
        },
        friction_torque_nm: shaft.map_or(0.0, |shaft| shaft.friction_torque_nmm * 1e-3),
        torsion: shaft.and_then(|shaft| torsion(shaft, tool)),
        side_force: scene.drilling.side_force.unwrap_or(false),
        cutting_coefficient: cutting_coefficient(scene).unwrap_or(standard),
        state: BurrDriveState::default(),
    }
}

/// Returns the shaft as a spring `G J / length` with the burr at its end; the damping is a fraction of `2
/// sqrt(k J)`.
fn torsion(shaft: &ToolDriveShaft, tool: &ManipulatorParameters) -> Option<Torsion> {
    let length_m = shaft.length_mm.map_or(tool.burr_centre_m(), |mm| mm * 1e-3);
    let stiffness_nm_per_rad = shaft.torsional_stiffness_nm2? / length_m;
    let inertia_kg_m2 = tool.burr_mass_kg * tool.cutter.solid().along_m2;
    Some(Torsion {
        stiffness_nm_per_rad,
        damping_nms_per_rad: 2.0
            * shaft.torsional_damping_ratio
            * libm::sqrt(stiffness_nm_per_rad * inertia_kg_m2),
        inertia_kg_m2,
    })
}

/// Returns the scene's cutting coefficient, or else that of its tool's burr, or else that of its law.
fn cutting_coefficient(scene: &Scene) -> Option<f64> {
    let of_tool = || scene.manipulator.tool.as_ref().and_then(|tool| tool.burr.cutting_coefficient);
    let of_law = || Some(TwistDrillLaw::default().cutting_coefficient(&drill_point(scene)?));
    scene.drilling.cutting_coefficient.or_else(of_tool).or_else(of_law)
}

/// Returns the point of the scene's drill if its law is that of a twist drill.
fn drill_point(scene: &Scene) -> Option<DrillPoint> {
    let burr = &scene.manipulator.tool.as_ref()?.burr;
    match (scene.drilling.law?, burr.tip_diameter_mm, burr.point_deg) {
        (DrillingLaw::TwistDrill, Some(chisel_mm), Some(point_deg)) => Some(DrillPoint {
            radius_m: burr.diameter_mm * 0.5e-3,
            chisel_radius_m: chisel_mm * 0.5e-3,
            point_deg,
            rake_deg: burr.rake_deg.unwrap_or(DrillPoint::STANDARD_RAKE_DEG),
        }),
        _ => None,
    }
}

/// Returns the rung for a scene's `manipulator.model`.
pub fn rung(name: ManipulatorRung) -> Rung {
    match name {
        ManipulatorRung::ConstantCurvature => Rung::ConstantCurvature,
        ManipulatorRung::Modal => Rung::Modal,
        ManipulatorRung::Planar => Rung::Planar,
        ManipulatorRung::Spatial => Rung::Spatial,
        ManipulatorRung::Full => Rung::Full,
    }
}

/// Returns the scene's tool, or the standard one, with the scene's overrides.
///
/// # Errors
/// The manipulator rejects the number of links, or a value derived from the tool description.
pub fn manipulator_parameters(scene: &Scene) -> Result<ManipulatorParameters, ManipulatorError> {
    let overrides = &scene.manipulator;
    let mut parameters = overrides.tool.as_ref().map_or_else(|| standard(overrides), described);
    if let Some(links) = overrides.links {
        parameters = parameters.with_links(links)?;
    }
    parameters.lateral_stiffness_ratio = overrides.lateral_stiffness_ratio;
    parameters.torsion_stiffness_ratio = overrides.torsion_stiffness_ratio;
    if let Some(friction) = overrides.tendon_friction {
        parameters.tendon.friction_coefficient = friction;
        parameters.tendon_routes.iter_mut().flatten().for_each(|route| route.friction_coefficient = None);
    }
    if !scene.tendon.is_empty() {
        let routes = scene.tendon.iter().map(|it| TendonRoute {
            twist_rad_per_m: twist_rad_per_m(it.twist_deg_per_mm),
            ..TendonRoute::from([it.toward_mm * 1e-3, it.across_mm * 1e-3])
        });
        parameters.tendon_routes = Some(routes.collect());
    }
    if let Some(modes) = overrides.modes {
        parameters.moment_modes = modes;
    }
    if let Some(ratio) = overrides.damping_ratio {
        parameters.damping_ratio = ratio;
    }
    if let Some(scale) = overrides.stiffness_scale {
        parameters.joint_stiffness_nm_per_rad.iter_mut().for_each(|k| *k *= scale);
    }
    if let Some(scale) = overrides.mass_scale {
        parameters.linear_density_kg_per_m *= scale;
        parameters.burr_mass_kg *= scale;
        parameters.shaft_mass_kg *= scale;
    }
    if let Some(stiffness) = overrides.mount_stiffness_n_per_m {
        parameters.mount_stiffness_n_per_m = [stiffness; 3];
    }
    parameters.cutter = overrides.radii().cutter;
    parameters.gravity_m_per_s2 = Vector3::from(scene.gravity_m_per_s2);
    parameters.integrator = match overrides.integrator.unwrap_or_default() {
        SceneIntegrator::LinearlyImplicitEuler => Integrator::LinearlyImplicitEuler,
        SceneIntegrator::Hybrid => Integrator::Hybrid,
    };
    if let Some(friction) = scene.contact.friction {
        parameters.contact.friction_coefficient = friction;
    }
    if let Some(stiffness) = scene.contact.stiffness_n_per_m {
        parameters.contact.stiffness_n_per_m = stiffness;
    }
    Ok(parameters)
}

/// Returns the standard tool with the scene's notch overrides.
fn standard(overrides: &scene::Manipulator) -> ManipulatorParameters {
    let mut parameters = ManipulatorParameters::jhu_27();
    parameters.set_notch(&Notch {
        width_m: overrides.notch_width_mm.map_or(Notch::JHU.width_m, |mm| mm * 1e-3),
        past_axis_m: overrides.notch_past_axis_mm.map_or(Notch::JHU.past_axis_m, |mm| mm * 1e-3),
    });
    parameters
}

/// Returns the base pose of the straight tool whose burr is at the scene's start position.
fn tool_base(tool: &Tool, parameters: &ManipulatorParameters) -> Isometry3<f64> {
    let along = Vector3::from(tool.direction).normalize();
    let toward = Vector3::from(tool.bend_toward);
    let bend = (toward - along * toward.dot(&along)).normalize();
    let across = along.cross(&bend);
    let turn = Rotation3::from_matrix_unchecked(Matrix3::from_columns(&[bend, across, along]));
    let origin = Vector3::from(tool.burr_start_mm) * 1e-3 - along * parameters.burr_centre_m();
    Isometry3::from_parts(Translation3::from(origin), UnitQuaternion::from_rotation_matrix(&turn))
}

/// Returns the body that a controller of the scene drives.
fn driven_body(scene: &Scene, controller: usize) -> Option<usize> {
    let name = scene.controller.get(controller)?.body.as_ref()?;
    scene.body.iter().position(|body| body.name == *name)
}

/// Returns a body in SI units.
fn body(body: &Body) -> BodyParameters {
    let shape = if let Some(cuboid) = &body.cuboid {
        BodyShape::Box { half_extents_m: Vector3::from(cuboid.half_extents_mm) * 1e-3 }
    } else if let Some(capsule) = &body.capsule {
        BodyShape::Capsule {
            half_height_m: capsule.half_height_mm * 1e-3,
            radius_m: capsule.radius_mm * 1e-3,
        }
    } else {
        // A scene body has exactly one shape; the rigid scene rejects a radius of 0.
        BodyShape::Ball { radius_m: body.ball.as_ref().map_or(0.0, |ball| ball.radius_mm * 1e-3) }
    };
    let turn_rad = Vector3::from(body.rotation_vector_deg) * RAD_PER_DEG;
    let t_world_body = Isometry3::from_parts(
        Translation3::from(Vector3::from(body.position_mm) * 1e-3),
        UnitQuaternion::from_scaled_axis(turn_rad),
    );
    let motion = match body.motion {
        SceneMotion::Fixed => BodyMotion::Fixed,
        SceneMotion::Free => BodyMotion::Free,
        SceneMotion::Driven => BodyMotion::Driven,
    };
    let (density_kg_per_m3, friction) = (body.density_kg_per_m3, body.friction);
    BodyParameters { name: body.name.clone(), shape, t_world_body, motion, density_kg_per_m3, friction }
}

fn arm(scene: &Scene, t_world_tool: &Isometry3<f64>) -> Result<Arm, SimulationError> {
    let mut parameters = ArmParameters::of(&scene.arm, scene.dt_s());
    let joints = initial_q_rad(&scene.arm);
    parameters.t_world_arm_base = place_base_for(&parameters.geometry, t_world_tool, &joints);
    Ok(Arm::new(parameters, &joints)?)
}

/// Number of contacts that may resist a displacement of the tool base at once: two on each side of a tunnel.
const CONTACTS_AT_ONCE: f64 = 4.0;

fn compliance(
    scene: &Scene,
    arm: &ArmParameters,
    tool: &ManipulatorParameters,
) -> Result<Option<Compliance>, SimulationError> {
    // In a checked scene, only arms with known links have elastic joints.
    let (Some(given), Some(links)) = (&scene.arm.compliance, arm.links) else { return Ok(None) };
    let mount = tool.mount_stiffness_n_per_m.into_iter().fold(0.0, f64::max);
    let first_m = tool.joint_positions_m.first().copied().unwrap_or(0.0);
    let last_m = tool.joint_positions_m.last().copied().unwrap_or(0.0);
    let mass_kg = tool.shaft_mass_kg + tool.burr_mass_kg + tool.linear_density_kg_per_m * (last_m - first_m);
    let parameters = ComplianceParameters {
        links,
        stiffness_nm_per_rad: given.joint_stiffness_nm_per_rad,
        damping_nms_per_rad: given.joint_damping_nms_per_rad,
        tool_stiffness_n_per_m: mount + CONTACTS_AT_ONCE * tool.contact.stiffness_n_per_m,
        tool_damping_n_s_per_m: 2.0 * tool.mount_damping_ratio * libm::sqrt(mount * mass_kg),
        tool_length_m: tool.burr_centre_m(),
    };
    Ok(Some(Compliance::new(parameters)?))
}

fn bone<'v>(
    scene: &Scene,
    (geometry, hu): (GridGeometry, Hounsfield<'v>),
    cutter: &Cutter,
    most_planes: usize,
) -> Result<(Bone<'v>, Vec<u32>), SimulationError> {
    let (max_burr_radius_m, cutter_span_m) = (cutter.widest_radius_m(), cutter.span_m());
    let mut parameters = BoneParameters { max_burr_radius_m, cutter_span_m, ..BoneParameters::default() };
    if let Some(volume) = &scene.volume {
        parameters.threshold_hu = volume.bone_threshold_hu;
    }
    let drilling = &scene.drilling;
    if let Some(reach_mm) = drilling.reach_mm {
        parameters.cutting.reach_m = reach_mm * 1e-3;
    }
    if let Some(feed_mm) = drilling.feed_per_revolution_mm {
        parameters.cutting.feed_per_revolution_max_m = feed_mm * 1e-3;
    }
    let hole_m = max_burr_radius_m + parameters.cutting.reach_m;
    if let Some(point) = drill_point(scene) {
        let (material, cutting) = (&mut parameters.material, &mut parameters.cutting);
        TwistDrillLaw::default().apply(&point, hole_m, material, cutting);
    }
    if let Some(energy) = drilling.specific_energy_j_per_mm3 {
        parameters.material.specific_energy_ref_j_m3 = energy * 1e9;
    }
    if let Some(exponent) = drilling.density_exponent {
        parameters.material.exponent = exponent;
    }
    if let Some(coefficient) = cutting_coefficient(scene) {
        parameters.cutting.cutting_friction = coefficient;
    }
    if let Some(pressure) = drilling.edge_pressure_mpa {
        parameters.material.edge_pressure_ref_pa = pressure * 1e6;
    }
    if let Some(force) = drilling.edge_force_n_per_mm {
        // Distributed over the cross-section of the hole, pi r^2, that is its diameter times the force: 2 r e
        // / (pi r^2).
        parameters.material.edge_pressure_ref_pa = 2.0 * force * 1e3 / (core::f64::consts::PI * hole_m);
    }
    if let Some(exponent) = drilling.edge_exponent {
        parameters.material.edge_exponent = exponent;
    }
    if let Some(strength) = scene.contact.strength_mpa {
        parameters.material.strength_ref_pa = strength * 1e6;
    }
    if let Some(exponent) = scene.contact.strength_exponent {
        parameters.material.strength_exponent = exponent;
    }
    parameters.contact = contact_kind(scene.contact.voxels);
    parameters.removal = match drilling.removal {
        Some(SceneRemoval::Naive) => Removal::Naive,
        Some(SceneRemoval::Capped) => Removal::Capped,
        Some(SceneRemoval::Decrement) => Removal::Decrement,
        Some(SceneRemoval::Energy) | None => Removal::Energy,
    };
    let mut field = BoneField::new(geometry, &hu, parameters)?;
    let mut predrilled = Vec::new();
    for hole in &scene.predrill {
        let [from, to] = [hole.from_mm, hole.to_mm].map(|end| Vector3::from(end) * 1e-3);
        let removed = field.predrill_capsule(&from, &to, hole.diameter_mm * 0.5e-3);
        predrilled.extend(removed.into_iter().map(VoxelIndex::number));
    }
    predrilled.sort_unstable();
    let mut contacts = ContactBuffer::with_capacity(most_planes);
    contacts.make_room(field.voxels());
    let outside = Arc::new(Outside::new(geometry, &hu, parameters.threshold_hu));
    Ok((Bone { hu, field, contacts, outside }, predrilled))
}

/// Returns the contact kind that a scene's `contact.voxels` selects.
pub fn contact_kind(voxels: Option<SceneContactVoxels>) -> ContactKind {
    match voxels.unwrap_or_default() {
        SceneContactVoxels::Balls => ContactKind::VoxelBalls,
        SceneContactVoxels::Planes => ContactKind::Planes,
    }
}
