//! The tool: closed-form chords of its parts, and the anatomy they displace.
//!
//! Along a ray, L = L_anatomy - (anatomy inside the union of the parts' envelopes) + sum(mu_metal * chord). A hollow part's
//! lumen belongs to its envelope and holds air, apart from what other parts put there (a drive cable). Metal that two parts
//! both claim counts twice.

mod crossing;
mod part;

use crate::attenuation::Material;

pub(crate) use crossing::SeenPart;
pub use crossing::{Crossing, join_intervals};
pub use part::PreparedPart;
pub(crate) use part::Radii;

/// One part of the tool, in the world.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum ToolPart {
    /// A solid cylinder with flat ends.
    Cylinder {
        /// Centre of one end.
        start_m: [f64; 3],
        /// Centre of the other end.
        end_m: [f64; 3],
        /// Radius.
        radius_m: f64,
        /// What it is made of.
        material: Material,
    },
    /// A tube with flat, open ends.
    HollowCylinder {
        /// Centre of one end.
        start_m: [f64; 3],
        /// Centre of the other end.
        end_m: [f64; 3],
        /// Outer radius.
        outer_radius_m: f64,
        /// Radius of the lumen.
        inner_radius_m: f64,
        /// What the wall is made of.
        material: Material,
    },
    /// A tube with a notch in its wall, as between two flexures. The notch belongs to the envelope and holds air.
    NotchedTube {
        /// Centre of one end.
        start_m: [f64; 3],
        /// Centre of the other end.
        end_m: [f64; 3],
        /// Outer radius.
        outer_radius_m: f64,
        /// Radius of the lumen.
        inner_radius_m: f64,
        /// What was cut out.
        notch: Notch,
        /// What the wall is made of.
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
        /// What it is made of.
        material: Material,
    },
    /// A solid sphere.
    Sphere {
        /// Centre.
        centre_m: [f64; 3],
        /// Radius.
        radius_m: f64,
        /// What it is made of.
        material: Material,
    },
}

/// A notch in a tube: everything between two planes across the axis and beyond a third plane parallel to it is cut out.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Notch {
    /// From the tube's start to the notch's first plane, along the axis.
    pub offset_m: f64,
    /// Width along the axis.
    pub width_m: f64,
    /// The side that is open: a unit vector perpendicular to the axis.
    pub side: [f64; 3],
    /// Depth from the tube's outer surface, less than its outer diameter.
    pub depth_m: f64,
}

/// A tool: any number of parts. A tool without parts costs nothing.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct Tool {
    /// The parts, in any order. Their order fixes the order of the sums, and so the bits.
    pub parts: Vec<ToolPart>,
}
