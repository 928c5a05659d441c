//! Rules about the tool's start pose, the bone, the predrilled holes and the bodies.

use nalgebra::Vector3;
use scene::{Drives, Predrill, WIDEST_HOLE_MM};

use super::Start;
use crate::bone::{VoxelKind, Voxels};
use crate::manipulator::{ManipulatorModel, ProxySphere, SphereKind};

/// Coordinate magnitude below which a start may have been given in metres, mm.
const METRES_MM: f64 = 1.0;
/// Distance from bone within which a start is plausible however small its coordinates, m.
const NEAR_M: f64 = 0.01;
/// Distance from bone beyond which a start is most likely a mistake, m.
const FAR_M: f64 = 0.1;
/// Allowed overlap of a body with the tool at the start, m: it is pushed out.
const OVERLAP_M: f64 = 1e-4;
/// Relative rounding of voxel spacings in files.
const ROUNDING: f64 = 1e-6;
/// Depth in bone below which nothing is reported, m: it would display as 0.0 mm, and is often rounding,
/// because a point between two voxels is on the face of both.
const SHALLOW_M: f64 = 5e-5;

impl Start<'_> {
    pub(super) fn voxels(&self) -> Option<&Voxels> {
        self.simulation.bone.as_ref().map(|bone| bone.field.voxels())
    }

    pub(super) fn burr_m(&self) -> Vector3<f64> {
        self.simulation.manipulator.t_world_tip().translation.vector
    }

    pub(super) fn burr_gap_m(&self) -> Option<f64> {
        let voxels = self.voxels()?;
        let gap_m =
            |ball: &ProxySphere| Some(voxels.distance_m(&ball.centre_m, VoxelKind::Bone)? - ball.radius_m);
        self.burr().filter_map(gap_m).min_by(f64::total_cmp)
    }

    /// Returns the burr's spheres.
    fn burr(&self) -> impl Iterator<Item = &ProxySphere> {
        let spheres = self.simulation.manipulator.proxy_spheres().iter();
        spheres.filter(|sphere| sphere.kind == SphereKind::Burr)
    }

    /// Returns the tube's spheres: shaft and segments.
    fn tube(&self) -> impl Iterator<Item = &ProxySphere> {
        let spheres = self.simulation.manipulator.proxy_spheres().iter();
        spheres.filter(|sphere| sphere.kind != SphereKind::Burr)
    }

    fn tube_diameter_mm(&self) -> f64 {
        2e3 * self.simulation.manipulator.parameters().widest_tube_m()
    }

    /// Returns the largest Hounsfield unit of the volume.
    fn most_hu(&self) -> Option<i16> {
        self.simulation.bone.as_ref()?.hu.iter().copied().max()
    }

    /// Returns the volume's largest value, if it is below the threshold.
    fn below_threshold(&self) -> Option<(i16, i16)> {
        // Avoids a search of the CT.
        if self.voxels()?.solid_count() > 0 {
            return None;
        }
        let threshold_hu = self.scene.volume.as_ref()?.bone_threshold_hu;
        self.most_hu().filter(|most_hu| *most_hu < threshold_hu).map(|most_hu| (most_hu, threshold_hu))
    }
}

/// Returns the distance of a point from a hole's axis between its ends, m.
fn from_axis_m(hole: &Predrill, point_m: &Vector3<f64>) -> f64 {
    let [from, to] = [hole.from_mm, hole.to_mm].map(|end| Vector3::from(end) * 1e-3);
    let along = to - from;
    let share = (point_m - from).dot(&along) / along.norm_squared().max(f64::MIN_POSITIVE);
    (point_m - from - along * share.clamp(0.0, 1.0)).norm()
}

pub(super) fn nothing_to_drill(start: &Start) -> Option<String> {
    start.feeds().next()?;
    let (most_hu, threshold_hu) = start.below_threshold()?;
    let problem = format!(
        "is {threshold_hu}; allowed: -1000 to {most_hu} (the volume's largest value): no bone to drill"
    );
    Some(problem)
}

pub(super) fn no_bone(start: &Start) -> Option<String> {
    if start.feeds().next().is_some() {
        return None;
    }
    let (most_hu, threshold_hu) = start.below_threshold()?;
    Some(format!("is {threshold_hu}, but the volume's largest value is {most_hu} HU: no bone to drill"))
}

