//! Link frames and Jacobian of an arm, and the forward kinematics of the six-joint Universal Robots arms (UR3
//! to UR20, which share one geometry).
//!
//! The Universal Robots arms use the standard Denavit-Hartenberg convention: `T_{i-1,i} = Rz(q_i) Tz(d_i)
//! Tx(a_i) Rx(alpha_i)`; frame 0 is the arm's base, frame 6 the flange. The twists alpha are 90, 0, 0, 90,
//! -90, 0 degrees. Their sines and cosines are exact 0 and ±1 in the code, so no rounding of pi/2 enters a
//! pose.

use messages::MAX_ARM_JOINTS;
use nalgebra::{
    Isometry3, Matrix3, Matrix6, Rotation3, SMatrix, Translation3, UnitQuaternion, Vector3, Vector6,
};

/// One value per joint, from base to wrist; entries after the arm's last joint are 0. The first three entries
/// of a gantry are its linear axes, in m instead of rad.
pub type Joints = [f64; MAX_ARM_JOINTS];

/// Returns the values for a six-joint arm.
pub const fn six_joints(values: [f64; UR_JOINTS]) -> Joints {
    with_seventh(values, 0.0)
}

/// Returns the values of six joints and a seventh.
pub(super) const fn with_seventh([a, b, c, d, e, f]: [f64; UR_JOINTS], seventh: f64) -> Joints {
    [a, b, c, d, e, f, seventh]
}

/// Geometric Jacobian of the tool's base: rows 0..3 linear velocity of its origin (m/rad), rows 3..6 angular
/// velocity (rad/rad); one column per joint, 0 after the arm's last one.
pub type Jacobian = SMatrix<f64, 6, MAX_ARM_JOINTS>;

/// Number of joints of a Universal Robots arm.
pub(super) const UR_JOINTS: usize = 6;

/// Cosine and sine of the link twists alpha_1..alpha_6 (90, 0, 0, 90, -90, 0 degrees).
const TWIST_COS_SIN: [(f64, f64); UR_JOINTS] =
    [(0.0, 1.0), (1.0, 0.0), (1.0, 0.0), (0.0, 1.0), (0.0, -1.0), (1.0, 0.0)];

/// Denavit-Hartenberg lengths of a Universal Robots arm (standard convention); all others are zero.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct UrGeometry {
    /// Height of the shoulder above the base (d1).
    pub d1_m: f64,
    /// Upper arm (a2, negative by UR's convention).
    pub a2_m: f64,
    /// Forearm (a3, negative by UR's convention).
    pub a3_m: f64,
    /// Offset of the wrist out of the arm's plane (d4).
    pub d4_m: f64,
    /// Distance from wrist 1 to wrist 2 (d5).
    pub d5_m: f64,
    /// Distance from wrist 2 to the flange (d6).
    pub d6_m: f64,
    /// T_flange_tool: pose of the tool's base on the flange; `None` means identity.
    pub t_flange_tool: Option<Isometry3<f64>>,
}

impl UrGeometry {
    /// Returns all link frames at joint angles `q_rad`; the last one is the tool's base.
    pub fn frames(&self, q_rad: &Joints) -> LinkFrames {
        let d = [self.d1_m, 0.0, 0.0, self.d4_m, self.d5_m, self.d6_m];
        let a = [0.0, self.a2_m, self.a3_m, 0.0, 0.0, 0.0];
        let mut frames = LinkFrames::standing(UR_JOINTS);
        let LinkFrames { rotation, origin_m, .. } = &mut frames;
        for i in 0..UR_JOINTS {
            let (sin, cos) = libm::sincos(q_rad[i]);
            let (twist_cos, twist_sin) = TWIST_COS_SIN[i];
            #[rustfmt::skip]
            let link = Matrix3::new(
                cos, -sin * twist_cos, sin * twist_sin,
                sin, cos * twist_cos, -cos * twist_sin,
                0.0, twist_sin, twist_cos,
            );
            origin_m[i + 1] = origin_m[i] + rotation[i] * Vector3::new(a[i] * cos, a[i] * sin, d[i]);
            rotation[i + 1] = rotation[i] * link;
        }
        frames.attach(self.t_flange_tool.as_ref());
        frames
    }

    /// Returns `T_base_tool`: pose of the tool's base in the arm's base frame; without a tool transform, the
    /// pose of the flange.
    pub fn forward(&self, q_rad: &Joints) -> Isometry3<f64> {
        self.frames(q_rad).t_base_tool()
    }

    /// Returns the three factors of the Jacobian determinant, `det J = a2 a3 · elbow · wrist · shoulder` up
    /// to sign: `sin q3`, `sin q5` and `a2 cos q2 + a3 cos q23 + d5 sin q234` (m). The arm is singular where
    /// a factor is zero, and the sign of each factor is constant within each of the eight inverse branches.
    /// (Derived from the Denavit-Hartenberg chain; the tests compare it with the numeric determinant.)
    pub fn singularity_factors(&self, q_rad: &Joints) -> SingularityFactors {
        let q23 = q_rad[1] + q_rad[2];
        let shoulder_m = self.a2_m * libm::cos(q_rad[1])
            + self.a3_m * libm::cos(q23)
            + self.d5_m * libm::sin(q23 + q_rad[3]);
        SingularityFactors { elbow: libm::sin(q_rad[2]), wrist: libm::sin(q_rad[4]), shoulder_m }
    }

    /// Returns `|det J|` in m³, Yoshikawa's manipulability of a six-joint arm.
    pub fn manipulability_m3(&self, q_rad: &Joints) -> f64 {
        let f = self.singularity_factors(q_rad);
        (self.a2_m * self.a3_m * f.elbow * f.wrist * f.shoulder_m).abs()
    }
}

