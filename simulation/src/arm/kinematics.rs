//! Forward and differential kinematics of the Universal Robots six-joint arms (UR3 to UR20: one geometry).
//!
//! Standard Denavit-Hartenberg convention: `T_{i-1,i} = Rz(q_i) Tz(d_i) Tx(a_i) Rx(alpha_i)`; frame 0 is the arm's base, frame 6 the
//! flange. The twists alpha are 90, 0, 0, 90, -90, 0 degrees. Their sines and cosines are exact 0 and ±1 in the code, so no rounding of
//! pi/2 enters a pose.

use nalgebra::{Isometry3, Matrix3, Matrix6, Rotation3, Translation3, UnitQuaternion, Vector3, Vector6};

/// Six values, one per joint, from base to wrist. Of a gantry the first three belong to its linear axes, in m where an angle would be in
/// rad; the last three are 0.
pub type Joints = [f64; 6];

/// Cosine and sine of the link twists alpha_1..alpha_6 (90, 0, 0, 90, -90, 0 degrees).
const TWIST_COS_SIN: [(f64, f64); 6] =
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
    /// Wrist 1 to wrist 2 (d5).
    pub d5_m: f64,
    /// Wrist 2 to the flange (d6).
    pub d6_m: f64,
    /// T_flange_tool: pose of the tool's base on the flange; `None` means identity.
    pub t_flange_tool: Option<Isometry3<f64>>,
}

impl UrGeometry {
    /// All link frames at joint angles `q_rad`; the last one is the tool's base.
    pub fn frames(&self, q_rad: &Joints) -> LinkFrames {
        let d = [self.d1_m, 0.0, 0.0, self.d4_m, self.d5_m, self.d6_m];
        let a = [0.0, self.a2_m, self.a3_m, 0.0, 0.0, 0.0];
        let mut rotation = [Matrix3::identity(); 7];
        let mut origin_m = [Vector3::zeros(); 7];
        for i in 0..6 {
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
        let mut frames = LinkFrames { rotation, origin_m };
        frames.attach(self.t_flange_tool.as_ref());
        frames
    }

    /// `T_base_tool`: pose of the tool's base in the arm's base frame; without a tool transform, of the flange.
    pub fn forward(&self, q_rad: &Joints) -> Isometry3<f64> {
        self.frames(q_rad).t_base_link(6)
    }

    /// The three factors of the Jacobian determinant, `det J = a2 a3 · elbow · wrist · shoulder` up to sign: `sin q3`, `sin q5` and
    /// `a2 cos q2 + a3 cos q23 + d5 sin q234` (m). The arm is singular where a factor is zero, and the sign of each factor is constant
    /// within each of the eight inverse branches. (Derived from the Denavit-Hartenberg chain; the tests compare it with the numeric
    /// determinant.)
    pub fn singularity_factors(&self, q_rad: &Joints) -> SingularityFactors {
        let q23 = q_rad[1] + q_rad[2];
        let shoulder_m = self.a2_m * libm::cos(q_rad[1])
            + self.a3_m * libm::cos(q23)
            + self.d5_m * libm::sin(q23 + q_rad[3]);
        SingularityFactors { elbow: libm::sin(q_rad[2]), wrist: libm::sin(q_rad[4]), shoulder_m }
    }

    /// `|det J|` in m³, Yoshikawa's manipulability of a six-joint arm.
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

/// The frames of the base (index 0), the links (1..=5) and the tool's base (6), in the arm's base frame. Joint i + 1 turns about z of
/// frame i; in an arm that is not of Universal Robots, frame 0 is that of the first joint.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct LinkFrames {
    /// Rotation of each frame.
    pub rotation: [Matrix3<f64>; 7],
    /// Origin of each frame.
    pub origin_m: [Vector3<f64>; 7],
}

impl LinkFrames {
    /// `T_base_link` of frame `index` (0 = base, 6 = tool's base); any larger index returns the tool's base.
    pub fn t_base_link(&self, index: usize) -> Isometry3<f64> {
        let i = index.min(6);
        let rotation =
            UnitQuaternion::from_rotation_matrix(&Rotation3::from_matrix_unchecked(self.rotation[i]));
        Isometry3::from_parts(Translation3::from(self.origin_m[i]), rotation)
    }

    /// Moves the last frame from the flange to the tool's base.
    pub(super) fn attach(&mut self, t_flange_tool: Option<&Isometry3<f64>>) {
        if let Some(tool) = t_flange_tool {
            self.origin_m[6] += self.rotation[6] * tool.translation.vector;
            self.rotation[6] *= tool.rotation.to_rotation_matrix().matrix();
        }
    }

    /// Axis of joint `i` (0..=5) in the base frame.
    fn axis(&self, i: usize) -> Vector3<f64> {
        self.rotation[i].column(2).into_owned()
    }

    /// Geometric Jacobian of the tool's base, in base axes: rows 0..3 linear velocity of its origin (m/rad), rows 3..6 angular velocity
    /// (rad/rad).
    pub fn jacobian(&self) -> Matrix6<f64> {
        let mut jacobian = Matrix6::zeros();
        for i in 0..6 {
            let axis = self.axis(i);
            jacobian
                .fixed_view_mut::<3, 1>(0, i)
                .copy_from(&axis.cross(&(self.origin_m[6] - self.origin_m[i])));
            jacobian.fixed_view_mut::<3, 1>(3, i).copy_from(&axis);
        }
        jacobian
    }

    /// `J̇ q̇`: the tool base's acceleration at joint velocities `qd_rad_s` and zero joint acceleration (linear m/s², angular rad/s²,
    /// base axes), propagated link by link.
    pub fn bias_acceleration(&self, qd_rad_s: &Joints) -> Vector6<f64> {
        let mut angular = Vector3::zeros();
        let mut angular_acceleration = Vector3::zeros();
        let mut linear_acceleration = Vector3::zeros();
        for (i, rate) in qd_rad_s.iter().enumerate() {
            let spin = self.axis(i) * *rate;
            angular_acceleration += angular.cross(&spin);
            angular += spin;
            let arm = self.origin_m[i + 1] - self.origin_m[i];
            linear_acceleration += angular_acceleration.cross(&arm) + angular.cross(&angular.cross(&arm));
        }
        stack(&linear_acceleration, &angular_acceleration)
    }
}

/// Stacks a linear and an angular part into a six-vector, linear part first.
pub(super) fn stack(linear: &Vector3<f64>, angular: &Vector3<f64>) -> Vector6<f64> {
    Vector6::new(linear.x, linear.y, linear.z, angular.x, angular.y, angular.z)
}

/// Joint rates that give the tool's base the velocity `twist` (linear first, base axes); `None` if the Jacobian is singular.
pub(super) fn solve_rates(jacobian: &Matrix6<f64>, twist: &Vector6<f64>) -> Option<Joints> {
    let rates = jacobian.lu().solve(twist)?;
    rates.iter().all(|x| x.is_finite()).then(|| rates.into())
}
