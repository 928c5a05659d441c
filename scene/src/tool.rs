//! The tool's dimensions, from which physics, contact spheres, X-ray, viewer and controllers take theirs.

use crate::Manipulator;

/// Radii of the tool.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct ToolRadii {
    /// Outside of the notched tube; the contact spheres of shaft and links have it too.
    pub tube_outer_m: f64,
    /// Lumen of the tube.
    pub tube_inner_m: f64,
    /// Flexible drive cable in the lumen.
    pub drive_cable_m: f64,
    /// The burr, a ball.
    pub burr_m: f64,
}

/// The BIGSS/JHU manipulator: a nitinol tube with an outer diameter of 6 mm and a lumen of 4 mm (Murphy et al. 2014, "Design and kinematic
/// characterization of a surgical manipulator with a focus on treating osteolysis", Robotica 32, doi 10.1017/S0263574713001082); contact
/// spheres of 3 mm radius and a burr of 3.25 mm radius as in the open-source simulator (htp2/continuum-manip-volumetric-drilling-plugin).
/// The cable's 2 mm are an assumption: only X-ray frames show it.
pub const STANDARD_RADII: ToolRadii =
    ToolRadii { tube_outer_m: 3.0e-3, tube_inner_m: 2.0e-3, drive_cable_m: 1.0e-3, burr_m: 3.25e-3 };

impl Manipulator {
    /// The radii of the scene's tool.
    pub fn radii(&self) -> ToolRadii {
        let burr_m = self.burr_diameter_mm.map_or(STANDARD_RADII.burr_m, |diameter_mm| diameter_mm * 0.5e-3);
        ToolRadii { burr_m, ..STANDARD_RADII }
    }
}
