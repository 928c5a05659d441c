//! X-ray model of the manipulator and its burr.

use messages::{Pose, State};
use scene::{CutterZone, Holder, Notch as SceneNotch, ToolRadii};

use crate::placement::{x_axis, z_axis};
use crate::tool::LEAST_MITRE_COSINE;
use crate::vector::{Vec3, add_scaled, cross, dot, norm, scale, sub};
use crate::{Material, Notch, Tool, ToolPart};

/// Angle below which links count as collinear (rounding of their positions), rad.
const STRAIGHT_RAD: f64 = 1e-9;
/// Wall thickness of the holder, m (assumed). The drive inside it is not drawn.
const HOLDER_WALL_M: f64 = 2e-3;

/// Builds the X-ray model of a tool: shaft and links as nitinol tubes around a steel cable, the burr as a
/// steel ball. With `notch`, every link between two flexures has a notch at its middle, on alternating sides
/// of the bending plane. Where two links meet at an angle, the bisecting plane through the joint cuts both,
/// so that no wedge is missing and no metal counts twice. Behind the base the shaft continues to the holder
/// on the arm's flange, a steel sleeve. A tool that slides out of an outer tube is surrounded by that steel
/// tube. The burr is the last part. A longer cutter ends in the parts of its balls, cut so that they do not
/// overlap, from front to back, and the last link ends at the centre of the last ball.
pub fn tool_of(state: &State, radii: &ToolRadii, holder: &Holder, notch: Option<&SceneNotch>) -> Tool {
    let front_m = holder.front_m(state.t_world_flange.position_m, state.t_world_base.position_m);
    let cutter = &radii.cutter;
    let ahead = z_axis(&state.t_world_burr.orientation_xyzw);
    let end_m = match cutter.only_radius_m() {
        Some(_) => state.t_world_burr.position_m,
        None => add_scaled(state.t_world_burr.position_m, -cutter.span_m(), ahead),
    };
    let links = links_of(state, front_m, end_m);
    let mut parts = Vec::with_capacity(2 * links.len() + 2 + cutter.balls().len());
    if let Some(sleeve) =
        front_m.and_then(|front_m| Link::new(0, state.t_world_flange.position_m, front_m, [0.0; 3]))
    {
        let inner_m = (holder.radius_m - HOLDER_WALL_M).max(0.0);
        parts.push(sleeve.part([None; 2], [holder.radius_m, inner_m], None, Material::Steel316L));
    }
    if let Some(outer) = &radii.outer_tube {
        let base_m = state.t_world_base.position_m;
        let end_m = add_scaled(base_m, outer.end_m, z_axis(&state.t_world_base.orientation_xyzw));
        let tube = Link::new(0, front_m.unwrap_or(base_m), end_m, [0.0; 3]);
        let part =
            |tube: Link| tube.part([None; 2], [outer.outer_m, outer.inner_m], None, Material::Steel316L);
        parts.extend(tube.map(part));
    }
    for (at, link) in links.iter().enumerate() {
        let before = at.checked_sub(1).and_then(|before| links.get(before));
        let ends = [
            before.and_then(|before| mitre(before.axis, link.axis)),
            links.get(at + 1).and_then(|next| mitre(link.axis, next.axis)),
        ];
        // The first part is the rigid shaft.
        let notch = notch.filter(|_| link.number > 0).and_then(|notch| notch_of(notch, link));
        parts.push(link.part(ends, [radii.tube_outer_m, radii.tube_inner_m], notch, Material::Nitinol));
        if radii.drive_cable_m > 0.0 {
            parts.push(link.part(ends, [radii.drive_cable_m, 0.0], None, Material::Steel316L));
        }
    }
    let centre_m = state.t_world_burr.position_m;
    let material = Material::Steel316L;
    match cutter.only_radius_m() {
        Some(radius_m) => parts.push(ToolPart::Sphere { centre_m, radius_m, material }),
        None => parts.extend(cutter.zones().map(|CutterZone { ball, ahead_m }| ToolPart::SphereZone {
            centre_m: add_scaled(centre_m, -ball.behind_m, ahead),
            radius_m: ball.radius_m,
            axis: ahead,
            along_m: ahead_m,
            material,
        })),
    }
    Tool { parts, ..Tool::default() }
}

