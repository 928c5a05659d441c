//! Describes arm and tool as URDF, so that RViz and SlicerROS2 can draw them: plain cylinders and a ball, no
//! meshes.

use std::fmt::Write;

use nalgebra::{Isometry3, UnitQuaternion, Vector3};
use scene::{Cutter, Scene};
use simulation::manipulator_parameters;

use crate::robot::{Robot, WORLD};
use crate::topics::{TUBE_JOINT_NAMES, joint_names};

/// Drawn radius of the arm's links.
const ARM_RADIUS_M: f64 = 0.04;
/// Range of a flexure in the description; the tool's own stops are nearer.
const FLEXURE_RANGE_RAD: f64 = core::f64::consts::FRAC_PI_2;

/// Returns the robot's description. Its links are the frames of `/tf`, its movable joints those of
/// `measured_js`.
///
/// # Errors
/// The scene's tool is invalid; a session would not have started with it.
pub fn describe(scene: &Scene, robot: &Robot) -> Result<String, simulation::manipulator::ManipulatorError> {
    let tool = manipulator_parameters(scene)?;
    let mut urdf = Urdf::default();
    urdf.link(WORLD, None);
    let fixed = robot.fixed();
    urdf.link(&fixed.child, None);
    urdf.joint("arm_mount", Kind::Fixed, &fixed.parent, &fixed.child, &crate::robot::isometry(&fixed.pose));
    arm(&mut urdf, robot);
    let radii = scene.manipulator.radii();
    let chain = Chain {
        flexures_m: &tool.joint_positions_m,
        burr_from_last_m: tool.tip_offset_m,
        tube_m: radii.tube_outer_m,
        cutter: &radii.cutter,
    };
    chain.add_to(&mut urdf, robot);
    let name = foreign_text::plain(&scene.name).replace(['<', '>', '&', '"'], "_");
    Ok(format!("<?xml version=\"1.0\"?>\n<robot name=\"{name}\">\n{}</robot>\n", urdf.text))
}

fn arm(urdf: &mut Urdf, robot: &Robot) {
    let parts = robot.fixed_parts();
    let joints = robot.arm_joints().len();
    for (index, name) in robot.arm_joints().iter().enumerate() {
        let child = robot.arm_frame(index + 1);
        let next = parts[index + 1].translation.vector;
        urdf.link(&child, Some(Shape::Rod { to: next, radius_m: ARM_RADIUS_M }));
        let [lower, upper, rate] = robot.limits(index);
        let kind = Kind::Revolute { axis: [0, 0, 1], lower, upper, rate };
        urdf.joint(name, kind, &robot.arm_frame(index), &child, &parts[index]);
    }
    urdf.link(&robot.flange(), None);
    let kind = if robot.flange_floats() { Kind::Floating } else { Kind::Fixed };
    urdf.joint("flange", kind, &robot.arm_frame(joints), &robot.flange(), &parts[joints]);
}

/// A tool in the description.
struct Chain<'a> {
    /// z of each flexure on the straight tool.
    flexures_m: &'a [f64],
    burr_from_last_m: f64,
    tube_m: f64,
    cutter: &'a Cutter,
}

impl Chain<'_> {
    fn add_to(&self, urdf: &mut Urdf, robot: &Robot) {
        let along = |z: f64| Vector3::new(0.0, 0.0, z);
        let rod = |z: f64| Some(Shape::Rod { to: along(z), radius_m: self.tube_m });
        let first = self.flexures_m.first().copied().unwrap_or(0.0);
        let outer = robot.outer_tube().map(|outer| Shape::Rod {
            to: along(outer.end_mm * 1e-3),
            radius_m: outer.outer_diameter_mm * 0.5e-3,
        });
        urdf.link(&robot.tool_base(), outer.or_else(|| rod(first)));
        urdf.joint("tool_mount", Kind::Fixed, &robot.flange(), &robot.tool_base(), robot.t_flange_base());
        let (mut parent, mut from) = (robot.tool_base(), 0.0);
        if let Some(outer) = robot.outer_tube() {
            let [slide, tube] = ["slide", "tube"].map(|which| robot.tool_end(which));
            let [deployed, roll] = TUBE_JOINT_NAMES;
            urdf.link(&slide, None);
            let (upper, rate) = (outer.travel_mm * 1e-3, outer.speed_mm_per_s * 1e-3);
            let kind = Kind::Prismatic { axis: [0, 0, 1], lower: 0.0, upper, rate };
            urdf.joint(deployed, kind, &parent, &slide, &Isometry3::identity());
            urdf.link(&tube, rod(first));
            let (turn, rate) = (core::f64::consts::TAU, outer.roll_speed_deg_per_s.to_radians());
            let kind = Kind::Revolute { axis: [0, 0, 1], lower: -turn, upper: turn, rate };
            urdf.joint(roll, kind, &slide, &tube, &Isometry3::identity());
            parent = tube;
        }
        for (index, name) in joint_names("flexure", robot.flexures()).iter().enumerate() {
            let here = self.flexures_m.get(index).copied().unwrap_or(from);
            let next = self.flexures_m.get(index + 1).copied().unwrap_or(here + self.burr_from_last_m);
            let child = robot.tool_link(index);
            let is_last = index + 1 == self.flexures_m.len();
            let covered = if is_last { self.cutter.span_m() } else { 0.0 };
            urdf.link(&child, rod(next - here - covered));
            let (lower, upper) = (-FLEXURE_RANGE_RAD, FLEXURE_RANGE_RAD);
            // Positive bends +z towards +x, the side of tendon 0.
            let kind = Kind::Revolute { axis: [0, 1, 0], lower, upper, rate: 100.0 };
            urdf.joint(name, kind, &parent, &child, &shift(along(here - from)));
            (parent, from) = (child, here);
        }
        let burr = robot.tool_end("burr");
        urdf.link(
            &burr,
            self.cutter
                .balls()
                .iter()
                .map(|ball| Shape::Ball { behind_m: ball.behind_m, radius_m: ball.radius_m }),
        );
        urdf.joint("burr_centre", Kind::Fixed, &parent, &burr, &shift(along(self.burr_from_last_m)));
        let tip = robot.tool_end("tip");
        urdf.link(&tip, None);
        urdf.joint(
            "tip",
            Kind::Fixed,
            &parent,
            &tip,
            &shift(along(self.burr_from_last_m + self.cutter.front_radius_m())),
        );
    }
}

