//! The bone's surface, block by block: only blocks whose voxels have changed are meshed again.
//!
//! Method: surface nets (Gibson, "Constrained Elastic Surface Nets", 1998) without relaxation. Each cell of
//! eight voxel centres that the surface crosses has one vertex, the mean of the points where the surface
//! crosses the cell's edges. Each edge between voxels on opposite sides has a quadrilateral of the four cells
//! around it. A cell's vertex depends only on its eight voxels, so blocks meshed at different times fit
//! together exactly.

pub mod bone;
pub mod coarse;
pub mod field;
pub mod link;
pub mod mesh;
pub mod nets;
pub mod structure;
mod tube;

pub use coarse::CoarseBone;
pub use field::{Field, Voxel};
pub use link::{link_mesh, smooth_mesh};
pub use mesh::BlockMesh;
pub use nets::{BLOCK, Blocks};
pub use structure::{SurfaceError, structure_surface};

/// Corners of a triangle, m, counterclockwise seen from outside.
pub type Triangle = [[f64; 3]; 3];
