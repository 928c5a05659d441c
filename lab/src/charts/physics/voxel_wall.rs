//! A tool sphere at rest on a flat wall of voxels: the error of the contact kind alone.

use ipc_types::scene::ContactVoxels;
use nalgebra::Vector3;
use simulation::bone::{BoneError, BoneField, BoneParameters, ContactBuffer, GridGeometry};
use simulation::contact_kind;

/// Radius of the flexures' proxy spheres (Phalen et al. 2023).
const RADIUS_MM: f64 = 3.0;
/// Number of solid voxel layers, and of voxels across.
const LAYERS: usize = 8;
const ACROSS: usize = 40;
/// Positions over one voxel, in each direction.
const PLACES: usize = 8;

/// Returns the largest error of the height at which a sphere rests on the wall, over positions within a
/// voxel, mm.
///
/// # Errors
/// The grid is refused.
pub fn voxel_wall_mm(contact: ContactVoxels, spacing_mm: f64) -> Result<f64, BoneError> {
    let h = spacing_mm * 1e-3;
    let geometry = GridGeometry::axis_aligned([ACROSS; 3], [h; 3], Vector3::zeros());
    let hu: Vec<i16> = (0..geometry.voxel_count())
        .map(|n| if n / (ACROSS * ACROSS) < LAYERS { 1000 } else { -1000 })
        .collect();
    let parameters = BoneParameters { contact: contact_kind(Some(contact)), ..BoneParameters::default() };
    let field = BoneField::new(geometry, &hu, parameters)?;
    // Voxel centres are at integer multiples of the spacing.
    let wall_m = (LAYERS as f64 - 0.5) * h;
    let mut worst_m: f64 = 0.0;
    for place in 0..PLACES * PLACES {
        let offset = |n: usize| (ACROSS as f64 / 2.0 + n as f64 / PLACES as f64) * h;
        let (x, y) = (offset(place % PLACES), offset(place / PLACES));
        worst_m = worst_m.max((resting_height_m(&field, x, y, wall_m) - wall_m - RADIUS_MM * 1e-3).abs());
    }
    Ok(worst_m * 1e3)
}

/// Returns the centre height at which the smallest gap is zero, by bisection: the gap increases with height.
fn resting_height_m(field: &BoneField, x: f64, y: f64, wall_m: f64) -> f64 {
    let radius_m = RADIUS_MM * 1e-3;
    let mut buffer = ContactBuffer::with_capacity(8);
    let (mut low, mut high) = (wall_m + 0.5 * radius_m, wall_m + 1.5 * radius_m);
    for _ in 0..50 {
        let middle = 0.5 * (low + high);
        buffer.clear();
        field.voxels().contact_planes(0, &Vector3::new(x, y, middle), radius_m, radius_m, &mut buffer);
        let gap_m = buffer.planes().iter().fold(f64::INFINITY, |least, plane| least.min(plane.gap_m));
        if gap_m > 0.0 { high = middle } else { low = middle }
    }
    high
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Between four balls of diameter h a sphere of radius r sinks by (r + h/2) (1 - sqrt(1 - (h / sqrt 2)^2
    /// / (r + h/2)^2)).
    #[test]
    fn planes_hold_a_sphere_where_the_wall_is_and_balls_let_it_sink() -> Result<(), BoneError> {
        let (h, reach) = (0.5, RADIUS_MM + 0.25);
        let closed = reach * (1.0 - (1.0 - 0.5 * h * h / (reach * reach)).sqrt());
        let balls = voxel_wall_mm(ContactVoxels::Balls, h)?;
        assert!((balls - closed).abs() < 1e-9, "{balls} mm, closed form {closed}");
        assert!(voxel_wall_mm(ContactVoxels::Planes, h)? < 1e-9);
        Ok(())
    }
}
