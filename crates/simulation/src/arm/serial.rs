//! Serial arms of six or seven revolute joints: kinematics from joint positions and axes, and a numeric
//! inverse.
//!
//! The joints follow URDF: joint i is at `T_i` in the frame of the previous joint and turns about a unit
//! vector of its own frame. In frames whose z is the axis, the pose is `G_0 Rz(q_1) G_1 .. Rz(q_n) G_n`, with
//! constant `G`.
//!
//! With seven joints, one is redundant. As with KUKA's E1 and Franka's elbow, its angle selects one of the
//! infinitely many solutions; both vendors use the third joint. On a path it keeps its angle, so the joints
//! depend only on the position along the path.

use super::inverse::{KinematicsError, check_pose};
use super::kinematics::{Jacobian, Joints, LinkFrames};
use messages::MAX_ARM_JOINTS;
use nalgebra::{Isometry3, Matrix3, Matrix6, Rotation3, UnitQuaternion, Vector3, Vector6};

/// Maximum iterations from one start; near a solution, Newton's method needs about five.
const ITERATIONS: usize = 60;
/// Additional starts if the reference finds no solution.
const OTHER_STARTS: usize = 12;
/// Convergence tolerance (m and rad combined); rounding leaves about 1e-15.
const REACHED: f64 = 1e-12;
/// Minimum damping, m² or rad²: it keeps the equations solvable at a singularity, and is far below the
/// squared Jacobian entries of a regular arm.
const LEAST_DAMPING: f64 = 1e-16;
/// Largest change of a joint per iteration.
const LARGEST_STEP_RAD: f64 = 0.5;

/// A constant part of the chain.
#[derive(Clone, Copy, Debug, PartialEq)]
struct FixedTransform {
    rotation: Matrix3<f64>,
    origin_m: Vector3<f64>,
}

impl FixedTransform {
    const IDENTITY: FixedTransform = FixedTransform {
        rotation: Matrix3::new(1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0),
        origin_m: Vector3::new(0.0, 0.0, 0.0),
    };

    fn then(&self, next: &FixedTransform) -> FixedTransform {
        FixedTransform {
            rotation: self.rotation * next.rotation,
            origin_m: self.origin_m + self.rotation * next.origin_m,
        }
    }
}

/// A joint as URDF describes it.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct SerialJoint {
    /// Position of the joint's frame in the frame of the previous joint, or in the arm's base, m.
    pub position_m: Vector3<f64>,
    /// Rotations about the fixed axes x, y and z, in this order, rad.
    pub roll_pitch_yaw_rad: Vector3<f64>,
    /// Axis in the joint's frame, of any nonzero length; `None` for a fixed joint.
    pub axis: Option<Vector3<f64>>,
}

/// Whether the redundant one of seven joints may leave the reference angle.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Redundancy {
    /// It keeps its angle, as on a path.
    Held,
    /// It may move if the other joints cannot reach the goal within their limits.
    Free,
}

/// Kinematics of a serial arm of six or seven revolute joints.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct SerialGeometry {
    /// `G_0` .. `G_n`.
    parts: [FixedTransform; MAX_ARM_JOINTS + 1],
    /// Number of revolute joints.
    joints: usize,
    /// The redundant one of seven joints, from 0.
    redundant: usize,
    /// T_flange_tool: pose of the tool's base on the flange; `None` means identity.
    pub t_flange_tool: Option<Isometry3<f64>>,
}

impl SerialGeometry {
    /// Creates the chain of `joints` from base to flange, of which six or seven are revolute; with seven, the
    /// joint `redundant` (from 0) keeps its angle on a path. Revolute joints beyond the seventh stay fixed; a
    /// checked scene has none.
    pub fn new(joints: impl IntoIterator<Item = SerialJoint>, redundant: usize) -> Self {
        let mut parts = [FixedTransform::IDENTITY; MAX_ARM_JOINTS + 1];
        let mut turning = 0;
        for joint in joints {
            let place = FixedTransform {
                rotation: roll_pitch_yaw(&joint.roll_pitch_yaw_rad),
                origin_m: joint.position_m,
            };
            parts[turning] = parts[turning].then(&place);
            if let Some(axis) = joint.axis.filter(|_| turning < MAX_ARM_JOINTS) {
                let onto_axis =
                    FixedTransform { rotation: z_onto(&axis.normalize()), origin_m: Vector3::zeros() };
                parts[turning] = parts[turning].then(&onto_axis);
                turning += 1;
                parts[turning].rotation = onto_axis.rotation.transpose();
            }
        }
        Self { parts, joints: turning, redundant: redundant.min(MAX_ARM_JOINTS - 1), t_flange_tool: None }
    }

    /// Returns the number of revolute joints.
    pub fn joints(&self) -> usize {
        self.joints
    }

    /// Returns whether the arm has one joint more than a pose needs.
    pub fn is_redundant(&self) -> bool {
        self.joints == MAX_ARM_JOINTS
    }

