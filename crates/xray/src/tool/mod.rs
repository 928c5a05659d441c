//! The tool: closed-form chords of its parts, and the anatomy that they displace.
//!
//! Along a ray, L = L_anatomy - (anatomy inside the union of the parts' envelopes) + sum(mu_metal * chord).
//! The lumen of a hollow part belongs to its envelope and holds air, except where other parts occupy it (a
//! drive cable). Metal in the overlap of two parts counts twice.

mod crossing;
mod part;

use crate::attenuation::Material;
use crate::error::DrrError;
use crate::solids::PlacedSolids;

pub use crossing::{Crossing, join_intervals};
pub(crate) use crossing::{End, SeenPart};
pub use part::PreparedPart;
pub(crate) use part::{LEAST_MITRE_COSINE, Radii};

/// One part of the tool, in the world.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum ToolPart {
    /// A rod or a tube.
    Tube {
        /// Where the axis meets the plane of one end.
        start_m: [f64; 3],
        /// Where the axis meets the plane of the other end.
        end_m: [f64; 3],
        /// Unit normals of the planes that cut the two ends, both from start to end and at most 60 degrees
        /// from the axis; `None` for flat ends. The link beyond, cut by the same plane, fits without a gap
        /// and without overlap.
        normals: Option<[[f64; 3]; 2]>,
        /// Outer radius.
        outer_radius_m: f64,
        /// Radius of the lumen; 0 for a solid rod.
        inner_radius_m: f64,
        /// A notch in the wall, as between two flexures. It belongs to the envelope and holds air.
        notch: Option<Notch>,
        /// Material of the wall or rod.
        material: Material,
    },
    /// A solid frustum of a cone with flat ends.
    Cone {
        /// Centre of one end.
        start_m: [f64; 3],
        /// Centre of the other end.
        end_m: [f64; 3],
        /// Radius at the start, 0 for a point.
        start_radius_m: f64,
        /// Radius at the end, 0 for a point.
        end_radius_m: f64,
        /// Material.
        material: Material,
    },
    /// A solid sphere.
    Sphere {
        /// Centre.
        centre_m: [f64; 3],
        /// Radius.
        radius_m: f64,
        /// Material.
        material: Material,
    },
    /// The part of a solid sphere between two parallel planes, such as a ball in a row of overlapping balls.
    SphereZone {
        /// Centre.
        centre_m: [f64; 3],
        /// Radius.
        radius_m: f64,
        /// Unit normal of the planes.
        axis: [f64; 3],
        /// Positions of the planes along the axis, from the centre, in ascending order; both within the
        /// sphere.
        along_m: [f64; 2],
        /// Material.
        material: Material,
    },
    /// A solid cuboid.
    Cuboid {
        /// Centre.
        centre_m: [f64; 3],
        /// Perpendicular unit vectors along its edges.
        axes: [[f64; 3]; 3],
        /// Half the length of the edges along each axis.
        half_m: [f64; 3],
        /// Material.
        material: Material,
    },
}

impl ToolPart {
    /// A tube with flat, open ends, of these outer and inner radii; a rod if the inner one is 0.
    pub fn tube(start_m: [f64; 3], end_m: [f64; 3], radii_m: [f64; 2], material: Material) -> Self {
        let [outer_radius_m, inner_radius_m] = radii_m;
        Self::Tube { start_m, end_m, normals: None, outer_radius_m, inner_radius_m, notch: None, material }
    }
}

/// A notch in a tube: the cut-out between two planes perpendicular to the axis and beyond a third plane
/// parallel to it.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Notch {
    /// From the tube's start to the first plane of the notch, along the axis.
    pub offset_m: f64,
    /// Width along the axis.
    pub width_m: f64,
    /// Unit vector to the open side, perpendicular to the axis.
    pub side: [f64; 3],
    /// Depth from the tube's outer surface, less than its outer diameter.
    pub depth_m: f64,
}

/// Objects beside the tool, in the world.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct PlacedObjects {
    /// Primitives, in the form of a tool's parts. They displace anatomy.
    pub parts: Vec<ToolPart>,
    /// Meshes, solid. They displace no anatomy.
    pub solids: Vec<PlacedSolids>,
}

/// A tool: any number of parts, the arm that carries it, and the objects beside it. A tool without parts
/// costs nothing, nor do an absent arm and no objects.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct Tool {
    /// The parts, in any order. The order of the sums follows it, and so do the last bits.
    pub parts: Vec<ToolPart>,
    /// The arm, if X-ray frames show it. It displaces no anatomy, and labels leave it out.
    pub arm: Option<PlacedSolids>,
    /// Objects beside the tool.
    pub objects: PlacedObjects,
}

impl Tool {
    /// The validated parts, in their order, and then those of the objects.
    pub(crate) fn prepared(&self) -> impl Iterator<Item = Result<PreparedPart, DrrError>> {
        let prepare =
            |(part, given)| PreparedPart::new(given).map_err(|reason| DrrError::ToolPart { part, reason });
        self.parts.iter().chain(&self.objects.parts).enumerate().map(prepare)
    }
}