/// A straight piece between two joints.
struct Link {
    /// From base to tip; 0 is the shaft, before and behind the base.
    number: usize,
    start_m: Vec3,
    end_m: Vec3,
    axis: Vec3,
    length_m: f64,
    /// Toward tendon 0.
    toward: Vec3,
}

impl Link {
    /// Creates a link between two points; `None` if it has no length.
    fn new(number: usize, start_m: Vec3, end_m: Vec3, toward: Vec3) -> Option<Self> {
        let length_m = norm(sub(end_m, start_m));
        let axis = sub(end_m, start_m).map(|x| x / length_m);
        (length_m >= 1e-6).then_some(Self { number, start_m, end_m, axis, length_m, toward })
    }

    /// Returns a tube along the link, or a rod if the second radius is 0; a normal of `None` gives a flat
    /// end.
    fn part(
        &self,
        ends: [Option<Vec3>; 2],
        [outer_radius_m, inner_radius_m]: [f64; 2],
        notch: Option<Notch>,
        material: Material,
    ) -> ToolPart {
        let Self { start_m, end_m, .. } = *self;
        let notch = notch.filter(|_| inner_radius_m > 0.0);
        let normals = (ends != [None; 2]).then(|| ends.map(|normal| normal.unwrap_or(self.axis)));
        ToolPart::Tube { start_m, end_m, normals, outer_radius_m, inner_radius_m, notch, material }
    }
}

/// Returns the shaft from the holder's front on, and the tool's links from base to the burr at `end_m`,
/// except those without length.
fn links_of(state: &State, front_m: Option<Vec3>, end_m: Vec3) -> Vec<Link> {
    let joints = &state.t_world_link[..(state.joint_count as usize).min(state.t_world_link.len())];
    let origins = core::iter::once(&state.t_world_base).chain(joints);
    let ends = joints.iter().map(|joint| joint.position_m).chain(core::iter::once(end_m));
    let link = |(number, (start, end_m)): (usize, (&Pose, Vec3))| {
        Link::new(number, start.position_m, end_m, x_axis(&start.orientation_xyzw))
    };
    let behind = front_m.and_then(|front_m| Link::new(0, front_m, state.t_world_base.position_m, [0.0; 3]));
    behind.into_iter().chain(origins.zip(ends).enumerate().filter_map(link)).collect()
}

/// Normal of the plane that bisects the angle between two links; `None` if they are collinear or the mitre
/// would be too oblique.
fn mitre(before: Vec3, after: Vec3) -> Option<Vec3> {
    let sum = add_scaled(before, 1.0, after);
    let normal = scale(sum, 1.0 / norm(sum).max(f64::MIN_POSITIVE));
    let turns = norm(cross(before, after)) > STRAIGHT_RAD;
    // With a margin, since the cosines of both links are nearly equal.
    (turns && dot(normal, before) > LEAST_MITRE_COSINE + 1e-6).then_some(normal)
}

/// Keypoints of the tool for labels: base, each joint from base to tip, burr. World frame, m.
pub fn points_of(state: &State) -> Vec<[f64; 3]> {
    let links = &state.t_world_link[..(state.joint_count as usize).min(state.t_world_link.len())];
    let poses = core::iter::once(&state.t_world_base).chain(links);
    poses.chain(core::iter::once(&state.t_world_burr)).map(|pose| pose.position_m).collect()
}

/// The notch of a link; `None` if the link is too short for it.
fn notch_of(notch: &SceneNotch, link: &Link) -> Option<Notch> {
    let width_m = notch.width_mm * 1e-3;
    if width_m >= link.length_m {
        return None;
    }
    // +x of the link points toward tendon 0; remove its component along the axis.
    let across = add_scaled(link.toward, -dot(link.axis, link.toward), link.axis);
    let size = norm(across);
    let turn = if link.number.is_multiple_of(2) { 1.0 } else { -1.0 };
    let side = across.map(|a| turn * a / size);
    (size > 0.1).then_some(Notch {
        offset_m: 0.5 * (link.length_m - width_m),
        width_m,
        side,
        depth_m: notch.depth_mm * 1e-3,
    })
}
