//! The named arm models, and the conversion of a scene's `[arm]` to parameters.
//!
//! Lengths, masses and centres of mass: Universal Robots, "DH Parameters for calculations of kinematics and
//! dynamics" (support article; UR20 from its data sheet). Inertias and joint limits:
//! Universal_Robots_ROS2_Description, `config/<arm>/physical_parameters.yaml` and `joint_limits.yaml`; those
//! of the UR3 and UR5 are cylinder approximations from that file. Its link frames are converted to
//! Denavit-Hartenberg frames here. Payloads: Universal Robots, technical specifications.

use super::gantry::GantryGeometry;
use super::geometry::ArmGeometry;
use super::kinematics::{Joints, UR_JOINTS, UrGeometry, with_seventh};
use super::parameters::{ArmParameters, COMFORTABLE_Q_RAD, CartesianLimits, JointLimits};
use super::serial::{SerialGeometry, SerialJoint};
use messages::MAX_ARM_JOINTS;
use nalgebra::{Isometry3, Matrix3, Vector3};
use scene::{ArmJoint, ArmModel};
use std::f64::consts::{PI, TAU};

const RAD_PER_DEG: f64 = PI / 180.0;

/// Assumed acceleration and jerk limits, since none are published; with these, a joint reaches full
/// acceleration in 0.1 s.
const ACCELERATION_RAD_S2: f64 = 5.0;
const JERK_RAD_S3: f64 = 50.0;

/// Default travel of a gantry's axes to either side of the start: enough for a femur of half a metre.
const GANTRY_TRAVEL_MM: [f64; 3] = [250.0; 3];
/// Range of unused joints, which stay at 0, rad or m.
const NO_TRAVEL: f64 = 1e-9;

/// Speed of unused joints; the motion planner needs a value above 0.
const NO_SPEED_DEG_S: f64 = 1.0;
/// Joint whose angle KUKA (E1) and Franka (elbow) use as the redundancy parameter of seven joints, from 0.
const THIRD: usize = 2;

/// Inertial data of a link: mass, centre of mass in its Denavit-Hartenberg frame, and inertia about that
/// frame's axes through the centre of mass.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Link {
    /// Mass.
    pub mass_kg: f64,
    /// Centre of mass in the link's frame.
    pub centre_m: [f64; 3],
    /// Inertia components xx, yy, zz, xy, xz, yz.
    pub inertia_kg_m2: [f64; 6],
}

impl Link {
    /// Returns the inertia tensor, kg m².
    pub(super) fn inertia(&self) -> Matrix3<f64> {
        let [xx, yy, zz, xy, xz, yz] = self.inertia_kg_m2;
        Matrix3::new(xx, xy, xz, xy, yy, yz, xz, yz, zz)
    }
}

const fn link(mass_kg: f64, centre_m: [f64; 3], inertia_kg_m2: [f64; 6]) -> Link {
    Link { mass_kg, centre_m, inertia_kg_m2 }
}

/// Returns a link with principal axes along its frame.
const fn plain(mass_kg: f64, centre_m: [f64; 3], [xx, yy, zz]: [f64; 3]) -> Link {
    link(mass_kg, centre_m, [xx, yy, zz, 0.0, 0.0, 0.0])
}

/// Force on the flange at which an arm stops, N: `Default` of the general safety limits that a UR5 of the CB3
/// series is delivered with (user manual CB3, General Limits; `Least Restricted` is 250 N). The other arms of
/// Universal Robots are taken to be set like it.
const PROTECTIVE_STOP_N: f64 = 150.0;

/// Published data of a Universal Robots arm.
struct Published {
    geometry: UrGeometry,
    velocity_deg_s: [f64; UR_JOINTS],
    payload_kg: f64,
    links: [Link; UR_JOINTS],
}

const fn lengths([d1_m, a2_m, a3_m, d4_m, d5_m, d6_m]: [f64; 6]) -> UrGeometry {
    UrGeometry { d1_m, a2_m, a3_m, d4_m, d5_m, d6_m, t_flange_tool: None }
}

