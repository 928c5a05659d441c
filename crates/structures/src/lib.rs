//! Critical structures of a scene: nerves, vessels, canals, cartilage, or the outside of the bone.
//!
//! A [`Structure`] has a signed distance, negative inside: in closed form for balls, capsules, boxes and
//! tubes, from its triangles for a mesh ([`Solid`]), and sampled on a grid for what a volume defines
//! ([`DistanceField`]). [`Structure::nearest`] finds which of a tool's spheres comes closest to it.
//!
//! **Boundary:** points in, distances out. It only computes. **Invariant:** a query allocates nothing, and
//! its bits depend on the structure and the points alone: what is remembered of earlier queries
//! ([`Memory`]) only saves work.
//!
//! ```
//! use nalgebra::Vector3;
//! use structures::Shape;
//!
//! let nerve = Shape::Tube { points_m: vec![Vector3::zeros(), Vector3::new(0.0, 0.0, 0.05)], radius_m: 0.002 };
//! let distance_m = nerve.distance_m(&Vector3::new(0.005, 0.0, 0.02));
//! assert!((distance_m - 0.003).abs() < 1e-12);
//! ```

mod field;
mod regions;
mod shape;
mod solid;

use std::sync::Arc;

use nalgebra::Vector3;

pub use field::DistanceField;
pub use regions::{Regions, Removal};
pub use shape::{Shape, StructureError, label_grid};
pub use solid::Solid;

/// A structure with the distance from it that a tool should keep.
#[derive(Debug, Clone)]
pub struct Structure {
    /// Its name in the scene.
    pub name: Arc<str>,
    /// Its shape.
    pub shape: Shape,
    /// Distance that the tool should keep, m.
    pub margin_m: f64,
    /// Whether the tool comes in through it, as through the outside of a bone: spheres count only behind the
    /// first one, from the base on, that keeps the margin.
    pub is_entrance: bool,
    /// Whether the tool is to remove it, and so to enter it.
    pub is_target: bool,
    /// What happens when the tool comes closer.
    pub on_margin: scene::StructureAction,
    /// What happens when the tool enters it.
    pub on_breach: scene::StructureAction,
}

/// The sphere of a tool that comes closest to a structure.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Clearance {
    /// Distance between the surfaces of sphere and structure, m; negative where they overlap.
    pub distance_m: f64,
    /// Index of the sphere.
    pub sphere: usize,
}

/// The spheres of a tool from its base to its tip, each a centre and a radius, m, and how far they have
/// moved.
#[derive(Debug, Clone, Default)]
pub struct Spheres {
    all: Vec<(Vector3<f64>, f64)>,
    /// Sum of the ways of whichever sphere moved farthest each time, m.
    way_m: f64,
    /// Counts the tools: another number of spheres is another tool.
    tool: u64,
}

impl Spheres {
    /// Takes the spheres' present places. Allocates the first time, or for more spheres.
    pub fn place(&mut self, spheres: impl ExactSizeIterator<Item = (Vector3<f64>, f64)>) {
        if spheres.len() != self.all.len() {
            self.all.clear();
            self.all.extend(spheres);
            self.tool += 1;
            return;
        }
        let (mut most_m2, mut most_grown_m) = (0.0_f64, 0.0_f64);
        for (known, new) in self.all.iter_mut().zip(spheres) {
            most_m2 = most_m2.max((new.0 - known.0).norm_squared());
            most_grown_m = most_grown_m.max((new.1 - known.1).abs());
            *known = new;
        }
        let most_m = libm::sqrt(most_m2) + most_grown_m;
        if most_m > 0.0 {
            // Up, so that the smallest ways add up, too.
            self.way_m = (self.way_m + most_m).next_up();
        }
    }
}

/// What is remembered of a structure's distances from the spheres of a tool, so that those which cannot be
/// the nearest need not be computed again: a distance changes by no more than [`Shape::steepness`] times the
/// way.
#[derive(Debug, Clone, Default)]
pub struct Memory {
    known: Vec<Known>,
    tool: u64,
    first: usize,
    nearest: usize,
}

