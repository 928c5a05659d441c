//! Sorts out candidates by their planned path, before any is simulated.

use ipc_types::scene::{Scene, StructureRole, planned_path_mm};
use nalgebra::Vector3;
use structures::Shape;

use super::offsets::{Offsets, drilling, offset};
use crate::report::course::Course;

/// The planned path of a scene's candidates against its structures.
pub struct Screen {
    /// The scene without its structures, which are large if they come from files.
    bare: Scene,
    /// The structures to avoid whose distance does not come from the volume.
    avoided: Vec<Shape>,
    radius_mm: f64,
}

impl Screen {
    /// Creates the screen of a scene.
    pub fn of(scene: &Scene) -> Screen {
        let avoided = scene.structure.iter().filter(|structure| structure.role == StructureRole::Avoid);
        let shapes = avoided.filter_map(|structure| Shape::of(scene, structure, None).ok());
        let radii = scene.manipulator.radii();
        Screen {
            avoided: shapes.collect(),
            radius_mm: 1e3 * radii.cutter.widest_radius_m().max(radii.tube_outer_m),
            bare: Scene { structure: Vec::new(), ..scene.clone() },
        }
    }

    /// Returns the planned objectives of a candidate, both to be minimised: the clearance with the opposite
    /// sign, and the length of the feed. `None` if the tool cannot bend so far or would enter a structure.
    pub fn objectives(&self, offsets: &Offsets) -> Option<[f64; 2]> {
        let scene = offset(&self.bare, offsets)?;
        let plan = Course::of(&scene, None).plan();
        if plan.planned_radius_mm.zip(plan.possible_radius_mm).is_some_and(|(planned, least)| planned < least)
        {
            return None;
        }
        let path = planned_path_mm(&scene)?;
        let distance_m = |point_mm: &[f64; 3]| {
            let point_m = Vector3::from(*point_mm) * 1e-3;
            self.avoided.iter().map(move |shape| shape.distance_m(&point_m)).fold(f64::INFINITY, f64::min)
        };
        let least_mm = 1e3 * path.iter().map(distance_m).fold(f64::INFINITY, f64::min) - self.radius_mm;
        // Without a structure, all are as far away.
        let clearance_mm = if self.avoided.is_empty() { 0.0 } else { least_mm };
        (clearance_mm >= 0.0).then_some([-clearance_mm, drilling(&scene)?.insertion_mm])
    }
}