    /// Returns the joint, from 0, that keeps its angle on a path; with six joints, the entry after them.
    pub(super) fn held_joint(&self) -> usize {
        if self.is_redundant() { self.redundant } else { MAX_ARM_JOINTS - 1 }
    }

    /// Returns all link frames at joint angles `q_rad`: frame i has the axis of joint i + 1 as its z, and the
    /// last one is the tool base.
    pub fn frames(&self, q_rad: &Joints) -> LinkFrames {
        let mut frames = LinkFrames::standing(self.joints);
        let LinkFrames { rotation, origin_m, .. } = &mut frames;
        (rotation[0], origin_m[0]) = (self.parts[0].rotation, self.parts[0].origin_m);
        for (i, angle_rad) in q_rad[..self.joints].iter().enumerate() {
            let (sin, cos) = libm::sincos(*angle_rad);
            let turned = rotation[i] * Matrix3::new(cos, -sin, 0.0, sin, cos, 0.0, 0.0, 0.0, 1.0);
            origin_m[i + 1] = origin_m[i] + turned * self.parts[i + 1].origin_m;
            rotation[i + 1] = turned * self.parts[i + 1].rotation;
        }
        frames.attach(self.t_flange_tool.as_ref());
        frames
    }

    /// Returns the joint angles within the limits that put the tool's base at `t_base_tool`, to 1e-12 m and
    /// rad.
    ///
    /// The Levenberg-Marquardt method, damped by the squared error (Sugihara, "Solvability-Unconcerned
    /// Inverse Kinematics by the Levenberg-Marquardt Method", IEEE Trans. Robotics 27 (2011), eq. 22), with
    /// joints at the end of their range held there. It starts at the reference, and ends near it if the goal
    /// is near; with seven joints, the redundant one is held there first. If that finds no solution and
    /// `redundancy` allows it, that joint may move: the damped least squares then move all seven as little as
    /// the goal needs. If that fails too, the method starts from twelve other fixed points within half a turn
    /// of the reference, and the solution closest to the reference is used.
    ///
    /// # Errors
    /// The pose is invalid, or no start leads to it.
    pub fn inverse_nearest(
        &self,
        t_base_tool: &Isometry3<f64>,
        q_reference_rad: &Joints,
        lower_rad: &Joints,
        upper_rad: &Joints,
        redundancy: Redundancy,
    ) -> Result<Joints, KinematicsError> {
        check_pose(t_base_tool)?;
        let mut goal = Goal {
            rotation: *t_base_tool.rotation.to_rotation_matrix().matrix(),
            origin_m: t_base_tool.translation.vector,
            lower_rad,
            upper_rad,
            held: Some(self.held_joint()),
        };
        let mut first = self.descend(&goal, q_reference_rad);
        if first.missed.norm() > REACHED && self.is_redundant() && redundancy == Redundancy::Free {
            goal.held = None;
            first = self.descend(&goal, q_reference_rad);
        }
        if first.missed.norm() <= REACHED {
            return Ok(first.q_rad);
        }
        let (mut closest, mut nearest) = (first, None::<(f64, Joints)>);
        for start in 1..=OTHER_STARTS {
            let mut from = spread(start, q_reference_rad, lower_rad, upper_rad);
            if let Some(held) = goal.held {
                from[held] = q_reference_rad[held];
            }
            let ended = self.descend(&goal, &from);
            if ended.missed.norm() < closest.missed.norm() {
                closest = ended;
            }
            if ended.missed.norm() <= REACHED {
                let far =
                    |q: &Joints| q.iter().zip(q_reference_rad).map(|(a, b)| (a - b) * (a - b)).sum::<f64>();
                let distance = far(&ended.q_rad);
                if nearest.is_none_or(|(least, _)| distance < least) {
                    nearest = Some((distance, ended.q_rad));
                }
            }
        }
        nearest.map(|(_, q_rad)| q_rad).ok_or_else(|| KinematicsError::NotReached {
            missed_m: closest.missed.fixed_rows::<3>(0).norm(),
            missed_rad: closest.missed.fixed_rows::<3>(3).norm(),
        })
    }

    /// Descends from `start` until the goal is reached or the error no longer decreases.
    fn descend(&self, goal: &Goal, start: &Joints) -> Descent {
        let mut q_rad = goal.within(start);
        let mut frames = self.frames(&q_rad);
        let mut missed = goal.missed(&frames);
        let mut caution = 1.0;
        for _ in 0..ITERATIONS {
            let squared = missed.norm_squared();
            // A tenth of the convergence tolerance, so that the last iterations reach rounding.
            if squared <= 0.01 * REACHED * REACHED {
                break;
            }
            let damping = LEAST_DAMPING + 0.5 * squared * caution;
            let Some(tried) = goal.step(&frames.jacobian(), &missed, &q_rad, damping) else { break };
            let tried_frames = self.frames(&tried);
            let tried_missed = goal.missed(&tried_frames);
            if tried_missed.norm_squared() < squared {
                (q_rad, frames, missed) = (tried, tried_frames, tried_missed);
                caution = (caution * 0.5).max(1e-3);
            } else if squared <= REACHED * REACHED {
                break;
            } else {
                caution *= 8.0;
            }
        }
        Descent { q_rad, missed }
    }
}