impl Memory {
    /// Returns the first sphere that counts: those before it are in an entrance.
    pub fn first(&self) -> usize {
        self.first
    }
}

/// A clearance of an earlier query.
#[derive(Debug, Clone, Copy)]
struct Known {
    clearance_m: f64,
    /// [`Spheres::way_m`] at that query; infinitely long ago at first.
    way_m: f64,
}

/// What rounding may add to the change of a clearance, m.
const ROUNDING_M: f64 = 1e-9;

impl Structure {
    /// Returns the least clearance of the spheres; of equals the one nearest the tip. Of an entrance that no
    /// sphere has passed yet, it is the margin. `None` without a sphere. Allocates the first time, or for
    /// more spheres.
    pub fn nearest(&self, spheres: &Spheres, memory: &mut Memory) -> Option<Clearance> {
        let count = spheres.all.len();
        if memory.tool != spheres.tool {
            memory.tool = spheres.tool;
            memory.known.clear();
            memory.known.resize(count, Known { clearance_m: 0.0, way_m: f64::NEG_INFINITY });
            memory.nearest = 0;
        }
        let Memory { known, first: first_passed, nearest, .. } = memory;
        let steepness = self.shape.steepness();
        let change_m = |known: &Known| steepness * (spheres.way_m - known.way_m) + ROUNDING_M;
        let measure = |known: &mut Known, sphere: usize| {
            let (centre_m, radius_m) = &spheres.all[sphere];
            let clearance_m = self.shape.distance_m(centre_m) - radius_m;
            *known = Known { clearance_m, way_m: spheres.way_m };
            clearance_m
        };
        let mut first = 0;
        if self.is_entrance {
            let passes = |sphere: usize, known: &mut Known| {
                let change_m = change_m(known);
                if known.clearance_m + change_m < self.margin_m {
                    false
                } else {
                    known.clearance_m - change_m >= self.margin_m || measure(known, sphere) >= self.margin_m
                }
            };
            match known.iter_mut().enumerate().position(|(sphere, known)| passes(sphere, known)) {
                Some(passed) => first = passed,
                None => {
                    *first_passed = count;
                    return (count > 0).then_some(Clearance { distance_m: self.margin_m, sphere: 0 });
                }
            }
        }
        *first_passed = first;
        let start = if (first..count).contains(nearest) { *nearest } else { count.checked_sub(1)? };
        let mut least = Clearance { distance_m: measure(&mut known[start], start), sphere: start };
        for sphere in (first..count).rev() {
            let known = &mut known[sphere];
            if sphere == start || known.clearance_m - change_m(known) > least.distance_m {
                continue;
            }
            let distance_m = measure(known, sphere);
            if distance_m < least.distance_m || (distance_m == least.distance_m && sphere > least.sphere) {
                least = Clearance { distance_m, sphere };
            }
        }
        *nearest = least.sphere;
        Some(least)
    }
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;
    use scene::StructureAction;

    use super::*;

    /// The half space below z = 0, through which the tool comes.
    fn entrance(margin_m: f64) -> Structure {
        let slab = Shape::Cuboid {
            t_world_cuboid: nalgebra::Isometry3::translation(0.0, 0.0, -50.0),
            half_m: Vector3::new(1e3, 1e3, 50.0),
        };
        let action = StructureAction::Event;
        let name = Arc::from("outside");
        Structure {
            name,
            shape: slab,
            margin_m,
            is_entrance: true,
            is_target: false,
            on_margin: action,
            on_breach: action,
        }
    }

    fn placed(all: &[(Vector3<f64>, f64)]) -> Spheres {
        let mut spheres = Spheres::default();
        spheres.place(all.iter().copied());
        spheres
    }

    /// A tool of four balls of radius 1, from outside through z = 0.
    fn tool(depths: [f64; 4]) -> Spheres {
        placed(&depths.map(|z| (Vector3::new(0.0, 0.0, z), 1.0)))
    }

