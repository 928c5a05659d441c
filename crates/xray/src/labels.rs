//! Ground-truth labels of a frame, per pixel and per joint: for training, segmentation and registration.
//!
//! Labels refer to the rays to the pixel centres, so they have neither noise nor blur.
//! [`DrrRenderer::labels`](crate::DrrRenderer::labels) computes them with Siddon's walk
//! ([`siddon`](crate::siddon)), whichever projector renders the frame.

use crate::carm::CArm;
use crate::ray::WorldRay;
use crate::tool::{PreparedPart, Tool, ToolPart};
use crate::vector::{Vec3, add_scaled, dot, norm, sub};

/// Classes of the mask. A pixel can belong to several, because an X-ray has no foreground.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
pub enum Class {
    /// The ray crosses remaining bone.
    Bone,
    /// The ray crosses metal of the shaft, the links or the drive cable.
    Tool,
    /// The ray crosses the burr.
    Burr,
    /// The ray crosses drilled voxels, including those drilled before the start.
    Tunnel,
    /// The ray crosses an object beside the tool: a wire, a screw, a marker, a rigid body.
    Object,
}

impl Class {
    /// All classes in order of their bits.
    pub const ALL: [Self; 5] = [Self::Bone, Self::Tool, Self::Burr, Self::Tunnel, Self::Object];

    /// The class's bit in [`Labels::mask`]: 1, 2, 4, 8, 16.
    pub fn bit(self) -> u8 {
        1 << self as u8
    }

    /// The class's name in data sets.
    pub fn name(self) -> &'static str {
        match self {
            Self::Bone => "bone",
            Self::Tool => "tool",
            Self::Burr => "burr",
            Self::Tunnel => "tunnel",
            Self::Object => "object",
        }
    }
}

/// What to label in addition to the anatomy.
#[derive(Debug, Clone, Copy)]
pub struct LabelRequest<'a> {
    /// The tool.
    pub tool: &'a Tool,
    /// Index of the tool's first burr part; all later parts belong to the burr too.
    pub burr: usize,
    /// World points to project into the image: base, joints from base to tip, burr.
    pub points_m: &'a [[f64; 3]],
    /// Markers to project into the image: names and world positions of their centres.
    pub markers: &'a [(String, [f64; 3])],
    /// Voxels at or above this are bone.
    pub bone_from_hu: i16,
}

/// The labels of a frame. Images are row-major from the top.
#[derive(Debug, Clone, PartialEq)]
pub struct Labels {
    /// Pixels in a row.
    pub columns: u32,
    /// Pixels in a column.
    pub rows: u32,
    /// Class bits of each pixel, [`Class::bit`].
    pub mask: Vec<u8>,
    /// Attenuation (-ln of the transmission) of the anatomy, excluding what tool and objects displace. Adding
    /// `metal` gives the frame's attenuation before noise and blur, by Siddon's projector.
    pub anatomy: Vec<f32>,
    /// Attenuation added by the metal of the tool, by objects, and by the arm if frames show it. For a single
    /// photon energy this is the line integral through the metal; a spectrum is hardened by the anatomy.
    pub metal: Vec<f32>,
    /// Length of the ray in bone, m; bone that the tool displaces is included.
    pub bone_m: Vec<f32>,
    /// Length of the ray in drilled voxels, m.
    pub tunnel_m: Vec<f32>,
    /// Depth at which the ray first enters a tool part whose metal it crosses, m from the source along the
    /// detector's normal; NaN if there is none.
    pub tool_depth_m: Vec<f32>,
    /// Depth at which the ray first enters bone; NaN without bone.
    pub bone_depth_m: Vec<f32>,
    /// The points of the request.
    pub keypoints: Vec<Keypoint>,
    /// The markers of the request.
    pub markers: Vec<Marker>,
}

/// The centre of a marker ball in the image.
#[derive(Debug, Clone, PartialEq)]
pub struct Marker {
    /// Name: that of the object, with a number if the object has several balls.
    pub name: String,
    /// Centre in the world.
    pub centre_m: [f64; 3],
    /// The centre's projection; overlapped where the ray to it also crosses metal of the tool.
    pub point: Keypoint,
}

impl Labels {
    /// For each pixel, row-major, true if it belongs to the class.
    pub fn of(&self, class: Class) -> impl Iterator<Item = bool> {
        self.mask.iter().map(move |bits| bits & class.bit() != 0)
    }
}

/// A point of the tool in the image.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Keypoint {
    /// Column coordinate; pixel centres are at integers. NaN for a point level with or behind the source.
    pub column: f64,
    /// Row coordinate.
    pub row: f64,
    /// Distance from the source along the detector's normal, m.
    pub depth_m: f64,
    /// Visibility of the point in the image.
    pub visibility: Visibility,
}

/// Visibility of a keypoint, numbered as in COCO.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Visibility {
    /// Not in the image.
    Outside = 0,
    /// In the image, but the ray also crosses another part of the tool: the burr, or a section farther from
    /// the point than the tool's width, as where the tool crosses itself or is seen end-on.
    Overlapped = 1,
    /// In the image, with no other part of the tool in front or behind. Bone hides nothing from X-rays.
    Alone = 2,
}