/// Result of a descent.
#[derive(Clone, Copy)]
struct Descent {
    q_rad: Joints,
    /// Remaining error to the goal: m, then rad.
    missed: Vector6<f64>,
}

/// Goal of the tool base, and the joint ranges.
struct Goal<'a> {
    rotation: Matrix3<f64>,
    origin_m: Vector3<f64>,
    lower_rad: &'a Joints,
    upper_rad: &'a Joints,
    /// The joint that keeps its angle, if any.
    held: Option<usize>,
}

impl Goal<'_> {
    fn within(&self, q_rad: &Joints) -> Joints {
        std::array::from_fn(|i| q_rad[i].max(self.lower_rad[i]).min(self.upper_rad[i]))
    }

    /// Returns the error from the tool base to the goal: linear in m, then angular as the axis times twice
    /// the sine of half the angle, rad.
    fn missed(&self, frames: &LinkFrames) -> Vector6<f64> {
        let turn =
            Rotation3::from_matrix_unchecked(self.rotation * frames.rotation[LinkFrames::TOOL].transpose());
        let turn = UnitQuaternion::from_rotation_matrix(&turn);
        let sign = if turn.w < 0.0 { -2.0 } else { 2.0 };
        super::kinematics::stack(&(self.origin_m - frames.origin_m[LinkFrames::TOOL]), &(turn.imag() * sign))
    }

    /// Returns the joints after one damped step. A joint that the step would push out of its range stays at
    /// its limit, and the others compensate.
    fn step(
        &self,
        jacobian: &Jacobian,
        missed: &Vector6<f64>,
        q_rad: &Joints,
        damping: f64,
    ) -> Option<Joints> {
        let mut jacobian = *jacobian;
        if let Some(held) = self.held {
            jacobian.set_column(held, &Vector6::zeros());
        }
        for _ in 0..MAX_ARM_JOINTS {
            let normal = jacobian * jacobian.transpose() + Matrix6::identity() * damping;
            let step = jacobian.transpose() * normal.cholesky()?.solve(missed);
            let blocked = (0..MAX_ARM_JOINTS).find(|&i| {
                (step[i] > 0.0 && q_rad[i] >= self.upper_rad[i])
                    || (step[i] < 0.0 && q_rad[i] <= self.lower_rad[i])
            });
            match blocked {
                Some(joint) => jacobian.set_column(joint, &Vector6::zeros()),
                None => {
                    let scale = (LARGEST_STEP_RAD / step.amax()).min(1.0);
                    return Some(self.within(&std::array::from_fn(|i| q_rad[i] + step[i] * scale)));
                }
            }
        }
        None
    }
}

/// Returns the n-th point of a fixed sequence that fills the joint ranges evenly, within half a turn of the
/// reference: the additive recurrence with the powers of the root of `x^7 = x + 1` (Roberts, "The
/// unreasonable effectiveness of quasirandom sequences", 2018), which is the one for six joints; its seventh
/// power is used for the seventh.
fn spread(n: usize, q_reference_rad: &Joints, lower_rad: &Joints, upper_rad: &Joints) -> Joints {
    const ROOT: f64 = 1.112_775_684_278_705_5;
    let mut share = 1.0;
    std::array::from_fn(|i| {
        share /= ROOT;
        let place = 0.5 + n as f64 * share;
        let low = lower_rad[i].max(q_reference_rad[i] - std::f64::consts::PI);
        let high = upper_rad[i].min(q_reference_rad[i] + std::f64::consts::PI);
        low + (high - low) * (place - libm::floor(place))
    })
}

/// Returns Rz(yaw) Ry(pitch) Rx(roll).
fn roll_pitch_yaw(angles_rad: &Vector3<f64>) -> Matrix3<f64> {
    let [(sr, cr), (sp, cp), (sy, cy)] = [angles_rad.x, angles_rad.y, angles_rad.z].map(libm::sincos);
    Matrix3::new(
        cy * cp,
        cy * sp * sr - sy * cr,
        cy * sp * cr + sy * sr,
        sy * cp,
        sy * sp * sr + cy * cr,
        sy * sp * cr - cy * sr,
        -sp,
        cp * sr,
        cp * cr,
    )
}

/// Returns a rotation that turns z onto `axis`, a unit vector.
fn z_onto(axis: &Vector3<f64>) -> Matrix3<f64> {
    let across = Vector3::ith(axis.iamin(), 1.0);
    let x = (across - axis * axis.dot(&across)).normalize();
    Matrix3::from_columns(&[x, axis.cross(&x), *axis])
}
