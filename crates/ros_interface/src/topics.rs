//! The topics, each once: name, type, quality of service, meaning. `docs/ros2.md` lists the same rows (a test compares them).

use scene::Drives;

/// Names that stand in topics and frames.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Names {
    /// The arm, as in `/UR5/measured_js`.
    pub arm: String,
    /// The manipulator, as in `/CM/measured_cp`.
    pub manipulator: String,
}

impl Default for Names {
    fn default() -> Names {
        Names { arm: "UR5".into(), manipulator: "CM".into() }
    }
}

impl Names {
    /// A name that ROS 2 takes as a part of a topic: a letter, then letters, digits and underscores, no two underscores in a row.
    pub fn is_legal(name: &str) -> bool {
        name.len() <= 64
            && name.starts_with(|c: char| c.is_ascii_alphabetic())
            && name.chars().all(|c| c.is_ascii_alphanumeric() || c == '_')
            && !name.contains("__")
    }

    fn put_in(&self, template: &str) -> String {
        template.replace("<arm>", &self.arm).replace("<cm>", &self.manipulator)
    }
}

/// How a topic is offered or asked for. History is KEEP_LAST throughout.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Qos {
    /// Reliable, volatile, depth 1: serves subscribers of both kinds, since DDS lets one that asks for best effort have it from a
    /// reliable publisher, and a subscriber with ROS 2's defaults would not hear a best-effort one at all.
    State,
    /// The same, but a subscriber that comes late hears the last message (transient local).
    Latched,
    /// As [`Qos::State`]; few images wait for a subscriber that acknowledges none.
    Image,
    /// What the bridge asks of publishers of commands: reliable, volatile, depth 8.
    Command,
}

impl Qos {
    /// In words, for the page.
    pub fn words(self) -> &'static str {
        match self {
            Qos::State | Qos::Image => "reliable, volatile, keep last 1",
            Qos::Latched => "reliable, transient local, keep last 1",
            Qos::Command => "reliable, volatile, keep last 8",
        }
    }
}

/// One row of the tables.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Row<T> {
    /// Which topic.
    pub topic: T,
    /// Its name; `<arm>` and `<cm>` stand for [`Names`].
    pub template: &'static str,
    /// Package and message, as `sensor_msgs/JointState`.
    pub kind: &'static str,
    /// Its quality of service.
    pub qos: Qos,
    /// What it holds, or what it does.
    pub meaning: &'static str,
}

impl<T> Row<T> {
    /// The name that users see.
    pub fn name(&self, names: &Names) -> String {
        names.put_in(self.template)
    }

    /// The name on the wire: ROS 2 puts `rt` before topics.
    pub fn dds_name(&self, names: &Names) -> String {
        format!("rt{}", self.name(names))
    }

    /// The type on the wire: `sensor_msgs::msg::dds_::JointState_`.
    pub fn dds_type(&self) -> String {
        let (package, message) = self.kind.split_once('/').unwrap_or(("", self.kind));
        format!("{package}::msg::dds_::{message}_")
    }
}

/// What the bridge publishes.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord)]
#[allow(missing_docs, reason = "the table says what each is")]
pub enum Output {
    Clock,
    Tf,
    TfStatic,
    RobotDescription,
    ArmMeasuredJs,
    ArmSetpointJs,
    ArmMeasuredCp,
    ArmMeasuredCv,
    ArmMeasuredCf,
    OperatingState,
    TendonMeasuredJs,
    FlexureMeasuredJs,
    TipMeasuredCp,
    BurrMeasuredJs,
    TubeMeasuredJs,
    BurrForce,
    RemovedVoxels,
    CArmImage,
    CArmInfo,
}

/// What a message that comes in asks for.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord)]
#[allow(missing_docs, reason = "the table says what each is")]
pub enum Input {
    ArmServoJp,
    ArmServoJv,
    ArmMoveJp,
    ArmServoCp,
    ArmMoveCp,
    StateCommand,
    TendonServoJf,
    TendonServoJp,
    TendonMoveJp,
    BurrServoJv,
    TubeMoveJp,
}

