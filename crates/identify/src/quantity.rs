//! What a sensor measures, as a function of the state.

use messages::{MAX_JOINTS, MAX_TENDONS, Pose, State};
use nalgebra::{Isometry3, Quaternion, Translation3, UnitQuaternion, Vector3};
use run_log::columns::{Column, columns};
use sensors::node_curvatures;
use serde::{Deserialize, Serialize};
use zerocopy::IntoBytes;

use crate::unit::Dimension;

/// A body of the tool.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Body {
    /// The front of the burr.
    #[default]
    Tip,
    /// The centre of the burr.
    Burr,
    /// The start of the tool's shaft.
    Base,
    /// The arm's flange.
    Flange,
    /// The link after a flexure; `link` chooses which.
    Link,
}

/// Frame in which a position or force is measured.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Frame {
    /// The patient frame (LPS), that of the scene.
    Patient,
    /// The tool's base at the start: +z along the straight tool, +x toward tendon 0.
    Start,
    /// The tool's present base.
    Base,
    /// The arm's flange.
    Flange,
}

/// Kinds of quantities.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Kind {
    /// Position of a body, or of a marker on it: x, y, z.
    Position,
    /// Sum of the flexure angles.
    Bend,
    /// Curvature at the nodes of a fibre: toward tendon 0 and across, for each node.
    Curvature,
    /// Tension of the tendons, from tendon 0 on.
    TendonTension,
    /// Displacement of the tendons, from tendon 0 on.
    TendonDisplacement,
    /// Force that the tool exerts on the flange: x, y, z.
    FlangeForce,
    /// Torque that the tool exerts on the flange, about the tool's base: x, y, z.
    FlangeTorque,
    /// Normal force between burr and bone.
    BurrForce,
    /// Normal force between the rest of the tool and bone.
    WallForce,
    /// Distance of the burr's centre from its start, along the straight tool.
    Depth,
    /// Angles of the arm's joints, from the base on.
    ArmJoints,
    /// Column and row of a body, or of a marker on it, in the X-ray frames of the scene's C-arm.
    Pixel,
    /// A field of the state; `field` names it.
    Field,
}

/// Projects a point of the patient frame (m) to column and row.
pub type Projector<'a> = &'a dyn Fn([f64; 3]) -> Option<[f64; 2]>;

/// A quantity with its settings.
#[derive(Debug, Clone, PartialEq)]
pub struct Quantity {
    /// Kind.
    pub kind: Kind,
    /// Body of a position or pixel.
    pub body: Body,
    /// Index of the link, for [`Body::Link`].
    pub link: usize,
    /// Marker in the body's frame, m.
    pub point_m: [f64; 3],
    /// Frame of a position or force.
    pub frame: Frame,
    /// Gauge length of a curvature's node, m.
    pub gauge_m: f64,
    /// Field of the state.
    pub field: Option<Column>,
}

fn isometry(pose: &Pose) -> Isometry3<f64> {
    let [x, y, z, w] = pose.orientation_xyzw;
    let [px, py, pz] = pose.position_m;
    Isometry3::from_parts(
        Translation3::new(px, py, pz),
        UnitQuaternion::from_quaternion(Quaternion::new(w, x, y, z)),
    )
}

impl Kind {
    /// Returns the dimension; that of a field depends on its name.
    pub fn dimension(self, field: Option<&str>) -> Dimension {
        match self {
            Kind::Position | Kind::TendonDisplacement | Kind::Depth => Dimension::Length,
            Kind::Bend | Kind::ArmJoints => Dimension::Angle,
            Kind::Curvature => Dimension::Curvature,
            Kind::TendonTension | Kind::FlangeForce | Kind::BurrForce | Kind::WallForce => Dimension::Force,
            Kind::FlangeTorque => Dimension::Torque,
            Kind::Pixel => Dimension::Pixel,
            Kind::Field => Dimension::of_field(field.unwrap_or_default()),
        }
    }