    #[test]
    fn the_spheres_in_an_entrance_count_only_behind_the_first_that_keeps_the_margin() {
        let outside = entrance(2.0);
        let found = |depths| {
            outside.nearest(&tool(depths), &mut Memory::default()).map(|it| (it.distance_m, it.sphere))
        };
        // Not in yet, or not by the margin.
        assert_eq!(found([-9.0, -6.0, -3.0, 0.0]), Some((2.0, 0)));
        assert_eq!(found([-6.0, -3.0, 0.0, 2.9]), Some((2.0, 0)));
        // In: the second ball is the first that counts, and the tip the least deep after it.
        assert_eq!(found([-3.0, 4.0, 7.0, 3.5]), Some((2.5, 3)));
        assert_eq!(found([-3.0, 4.0, 2.0, -0.5]), Some((-1.5, 3)));
        let nerve = Structure { is_entrance: false, ..outside.clone() };
        let nearest = |structure: &Structure, spheres: &Spheres| {
            structure.nearest(spheres, &mut Memory::default()).map(|it| it.sphere)
        };
        assert_eq!(nearest(&nerve, &tool([-3.0, 4.0, 7.0, 3.5])), Some(0));
        assert_eq!(nearest(&outside, &placed(&[])), None);
    }

    /// Computes the clearance of every sphere.
    fn slowly(structure: &Structure, spheres: &[(Vector3<f64>, f64)]) -> Clearance {
        let clearance =
            |(centre_m, radius_m): &(Vector3<f64>, f64)| structure.shape.distance_m(centre_m) - radius_m;
        let is_in = |it: &(Vector3<f64>, f64)| clearance(it) >= structure.margin_m;
        let first = if structure.is_entrance { spheres.iter().position(is_in) } else { Some(0) };
        let Some(first) = first else { return Clearance { distance_m: structure.margin_m, sphere: 0 } };
        let each = spheres.iter().map(clearance).enumerate().skip(first);
        let each = each.map(|(sphere, distance_m)| Clearance { distance_m, sphere });
        each.reduce(|a, b| if b.distance_m <= a.distance_m { b } else { a }).unwrap()
    }

    proptest! {
        /// What is remembered changes nothing while a tool moves, by small steps and by jumps.
        #[test]
        fn the_nearest_sphere_is_that_of_all(
            start in proptest::collection::vec(([-9.0..9.0, -9.0..9.0, -9.0..9.0_f64], 0.1..2.0_f64), 1..30),
            steps in proptest::collection::vec(([-1.0..1.0, -1.0..1.0, -1.0..1.0_f64], 0..4_i32), 1..60),
        ) {
            let ball = Shape::Tube { points_m: vec![Vector3::new(1.0, 2.0, 3.0)], radius_m: 1.5 };
            let grid = voxel_grid::VoxelGrid::axis_aligned([9; 3], [0.05, 0.06, 0.1], [0.0; 3]).unwrap();
            let voxels: Vec<bool> = (0..729).map(|index| index % 7 == 0 && index > 300).collect();
            let field = Arc::new(DistanceField::new(&grid, &voxels));
            let plain = Structure { is_entrance: false, ..entrance(1.0) };
            let structures = [
                Structure { shape: ball, ..plain.clone() },
                Structure { shape: Shape::Field { field, more_m: 0.1 }, ..plain.clone() },
                plain,
                entrance(1.0),
            ];
            let mut memories = [(); 4].map(|()| Memory::default());
            let mut all: Vec<(Vector3<f64>, f64)> =
                start.into_iter().map(|(at, radius)| (Vector3::from(at), radius)).collect();
            let mut spheres = Spheres::default();
            for (step, size) in steps {
                // A step of the whole tool and a turn, of 1e-3 to 1.
                let step = Vector3::from(step) * 10.0_f64.powi(-size);
                all.iter_mut().for_each(|(centre, _)| *centre += step + step.cross(centre) * 0.1);
                spheres.place(all.iter().copied());
                for (structure, memory) in structures.iter().zip(&mut memories) {
                    prop_assert_eq!(structure.nearest(&spheres, memory), Some(slowly(structure, &all)));
                }
            }
        }
    }
}
