//! Bone for measurements: a block with a position-dependent density.

use nalgebra::Vector3;
use simulation::CtView;
use simulation::bone::{GridGeometry, MaterialLaw};

/// A block of bone with a prescribed density.
pub struct Block {
    /// Grid.
    pub geometry: GridGeometry,
    /// Hounsfield units.
    pub hu: Vec<i16>,
}

/// Hounsfield units for a density, kg/m³, by the standard material law.
pub fn hu_of_density(density_kg_per_m3: f64) -> i16 {
    let law = MaterialLaw::default();
    ((density_kg_per_m3 - law.density_offset_kg_m3) / law.density_slope_kg_m3_hu).round() as i16
}

impl Block {
    /// The block in the form used by the physics.
    pub fn ct(&self) -> CtView<'_> {
        CtView { geometry: self.geometry, hu: &self.hu }
    }

    /// A block with its corners at `low_mm` and `high_mm`; `density_kg_per_m3` maps a point in metres to a
    /// density, 0 for air.
    pub fn new(
        low_mm: [f64; 3],
        high_mm: [f64; 3],
        voxel_mm: f64,
        density_kg_per_m3: impl Fn(&Vector3<f64>) -> f64,
    ) -> Block {
        let dims = [0, 1, 2].map(|a| ((high_mm[a] - low_mm[a]) / voxel_mm).round() as usize);
        let voxel_m = voxel_mm * 1e-3;
        let origin = Vector3::from(low_mm.map(|x| x * 1e-3)).add_scalar(0.5 * voxel_m);
        let geometry = GridGeometry::axis_aligned(dims, [voxel_m; 3], origin);
        let mut hu = Vec::with_capacity(geometry.voxel_count());
        for k in 0..dims[2] {
            for j in 0..dims[1] {
                for i in 0..dims[0] {
                    let density = density_kg_per_m3(&geometry.voxel_centre_world_m(i, j, k));
                    hu.push(if density > 0.0 { hu_of_density(density) } else { -1000 });
                }
            }
        }
        Block { geometry, hu }
    }
}