pub(super) fn start_in_metres(start: &Start) -> Option<String> {
    let given = start.scene.tool.burr_start_mm;
    let geometry = start.voxels()?.geometry();
    let tiny = given.iter().all(|x| x.abs() < METRES_MM) && given != [0.0; 3];
    // The coordinates in metres, read as metres.
    let place = geometry.point_to_grid(&Vector3::from(given));
    let inside =
        (0..3).all(|a| (-0.5..geometry.dims[a] as f64 - 0.5).contains(&(place[a] / geometry.spacing_m[a])));
    let gap_m = start.burr_gap_m.filter(|gap_m| *gap_m > NEAR_M)?;
    let [x, y, z] = given;
    (tiny && inside).then(|| {
        format!(
            "is [{x}, {y}, {z}], {:.1} mm from the nearest bone, but 1000 times that is inside \
             the volume; expected millimetres, not metres",
            gap_m * 1e3
        )
    })
}

pub(super) fn start_far_from_bone(start: &Start) -> Option<String> {
    let gap_m = start.burr_gap_m.filter(|gap_m| *gap_m > FAR_M)?;
    let is_fed = start.feeds().next().is_some();
    (start.is_led(Drives::Arm) && !is_fed)
        .then(|| format!("puts the burr {:.1} mm from the nearest bone", gap_m * 1e3))
}

pub(super) fn burr_in_bone(start: &Start) -> Option<String> {
    let voxels = start.voxels()?;
    let depths_m = start.burr().filter_map(|ball| voxels.distance_m(&ball.centre_m, VoxelKind::Open));
    let depth_m = depths_m.max_by(f64::total_cmp).filter(|depth_m| *depth_m > SHALLOW_M)?;
    let depth_mm = depth_m * 1e3;
    Some(format!(
        "puts the burr {depth_mm:.1} mm inside bone; start in front of it, or in a `[[predrill]]` hole"
    ))
}

pub(super) fn shaft_in_bone(start: &Start) -> Option<String> {
    let voxels = start.voxels()?;
    let depth_m = start.tube().filter_map(|sphere| voxels.distance_m(&sphere.centre_m, VoxelKind::Open));
    let depth_mm = 1e3 * depth_m.fold(0.0, f64::max);
    (depth_mm > SHALLOW_M * 1e3).then(|| {
        format!("puts the shaft up to {depth_mm:.1} mm inside bone; add a `[[predrill]]` hole along it")
    })
}

/// Least distance of the tool from the flange to advise, mm.
const FAR_ENOUGH_MM: f64 = 200.0;
/// By how much to increase a larger one, mm.
const FARTHER_MM: f64 = 100.0;

/// Returns the advice for an arm in bone.
fn farther([x, y, z]: [f64; 3]) -> String {
    let z = FAR_ENOUGH_MM.max(z + FARTHER_MM);
    format!("move the tool farther from the flange, e.g. [{x:?}, {y:?}, {z:?}]")
}

