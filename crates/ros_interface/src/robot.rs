//! Arm and tool as a tree of frames, and the arm's velocity.

use messages::{MAX_ARM_JOINTS, Pose, State};
use nalgebra::{Isometry3, Quaternion, SMatrix, SVector, Translation3, UnitQuaternion, Vector3, Vector6};
use scene::{Scene, ToolOuterTube};
use simulation::arm::{ArmGeometry, ArmParameters};
use simulation::pose;

use crate::topics::{ARM_JOINT_NAMES, Names};

/// The root frame: the patient frame, LPS.
pub const WORLD: &str = "world";

/// A frame with its parent and its pose in it.
#[derive(Debug, Clone, PartialEq)]
pub struct FrameInParent {
    /// Parent frame.
    pub parent: String,
    /// The frame.
    pub child: String,
    /// Its pose in the parent.
    pub pose: Pose,
}

/// The arm's geometry and place, and the names of all frames.
#[derive(Debug, Clone)]
pub struct Robot {
    names: Names,
    /// Without the tool: the last frame is the flange.
    geometry: ArmGeometry,
    /// Names of the arm's joints: six or seven, or empty if the arm has none.
    arm_joints: Vec<String>,
    t_world_arm_base: Isometry3<f64>,
    /// The fixed parts of the chain ([`ArmGeometry::fixed_parts`]).
    fixed_parts: Vec<Isometry3<f64>>,
    t_flange_base: Isometry3<f64>,
    /// Lower and upper ends of the joints' ranges.
    ranges_rad: [[f64; MAX_ARM_JOINTS]; 2],
    rates_rad_per_s: [f64; MAX_ARM_JOINTS],
    flexures: usize,
    tendons: usize,
    outer_tube: Option<ToolOuterTube>,
}

impl Robot {
    /// Creates the robot of a scene, placed by a state: the arm's base is where its flange and its joints
    /// imply.
    pub fn new(scene: &Scene, state: &State, names: Names) -> Robot {
        let parameters = ArmParameters::of(&scene.arm, scene.dt_s());
        let (geometry, limits) = (parameters.geometry.with_tool(None), parameters.joint_limits);
        let t_world_flange = isometry(&state.t_world_flange);
        Robot {
            names,
            geometry,
            arm_joints: arm_joints(scene, &geometry),
            t_world_arm_base: t_world_flange * geometry.forward(&state.arm_joint_position_rad).inverse(),
            fixed_parts: geometry.fixed_parts(),
            t_flange_base: t_world_flange.inverse() * isometry(&state.t_world_base),
            ranges_rad: [limits.lower_rad, limits.upper_rad],
            rates_rad_per_s: limits.velocity_rad_s,
            flexures: used(state.joint_count, state.t_world_link.len()),
            tendons: used(state.tendon_count, state.tendon_tension_n.len()),
            outer_tube: scene.manipulator.outer_tube().cloned(),
        }
    }

    /// Names in topics and frames.
    pub fn names(&self) -> &Names {
        &self.names
    }

    /// Names of the arm's joints, from base to flange: six or seven, or empty if the arm has none.
    pub fn arm_joints(&self) -> &[String] {
        &self.arm_joints
    }

    /// Returns the ends of an arm joint's range, and its maximum rate.
    pub fn limits(&self, joint: usize) -> [f64; 3] {
        [self.ranges_rad[0][joint], self.ranges_rad[1][joint], self.rates_rad_per_s[joint]]
    }

    /// Flexures in use.
    pub fn flexures(&self) -> usize {
        self.flexures
    }

    /// Tendons in use.
    pub fn tendons(&self) -> usize {
        self.tendons
    }

    /// Returns the frame of the arm's base (index 0) or of a link (from 1). Each link's frame is at its joint
    /// and turns about its own z, as URDF requires.
    pub fn arm_frame(&self, index: usize) -> String {
        if index == 0 {
            format!("{}/base", self.names.arm)
        } else {
            format!("{}/link_{index}", self.names.arm)
        }
    }

