//! A block of bone to drill into.

use nalgebra::Vector3;
use simulation::bone::{BoneError, BoneField, BoneParameters, GridGeometry, MaterialLaw};

pub const RADIUS_M: f64 = 2.5e-3;

/// A block of bone that fills its grid, with the CT it was built from.
pub struct Block {
    pub field: BoneField,
    pub hu: Vec<i16>,
    /// z of its upper face.
    pub top_m: f64,
}

pub fn block(
    size_m: [f64; 3],
    voxel_m: f64,
    material: MaterialLaw,
    hu_at: impl Fn(f64) -> i16,
) -> Result<Block, BoneError> {
    // One layer of air above, so that the face is inside the grid.
    let dims = size_m.map(|s| (s / voxel_m).round() as usize);
    let geometry = GridGeometry::axis_aligned(dims, [voxel_m; 3], Vector3::repeat(0.5 * voxel_m));
    let mut hu = Vec::with_capacity(geometry.voxel_count());
    for k in 0..dims[2] {
        for _ in 0..dims[1] {
            for i in 0..dims[0] {
                hu.push(if k + 1 < dims[2] { hu_at((i as f64 + 0.5) * voxel_m) } else { -1000 });
            }
        }
    }
    let parameters = BoneParameters { material, ..BoneParameters::default() };
    let field = BoneField::new(geometry, &hu, parameters)?;
    Ok(Block { field, hu, top_m: (dims[2] - 1) as f64 * voxel_m })
}

/// A law with energies in proportion to HU: 200 HU is ten times as easy to cut as 2000 HU.
pub fn proportional() -> MaterialLaw {
    MaterialLaw {
        density_offset_kg_m3: 0.0,
        density_slope_kg_m3_hu: 1.0,
        specific_energy_ref_j_m3: 1.0e8,
        density_ref_kg_m3: 2000.0,
        exponent: 1.0,
        ..MaterialLaw::default()
    }
}