fn shift(by: Vector3<f64>) -> Isometry3<f64> {
    Isometry3::translation(by.x, by.y, by.z)
}

#[derive(Debug, Clone, Copy)]
enum Shape {
    /// From the link's origin to a point.
    Rod { to: Vector3<f64>, radius_m: f64 },
    /// Behind the link's origin, along z.
    Ball { behind_m: f64, radius_m: f64 },
}

#[derive(Debug, Clone, Copy)]
enum Kind {
    Fixed,
    /// Moves freely; its pose comes only from the bridge's transforms.
    Floating,
    Revolute {
        axis: [u8; 3],
        lower: f64,
        upper: f64,
        rate: f64,
    },
    Prismatic {
        axis: [u8; 3],
        lower: f64,
        upper: f64,
        rate: f64,
    },
}

#[derive(Debug, Default)]
struct Urdf {
    text: String,
}

impl Urdf {
    /// Writing to a String cannot fail.
    fn add(&mut self, line: core::fmt::Arguments) {
        let _ = writeln!(self.text, "  {line}");
    }

    fn link(&mut self, name: &str, shapes: impl IntoIterator<Item = Shape>) {
        let visual = |(at, geometry): (Isometry3<f64>, String)| {
            format!("<visual>{}<geometry>{geometry}</geometry></visual>", origin(&at))
        };
        let visuals: String = shapes.into_iter().filter_map(drawn).map(visual).collect();
        if visuals.is_empty() {
            return self.add(format_args!("<link name=\"{name}\"/>"));
        }
        self.add(format_args!("<link name=\"{name}\">{visuals}</link>"));
    }

    fn joint(&mut self, name: &str, kind: Kind, parent: &str, child: &str, at: &Isometry3<f64>) {
        let (word, more) = match kind {
            Kind::Fixed => ("fixed", String::new()),
            Kind::Floating => ("floating", String::new()),
            Kind::Revolute { axis, lower, upper, rate } => ("revolute", limits(axis, [lower, upper, rate])),
            Kind::Prismatic { axis, lower, upper, rate } => ("prismatic", limits(axis, [lower, upper, rate])),
        };
        let origin = origin(at);
        self.add(format_args!(
            "<joint name=\"{name}\" type=\"{word}\"><parent link=\"{parent}\"/><child \
             link=\"{child}\"/>{origin}{more}</joint>"
        ));
    }
}

fn limits([x, y, z]: [u8; 3], [lower, upper, rate]: [f64; 3]) -> String {
    format!(
        "<axis xyz=\"{x} {y} {z}\"/><limit lower=\"{lower}\" upper=\"{upper}\" velocity=\"{rate}\" \
         effort=\"0\"/>"
    )
}

fn origin(at: &Isometry3<f64>) -> String {
    let (roll, pitch, yaw) = at.rotation.euler_angles();
    let at = at.translation.vector;
    format!("<origin xyz=\"{} {} {}\" rpy=\"{roll} {pitch} {yaw}\"/>", at.x, at.y, at.z)
}

/// Returns a shape's pose and its element; `None` for a rod without length.
fn drawn(shape: Shape) -> Option<(Isometry3<f64>, String)> {
    match shape {
        Shape::Ball { behind_m, radius_m } => {
            let at =
                if behind_m > 0.0 { shift(Vector3::new(0.0, 0.0, -behind_m)) } else { Isometry3::identity() };
            Some((at, format!("<sphere radius=\"{radius_m}\"/>")))
        }
        Shape::Rod { to, radius_m } => {
            let length = to.norm();
            if length < 1e-6 {
                return None;
            }
            // A cylinder lies along its own z, centred on its origin; half a turn about x if the rod points
            // straight back.
            let turn = UnitQuaternion::rotation_between(&Vector3::z(), &to).unwrap_or_else(|| {
                UnitQuaternion::from_axis_angle(&Vector3::x_axis(), core::f64::consts::PI)
            });
            let at = Isometry3::from_parts((to / 2.0).into(), turn);
            Some((at, format!("<cylinder radius=\"{radius_m}\" length=\"{length}\"/>")))
        }
    }
}