    /// Returns whether the flange moves relative to the base without joints, as on a gantry, of which a state
    /// has only the pose.
    pub fn flange_floats(&self) -> bool {
        matches!(self.geometry, ArmGeometry::Gantry(_))
    }

    /// Frame of the arm's flange.
    pub fn flange(&self) -> String {
        format!("{}/flange", self.names.arm)
    }

    /// Returns the pose of each joint in the preceding link (from index 0), and last of the flange in the
    /// last link.
    pub fn fixed_parts(&self) -> &[Isometry3<f64>] {
        &self.fixed_parts
    }

    /// Returns the tool's base on the flange in the state with which the robot was created.
    pub fn t_flange_base(&self) -> &Isometry3<f64> {
        &self.t_flange_base
    }

    /// Returns the tube out of which the tool slides, if there is one.
    pub fn outer_tube(&self) -> Option<&ToolOuterTube> {
        self.outer_tube.as_ref()
    }

    /// Frame of the tool's base.
    pub fn tool_base(&self) -> String {
        format!("{}/base", self.names.manipulator)
    }

    /// Returns the frame of a link, just after its flexure; that of the base if no flexure precedes it.
    pub fn tool_link(&self, index: usize) -> String {
        format!("{}/link_{index}", self.names.manipulator)
    }

    /// Returns the frame of the burr's centre (`burr`), of the tip (`tip`), of the part that slides in an
    /// outer tube (`slide`) or of the part that also turns in it (`tube`).
    pub fn tool_end(&self, which: &str) -> String {
        format!("{}/{which}", self.names.manipulator)
    }

    /// Returns the arm's base in the world, which does not move.
    pub fn fixed(&self) -> FrameInParent {
        FrameInParent { parent: WORLD.into(), child: self.arm_frame(0), pose: pose(&self.t_world_arm_base) }
    }

    /// Returns every frame that moves, parents first.
    pub fn moving(&self, state: &State) -> Vec<FrameInParent> {
        let mut placed = Vec::with_capacity(MAX_ARM_JOINTS + self.flexures + 6);
        let joints = self.arm_joints.len();
        for (index, angle_rad) in state.arm_joint_position_rad.into_iter().take(joints).enumerate() {
            let turn = UnitQuaternion::from_axis_angle(&Vector3::z_axis(), angle_rad);
            let t_parent_child = self.fixed_parts[index] * turn;
            let (parent, child) = (self.arm_frame(index), self.arm_frame(index + 1));
            placed.push(FrameInParent { parent, child, pose: pose(&t_parent_child) });
        }
        let t_last_flange = match self.flange_floats() {
            true => self.t_world_arm_base.inverse() * isometry(&state.t_world_flange),
            false => self.fixed_parts[joints],
        };
        let (parent, child) = (self.arm_frame(joints), self.flange());
        placed.push(FrameInParent { parent, child, pose: pose(&t_last_flange) });
        let mut last = (self.flange(), isometry(&state.t_world_flange));
        let mut hang = |child: String, t_world_child: &Pose, stays: bool| {
            let t_world_child = isometry(t_world_child);
            let pose = pose(&(last.1.inverse() * t_world_child));
            placed.push(FrameInParent { parent: last.0.clone(), child: child.clone(), pose });
            if !stays {
                last = (child, t_world_child);
            }
        };
        hang(self.tool_base(), &state.t_world_base, false);
        if self.outer_tube.is_some() {
            let slid = isometry(&state.t_world_base) * Translation3::new(0.0, 0.0, state.tube_deployed_m);
            let turn = UnitQuaternion::from_axis_angle(&Vector3::z_axis(), state.tube_roll_rad);
            hang(self.tool_end("slide"), &pose(&slid), false);
            hang(self.tool_end("tube"), &pose(&(slid * turn)), false);
        }
        for (index, link) in state.t_world_link[..self.flexures].iter().enumerate() {
            hang(self.tool_link(index), link, false);
        }
        hang(self.tool_end("burr"), &state.t_world_burr, true);
        hang(self.tool_end("tip"), &state.t_world_tip, true);
        placed
    }

