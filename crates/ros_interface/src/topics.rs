//! The topics: name, type, quality of service, meaning. `docs/ros2.md` lists the same rows (a test compares
//! them).

use scene::Drives;

/// Names used in topics and frames.
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
    /// Returns whether ROS 2 accepts a name as part of a topic: a letter, then letters, digits and
    /// underscores, no two underscores in a row.
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

/// Quality of service of a topic. History is KEEP_LAST throughout.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Qos {
    /// Reliable, volatile, depth 1. Serves subscribers of both kinds: a reliable publisher also serves
    /// subscribers that request best effort, whereas a subscriber with ROS 2's defaults would receive nothing
    /// from a best-effort one.
    State,
    /// The same, but a late subscriber receives the last message (transient local).
    Latched,
    /// Reliable, volatile, depth 64, and nothing is skipped: what a slow subscriber has no room for follows
    /// later.
    Lossless,
    /// Like [`Qos::State`]; few images are queued for a subscriber that acknowledges none.
    Image,
    /// Required of publishers of commands: reliable, volatile, depth 8.
    Command,
}

impl Qos {
    /// Returns a description for the page.
    pub fn words(self) -> &'static str {
        match self {
            Qos::State | Qos::Image => "reliable, volatile, keep last 1",
            Qos::Lossless => "reliable, volatile, keep last 64",
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
    /// Name of the topic, in which `<arm>` and `<cm>` stand for the names in [`Names`].
    pub template: &'static str,
    /// Package and message, such as `sensor_msgs/JointState`.
    pub kind: &'static str,
    /// Its quality of service.
    pub qos: Qos,
    /// Its content or its effect.
    pub meaning: &'static str,
}

impl<T> Row<T> {
    /// Returns the name that users see.
    pub fn name(&self, names: &Names) -> String {
        names.put_in(self.template)
    }

    /// Returns the name on the wire: ROS 2 puts `rt` before topics.
    pub fn dds_name(&self, names: &Names) -> String {
        format!("rt{}", self.name(names))
    }

