//! Watches the clearance of the tool's contact spheres from the critical structures of the scene.
//!
//! The clearances follow from the state alone, so they change no bit of it and need no place in a keyframe. A
//! structure that is to stop the arm does so in the tick in which the tool comes closer than its margin or
//! enters it; like a force limit, it stops once for each approach, and the arm can leave after `hold`.

use std::sync::Arc;

use messages::Approach;
use nalgebra::{Isometry3, Matrix3, Rotation3, Translation3, UnitQuaternion, Vector3};
use scene::{BuiltInStructure, MAX_STRUCTURES, Scene, StructureAction};
use structures::{Clearance, DistanceField, Shape, Structure};
use voxel_grid::VoxelGrid;

use super::Simulation;
use crate::bone::Outside;
use crate::manipulator::{ManipulatorModel, ProxySphere, SphereKind};

/// The structures of a scene and the tool's clearance from them.
#[derive(Debug, Default)]
pub(super) struct StructureWatch {
    structures: Vec<Structure>,
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
    pub fn new(scene: &Scene, outside: Option<&Arc<Outside>>) -> StructureWatch {
        let needs_outside =
            scene.structure.iter().any(|it| it.built_in == Some(BuiltInStructure::OutsideOfBone));
        let field = outside.filter(|_| needs_outside).and_then(|outside| outside.field()).map(Arc::new);
        let structures: Vec<Structure> =
            scene.structure.iter().filter_map(|it| structure(scene, it, field.as_ref())).collect();
        let count = structures.len();
        StructureWatch {
            structures,
            clearances: Vec::with_capacity(count),
            approaches: Vec::with_capacity(2 * MAX_STRUCTURES),
        }
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

fn structure(
    scene: &Scene,
    of: &scene::Structure,
    outside: Option<&Arc<DistanceField>>,
) -> Option<Structure> {
    let metres = |point_mm: [f64; 3]| Vector3::from(scene.in_bone_mm(point_mm)) * 1e-3;
    let shape = match Shape::of(of, outside)? {
        Shape::Tube { points_m, radius_m } => {
            let moved = |point_m: Vector3<f64>| metres((point_m * 1e3).into());
            Shape::Tube { points_m: points_m.into_iter().map(moved).collect(), radius_m }
        }
        Shape::Cuboid { t_world_cuboid, half_m } => {
            let axes = t_world_cuboid.rotation.to_rotation_matrix();
            let axis = |index: usize| {
                Vector3::from(scene.turned_with_bone(axes.matrix().column(index).into_owned().into()))
            };
            let turned =
                Rotation3::from_matrix_unchecked(Matrix3::from_columns(&[axis(0), axis(1), axis(2)]));
            let centre_m = metres((t_world_cuboid.translation.vector * 1e3).into());
            let rotation = UnitQuaternion::from_rotation_matrix(&turned);
            Shape::Cuboid {
                t_world_cuboid: Isometry3::from_parts(Translation3::from(centre_m), rotation),
                half_m,
            }
        }
        // The volume lies where the bone is.
        Shape::Field(field) => Shape::Field(field),
    };
    Some(Structure {
        name: Arc::from(of.name.as_str()),
        shape,
        margin_m: of.margin_mm * 1e-3,
        is_entrance: of.built_in == Some(BuiltInStructure::OutsideOfBone),
        on_margin: of.on_margin,
        on_breach: of.on_breach,
    })
}

impl Outside {
    /// Returns the distance from this outside, negative in it; `None` if the grid is not one of a volume.
    fn field(&self) -> Option<DistanceField> {
        let geometry = self.geometry();
        let axes = [0, 1, 2].map(|axis| geometry.direction_world_grid.column(axis).into_owned().into());
        let grid =
            VoxelGrid::new(geometry.dims, geometry.spacing_m, geometry.origin_world_m.into(), axes).ok()?;
        Some(DistanceField::new(&grid, &self.bits()))
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
            if nearness <= before {
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
        for structure in &watch.structures {
            let spheres = self.manipulator.proxy_spheres().iter();
            let nearest = structure.nearest(spheres.map(|sphere| (sphere.centre_m, sphere.radius_m)));
            watch.clearances.extend(nearest);
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