    /// Returns the velocity of the tool's base, m/s and rad/s along the world's axes: that of the flange
    /// according to the arm's Jacobian, transferred to the base. `None` for a gantry, of which a state has no
    /// velocity.
    pub fn base_velocity(&self, state: &State) -> Option<[[f64; 3]; 2]> {
        let rates = SVector::from(state.arm_joint_velocity_rad_per_s);
        Some(self.at_base(state, &(self.flange_jacobian(state)? * rates)))
    }

    /// Returns the Jacobian of the tool's base by the arm's joints, with the rows of [`Self::base_velocity`].
    pub fn base_jacobian(&self, state: &State) -> Option<[Vec<f64>; 6]> {
        let jacobian = self.flange_jacobian(state)?;
        let columns = 0..self.arm_joints().len();
        let columns: Vec<_> =
            columns.map(|joint| self.at_base(state, &jacobian.column(joint).into_owned())).collect();
        Some(core::array::from_fn(|row| columns.iter().map(|column| column[row / 3][row % 3]).collect()))
    }

    /// Returns the Jacobian of the flange in the axes of the arm's base; `None` for a gantry.
    fn flange_jacobian(&self, state: &State) -> Option<SMatrix<f64, 6, MAX_ARM_JOINTS>> {
        (!self.flange_floats()).then(|| self.geometry.frames(&state.arm_joint_position_rad).jacobian())
    }

    /// Transfers a twist of the flange in the axes of the arm's base to the tool's base, world axes.
    fn at_base(&self, state: &State, twist: &Vector6<f64>) -> [[f64; 3]; 2] {
        let turn = self.t_world_arm_base.rotation;
        let angular = turn * Vector3::new(twist[3], twist[4], twist[5]);
        let arm =
            Vector3::from(state.t_world_base.position_m) - Vector3::from(state.t_world_flange.position_m);
        let linear = turn * Vector3::new(twist[0], twist[1], twist[2]) + angular.cross(&arm);
        [linear.into(), angular.into()]
    }
}

/// Returns the names of a scene's arm joints: those of its file, or those of Universal Robots' own
/// description.
fn arm_joints(scene: &Scene, geometry: &ArmGeometry) -> Vec<String> {
    match &scene.arm.joint {
        Some(joints) => {
            let turning = joints.iter().filter(|joint| joint.axis.is_some());
            let legal = |name: &str| foreign_text::plain(name).replace(['<', '>', '&', '"', '\n', '\t'], "_");
            turning.map(|joint| legal(&joint.name)).collect()
        }
        None if geometry.turns() => ARM_JOINT_NAMES.map(str::to_owned).to_vec(),
        None => Vec::new(),
    }
}

/// Returns a count of a message, limited to its array's length.
pub(crate) fn used(count: u32, most: usize) -> usize {
    usize::try_from(count).unwrap_or(most).min(most)
}

/// Converts a message's pose to a transform.
pub fn isometry(pose: &Pose) -> Isometry3<f64> {
    let [x, y, z, w] = pose.orientation_xyzw;
    let rotation = UnitQuaternion::from_quaternion(Quaternion::new(w, x, y, z));
    Isometry3::from_parts(Translation3::from(Vector3::from(pose.position_m)), rotation)
}

#[cfg(test)]
mod tests {
    use std::path::Path;

    use zerocopy::FromZeros;

    use super::*;

    const SCENE: &str = "name = \"bench\"\n[run]\nmode = \"lockstep\"\nduration_s = 1.0\n[tool]\n\
        burr_start_mm = [0.0, 0.0, 0.0]\ndirection = [0.0, 0.0, 1.0]\nbend_toward = [1.0, 0.0, 0.0]\n\
        [arm]\nmodel = \"gantry\"\n";

