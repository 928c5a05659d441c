//! Detects whether the arm, the holder or the bare shaft behind the tool base is inside bone.
//!
//! These parts do not collide; only the tool's spheres have contacts. The links are capsules between the
//! origins of the arm's frames, like a skeleton: an upper arm that is offset from the arm's plane is moved
//! into it, but the wrist, which comes closest to bone, is where it really is. A tick checks at most one
//! part, so the whole arm takes [`PERIOD_TICKS`].

use core::f64::consts::TAU;

use messages::{ArmEntry, MAX_ARM_JOINTS, State};
use nalgebra::{Isometry3, Vector3};
use scene::Holder;

use super::Simulation;
use crate::arm::{ArmParameters, Joints, Redundancy};
use crate::bone::Voxels;
use crate::manipulator::ManipulatorModel;

/// Number of parts: links, holder and shaft.
const PIECES: usize = MAX_ARM_JOINTS + 2;
/// Ticks between checks of two parts.
const TICKS_PER_PIECE: u64 = 8;
/// Ticks in which every part is checked once.
const PERIOD_TICKS: u64 = TICKS_PER_PIECE * PIECES as u64;
/// Spacing of the points checked on a part, m: thinner bone can be missed.
const SPACING_M: f64 = 4e-3;
/// Resolution of the depth, m.
const DEPTH_STEP_M: f64 = 1e-3;
/// Clearance at which a part counts as having left the bone, m.
const LEAVING_M: f64 = 2e-3;

/// Names and radii of the links. The radii are those of the cylinders in Universal Robots' ROS description of
/// the UR5 (`ur_description`, `ur5.urdf.xacro`: shoulder 60 mm, upper arm 54, forearm 40, wrists 45); other
/// arms use the same.
const LINKS: [(&str, f64); 6] = [
    ("shoulder", 0.060),
    ("upper arm", 0.054),
    ("forearm", 0.040),
    ("wrist 1", 0.045),
    ("wrist 2", 0.045),
    ("wrist 3", 0.045),
];

/// Names of the links of a seven-joint arm. All have the radius of the upper arm above, which is about that
/// of the links of a Franka or a KUKA LBR.
const SEVEN_LINKS: [&str; MAX_ARM_JOINTS] =
    ["link 1", "link 2", "link 3", "link 4", "link 5", "link 6", "link 7"];

/// A part of the arm: a capsule, or a cylinder where an end is flat.
#[derive(Debug, Clone, Copy)]
pub(super) struct Piece {
    pub(super) name: &'static str,
    from_m: Vector3<f64>,
    to_m: Vector3<f64>,
    radius_m: f64,
    /// Whether each end is a hemisphere.
    is_round: [bool; 2],
}

/// Configuration of the arm and the tool base.
#[derive(Debug, Clone, Copy)]
pub(super) struct Posture {
    pub(super) q_rad: Joints,
    pub(super) flange_m: [f64; 3],
    pub(super) base_m: [f64; 3],
}

impl Posture {
    pub(super) fn of(state: &State) -> Posture {
        Posture {
            q_rad: state.arm_joint_position_rad,
            flange_m: state.t_world_flange.position_m,
            base_m: state.t_world_base.position_m,
        }
    }
}

/// What is mounted on the arm.
#[derive(Debug, Clone, Copy)]
pub(super) struct Fixture {
    pub(super) holder: Holder,
    pub(super) shaft_radius_m: f64,
}

/// Returns the name and radius, m, of a link, from 0.
fn link(index: usize, joints: usize) -> Option<(&'static str, f64)> {
    let seven = || SEVEN_LINKS.get(index).map(|name| (*name, LINKS[1].1));
    if joints == MAX_ARM_JOINTS { seven() } else { LINKS.get(index).filter(|_| index < joints).copied() }
}