    /// Returns the type on the wire: `sensor_msgs::msg::dds_::JointState_`.
    pub fn dds_type(&self) -> String {
        let (package, message) = self.kind.split_once('/').unwrap_or(("", self.kind));
        format!("{package}::msg::dds_::{message}_")
    }
}

/// Declares topics: an enum, and their rows, each `TOPIC "name" "type" QOS "meaning"`.
macro_rules! topics {
    ($(#[doc = $doc:literal])* $topic:ident, $rows:ident;
     $($name:ident $template:literal $kind:literal $qos:ident $meaning:literal;)*) => {
        $(#[doc = $doc])*
        #[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord)]
        pub enum $topic {
            $(#[doc = $meaning] $name,)*
        }

        $(#[doc = $doc])*
        pub const $rows: &[Row<$topic>] = &[$(
            Row { topic: $topic::$name, template: $template, kind: $kind, qos: Qos::$qos, meaning: $meaning },
        )*];
    };
}

topics! {
    /// The topics that the bridge publishes.
    Output, OUTPUTS;
    Clock "/clock" "rosgraph_msgs/Clock" State "simulated time, for `use_sim_time`; every stamp is in it";
    Tf "/tf" "tf2_msgs/TFMessage" State
        "the arm's links, the tool's base, links, burr and tip, the C-arm's camera";
    TfStatic "/tf_static" "tf2_msgs/TFMessage" Latched "`world` to the arm's base";
    RobotDescription "/robot_description" "std_msgs/String" Latched
        "URDF of the scene's arm and tool";
    ArmMeasuredJs "/<arm>/measured_js" "sensor_msgs/JointState" State
        "joint angles and velocities, elastic deflection included";
    ArmSetpointJs "/<arm>/setpoint_js" "sensor_msgs/JointState" State
        "joint angles of the arm's drives: the planned motion, without the deflection";
    ArmMeasuredCp "/<arm>/measured_cp" "geometry_msgs/PoseStamped" State
        "the tool's base in `world`, its mount's deflection included";
    ArmMeasuredCv "/<arm>/measured_cv" "geometry_msgs/TwistStamped" State
        "velocity of the tool's base along the axes of `world`, from the joints' velocities";
    ArmJacobian "/<arm>/jacobian" "std_msgs/Float64MultiArray" State
        "twist of the tool's base in `world` per joint rate";
    ArmMeasuredCf "/<arm>/measured_cf" "geometry_msgs/WrenchStamped" State
        "wrench of the tool on the flange, in the frame of the tool's base";
    OperatingState "/<arm>/operating_state" "crtk_msgs/OperatingState" Latched
        "`ENABLED`, `DISABLED`, `PAUSED` or `FAULT`, and whether a `move_*` is in progress; on each change";
    TendonMeasuredJs "/<cm>/bend_motor/measured_js" "sensor_msgs/JointState" State
        "tendons: displacement in m, positive when pulled, and tension in N as effort";
    FlexureMeasuredJs "/<cm>/measured_js" "sensor_msgs/JointState" State
        "flexure angles and their rates, base to tip";
    TipMeasuredCp "/<cm>/measured_cp" "geometry_msgs/PoseStamped" State
        "the tip, the front of the burr, in `world`";
    BurrMeasuredJs "/<cm>/burr/measured_js" "sensor_msgs/JointState" State
        "angular speed of the burr in rad/s";
    TubeMeasuredJs "/<cm>/tube/measured_js" "sensor_msgs/JointState" State
        "deployed length of the tube, m, and its roll, rad, with their speeds; only for a tool with an \
         outer tube";
    BurrForce "/<cm>/burr/force" "std_msgs/Float64" State "normal force between burr and bone in N";
    TipJacobian "/<cm>/jacobian" "std_msgs/Float64MultiArray" State
        "twist of the tip in `world` per rate of each tension, then per twist of the base; needs \
         `manipulator.tip_jacobian`";
    TipCompliance "/<cm>/compliance" "std_msgs/Float64MultiArray" State
        "displacement of the tip in `world` per wrench on it; needs `manipulator.tip_jacobian`";
    Clearance "/clearance" "std_msgs/Float64MultiArray" State
        "clearance of the tool from each `[[structure]]` in m, negative inside; `layout.dim[i].label` names \
         that of `data[i]`";
    RemovedVoxels "/removed_voxels" "std_msgs/UInt64" State
        "voxels removed since the start or the last reset";
    RemovedPoints "/removed_voxels/points" "sensor_msgs/PointCloud2" Lossless
        "voxels removed since the last cloud: place (x, y, z) and `index` in the CT; see \"Bone\"";
    AnatomyPose "/anatomy/pose" "geometry_msgs/PoseStamped" Latched
        "the centre of the CT's voxel (0, 0, 0), axes along i, j, k";
    AnatomyVoxels "/anatomy/voxels" "std_msgs/Float64MultiArray" Latched
        "numbers of voxels along i, j, k, then their sizes in m; the last is negative if the CT's axes are \
         left-handed";
    BoneSurface "/anatomy/surface" "visualization_msgs/Marker" Latched
        "the bone's surface, decimated to 2400 triangles; at most once a second while it is drilled";
    CArmImage "/c_arm/image_raw" "sensor_msgs/Image" Image
        "the X-ray, `mono16`, or `mono8` if that would be too large";
    CArmInfo "/c_arm/camera_info" "sensor_msgs/CameraInfo" Image
        "the C-arm as a camera: K, P, size; with each image";
    BurrTip "/c_arm/burr_tip" "geometry_msgs/PointStamped" Image
        "the front of the burr in the image, if the source sees it: column and row in pixels, and its distance \
         from the source along the optical axis in m; with each image";
}

topics! {
    /// The topics that the bridge subscribes to, as one of the scene's controllers.
    Input, INPUTS;
    ArmServoJp "/<arm>/servo_jp" "sensor_msgs/JointState" Command "follows joint angles (`position`)";
    ArmServoJv "/<arm>/servo_jv" "sensor_msgs/JointState" Command
        "moves the joints at the given rates (`velocity`)";
    ArmMoveJp "/<arm>/move_jp" "sensor_msgs/JointState" Command
        "moves to joint angles (`position`), jerk-limited";
    ArmTrajectory "/<arm>/joint_trajectory" "trajectory_msgs/JointTrajectory" Command
        "passes joint angles (`positions`) at their times, on straight lines between them; starts on arrival";
    ArmServoCp "/<arm>/servo_cp" "geometry_msgs/PoseStamped" Command
        "follows a pose of the tool's base in `world`";
    ArmMoveCp "/<arm>/move_cp" "geometry_msgs/PoseStamped" Command
        "moves the tool's base to a pose along a straight line, jerk-limited";
    StateCommand "/<arm>/state_command" "crtk_msgs/StringStamped" Command
        "`enable`, `disable`, `pause`, `resume`, `home`, `reset`: see below";
    TendonServoJf "/<cm>/bend_motor/servo_jf" "sensor_msgs/JointState" Command
        "tensions (`effort`, N, 0 to 60)";
    TendonServoJp "/<cm>/bend_motor/servo_jp" "sensor_msgs/JointState" Command
        "tendon displacements (`position`, m)";
    TendonMoveJp "/<cm>/bend_motor/move_jp" "sensor_msgs/JointState" Command
        "tendon displacements (`position`, m), jerk-limited";
    TendonServoJv "/<cm>/bend_motor/servo_jv" "sensor_msgs/JointState" Command
        "rates of tendon displacements (`velocity`, m/s, at most 0.005)";
    BurrServoJv "/<cm>/burr/servo_jv" "sensor_msgs/JointState" Command
        "speed of the burr (`velocity`, rad/s, 0 to 6283.2)";
    CArmTake "/c_arm/take" "geometry_msgs/PoseStamped" Command
        "takes an X-ray of the newest state with the isocentre at a pose in `world`, +x along the rows, +z to the \
         source; it comes on `/c_arm/image_raw`";
    TubeMoveJp "/<cm>/tube/move_jp" "sensor_msgs/JointState" Command
        "deployed length of the tube and its roll (`position`, m and rad), jerk-limited";
}

impl Input {
    /// Returns the part that a controller must drive to use this topic; `None`: any controller may.
    pub fn needs(self) -> Option<Drives> {
        match self {
            Input::ArmServoJp
            | Input::ArmServoJv
            | Input::ArmMoveJp
            | Input::ArmTrajectory
            | Input::ArmServoCp
            | Input::ArmMoveCp => Some(Drives::Arm),
            Input::TendonServoJf | Input::TendonServoJp | Input::TendonMoveJp | Input::TendonServoJv => {
                Some(Drives::Tendon)
            }
            Input::BurrServoJv => Some(Drives::Burr),
            Input::TubeMoveJp => Some(Drives::Tube),
            Input::StateCommand | Input::CArmTake => None,
        }
    }
}

/// The joint names of a tube in an outer tube.
pub const TUBE_JOINT_NAMES: [&str; 2] = ["deployed", "roll"];

/// Returns the names of a tool's joints in `JointState`.
pub fn joint_names(prefix: &str, count: usize) -> Vec<String> {
    (0..count).map(|index| format!("{prefix}_{index}")).collect()
}

/// Names of the arm's joints, from Universal Robots' own description.
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