    /// Checks the number of columns.
    ///
    /// # Errors
    /// The expected number, as text.
    pub fn check_count(self, count: usize) -> Result<(), &'static str> {
        let (is_right, expected) = match self {
            Kind::Position | Kind::FlangeForce | Kind::FlangeTorque => (count == 3, "3 columns: x, y, z"),
            Kind::Pixel => (count == 2, "2 columns: column and row of the image"),
            Kind::Curvature => {
                ((2..=32).contains(&count) && count.is_multiple_of(2), "2 columns for each of 1 to 16 nodes")
            }
            Kind::TendonTension | Kind::TendonDisplacement => {
                ((1..=MAX_TENDONS).contains(&count), "1 to 4 columns, one for each tendon")
            }
            Kind::ArmJoints => ((1..=7).contains(&count), "1 to 7 columns, one for each joint"),
            Kind::Bend | Kind::BurrForce | Kind::WallForce | Kind::Depth | Kind::Field => {
                (count == 1, "1 column")
            }
        };
        if is_right { Ok(()) } else { Err(expected) }
    }

    /// Returns whether its values have a frame.
    pub fn has_frame(self) -> bool {
        matches!(self, Kind::Position | Kind::FlangeForce | Kind::FlangeTorque)
    }
}

impl Quantity {
    /// Returns the scalar that a field's path names.
    ///
    /// # Errors
    /// No such field, or not a scalar.
    pub fn scalar(path: &str) -> Result<Column, String> {
        let description = <State as messages::layout::Message>::DESCRIPTION;
        let found = columns(description, &[path.to_owned()]).map_err(|cause| cause.to_string())?;
        <[Column; 1]>::try_from(found)
            .map(|[column]| column)
            .map_err(|several| format!("`{path}` has {} values, expected one of them", several.len()))
    }

    fn point_m(&self, state: &State) -> Vector3<f64> {
        let pose = match self.body {
            Body::Tip => &state.t_world_tip,
            Body::Burr => &state.t_world_burr,
            Body::Base => &state.t_world_base,
            Body::Flange => &state.t_world_flange,
            Body::Link => &state.t_world_link[self.link.min(MAX_JOINTS - 1)],
        };
        isometry(pose) * nalgebra::Point3::from(self.point_m) - nalgebra::Point3::origin()
    }

    /// Appends the error-free values in SI units, `count` of them; NaN where a value is absent. `start` is
    /// the state at tick 0.
    pub fn values(
        &self,
        state: &State,
        start: &State,
        project: Projector<'_>,
        count: usize,
        out: &mut Vec<f64>,
    ) {
        let before = out.len();
        match self.kind {
            Kind::Position => {
                let point =
                    self.frame_of(state, start).inverse() * nalgebra::Point3::from(self.point_m(state));
                out.extend(point.iter().copied());
            }
            Kind::FlangeForce | Kind::FlangeTorque => {
                let wrench = &state.flange_wrench;
                let vector = if self.kind == Kind::FlangeForce { wrench.force_n } else { wrench.torque_nm };
                let turned = self.frame_of(state, start).rotation.inverse() * Vector3::from(vector);
                out.extend(turned.iter().copied());
            }
            Kind::Bend => out.push(state.bend_rad),
            Kind::Curvature => out.extend(node_curvatures(state, (count / 2) as u32, self.gauge_m)),
            Kind::TendonTension => out.extend(state.tendon_tension_n.iter().take(count)),
            Kind::TendonDisplacement => out.extend(state.tendon_displacement_m.iter().take(count)),
            Kind::BurrForce => out.push(state.burr_force_n),
            Kind::WallForce => out.push(state.wall_force_n),
            Kind::Depth => {
                let from = isometry(&start.t_world_base);
                let moved = Vector3::from(state.t_world_burr.position_m)
                    - Vector3::from(start.t_world_burr.position_m);
                out.push((from.rotation.inverse() * moved).z);
            }
            Kind::ArmJoints => out.extend(state.arm_joint_position_rad.iter().take(count)),
            Kind::Pixel => {
                out.extend(project(self.point_m(state).into()).unwrap_or([f64::NAN; 2]));
            }
            Kind::Field => {
                let value = self.field.as_ref().and_then(|column| column.value(state.as_bytes()));
                out.push(value.map_or(f64::NAN, run_log::fields::Scalar::nearest_f64));
            }
        }
        out.resize(before + count, f64::NAN);
    }

    fn frame_of(&self, state: &State, start: &State) -> Isometry3<f64> {
        match self.frame {
            Frame::Patient => Isometry3::identity(),
            Frame::Start => isometry(&start.t_world_base),
            Frame::Base => isometry(&state.t_world_base),
            Frame::Flange => isometry(&state.t_world_flange),
        }
    }
}