/// The factors of `det J`: see [`UrGeometry::singularity_factors`].
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct SingularityFactors {
    /// sin q3: zero with the arm fully stretched or folded.
    pub elbow: f64,
    /// sin q5: zero with the axes of wrists 1 and 3 parallel.
    pub wrist: f64,
    /// Distance of the wrist from the base axis in the arm's plane: zero with the wrist above the base.
    pub shoulder_m: f64,
}

/// Frames of the base, the links and the tool base, in the arm's base frame. Frame i belongs to link i, and
/// joint i + 1 turns about its z axis; in arms other than Universal Robots', frame 0 is that of the first
/// joint. The flange is the last link.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct LinkFrames {
    /// Rotation of each frame; [`LinkFrames::TOOL`] is that of the tool's base.
    pub rotation: [Matrix3<f64>; MAX_ARM_JOINTS + 1],
    /// Origin of each frame.
    pub origin_m: [Vector3<f64>; MAX_ARM_JOINTS + 1],
    /// Number of revolute joints.
    joints: usize,
}

impl LinkFrames {
    /// Index of the tool base. A seven-joint arm has no other frame for its flange: without a tool, this is
    /// the flange.
    pub const TOOL: usize = MAX_ARM_JOINTS;

    /// Returns frames that all coincide with the base.
    pub(super) fn standing(joints: usize) -> Self {
        let (rotation, origin_m) = ([Matrix3::identity(); _], [Vector3::zeros(); _]);
        Self { rotation, origin_m, joints }
    }

    /// Returns `T_base_link` of frame `index`; an index beyond [`LinkFrames::TOOL`] yields the tool base.
    pub fn t_base_link(&self, index: usize) -> Isometry3<f64> {
        let i = index.min(Self::TOOL);
        let rotation =
            UnitQuaternion::from_rotation_matrix(&Rotation3::from_matrix_unchecked(self.rotation[i]));
        Isometry3::from_parts(Translation3::from(self.origin_m[i]), rotation)
    }

    /// Returns `T_base_tool`: pose of the tool's base.
    pub fn t_base_tool(&self) -> Isometry3<f64> {
        self.t_base_link(Self::TOOL)
    }

    /// Puts the tool's base on the flange.
    pub(super) fn attach(&mut self, t_flange_tool: Option<&Isometry3<f64>>) {
        let flange = self.joints;
        (self.rotation[Self::TOOL], self.origin_m[Self::TOOL]) =
            (self.rotation[flange], self.origin_m[flange]);
        if let Some(tool) = t_flange_tool {
            self.origin_m[Self::TOOL] += self.rotation[Self::TOOL] * tool.translation.vector;
            self.rotation[Self::TOOL] *= tool.rotation.to_rotation_matrix().matrix();
        }
    }

    /// Returns the axis of joint `i`, from 0, in the base frame.
    fn axis(&self, i: usize) -> Vector3<f64> {
        self.rotation[i].column(2).into_owned()
    }

    /// Returns the geometric Jacobian of the tool's base, in base axes.
    pub fn jacobian(&self) -> Jacobian {
        let mut jacobian = Jacobian::zeros();
        for i in 0..self.joints {
            let axis = self.axis(i);
            jacobian
                .fixed_view_mut::<3, 1>(0, i)
                .copy_from(&axis.cross(&(self.origin_m[Self::TOOL] - self.origin_m[i])));
            jacobian.fixed_view_mut::<3, 1>(3, i).copy_from(&axis);
        }
        jacobian
    }

    /// Returns `J̇ q̇`: the tool base's acceleration at joint velocities `qd_rad_s` and zero joint
    /// acceleration (linear m/s², angular rad/s², base axes), propagated link by link.
    pub fn bias_acceleration(&self, qd_rad_s: &Joints) -> Vector6<f64> {
        let mut angular = Vector3::zeros();
        let mut angular_acceleration = Vector3::zeros();
        let mut linear_acceleration = Vector3::zeros();
        for (i, rate) in qd_rad_s[..self.joints].iter().enumerate() {
            let spin = self.axis(i) * *rate;
            angular_acceleration += angular.cross(&spin);
            angular += spin;
            let next = if i + 1 == self.joints { Self::TOOL } else { i + 1 };
            let arm = self.origin_m[next] - self.origin_m[i];
            linear_acceleration += angular_acceleration.cross(&arm) + angular.cross(&angular.cross(&arm));
        }
        stack(&linear_acceleration, &angular_acceleration)
    }
}

/// Stacks a linear and an angular part into a six-vector, linear part first.
pub(super) fn stack(linear: &Vector3<f64>, angular: &Vector3<f64>) -> Vector6<f64> {
    Vector6::new(linear.x, linear.y, linear.z, angular.x, angular.y, angular.z)
}

/// Returns the Jacobian of the joints that move while joint `held`, from 0, keeps its angle.
pub(super) fn without(jacobian: &Jacobian, held: usize) -> Matrix6<f64> {
    jacobian.remove_column(held)
}

/// Returns the joint rates that give the tool's base the velocity `twist` (linear first, base axes) while
/// joint `held` keeps its angle; `None` if the Jacobian of the other joints is singular.
pub(super) fn solve_rates(jacobian: &Jacobian, held: usize, twist: &Vector6<f64>) -> Option<Joints> {
    let rates = without(jacobian, held).lu().solve(twist)?;
    let all = rates.insert_row(held, 0.0);
    all.iter().all(|x| x.is_finite()).then(|| all.into())
}