/// Returns one of the parts: up to seven links from the base on, then the holder, then the shaft. `None` if
/// the arm has no such part.
pub(super) fn piece(
    index: usize,
    arm: &ArmParameters,
    fixture: &Fixture,
    posture: &Posture,
) -> Option<Piece> {
    let flange_m = Vector3::from(posture.flange_m);
    if index >= MAX_ARM_JOINTS {
        let front_m = Vector3::from(fixture.holder.front_m(posture.flange_m, posture.base_m)?);
        let is_round = [false; 2];
        let (name, from_m, to_m, radius_m) = if index == MAX_ARM_JOINTS {
            ("holder", flange_m, front_m, fixture.holder.radius_m)
        } else {
            ("shaft behind its base", front_m, Vector3::from(posture.base_m), fixture.shaft_radius_m)
        };
        return ((to_m - from_m).norm() > 1e-6).then_some(Piece { name, from_m, to_m, radius_m, is_round });
    }
    let joints = arm.geometry.joints();
    let (name, radius_m) = link(index, joints)?;
    let frames = arm.geometry.frames(&posture.q_rad);
    let world = |at: usize| arm.t_world_arm_base.transform_point(&frames.origin_m[at].into()).coords;
    let is_last = index + 1 == joints;
    // The tool base may be offset from the flange.
    let to_m = if is_last { flange_m } else { world(index + 1) };
    Some(Piece { name, from_m: world(index), to_m, radius_m, is_round: [true, !is_last] })
}

impl Piece {
    /// Returns how far bone reaches into the part, m, to a millimetre; `None` if by no more than a voxel.
    pub(super) fn depth_m(&self, voxels: &Voxels) -> Option<f64> {
        let (mut deepest_m, mut below_m) = (None, voxel_m(voxels));
        while below_m <= self.radius_m {
            if self.meets_bone(voxels, -below_m) {
                deepest_m = Some(below_m);
            }
            below_m += DEPTH_STEP_M;
        }
        deepest_m
    }

    /// Returns whether bone crosses the part's surface after moving it outward by `outward_m`.
    fn meets_bone(&self, voxels: &Voxels, outward_m: f64) -> bool {
        let way = self.to_m - self.from_m;
        let (length_m, radius_m) = (way.norm(), (self.radius_m + outward_m).max(0.0));
        let axis = way.try_normalize(1e-9).unwrap_or_else(Vector3::z);
        if !voxels.is_near(&(self.from_m + 0.5 * way), 0.5 * length_m + radius_m) {
            return false;
        }
        let (x, y) = perpendiculars(&axis);
        let [before_m, beyond_m] = self.is_round.map(|is_round| if is_round { radius_m } else { outward_m });
        if before_m + length_m + beyond_m <= 0.0 {
            return false;
        }
        let rings = ((before_m + length_m + beyond_m) / SPACING_M).ceil().max(1.0) as usize;
        (0..=rings).any(|ring| {
            let share = ring as f64 / rings as f64;
            let along_m = share * (before_m + length_m + beyond_m) - before_m;
            let past_m = (-along_m).max(along_m - length_m).max(0.0);
            let ring_m = (radius_m * radius_m - past_m * past_m).max(0.0).sqrt();
            let centre_m = self.from_m + along_m * axis;
            // A flat end is checked as a disc.
            let is_end = (ring == 0 && !self.is_round[0]) || (ring == rings && !self.is_round[1]);
            let inner = if is_end { (ring_m / SPACING_M).floor() as usize } else { 0 };
            (0..=inner)
                .any(|step| circle_meets(voxels, &centre_m, (&x, &y), ring_m - step as f64 * SPACING_M))
        })
    }
}

/// Returns the longest edge of a voxel, m: bone that reaches less far into a part is not reported.
fn voxel_m(voxels: &Voxels) -> f64 {
    voxels.geometry().spacing_m.iter().copied().fold(0.0, f64::max)
}

/// Returns whether a point of a circle is in bone. A circle outside the volume, like most of those of a long
/// link, is skipped at once.
fn circle_meets(
    voxels: &Voxels,
    centre_m: &Vector3<f64>,
    (x, y): (&Vector3<f64>, &Vector3<f64>),
    radius_m: f64,
) -> bool {
    if !voxels.is_near(centre_m, radius_m) {
        return false;
    }
    let points = (TAU * radius_m / SPACING_M).ceil().max(1.0);
    let (sine, cosine) = libm::sincos(TAU / points);
    let mut at_m = [radius_m, 0.0];
    (0..points as usize).any(|_| {
        let point_m = centre_m + at_m[0] * x + at_m[1] * y;
        at_m = [cosine * at_m[0] - sine * at_m[1], sine * at_m[0] + cosine * at_m[1]];
        voxels.holds_bone(&point_m)
    })
}

/// Returns two unit vectors perpendicular to a unit vector and to each other.
fn perpendiculars(axis: &Vector3<f64>) -> (Vector3<f64>, Vector3<f64>) {
    let helper = if axis.x.abs() < 0.6 { Vector3::x() } else { Vector3::y() };
    let x = axis.cross(&helper).normalize();
    (x, axis.cross(&x))
}

