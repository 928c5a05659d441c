//! Watches the clearance of the tool's contact spheres from the critical structures of the scene.
//!
//! The clearances follow from the state alone, so they change no bit of it and need no place in a keyframe. A
//! structure that is to stop the arm does so in the tick in which the tool comes closer than its margin or
//! enters it; like a force limit, it stops once for each approach, and the arm can leave after `hold`.

use std::sync::Arc;

use messages::Approach;
use scene::{MAX_STRUCTURES, Scene, StructureAction, StructureRole};
use structures::{Clearance, DistanceField, Memory, Shape, Spheres, Structure, StructureError};
use voxel_grid::VoxelGrid;

use super::Simulation;
use super::fixture::Fixture;
use crate::bone::Outside;
use crate::manipulator::{ManipulatorModel, ProxySphere, SphereKind};

/// The structures of a scene and the tool's clearance from them.
#[derive(Debug, Default)]
pub(super) struct StructureWatch {
    pub(super) structures: Vec<Structure>,
    pub(super) spheres: Spheres,
    pub(super) memories: Vec<Memory>,
    pub(super) fixture: Option<Fixture>,
    /// Clearance of each structure, from the present state.
    clearances: Vec<Clearance>,
    /// The structures that the tool came close to or entered in the last tick.
    approaches: Vec<Approach>,
}

/// How near a structure the tool is.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord)]
enum Nearness {
    Clear,
    WithinMargin,
    Inside,
}

impl StructureWatch {
    /// Creates the watch for a scene, whose `[truth]` moves the structures with the bone.
    ///
    /// # Errors
    /// A structure's file has not been read.
    pub fn new(scene: &Scene, outside: Option<&Arc<Outside>>) -> Result<StructureWatch, StructureError> {
        let needs_outside = scene.structure.iter().any(|it| it.built_in.is_some());
        let field = outside.filter(|_| needs_outside).and_then(|outside| outside.field());
        let structure = |of: &scene::Structure| {
            Ok(Structure {
                name: Arc::from(of.name.as_str()),
                shape: Shape::of(scene, of, field.as_ref())?,
                margin_m: of.margin_mm * 1e-3,
                is_entrance: of.built_in.is_some(),
                is_target: of.role == StructureRole::Target,
                on_margin: of.on_margin,
                on_breach: of.on_breach,
            })
        };
        let structures = scene.structure.iter().map(structure).collect::<Result<Vec<_>, _>>()?;
        let count = structures.len();
        Ok(StructureWatch {
            fixture: Fixture::new(&structures),
            structures,
            spheres: Spheres::default(),
            memories: vec![Memory::default(); count],
            clearances: Vec::with_capacity(count),
            approaches: Vec::with_capacity(2 * MAX_STRUCTURES),
        })
    }

    /// Returns the clearances of the present state, in the scene's order.
    pub fn clearances(&self) -> &[Clearance] {
        &self.clearances
    }

    /// Returns the approaches of the last tick.
    pub fn approaches(&self) -> &[Approach] {
        &self.approaches
    }

    fn nearness(&self, structure: usize) -> Nearness {
        match self.clearances.get(structure) {
            Some(clearance) if clearance.distance_m < 0.0 => Nearness::Inside,
            Some(clearance) if clearance.distance_m < self.structures[structure].margin_m => {
                Nearness::WithinMargin
            }
            _ => Nearness::Clear,
        }
    }
}

impl Outside {
    /// Returns the distance from this outside, negative in it; `None` if the grid is not one of a volume.
    fn field(&self) -> Option<Arc<DistanceField>> {
        let geometry = self.geometry();
        let axes = [0, 1, 2].map(|axis| geometry.direction_world_grid.column(axis).into_owned().into());
        let grid =
            VoxelGrid::new(geometry.dims, geometry.spacing_m, geometry.origin_world_m.into(), axes).ok()?;
        Some(DistanceField::shared(&grid, &self.bits()))
    }
}

impl Simulation<'_> {
    /// Measures the clearances of the present state, and stops the arm if a structure asks for it.
    pub(super) fn watch_structures(&mut self) {
        self.structure_watch.approaches.clear();
        if self.structure_watch.structures.is_empty() {
            return;
        }
        let mut before = [Nearness::Clear; MAX_STRUCTURES];
        for (index, nearness) in before.iter_mut().enumerate() {
            *nearness = self.structure_watch.nearness(index);
        }
        self.measure_clearances();
        let count = self.structure_watch.structures.len();
        for (index, before) in before.into_iter().enumerate().take(count) {
            let nearness = self.structure_watch.nearness(index);
            if nearness <= before || self.structure_watch.structures[index].is_target {
                continue;
            }
            let watch = &mut self.structure_watch;
            let (structure, clearance) = (&watch.structures[index], watch.clearances[index]);
            let sphere = &self.manipulator.proxy_spheres()[clearance.sphere];
            let has_entered = nearness == Nearness::Inside;
            let action = if has_entered { structure.on_breach } else { structure.on_margin };
            let skipped_margin = has_entered && before == Nearness::Clear;
            let stops = action == StructureAction::Stop
                || (skipped_margin && structure.on_margin == StructureAction::Stop);
            watch.approaches.push(Approach {
                index,
                structure: Arc::clone(&structure.name),
                has_entered,
                clearance_m: clearance.distance_m,
                part: part(sphere),
                place_m: sphere.centre_m.into(),
                stops,
            });
            if stops {
                self.arm.stop_protectively();
            }
        }
    }

    /// Measures the clearances of the present state alone, as after a keyframe.
    pub(super) fn measure_clearances(&mut self) {
        let watch = &mut self.structure_watch;
        watch.clearances.clear();
        if watch.structures.is_empty() {
            return;
        }
        let spheres = self.manipulator.proxy_spheres().iter();
        watch.spheres.place(spheres.map(|sphere| (sphere.centre_m, sphere.radius_m)));
        for (structure, memory) in watch.structures.iter().zip(&mut watch.memories) {
            watch.clearances.extend(structure.nearest(&watch.spheres, memory));
        }
    }
}

fn part(sphere: &ProxySphere) -> &'static str {
    match sphere.kind {
        SphereKind::Shaft => "shaft",
        SphereKind::Segment(_) => "tube",
        SphereKind::Burr => "burr",
    }
}