const UR3: Published = Published {
    geometry: lengths([0.1519, -0.24365, -0.21325, 0.11235, 0.08535, 0.0819]),
    velocity_deg_s: [180.0, 180.0, 180.0, 360.0, 360.0, 360.0],
    payload_kg: 3.0,
    links: [
        plain(2.0, [0.0, -0.02, 0.0], [0.008_093_167, 0.005_625, 0.008_093_167]),
        plain(3.42, [0.13, 0.0, 0.1157], [0.009_618_75, 0.021_728_492, 0.021_728_492]),
        plain(1.26, [0.05, 0.0, 0.0238], [0.003_543_75, 0.006_546_809, 0.006_546_809]),
        plain(0.8, [0.0, 0.0, 0.01], [0.001_610_641_5, 0.002_25, 0.001_610_641_5]),
        plain(0.8, [0.0, 0.0, 0.01], [0.001_572_174, 0.002_25, 0.001_572_174]),
        plain(0.35, [0.0, 0.0, -0.02], [1.362_667e-4, 1.362_667e-4, 1.792e-4]),
    ],
};

const UR3E: Published = Published {
    geometry: lengths([0.15185, -0.24355, -0.2132, 0.13105, 0.08535, 0.0921]),
    velocity_deg_s: [180.0, 180.0, 180.0, 360.0, 360.0, 360.0],
    payload_kg: 3.0,
    links: [
        link(1.98, [0.0, -0.02, 0.0], [2.7657e-3, 2.1501e-3, 2.5626e-3, 9.6e-6, -1.49e-5, 1.873e-4]),
        link(
            3.4445,
            [0.13, 0.0, 0.1157],
            [4.2623e-3, 0.046_028_4, 0.044_894_7, -4.09e-5, -1.496e-3, -1.29e-5],
        ),
        link(1.437, [0.05, 0.0, 0.0238], [1.0511e-3, 0.011_339_6, 0.011_089_5, 0.0, -3.31e-5, 2.2e-6]),
        link(0.871, [0.0, 0.0, 0.01], [8.174e-4, 6.844e-4, 5.497e-4, -5e-7, 2.1e-6, 6.17e-5]),
        link(0.805, [0.0, 0.0, 0.01], [6.059e-4, 5.837e-4, 3.831e-4, -6e-7, -6e-7, -2.71e-5]),
        link(0.261, [0.0, 0.0, -0.02], [1.08e-4, 1.086e-4, 1.371e-4, -1e-7, -1e-7, -2e-7]),
    ],
};

const UR5: Published = Published {
    geometry: UrGeometry::ur5(),
    velocity_deg_s: [180.0; 6],
    payload_kg: 5.0,
    links: [
        plain(3.7, [0.0, -0.02561, 0.00193], [0.014_972_358, 0.010_406_25, 0.014_972_358]),
        plain(8.393, [0.2125, 0.0, 0.11336], [0.015_107_4, 0.133_885_835, 0.133_885_835]),
        plain(2.33, [0.15, 0.0, 0.0265], [0.004_095, 0.031_216_804, 0.031_216_804]),
        plain(1.219, [0.0, -0.0018, 0.01634], [0.002_013_890, 0.002_194_2, 0.002_013_890]),
        plain(1.219, [0.0, 0.0018, 0.01634], [0.001_831_040, 0.002_194_2, 0.001_831_040]),
        plain(0.1879, [0.0, 0.0, -0.001159], [8.062_476e-5, 8.062_476e-5, 1.321_172e-4]),
    ],
};

const UR5E: Published = Published {
    geometry: lengths([0.1625, -0.425, -0.3922, 0.1333, 0.0997, 0.0996]),
    velocity_deg_s: [180.0; 6],
    payload_kg: 5.0,
    links: [
        link(
            3.761,
            [0.0, -0.02561, 0.00193],
            [7.0021e-3, 6.480_91e-3, 6.572_86e-3, 7.3e-7, -1.053e-5, 4.9994e-4],
        ),
        link(
            8.058,
            [0.2125, 0.0, 0.11336],
            [0.015_058_85, 0.333_880_86, 0.332_472_07, -5.4e-5, 5.63e-6, -1.81e-6],
        ),
        link(
            2.846,
            [0.15, 0.0, 0.0265],
            [3.996_32e-3, 0.078_792_54, 0.078_485_1, -1.365e-5, 1.372_72e-3, -6.6e-6],
        ),
        link(
            1.37,
            [0.0, -0.0018, 0.01634],
            [1.654_91e-3, 1.359_62e-3, 1.262_79e-3, -2.82e-6, -4.38e-6, 1.0157e-4],
        ),
        link(
            1.3,
            [0.0, 0.0018, 0.01634],
            [1.356_17e-3, 1.278_27e-3, 9.6614e-4, -2.74e-6, 4.44e-6, -5.048e-5],
        ),
        link(0.365, [0.0, 0.0, -0.001159], [1.8694e-4, 1.8908e-4, 2.5756e-4, 6e-8, -1.7e-7, -9.2e-7]),
    ],
};

