//! The tool's dimensions, shared by physics, contact spheres, X-ray, viewer and controllers.

use crate::{Arm, Cutter, Manipulator, ToolDescription, ToolFlexure, ToolOuterTube};

/// Radii of the tool.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct ToolRadii {
    /// Outer radius of the notched tube, and of the contact spheres of shaft and links.
    pub tube_outer_m: f64,
    /// Lumen of the tube.
    pub tube_inner_m: f64,
    /// Radius of the flexible drive cable in the lumen; 0 without.
    pub drive_cable_m: f64,
    /// The tube that the tool slides out of, if any.
    pub outer_tube: Option<OuterTubeSize>,
    /// The burr.
    pub cutter: Cutter,
}

/// Size of a straight tube that a tool slides out of.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct OuterTubeSize {
    /// Outer radius.
    pub outer_m: f64,
    /// Lumen radius.
    pub inner_m: f64,
    /// Distance from the tool's base to its end.
    pub end_m: f64,
}

/// The BIGSS/JHU manipulator: a nitinol tube with an outer diameter of 6 mm and a lumen of 4 mm
/// (Murphy et al. 2014, "Design and kinematic characterization of a surgical manipulator with a focus
/// on treating osteolysis", Robotica 32, doi 10.1017/S0263574713001082); contact spheres of 3 mm
/// radius and a burr of 3.25 mm radius as in the open-source simulator
/// (htp2/continuum-manip-volumetric-drilling-plugin). The cable's 2 mm are an assumption: only X-ray
/// frames show it.
pub const STANDARD_RADII: ToolRadii = ToolRadii {
    tube_outer_m: 3.0e-3,
    tube_inner_m: 2.0e-3,
    drive_cable_m: 1.0e-3,
    outer_tube: None,
    cutter: Cutter::ball(3.25e-3),
};

/// The holder between the arm's flange and the tool. The shaft continues from it to the tool's base.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Holder {
    /// Length from the flange.
    pub length_m: f64,
    /// Outer radius.
    pub radius_m: f64,
}

/// Assumed, about the size of a drive unit with two motors; used only for pictures and for the check of the
/// arm against bone.
pub const STANDARD_HOLDER: Holder = Holder { length_m: 0.06, radius_m: 0.02 };

impl Holder {
    /// Length of the holder along the straight line from the flange to the tool's base, which is `distance_m`
    /// long, m: at most up to the base. `None` if the base is on the flange: then there is neither holder nor
    /// bare shaft.
    pub fn reach_m(&self, distance_m: f64) -> Option<f64> {
        (distance_m > ON_FLANGE_M).then(|| self.length_m.min(distance_m))
    }

    /// Where the holder ends and the bare shaft begins, on the line from the flange to the tool's base,
    /// world, m. `None` if the base is on the flange; the base itself if the holder reaches it.
    pub fn front_m(&self, flange_m: [f64; 3], base_m: [f64; 3]) -> Option<[f64; 3]> {
        let way: [f64; 3] = core::array::from_fn(|axis| base_m[axis] - flange_m[axis]);
        let length_m = way.iter().map(|x| x * x).sum::<f64>().sqrt();
        let share = self.reach_m(length_m)? / length_m;
        Some(core::array::from_fn(|axis| flange_m[axis] + share * way[axis]))
    }
}

/// A base closer to the flange than this is on it, m: the mount deflects by less.
const ON_FLANGE_M: f64 = 5e-3;

impl Arm {
    /// The holder on the scene's arm.
    pub fn holder(&self) -> Holder {
        Holder {
            length_m: self.holder_length_mm.map_or(STANDARD_HOLDER.length_m, |mm| mm * 1e-3),
            radius_m: self.holder_diameter_mm.map_or(STANDARD_HOLDER.radius_m, |mm| mm * 0.5e-3),
        }
    }
}

impl ToolRadii {
    /// Largest tube radius of the tool: of the tube, or of the outer tube if it has one.
    pub fn widest_tube_m(&self) -> f64 {
        self.outer_tube.map_or(self.tube_outer_m, |tube| tube.outer_m)
    }
}

impl Manipulator {
    /// The tube that the scene's tool slides out of, if any.
    pub fn outer_tube(&self) -> Option<&ToolOuterTube> {
        self.tool.as_ref()?.outer_tube.as_ref()
    }

    /// The radii of the scene's tool.
    pub fn radii(&self) -> ToolRadii {
        let own = self.tool.as_ref().map_or(STANDARD_RADII, ToolDescription::radii);
        let ball = |diameter_mm: f64| Cutter::ball(diameter_mm * 0.5e-3);
        ToolRadii { cutter: self.burr_diameter_mm.map_or(own.cutter, ball), ..own }
    }
}

/// A single flexure of a tool, expanded from its group.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct FlexurePlace<'a> {
    /// Its entry in the list of flexures, from 0.
    pub entry: usize,
    /// Its centre on the straight tool, from the flange.
    pub at_mm: f64,
    /// Its description.
    pub flexure: &'a ToolFlexure,
}

impl ToolDescription {
    /// The radii of this tool.
    pub fn radii(&self) -> ToolRadii {
        let radius_m = |diameter_mm: f64| diameter_mm / 2e3;
        ToolRadii {
            tube_outer_m: radius_m(self.tube.outer_diameter_mm),
            tube_inner_m: radius_m(self.tube.inner_diameter_mm),
            drive_cable_m: self.tube.drive_cable_diameter_mm.map_or(0.0, radius_m),
            outer_tube: self.outer_tube.as_ref().map(|tube| OuterTubeSize {
                outer_m: radius_m(tube.outer_diameter_mm),
                inner_m: radius_m(tube.inner_diameter_mm),
                end_m: tube.end_mm * 1e-3,
            }),
            cutter: self.burr.cutter(),
        }
    }

    /// Its flexures, expanded from their groups, in file order.
    pub fn flexures(&self) -> Vec<FlexurePlace<'_>> {
        let mut places = Vec::new();
        for (entry, flexure) in self.flexure.iter().enumerate() {
            let pitch_mm = flexure.pitch_mm.unwrap_or(0.0);
            let at_mm = |number: usize| flexure.at_mm + number as f64 * pitch_mm;
            places.extend((0..flexure.count).map(|number| FlexurePlace {
                entry,
                at_mm: at_mm(number),
                flexure,
            }));
        }
        places
    }

    /// Mean distance of a flexure from its neighbours, mm; `None` for a single flexure.
    pub fn pitch_mm(places: &[FlexurePlace], index: usize) -> Option<f64> {
        let (from, to) = (index.saturating_sub(1), (index + 1).min(places.len().saturating_sub(1)));
        let length_mm = places.get(to)?.at_mm - places.get(from)?.at_mm;
        (to > from).then(|| length_mm / (to - from) as f64)
    }

    /// Length of tube that a flexure bends, mm: its own, or half way to either neighbour. `None` for a single
    /// flexure without a length.
    pub fn length_mm(places: &[FlexurePlace], index: usize) -> Option<f64> {
        places.get(index)?.flexure.length_mm.or_else(|| ToolDescription::pitch_mm(places, index))
    }
}