impl Input {
    /// The part that a controller must drive for this topic; `None`: every controller may.
    pub fn needs(self) -> Option<Drives> {
        match self {
            Input::ArmServoJp
            | Input::ArmServoJv
            | Input::ArmMoveJp
            | Input::ArmServoCp
            | Input::ArmMoveCp => Some(Drives::Arm),
            Input::TendonServoJf | Input::TendonServoJp | Input::TendonMoveJp => Some(Drives::Tendon),
            Input::BurrServoJv => Some(Drives::Burr),
            Input::TubeMoveJp => Some(Drives::Tube),
            Input::StateCommand => None,
        }
    }
}

const JOINTS: &str = "sensor_msgs/JointState";
const POSE: &str = "geometry_msgs/PoseStamped";

macro_rules! row {
    ($topic:expr, $template:literal, $kind:expr, $qos:ident, $meaning:literal) => {
        Row { topic: $topic, template: $template, kind: $kind, qos: Qos::$qos, meaning: $meaning }
    };
}

/// What the bridge publishes.
pub const OUTPUTS: [Row<Output>; 19] = [
    row!(
        Output::Clock,
        "/clock",
        "rosgraph_msgs/Clock",
        State,
        "simulated time, for `use_sim_time`; every stamp is in it"
    ),
    row!(
        Output::Tf,
        "/tf",
        "tf2_msgs/TFMessage",
        State,
        "the arm's links, the tool's base, links, burr and tip, the C-arm's camera"
    ),
    row!(Output::TfStatic, "/tf_static", "tf2_msgs/TFMessage", Latched, "`world` to the arm's base"),
    row!(
        Output::RobotDescription,
        "/robot_description",
        "std_msgs/String",
        Latched,
        "URDF of arm and tool as the scene has them"
    ),
    row!(
        Output::ArmMeasuredJs,
        "/<arm>/measured_js",
        JOINTS,
        State,
        "joint angles and velocities, elastic deflection included"
    ),
    row!(
        Output::ArmSetpointJs,
        "/<arm>/setpoint_js",
        JOINTS,
        State,
        "joint angles that the arm's drives are at: those of the planned motion, without the deflection"
    ),
    row!(
        Output::ArmMeasuredCp,
        "/<arm>/measured_cp",
        POSE,
        State,
        "the tool's base in `world`, its mount's deflection included"
    ),
    row!(
        Output::ArmMeasuredCv,
        "/<arm>/measured_cv",
        "geometry_msgs/TwistStamped",
        State,
        "velocity of the tool's base along the axes of `world`, from the joints' velocities"
    ),
    row!(
        Output::ArmMeasuredCf,
        "/<arm>/measured_cf",
        "geometry_msgs/WrenchStamped",
        State,
        "wrench of the tool on the flange, in the frame of the tool's base"
    ),
    row!(
        Output::OperatingState,
        "/<arm>/operating_state",
        "crtk_msgs/OperatingState",
        Latched,
        "`ENABLED`, `DISABLED`, `PAUSED` or `FAULT`, and whether a `move_*` is under way; on each change"
    ),
    row!(
        Output::TendonMeasuredJs,
        "/<cm>/bend_motor/measured_js",
        JOINTS,
        State,
        "tendons: displacement in m, positive when pulled, and tension in N as effort"
    ),
    row!(
        Output::FlexureMeasuredJs,
        "/<cm>/measured_js",
        JOINTS,
        State,
        "flexure angles and their rates, base to tip"
    ),
    row!(
        Output::TipMeasuredCp,
        "/<cm>/measured_cp",
        POSE,
        State,
        "the tip, the front of the burr, in `world`"
    ),
    row!(
        Output::BurrMeasuredJs,
        "/<cm>/burr/measured_js",
        JOINTS,
        State,
        "angular speed of the burr in rad/s"
    ),
    row!(
        Output::TubeMeasuredJs,
        "/<cm>/tube/measured_js",
        JOINTS,
        State,
        "how far the tube is out of its outer tube, m, and its roll, rad, with their speeds; of a tool with an outer tube"
    ),
    row!(
        Output::BurrForce,
        "/<cm>/burr/force",
        "std_msgs/Float64",
        State,
        "normal force between burr and bone in N"
    ),
    row!(
        Output::RemovedVoxels,
        "/removed_voxels",
        "std_msgs/UInt64",
        State,
        "voxels removed since the start or the last reset"
    ),
    row!(
        Output::CArmImage,
        "/c_arm/image_raw",
        "sensor_msgs/Image",
        Image,
        "the X-ray, `mono16`, or `mono8` where that would be too large"
    ),
    row!(
        Output::CArmInfo,
        "/c_arm/camera_info",
        "sensor_msgs/CameraInfo",
        Image,
        "the C-arm as a camera: K, P, size; beside each image"
    ),
];