    fn state(flange_m: [f64; 3]) -> State {
        let mut state = State::new_zeroed();
        let orientation_xyzw = [0.0, 0.6, 0.0, 0.8];
        state.t_world_flange = Pose { position_m: flange_m, orientation_xyzw };
        state.t_world_base = state.t_world_flange;
        state.t_world_burr = state.t_world_flange;
        state.t_world_tip = state.t_world_flange;
        state
    }

    #[test]
    fn a_gantry_has_no_joints_and_its_flange_is_where_the_state_has_it() {
        let scene = Scene::parse(SCENE, Path::new("bench.toml")).unwrap();
        let robot = Robot::new(&scene, &state([0.1, 0.2, 0.3]), Names::default());
        assert_eq!(robot.arm_joints().len(), 0);
        let moved = state([0.15, 0.1, 0.32]);
        let [fixed, flange] = [robot.fixed(), robot.moving(&moved).remove(0)];
        assert_eq!((flange.parent.as_str(), flange.child.as_str()), ("UR5/base", "UR5/flange"));
        let t_world_flange = isometry(&fixed.pose) * isometry(&flange.pose);
        assert!((t_world_flange.translation.vector - Vector3::new(0.15, 0.1, 0.32)).norm() < 1e-15);
        assert_eq!(robot.base_velocity(&moved), None);
        let urdf = crate::urdf::describe(&scene, &robot).unwrap();
        assert!(urdf.contains("<joint name=\"flange\" type=\"floating\">"), "{urdf}");
    }

    #[test]
    fn a_tube_slides_and_turns_between_the_base_and_the_first_flexure() {
        let folder = Path::new(env!("CARGO_MANIFEST_DIR")).join("../../configs/tools");
        let text = format!("{SCENE}[manipulator]\nfile = \"tube_in_tube.toml\"\n");
        let read = |file: &Path| std::fs::read_to_string(file);
        let scene = Scene::parse_with(&text, &folder.join("bench.toml"), &read).unwrap();
        let mut state = state([0.1, 0.2, 0.3]);
        state.joint_count = 1;
        (state.tube_deployed_m, state.tube_roll_rad) = (0.02, 0.5);
        let robot = Robot::new(&scene, &state, Names::default());
        // The first flexure is where the tube's own shaft ends, 40.625 mm from its base.
        let turn = UnitQuaternion::from_axis_angle(&Vector3::z_axis(), 0.5);
        let from_base = Isometry3::from_parts(Translation3::new(0.0, 0.0, 0.060625), turn);
        state.t_world_link[0] = pose(&(isometry(&state.t_world_base) * from_base));
        let placed = robot.moving(&state);
        let of = |child: &str| placed.iter().find(|placed| placed.child == child).unwrap();
        let [slide, tube, link] = ["CM/slide", "CM/tube", "CM/link_0"].map(of);
        assert_eq!([&slide.parent, &tube.parent, &link.parent], ["CM/base", "CM/slide", "CM/tube"]);
        assert!((slide.pose.position_m[2] - 0.02).abs() < 1e-15 && tube.pose.position_m[2].abs() < 1e-15);
        assert!((isometry(&tube.pose).rotation.angle() - 0.5).abs() < 1e-12);
        let at = isometry(&link.pose);
        assert!((at.translation.vector - Vector3::new(0.0, 0.0, 0.040625)).norm() < 1e-12);
        assert!(at.rotation.angle() < 1e-12, "what turns is the tube");
        let urdf = crate::urdf::describe(&scene, &robot).unwrap();
        for line in [
            "<joint name=\"deployed\" type=\"prismatic\"><parent link=\"CM/base\"/><child \
             link=\"CM/slide\"/>",
            "<joint name=\"roll\" type=\"revolute\"><parent link=\"CM/slide\"/><child link=\"CM/tube\"/>",
            "<joint name=\"flexure_0\" type=\"revolute\"><parent link=\"CM/tube\"/>",
            "<limit lower=\"0\" upper=\"0.04\" velocity=\"0.01\" effort=\"0\"/>",
        ] {
            assert!(urdf.contains(line), "{line}\n{urdf}");
        }
    }
}
