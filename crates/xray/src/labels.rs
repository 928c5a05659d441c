//! What a frame shows, pixel by pixel and joint by joint: for training, segmentation and registration.
//!
//! Every label is of the rays to the pixels' centres, so it has neither noise nor blur.
//! [`DrrRenderer::labels`](crate::DrrRenderer::labels) makes them by Siddon's walk
//! ([`siddon`](crate::siddon)), whatever projector renders the frame.

use crate::carm::CArm;
use crate::ray::WorldRay;
use crate::tool::{PreparedPart, Tool, ToolPart};
use crate::vector::{Vec3, add_scaled, dot, norm, sub};

/// What a mask tells apart. A pixel may belong to several: an X-ray has no foreground.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
pub enum Class {
    /// The ray crosses bone that is still there.
    Bone,
    /// The ray crosses metal of the shaft, the links or the drive cable.
    Tool,
    /// The ray crosses the burr.
    Burr,
    /// The ray crosses voxels that are drilled, those drilled before the start among them.
    Tunnel,
}

impl Class {
    /// All classes, by rising bit.
    pub const ALL: [Self; 4] = [Self::Bone, Self::Tool, Self::Burr, Self::Tunnel];

    /// Its bit in [`Labels::mask`]: 1, 2, 4, 8.
    pub fn bit(self) -> u8 {
        1 << self as u8
    }

    /// Its name in data sets.
    pub fn name(self) -> &'static str {
        match self {
            Self::Bone => "bone",
            Self::Tool => "tool",
            Self::Burr => "burr",
            Self::Tunnel => "tunnel",
        }
    }
}

/// What to label beside the anatomy.
#[derive(Debug, Clone, Copy)]
pub struct LabelRequest<'a> {
    /// The tool.
    pub tool: &'a Tool,
    /// Number of the first part of the tool that is its burr; those behind it are so too.
    pub burr: usize,
    /// World points to find in the image: base, joints from base to tip, burr.
    pub points_m: &'a [[f64; 3]],
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
    /// The bits of each pixel's classes, [`Class::bit`].
    pub mask: Vec<u8>,
    /// Attenuation (-ln of the transmission) of the anatomy without what the tool displaces. With `metal` it
    /// is that of the frame before noise and blur, by Siddon's projector.
    pub anatomy: Vec<f32>,
    /// Attenuation that the metal of the tool, and of the arm where frames show it, adds. For one photon
    /// energy the line integral of the metal; a spectrum is hardened by the anatomy.
    pub metal: Vec<f32>,
    /// Length of the ray in bone, m. The tool takes none of it away.
    pub bone_m: Vec<f32>,
    /// Length of the ray in drilled voxels, m.
    pub tunnel_m: Vec<f32>,
    /// Depth at which the ray first enters a part of the tool whose metal it crosses, m from the source along
    /// the detector's normal; NaN without one.
    pub tool_depth_m: Vec<f32>,
    /// Depth at which the ray first enters bone; NaN without bone.
    pub bone_depth_m: Vec<f32>,
    /// The points of the request.
    pub keypoints: Vec<Keypoint>,
}

impl Labels {
    /// True where a class is, row-major.
    pub fn of(&self, class: Class) -> impl Iterator<Item = bool> {
        self.mask.iter().map(move |bits| bits & class.bit() != 0)
    }
}

/// A point of the tool in the image.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Keypoint {
    /// Column coordinate; pixel centres are whole numbers. NaN for a point level with or behind the source.
    pub column: f64,
    /// Row coordinate.
    pub row: f64,
    /// Distance from the source along the detector's normal, m.
    pub depth_m: f64,
    /// Whether it can be told in the image.
    pub visibility: Visibility,
}

/// Visibility of a keypoint, by the numbers of COCO.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Visibility {
    /// Not in the image.
    Outside = 0,
    /// In the image, but the ray crosses another part of the tool too: the burr, or a stretch farther from
    /// the point than the tool is wide, as where the tool crosses itself or is seen from its end.
    Overlapped = 1,
    /// In the image, and nothing else of the tool over it. Bone hides nothing from X-rays.
    Alone = 2,
}

impl Visibility {
    /// Its number: 0, 1, 2.
    pub fn code(self) -> u8 {
        self as u8
    }
}

/// Name of a keypoint of so many: `base`, `joint_1` and so on, `burr`.
pub fn keypoint_name(index: usize, count: usize) -> String {
    match index {
        0 => "base".to_owned(),
        last if last + 1 == count => "burr".to_owned(),
        joint => format!("joint_{joint}"),
    }
}

/// Finds points of the tool in the image.
pub(crate) fn keypoints(
    c_arm: &CArm,
    tool: &Tool,
    parts: &[PreparedPart],
    points_m: &[Vec3],
) -> Vec<Keypoint> {
    // The tool's own width: the holder behind it bears no point.
    let bears = |part: &&ToolPart| points_m.iter().any(|point| is_end(part, *point));
    let width_m = tool.parts.iter().filter(bears).map(half_width_m).fold(0.0, f64::max) * 2.0;
    let at = |&point_m: &Vec3| {
        let Some(seen) = c_arm.project(point_m) else {
            let (column, row, depth_m) = (f64::NAN, f64::NAN, f64::NAN);
            return Keypoint { column, row, depth_m, visibility: Visibility::Outside };
        };
        let within = |x: f64, pixels: u32| x >= -0.5 && x < f64::from(pixels) - 0.5;
        let inside = within(seen.column, c_arm.columns)
            && within(seen.row, c_arm.rows)
            && seen.depth_m <= c_arm.sight().1;
        let ray = WorldRay::between(c_arm.source_m, c_arm.pixel_m(seen.column, seen.row));
        let is_over = |(part, prepared): (&ToolPart, &PreparedPart)| {
            is_another(part, point_m, width_m) && prepared.cross(&ray).is_some_and(|c| c.metal_m > 0.0)
        };
        let visibility = match inside {
            false => Visibility::Outside,
            true if tool.parts.iter().zip(parts).any(is_over) => Visibility::Overlapped,
            true => Visibility::Alone,
        };
        Keypoint { column: seen.column, row: seen.row, depth_m: seen.depth_m, visibility }
    };
    points_m.iter().map(at).collect()
}

/// Whether a part counts as another one than that which a point lies on.
fn is_another(part: &ToolPart, point_m: Vec3, width_m: f64) -> bool {
    let Some([start_m, end_m]) = axis_ends_m(part) else {
        return matches!(*part, ToolPart::Sphere { centre_m, .. } if norm(sub(centre_m, point_m)) > 1e-9);
    };
    let (along, from_start) = (sub(end_m, start_m), sub(point_m, start_m));
    let nearest = (dot(from_start, along) / dot(along, along)).clamp(0.0, 1.0);
    norm(add_scaled(from_start, -nearest, along)) > width_m
}

/// Whether a point is an end of a part's axis.
fn is_end(part: &ToolPart, point_m: Vec3) -> bool {
    axis_ends_m(part).is_some_and(|ends_m| ends_m.iter().any(|end_m| norm(sub(*end_m, point_m)) < 1e-9))
}

/// The ends of a part's axis; `None` of a ball.
fn axis_ends_m(part: &ToolPart) -> Option<[Vec3; 2]> {
    match *part {
        ToolPart::Sphere { .. } => None,
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
        ToolPart::Sphere { .. } => 0.0,
        ToolPart::SphereZone { radius_m, .. } => radius_m,
        ToolPart::Tube { outer_radius_m, .. } => outer_radius_m,
        ToolPart::Cone { start_radius_m, end_radius_m, .. } => start_radius_m.max(end_radius_m),
    }
}