/// What the bridge understands, as one of the scene's controllers.
pub const INPUTS: [Row<Input>; 11] = [
    row!(Input::ArmServoJp, "/<arm>/servo_jp", JOINTS, Command, "follows joint angles (`position`)"),
    row!(Input::ArmServoJv, "/<arm>/servo_jv", JOINTS, Command, "turns the joints at rates (`velocity`)"),
    row!(
        Input::ArmMoveJp,
        "/<arm>/move_jp",
        JOINTS,
        Command,
        "moves to joint angles (`position`), jerk-limited"
    ),
    row!(Input::ArmServoCp, "/<arm>/servo_cp", POSE, Command, "follows a pose of the tool's base in `world`"),
    row!(
        Input::ArmMoveCp,
        "/<arm>/move_cp",
        POSE,
        Command,
        "moves the tool's base to a pose along a straight line, jerk-limited"
    ),
    row!(
        Input::StateCommand,
        "/<arm>/state_command",
        "crtk_msgs/StringStamped",
        Command,
        "`enable`, `disable`, `pause`, `resume`, `home`: see below"
    ),
    row!(
        Input::TendonServoJf,
        "/<cm>/bend_motor/servo_jf",
        JOINTS,
        Command,
        "tensions (`effort`, N, 0 to 60)"
    ),
    row!(
        Input::TendonServoJp,
        "/<cm>/bend_motor/servo_jp",
        JOINTS,
        Command,
        "tendon displacements (`position`, m)"
    ),
    row!(
        Input::TendonMoveJp,
        "/<cm>/bend_motor/move_jp",
        JOINTS,
        Command,
        "tendon displacements (`position`, m), jerk-limited"
    ),
    row!(
        Input::BurrServoJv,
        "/<cm>/burr/servo_jv",
        JOINTS,
        Command,
        "speed of the burr (`velocity`, rad/s, 0 to 6283.2)"
    ),
    row!(
        Input::TubeMoveJp,
        "/<cm>/tube/move_jp",
        JOINTS,
        Command,
        "length of the tube out of its outer tube and its roll (`position`, m and rad), jerk-limited"
    ),
];

/// The names of the tube's joints in an outer tube.
pub const TUBE_JOINT_NAMES: [&str; 2] = ["deployed", "roll"];

/// The names of a tool's joints in `JointState`.
pub fn joint_names(prefix: &str, count: usize) -> Vec<String> {
    (0..count).map(|index| format!("{prefix}_{index}")).collect()
}

/// Names of the arm's joints, as Universal Robots' own description has them.
pub const ARM_JOINT_NAMES: [&str; 6] = [
    "shoulder_pan_joint",
    "shoulder_lift_joint",
    "elbow_joint",
    "wrist_1_joint",
    "wrist_2_joint",
    "wrist_3_joint",
];

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn names_and_types_are_those_of_the_wire() {
        let names = Names::default();
        let servo = INPUTS.iter().find(|row| row.topic == Input::TendonServoJf).unwrap();
        assert_eq!(servo.dds_name(&names), "rt/CM/bend_motor/servo_jf");
        assert_eq!(servo.dds_type(), "sensor_msgs::msg::dds_::JointState_");
    }

    #[test]
    fn a_name_is_what_ros_takes() {
        for legal in ["UR5", "arm_1", "a"] {
            assert!(Names::is_legal(legal), "{legal}");
        }
        for illegal in ["", "5arm", "a/b", "a__b", "bräu", "a b", "_a", &"a".repeat(65)] {
            assert!(!Names::is_legal(illegal), "{illegal}");
        }
    }

    #[test]
    fn no_topic_stands_twice() {
        let mut all: Vec<_> = OUTPUTS.iter().map(|row| row.template).collect();
        all.extend(INPUTS.iter().map(|row| row.template));
        let count = all.len();
        all.sort_unstable();
        all.dedup();
        assert_eq!(all.len(), count);
    }
}