const UR10E: Published = Published {
    geometry: lengths([0.1807, -0.6127, -0.57155, 0.17415, 0.11985, 0.11655]),
    velocity_deg_s: [120.0, 120.0, 180.0, 180.0, 180.0, 180.0],
    payload_kg: 12.5,
    links: [
        link(7.369, [0.021, 0.0, 0.027], [0.034_08, 0.035_29, 0.021_56, 2e-5, -4.25e-3, 8e-5]),
        link(13.051, [0.38, 0.0, 0.158], [0.028_14, 0.770_68, 0.769_43, 5e-5, -0.015_61, 2e-5]),
        link(3.989, [0.24, 0.0, 0.068], [0.010_14, 0.309_28, 0.306_46, 8e-5, 9.16e-3, 0.0]),
        link(2.1, [0.0, 0.007, 0.018], [2.96e-3, 2.22e-3, 2.58e-3, -1e-5, 0.0, -2.4e-4]),
        link(1.98, [0.0, 0.007, 0.018], [2.96e-3, 2.22e-3, 2.58e-3, -1e-5, 0.0, -2.4e-4]),
        link(0.615, [0.0, 0.0, -0.026], [4e-4, 4.1e-4, 3.4e-4, 0.0, 0.0, 0.0]),
    ],
};

const UR16E: Published = Published {
    geometry: lengths([0.1807, -0.4784, -0.36, 0.17415, 0.11985, 0.11655]),
    velocity_deg_s: [120.0, 120.0, 180.0, 180.0, 180.0, 180.0],
    payload_kg: 16.0,
    links: [
        link(7.369, [0.0, -0.016, 0.03], [0.033_51, 0.033_74, 0.021, 2e-5, -1e-5, 3.74e-3]),
        link(10.45, [0.302, 0.0, 0.16], [0.027_96, 0.475_58, 0.476_35, -1e-4, -7.2e-3, 3e-5]),
        link(4.321, [0.194, 0.0, 0.065], [0.010_91, 0.1206, 0.117_14, 6e-5, 0.010_12, 1e-5]),
        link(2.18, [0.0, -0.009, 0.011], [6.09e-3, 2.45e-3, 5.79e-3, -1e-5, 0.0, 8.3e-4]),
        link(2.033, [0.0, 0.018, 0.012], [3.89e-3, 2.19e-3, 3.63e-3, -1e-5, 0.0, -4.5e-4]),
        link(0.907, [0.0, 0.0, -0.044], [1.17e-3, 1.18e-3, 8.4e-4, 0.0, 0.0, 0.0]),
    ],
};

const UR20: Published = Published {
    geometry: lengths([0.2363, -0.862, -0.7287, 0.201, 0.1593, 0.1543]),
    velocity_deg_s: [120.0, 120.0, 150.0, 210.0, 210.0, 210.0],
    payload_kg: 20.0,
    links: [
        link(16.343, [0.0, -0.061, 0.0062], [0.088_66, 0.076_32, 0.084_18, -1.1e-4, -1.1e-4, 7.2e-3]),
        link(29.632, [0.5226, 0.0, 0.2098], [0.1467, 4.6659, 4.6348, 1.9e-4, -0.051_63, 4e-5]),
        link(7.879, [0.3234, 0.0, 0.0604], [0.026_12, 0.757_63, 0.753_27, -5e-5, -0.028_98, -1e-5]),
        link(3.054, [0.0, -0.0026, 0.0393], [5.55e-3, 5.37e-3, 4.02e-3, -1e-5, -2e-5, 3.6e-4]),
        link(3.126, [0.0, 0.0024, 0.0379], [5.86e-3, 5.78e-3, 4.27e-3, -1e-5, -2e-5, -3.7e-4]),
        link(0.926, [0.0, 0.0, -0.0293], [9.2e-4, 9.1e-4, 1.17e-3, 0.0, 0.0, 0.0]),
    ],
};

impl UrGeometry {
    /// Returns the UR5, from Universal Robots' published "DH Parameters for calculations of kinematics and
    /// dynamics".
    pub const fn ur5() -> Self {
        lengths([0.089159, -0.425, -0.39225, 0.10915, 0.09465, 0.0823])
    }
}