impl Visibility {
    /// The COCO number: 0, 1 or 2.
    pub fn code(self) -> u8 {
        self as u8
    }
}

/// Name of keypoint `index` out of `count`: `base`, `joint_1` and so on, `burr`.
pub fn keypoint_name(index: usize, count: usize) -> String {
    match index {
        0 => "base".to_owned(),
        last if last + 1 == count => "burr".to_owned(),
        joint => format!("joint_{joint}"),
    }
}

/// Projects points of the tool into the image.
pub(crate) fn keypoints(
    c_arm: &CArm,
    tool: &Tool,
    parts: &[PreparedPart],
    points_m: &[Vec3],
) -> Vec<Keypoint> {
    // The width of the tool itself: the holder behind it has no keypoints.
    let bears = |part: &&ToolPart| points_m.iter().any(|point| is_end(part, *point));
    let width_m = tool.parts.iter().filter(bears).map(half_width_m).fold(0.0, f64::max) * 2.0;
    let at = |&point_m: &Vec3| {
        seen(c_arm, tool, parts, point_m, &|part: &ToolPart| is_another(part, point_m, width_m))
    };
    points_m.iter().map(at).collect()
}

/// Projects the centres of markers into the image.
pub(crate) fn markers(
    c_arm: &CArm,
    tool: &Tool,
    parts: &[PreparedPart],
    markers: &[(String, Vec3)],
) -> Vec<Marker> {
    let at = |(name, centre_m): &(String, Vec3)| {
        let point = seen(c_arm, tool, parts, *centre_m, &|_: &ToolPart| true);
        Marker { name: name.clone(), centre_m: *centre_m, point }
    };
    markers.iter().map(at).collect()
}

/// Projects a point, which parts of the tool for which `counts` holds can overlap.
fn seen(
    c_arm: &CArm,
    tool: &Tool,
    parts: &[PreparedPart],
    point_m: Vec3,
    counts: &dyn Fn(&ToolPart) -> bool,
) -> Keypoint {
    let Some(seen) = c_arm.project(point_m) else {
        let (column, row, depth_m) = (f64::NAN, f64::NAN, f64::NAN);
        return Keypoint { column, row, depth_m, visibility: Visibility::Outside };
    };
    let within = |x: f64, pixels: u32| x >= -0.5 && x < f64::from(pixels) - 0.5;
    let inside =
        within(seen.column, c_arm.columns) && within(seen.row, c_arm.rows) && seen.depth_m <= c_arm.sight().1;
    let ray = WorldRay::between(c_arm.source_m, c_arm.pixel_m(seen.column, seen.row));
    let is_over = |(part, prepared): (&ToolPart, &PreparedPart)| {
        counts(part) && prepared.cross(&ray).is_some_and(|c| c.metal_m > 0.0)
    };
    let visibility = match inside {
        false => Visibility::Outside,
        true if tool.parts.iter().zip(parts).any(is_over) => Visibility::Overlapped,
        true => Visibility::Alone,
    };
    Keypoint { column: seen.column, row: seen.row, depth_m: seen.depth_m, visibility }
}

/// Returns true if the part counts as different from the one that the point lies on.
fn is_another(part: &ToolPart, point_m: Vec3, width_m: f64) -> bool {
    let Some([start_m, end_m]) = axis_ends_m(part) else {
        return matches!(*part, ToolPart::Sphere { centre_m, .. } if norm(sub(centre_m, point_m)) > 1e-9);
    };
    let (along, from_start) = (sub(end_m, start_m), sub(point_m, start_m));
    let nearest = (dot(from_start, along) / dot(along, along)).clamp(0.0, 1.0);
    norm(add_scaled(from_start, -nearest, along)) > width_m
}

/// Returns true if the point is an end of the part's axis.
fn is_end(part: &ToolPart, point_m: Vec3) -> bool {
    axis_ends_m(part).is_some_and(|ends_m| ends_m.iter().any(|end_m| norm(sub(*end_m, point_m)) < 1e-9))
}

/// The ends of a part's axis; `None` for a ball or a cuboid.
fn axis_ends_m(part: &ToolPart) -> Option<[Vec3; 2]> {
    match *part {
        ToolPart::Sphere { .. } | ToolPart::Cuboid { .. } => None,
        ToolPart::SphereZone { centre_m, axis, along_m, .. } => {
            Some(along_m.map(|at_m| add_scaled(centre_m, at_m, axis)))
        }
        ToolPart::Tube { start_m, end_m, .. } | ToolPart::Cone { start_m, end_m, .. } => {
            Some([start_m, end_m])
        }
    }
}

/// Half the width of a part with an axis.
fn half_width_m(part: &ToolPart) -> f64 {
    match *part {
        ToolPart::Sphere { .. } | ToolPart::Cuboid { .. } => 0.0,
        ToolPart::SphereZone { radius_m, .. } => radius_m,
        ToolPart::Tube { outer_radius_m, .. } => outer_radius_m,
        ToolPart::Cone { start_radius_m, end_radius_m, .. } => start_radius_m.max(end_radius_m),
    }
}