/// Returns the part of the arm deepest in bone, with its depth in mm.
fn deepest(parts: impl Iterator<Item = (&'static str, f64)>) -> Option<(&'static str, f64)> {
    parts.max_by(|a, b| a.1.total_cmp(&b.1)).map(|(name, depth_m)| (name, 1e3 * depth_m))
}

pub(super) fn arm_in_bone(start: &Start) -> Option<String> {
    let (name, depth_mm) = deepest(start.simulation.pieces_in_bone())?;
    let position_mm @ [x, y, z] = start.scene.arm.tool_position_mm;
    Some(format!(
        "is [{x}, {y}, {z}]: the arm's {name} starts {depth_mm:.0} mm inside bone (the arm does not \
         collide); {}",
        farther(position_mm)
    ))
}

pub(super) fn arm_in_bone_at_end(start: &Start) -> Option<String> {
    let length_m = 1e-3 * start.arm_feed()?.length_mm;
    let t_world_tool = start.simulation.arm.state().t_world_tool;
    let ahead_m = t_world_tool.rotation * Vector3::new(0.0, 0.0, length_m);
    let at_end = nalgebra::Translation3::from(ahead_m) * t_world_tool;
    let (name, depth_mm) = deepest(start.simulation.pieces_in_bone_at(&at_end)?.into_iter())?;
    let position_mm @ [x, y, z] = start.scene.arm.tool_position_mm;
    Some(format!(
        "is [{x}, {y}, {z}]: the arm's {name} ends {depth_mm:.0} mm inside bone (the arm does not collide); \
         {}",
        farther(position_mm)
    ))
}

pub(super) fn hole_thinner_than_tool(start: &Start) -> Option<String> {
    let tube_mm = start.tube_diameter_mm();
    let is_tools = |hole: &&Predrill| {
        let radius_m = hole.diameter_mm * 0.5e-3;
        start.tube().any(|sphere| from_axis_m(hole, &sphere.centre_m) < radius_m)
    };
    start.voxels()?;
    let hole = start.scene.predrill.iter().filter(|hole| hole.diameter_mm < tube_mm).find(is_tools)?;
    Some(format!(
        "is {}; allowed: {tube_mm} to {WIDEST_HOLE_MM}: the tool, {tube_mm:.1} mm thick, starts in this hole",
        hole.diameter_mm
    ))
}

pub(super) fn hole_thinner_than_burr(start: &Start) -> Option<String> {
    let burr_mm = 2e3 * start.simulation.manipulator.parameters().cutter.widest_radius_m();
    let tube_mm = start.tube_diameter_mm();
    start.voxels()?;
    let is_burrs = |hole: &&Predrill| {
        (tube_mm..burr_mm).contains(&hole.diameter_mm)
            && from_axis_m(hole, &start.burr_m()) < hole.diameter_mm * 0.5e-3
    };
    let hole = start.scene.predrill.iter().find(is_burrs)?;
    Some(format!(
        "is {}: the burr, {burr_mm:.1} mm in diameter, starts in this hole and touches its wall",
        hole.diameter_mm
    ))
}

pub(super) fn burr_thinner_than_tool(start: &Start) -> Option<String> {
    start.voxels()?;
    let tool = &start.scene.manipulator;
    if tool.burr_diameter_mm.is_none() && tool.tool.is_none() {
        return None;
    }
    let burr_mm = 2e3 * tool.radii().cutter.widest_radius_m();
    // An outer tube that does not advance need not fit.
    let tube_mm = match start.arm_feed() {
        Some(_) => start.tube_diameter_mm(),
        None => 2e3 * tool.radii().tube_outer_m,
    };
    (burr_mm < tube_mm)
        .then(|| format!("is {burr_mm}: the shaft, {tube_mm:.1} mm thick, cannot follow a burr this thin"))
}

/// Checks for tendons outside the tube: guides beside a tube can hold them, but contact and X-ray do not
/// model these.
pub(super) fn tendon_outside_tube(start: &Start) -> Option<String> {
    let tool = start.scene.manipulator.tool.as_ref()?;
    let wall_mm = 0.5 * tool.tube.outer_diameter_mm;
    let from_axis_mm = |tendon: &scene::ToolTendon| libm::hypot(tendon.toward_mm, tendon.across_mm);
    let (index, tendon) = tool
        .tendon
        .iter()
        .enumerate()
        .find(|(_, tendon)| from_axis_mm(tendon) > wall_mm * (1.0 + ROUNDING))?;
    Some(format!(
        "{} is {:.2} mm from the tool axis, outside the tube ({wall_mm:.2} mm): it makes no contact and \
         appears in no X-ray frame",
        index + 1,
        from_axis_mm(tendon)
    ))
}

/// Checks for a thin tip: the smoothed bone surface and the voxels that are cut differ by up to half a voxel,
/// so a thinner tip catches on one and does not reach the other.
pub(super) fn tip_thinner_than_voxels(start: &Start) -> Option<String> {
    let tip_mm = start.scene.manipulator.tool.as_ref()?.burr.tip_diameter_mm?;
    let voxel_mm = 1e3 * start.voxels()?.geometry().spacing_m.into_iter().fold(0.0, f64::max);
    (tip_mm < 2.0 * voxel_mm * (1.0 - ROUNDING)).then(|| {
        format!(
            "is {tip_mm}: a tip thinner than two voxels ({:.2} mm) catches on them, and its force comes \
                 in bursts",
            2.0 * voxel_mm
        )
    })
}

pub(super) fn body_in_tool(start: &Start) -> Option<String> {
    let bodies = start.simulation.rigid.as_ref()?;
    let spheres = start.simulation.manipulator.proxy_spheres();
    let gaps = bodies.gaps_m(spheres);
    let (body, gap_m) = gaps.into_iter().enumerate().min_by(|a, b| a.1.total_cmp(&b.1))?;
    let name = start.scene.body.get(body).map_or("", |body| body.name.as_str());
    (gap_m < -OVERLAP_M).then(|| {
        format!("puts `{name}` {:.2} mm into the tool; allowed: at most {:.1}", -gap_m * 1e3, OVERLAP_M * 1e3)
    })
}