/// Returns the published data of a named arm; `None` for a bench.
fn published(model: ArmModel) -> Option<&'static Published> {
    match model {
        ArmModel::Ur3 => Some(&UR3),
        ArmModel::Ur3e => Some(&UR3E),
        ArmModel::Ur5 => Some(&UR5),
        ArmModel::Ur5e => Some(&UR5E),
        ArmModel::Ur10e => Some(&UR10E),
        ArmModel::Ur16e => Some(&UR16E),
        ArmModel::Ur20 => Some(&UR20),
        ArmModel::Gantry | ArmModel::Fixed => None,
    }
}

impl ArmParameters {
    /// Returns the arm that a scene describes, its base at the world's origin.
    pub fn of(arm: &scene::Arm, dt_s: f64) -> Self {
        let mut parameters = match &arm.joint {
            Some(joints) => Self::serial(joints, arm.redundant_joint.as_deref(), dt_s),
            None => Self::named(arm.model.unwrap_or_default(), dt_s),
        };
        if arm.tool_position_mm != [0.0; 3] || arm.tool_rotation_vector_deg != [0.0; 3] {
            parameters.geometry = parameters.geometry.with_tool(Some(Isometry3::new(
                Vector3::from(arm.tool_position_mm) * 1e-3,
                Vector3::from(arm.tool_rotation_vector_deg) * RAD_PER_DEG,
            )));
        }
        parameters.protective_stop_n = arm.max_force_n.or(parameters.protective_stop_n);
        parameters.limit(arm);
        parameters
    }

    /// Returns a named arm at the world's origin. Position limits of Universal Robots arms: ±360°, elbow
    /// ±180° (as in the description, which halves the elbow's range because the links would collide beyond
    /// it); wrist 3 of the UR3 and UR3e turns endlessly and is limited to ±360° here. The path limits suit a
    /// careful insertion.
    pub fn named(model: ArmModel, dt_s: f64) -> Self {
        let range_rad = with_seventh([TAU, TAU, PI, TAU, TAU, TAU], NO_TRAVEL);
        let found = published(model);
        let geometry = match (found, model) {
            (Some(arm), _) => arm.geometry.into(),
            (None, ArmModel::Gantry) => ArmGeometry::Gantry(GantryGeometry { t_flange_tool: None }),
            (None, _) => ArmGeometry::Fixed { t_flange_tool: None },
        };
        let velocity_deg_s = found.map_or([180.0; UR_JOINTS], |arm| arm.velocity_deg_s);
        Self {
            links: found.map(|arm| arm.links),
            payload_kg: found.map(|arm| arm.payload_kg),
            protective_stop_n: found.map(|_| PROTECTIVE_STOP_N),
            ..Self::moving(
                geometry,
                [range_rad.map(|x| -x), range_rad],
                with_seventh(velocity_deg_s, NO_SPEED_DEG_S),
                dt_s,
            )
        }
    }

    /// Returns a UR5 at the world origin.
    pub fn ur5(dt_s: f64) -> Self {
        Self::named(ArmModel::Ur5, dt_s)
    }

    /// Returns an arm that a scene describes joint by joint.
    fn serial(joints: &[ArmJoint], redundant: Option<&str>, dt_s: f64) -> Self {
        let of = |joint: &ArmJoint| SerialJoint {
            position_m: Vector3::from(joint.position_mm) * 1e-3,
            roll_pitch_yaw_rad: Vector3::from(joint.roll_pitch_yaw_deg) * RAD_PER_DEG,
            axis: joint.axis.map(Vector3::from),
        };
        let turning: Vec<&ArmJoint> = joints.iter().filter(|joint| joint.axis.is_some()).collect();
        // In a checked scene, each revolute joint has all three.
        let figures = |of: fn(&ArmJoint) -> Option<f64>, absent: f64| -> Joints {
            std::array::from_fn(|i| turning.get(i).and_then(|joint| of(joint)).unwrap_or(absent))
        };
        let no_travel_deg = NO_TRAVEL / RAD_PER_DEG;
        let ends = [
            figures(|joint| joint.lower_deg, -no_travel_deg),
            figures(|joint| joint.upper_deg, no_travel_deg),
        ];
        let named = redundant.and_then(|name| turning.iter().position(|joint| joint.name == name));
        Self::moving(
            ArmGeometry::Serial(SerialGeometry::new(joints.iter().map(of), named.unwrap_or(THIRD))),
            ends.map(|deg| deg.map(|deg| deg * RAD_PER_DEG)),
            figures(|joint| joint.max_speed_deg_per_s, NO_SPEED_DEG_S),
            dt_s,
        )
    }