/// Which parts were in bone when last checked, and the one that entered it in the last tick.
#[derive(Debug, Default)]
pub(super) struct ArmWatch {
    is_in: [bool; PIECES],
    entry: Option<ArmEntry>,
}

impl ArmWatch {
    /// Returns the part that entered bone in the last tick.
    pub(super) fn entry(&self) -> Option<&ArmEntry> {
        self.entry.as_ref()
    }
}

impl Simulation<'_> {
    fn fixture(&self) -> Fixture {
        let shaft_radius_m = self.manipulator.parameters().widest_tube_m();
        Fixture { holder: self.holder, shaft_radius_m }
    }

    /// Returns a part of the arm in its present configuration.
    fn piece(&self, index: usize) -> Option<Piece> {
        piece(index, self.arm.parameters(), &self.fixture(), &Posture::of(&self.state))
    }

    /// Returns the parts that are in bone now, with their depths, m.
    pub(super) fn pieces_in_bone(&self) -> impl Iterator<Item = (&'static str, f64)> {
        let voxels = self.bone.as_ref().map(|bone| bone.field.voxels());
        (0..PIECES).filter_map(move |index| {
            let piece = self.piece(index)?;
            Some((piece.name, piece.depth_m(voxels?)?))
        })
    }

    /// Returns the links and the holder that would be in bone with the tool base at another pose, with their
    /// depths, m; `None` if the arm cannot reach it. The shaft is omitted: by then, it is where the burr has
    /// drilled.
    pub(super) fn pieces_in_bone_at(
        &self,
        t_world_tool: &Isometry3<f64>,
    ) -> Option<Vec<(&'static str, f64)>> {
        let arm = self.arm.parameters();
        let voxels = self.bone.as_ref()?.field.voxels();
        let t_base_tool = arm.t_world_arm_base.inverse() * t_world_tool;
        let limits = &arm.joint_limits;
        let (now_rad, lower_rad, upper_rad) = (&self.arm.state().q_rad, &limits.lower_rad, &limits.upper_rad);
        let q_rad = arm
            .geometry
            .inverse_nearest(&t_base_tool, now_rad, lower_rad, upper_rad, Redundancy::Held)
            .ok()?;
        let t_tool_flange = arm.geometry.t_flange_tool().map_or_else(Isometry3::identity, Isometry3::inverse);
        let flange_m = (t_world_tool * t_tool_flange).translation.vector.into();
        let posture = Posture { q_rad, flange_m, base_m: t_world_tool.translation.vector.into() };
        let fixture = self.fixture();
        let pieces = (0..=MAX_ARM_JOINTS).filter_map(|index| piece(index, arm, &fixture, &posture));
        Some(pieces.filter_map(|piece| Some((piece.name, piece.depth_m(voxels)?))).collect())
    }

    /// Checks one part of the arm if one is due in this tick. Changes no state.
    pub(super) fn watch_arm(&mut self) {
        self.arm_watch.entry = None;
        if self.state.tick.is_multiple_of(TICKS_PER_PIECE) {
            self.look_at((self.state.tick % PERIOD_TICKS / TICKS_PER_PIECE) as usize);
        }
    }

    /// Resets the detector from the present state alone, as after a keyframe.
    pub(super) fn note_arm(&mut self) {
        self.arm_watch = ArmWatch::default();
        for index in 0..PIECES {
            self.arm_watch.is_in[index] = self.is_in_bone(index);
        }
    }

    /// Returns whether a part is in bone, with hysteresis: a part that was in bone has left it only when
    /// clear of it.
    fn is_in_bone(&self, index: usize) -> bool {
        let (Some(bone), Some(piece)) = (&self.bone, self.piece(index)) else { return false };
        let voxels = bone.field.voxels();
        let outward_m = if self.arm_watch.is_in[index] { LEAVING_M } else { -voxel_m(voxels) };
        piece.meets_bone(voxels, outward_m)
    }

    fn look_at(&mut self, index: usize) {
        let is_in = self.is_in_bone(index);
        let has_entered = is_in && !self.arm_watch.is_in[index];
        self.arm_watch.is_in[index] = is_in;
        if !has_entered {
            return;
        }
        let entered = self.piece(index).zip(self.bone.as_ref());
        self.arm_watch.entry = entered.map(|(piece, bone)| {
            let voxels = bone.field.voxels();
            ArmEntry { part: piece.name, depth_m: piece.depth_m(voxels).unwrap_or_else(|| voxel_m(voxels)) }
        });
    }
}
