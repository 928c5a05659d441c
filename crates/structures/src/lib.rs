//! Critical structures of a scene: nerves, vessels, canals, cartilage, or the outside of the bone.
//!
//! A [`Structure`] has a signed distance, negative inside: in closed form for balls, capsules, boxes and
//! tubes, and sampled on a grid for what a volume defines ([`DistanceField`]). [`Structure::nearest`] finds
//! which of a tool's spheres comes closest to it.
//!
//! **Boundary:** points in, distances out. It only computes. **Invariant:** a query allocates nothing, and
//! its bits depend on the structure and the points alone.
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
mod shape;

use std::sync::Arc;

use nalgebra::Vector3;

pub use field::DistanceField;
pub use shape::Shape;

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

impl Structure {
    /// Returns the least clearance of spheres from the tool's base to its tip, each a centre and a radius, m;
    /// of equals the one nearest the tip. Of an entrance that no sphere has passed yet, it is the margin.
    /// `None` without a sphere.
    pub fn nearest<I>(&self, spheres: I) -> Option<Clearance>
    where
        I: DoubleEndedIterator<Item = (Vector3<f64>, f64)> + ExactSizeIterator,
    {
        if self.is_entrance { self.nearest_inside(spheres) } else { self.nearest_of_all(spheres) }
    }

    fn clearance(&self, sphere: usize, (centre_m, radius_m): (Vector3<f64>, f64)) -> Clearance {
        Clearance { distance_m: self.shape.distance_m(&centre_m) - radius_m, sphere }
    }

    /// From the tip on, because it is usually the nearest: a distance changes by no more than its point
    /// moves, so a sphere too close to the one measured last cannot be nearer than the nearest so far.
    fn nearest_of_all<I>(&self, spheres: I) -> Option<Clearance>
    where
        I: DoubleEndedIterator<Item = (Vector3<f64>, f64)> + ExactSizeIterator,
    {
        let mut all = spheres.enumerate().rev();
        let (index, sphere) = all.next()?;
        let mut least = self.clearance(index, sphere);
        let (mut last_m, mut last_distance_m) = (sphere.0, least.distance_m + sphere.1);
        for (index, sphere) in all {
            let spare_m = last_distance_m - sphere.1 - least.distance_m;
            if spare_m >= 0.0 && (sphere.0 - last_m).norm_squared() <= spare_m * spare_m {
                continue;
            }
            let found = self.clearance(index, sphere);
            (last_m, last_distance_m) = (sphere.0, found.distance_m + sphere.1);
            if found.distance_m < least.distance_m {
                least = found;
            }
        }
        Some(least)
    }

    fn nearest_inside(&self, spheres: impl Iterator<Item = (Vector3<f64>, f64)>) -> Option<Clearance> {
        let mut all = spheres.enumerate().map(|(index, sphere)| self.clearance(index, sphere));
        let first = all.next()?;
        let mut passed = [first].into_iter().chain(all).skip_while(|it| it.distance_m < self.margin_m);
        let deepest = passed.next().unwrap_or(Clearance { distance_m: self.margin_m, ..first });
        Some(passed.fold(deepest, |a, b| if b.distance_m < a.distance_m { b } else { a }))
    }
}

#[cfg(test)]
mod tests {
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
        Structure { name, shape: slab, margin_m, is_entrance: true, on_margin: action, on_breach: action }
    }

    /// A tool of four balls of radius 1, from outside through z = 0.
    fn tool(depths: [f64; 4]) -> impl DoubleEndedIterator<Item = (Vector3<f64>, f64)> + ExactSizeIterator {
        depths.into_iter().map(|z| (Vector3::new(0.0, 0.0, z), 1.0))
    }

    #[test]
    fn the_spheres_in_an_entrance_count_only_behind_the_first_that_keeps_the_margin() {
        let outside = entrance(2.0);
        let found = |depths| outside.nearest(tool(depths)).map(|it| (it.distance_m, it.sphere));
        // Not in yet, or not by the margin.
        assert_eq!(found([-9.0, -6.0, -3.0, 0.0]), Some((2.0, 0)));
        assert_eq!(found([-6.0, -3.0, 0.0, 2.9]), Some((2.0, 0)));
        // In: the second ball is the first that counts, and the tip the least deep after it.
        assert_eq!(found([-3.0, 4.0, 7.0, 3.5]), Some((2.5, 3)));
        assert_eq!(found([-3.0, 4.0, 2.0, -0.5]), Some((-1.5, 3)));
        let nerve = Structure { is_entrance: false, ..outside.clone() };
        assert_eq!(nerve.nearest(tool([-3.0, 4.0, 7.0, 3.5])).map(|it| it.sphere), Some(0));
        assert_eq!(outside.nearest([].into_iter()), None);
    }

    proptest::proptest! {
        /// Spheres that are left out change nothing.
        #[test]
        fn the_nearest_sphere_is_that_of_all(
            spheres in proptest::collection::vec(([-9.0..9.0, -9.0..9.0, -9.0..9.0_f64], 0.1..2.0_f64), 1..40),
        ) {
            let spheres: Vec<_> = spheres.into_iter().map(|(at, radius)| (Vector3::from(at), radius)).collect();
            let structure = Structure { is_entrance: false, ..entrance(1.0) };
            let ball = Shape::Tube { points_m: vec![Vector3::new(1.0, 2.0, 3.0)], radius_m: 1.5 };
            for structure in [Structure { shape: ball, ..structure.clone() }, structure] {
                let found = structure.nearest(spheres.iter().copied()).unwrap();
                let distances = spheres.iter().map(|(centre, radius)| structure.shape.distance_m(centre) - radius);
                proptest::prop_assert_eq!(found.distance_m, distances.fold(f64::INFINITY, f64::min));
            }
        }
    }
}