    fn moving(
        geometry: ArmGeometry,
        [lower_rad, upper_rad]: [Joints; 2],
        velocity_deg_s: Joints,
        dt_s: f64,
    ) -> Self {
        Self {
            geometry,
            links: None,
            payload_kg: None,
            protective_stop_n: None,
            t_world_arm_base: Isometry3::identity(),
            joint_limits: JointLimits {
                lower_rad,
                upper_rad,
                velocity_rad_s: velocity_deg_s.map(|deg| deg * RAD_PER_DEG),
                acceleration_rad_s2: [ACCELERATION_RAD_S2; MAX_ARM_JOINTS],
                jerk_rad_s3: [JERK_RAD_S3; MAX_ARM_JOINTS],
            },
            cartesian_limits: CartesianLimits {
                speed_m_s: 0.1,
                acceleration_m_s2: 0.5,
                jerk_m_s3: 5.0,
                angular_speed_rad_s: 0.5,
                angular_acceleration_rad_s2: 2.5,
                angular_jerk_rad_s3: 25.0,
            },
            dt_s,
        }
    }

    /// Applies the limits from a scene.
    fn limit(&mut self, arm: &scene::Arm) {
        let path = &mut self.cartesian_limits;
        path.speed_m_s = arm.max_speed_mm_per_s * 1e-3;
        path.acceleration_m_s2 = arm.max_acceleration_mm_per_s2 * 1e-3;
        path.jerk_m_s3 = arm.max_jerk_mm_per_s3 * 1e-3;
        let set = |limit: &mut f64, deg: Option<f64>| *limit = deg.map_or(*limit, |deg| deg * RAD_PER_DEG);
        set(&mut path.angular_speed_rad_s, arm.max_turn_deg_per_s);
        set(&mut path.angular_acceleration_rad_s2, arm.max_turn_deg_per_s2);
        set(&mut path.angular_jerk_rad_s3, arm.max_turn_deg_per_s3);
        let limits = &mut self.joint_limits;
        if let ArmGeometry::Gantry(_) = self.geometry {
            let travel_m = arm.travel_mm.unwrap_or(GANTRY_TRAVEL_MM).map(|mm| mm * 1e-3);
            *limits = gantry_limits(path, travel_m);
            return;
        }
        for i in 0..self.geometry.joints() {
            let own = limits.velocity_rad_s[i];
            set(&mut limits.velocity_rad_s[i], arm.max_joint_speed_deg_per_s);
            limits.velocity_rad_s[i] = limits.velocity_rad_s[i].min(own);
            set(&mut limits.acceleration_rad_s2[i], arm.max_joint_acceleration_deg_per_s2);
            set(&mut limits.jerk_rad_s3[i], arm.max_joint_jerk_deg_per_s3);
            set(&mut limits.lower_rad[i], given(&arm.lower_joints_deg, i));
            set(&mut limits.upper_rad[i], given(&arm.upper_joints_deg, i));
        }
    }
}

/// Returns the scene's value for a joint, if any.
fn given(values: &Option<Vec<f64>>, joint: usize) -> Option<f64> {
    values.as_ref()?.get(joint).copied()
}

/// Returns the limits of a gantry's axes, each equal to those of the tool base on a path.
fn gantry_limits(path: &CartesianLimits, travel_m: [f64; 3]) -> JointLimits {
    let upper_m = std::array::from_fn(|i| travel_m.get(i).copied().unwrap_or(NO_TRAVEL));
    JointLimits {
        lower_rad: upper_m.map(|m: f64| -m),
        upper_rad: upper_m,
        velocity_rad_s: [path.speed_m_s; MAX_ARM_JOINTS],
        acceleration_rad_s2: [path.acceleration_m_s2; MAX_ARM_JOINTS],
        jerk_rad_s3: [path.jerk_m_s3; MAX_ARM_JOINTS],
    }
}

/// Returns the initial joint angles of a scene.
pub fn initial_q_rad(arm: &scene::Arm) -> Joints {
    match (&arm.initial_joints_deg, arm.model) {
        (Some(deg), _) => std::array::from_fn(|i| deg.get(i).map_or(0.0, |angle| angle * RAD_PER_DEG)),
        (None, Some(ArmModel::Fixed | ArmModel::Gantry)) => Joints::default(),
        (None, _) => COMFORTABLE_Q_RAD,
    }
}
