//! The surfaces of critical structures, as triangles.

use std::collections::HashMap;

use ipc_types::scene::{Scene, Structure, StructureMesh, StructureVoxels};
use nalgebra::{Isometry3, Point3, Vector3};
use structures::{Shape, StructureError, label_grid};
use thiserror::Error;

use super::tube::tube;
use super::{Blocks, Field, Triangle};

/// Most triangles of a label's surface before they are merged.
const MOST_EXTRACTED: usize = 2_000_000;
/// Factor by which the cells grow in which corners are merged.
const GROWTH: f64 = 1.2;
/// Hounsfield units of a label's voxels above and below the threshold: as those outside of a grid.
const HALF_HU: i16 = 1000;

/// Why a structure is not drawn.
#[derive(Debug, Error)]
pub enum SurfaceError {
    /// It has no shape.
    #[error("{0}")]
    Shape(#[from] StructureError),
    /// A label with more surface than one of an organ.
    #[error("structure `{0}` has a surface of more than {MOST_EXTRACTED} triangles")]
    Intricate(String),
}

/// Returns the surface of a structure where the bone of `[truth]` is, with at most `most` triangles in the
/// patient frame, m, counterclockwise seen from outside; `None` for a built-in structure, whose surface is
/// the bone's.
///
/// The corners are on the surface that distances are measured from. That of a label is extracted as the
/// bone's is, with edges and corners of voxels cut off.
///
/// # Errors
/// [`SurfaceError`]: its file has not been read, or it has too much surface.
pub fn structure_surface(
    scene: &Scene,
    structure: &Structure,
    most: usize,
) -> Result<Option<Vec<Triangle>>, SurfaceError> {
    if structure.built_in.is_some() {
        return Ok(None);
    }
    let triangles = if let Some(mesh) = &structure.mesh {
        mesh_surface(scene, &structure.name, mesh)?
    } else if let Some(label) = &structure.label {
        let unread = || StructureError::Unread(structure.name.clone());
        label_surface(scene, &structure.name, label.voxels.as_ref().ok_or_else(unread)?)?
    } else {
        match Shape::of(scene, structure, None)? {
            Shape::Tube { points_m, radius_m } => tube(&points_m, radius_m),
            Shape::Cuboid { t_world_cuboid, half_m } => cuboid(&t_world_cuboid, &half_m),
            Shape::Solid(_) | Shape::Field { .. } => return Ok(None),
        }
    };
    Ok(Some(merged(triangles, most)))
}

fn malformed(name: &str, problem: String) -> StructureError {
    StructureError::Malformed { name: name.to_owned(), problem }
}

fn cuboid(t_world_cuboid: &Isometry3<f64>, half_m: &Vector3<f64>) -> Vec<Triangle> {
    let corner = |index: usize| -> [f64; 3] {
        let sign = |axis: usize| if index >> axis & 1 == 1 { 1.0 } else { -1.0 };
        let local = half_m.component_mul(&Vector3::new(sign(0), sign(1), sign(2)));
        (t_world_cuboid * Point3::from(local)).into()
    };
    let quads = [[0, 2, 3, 1], [4, 5, 7, 6], [0, 1, 5, 4], [2, 6, 7, 3], [0, 4, 6, 2], [1, 3, 7, 5]];
    quads.iter().flat_map(|[a, b, c, d]| [[*a, *b, *c], [*a, *c, *d]]).map(|it| it.map(corner)).collect()
}

fn mesh_surface(scene: &Scene, name: &str, mesh: &StructureMesh) -> Result<Vec<Triangle>, StructureError> {
    let surface = mesh.surface.as_ref().ok_or_else(|| StructureError::Unread(name.to_owned()))?;
    let mesh = surface.mesh().map_err(|problem| malformed(name, problem))?;
    let place = |corner: &[f64; 3]| scene.in_bone_mm(*corner).map(|x| x * 1e-3);
    let corners_m: Vec<[f64; 3]> = mesh.corners().iter().map(place).collect();
    Ok(mesh.triangles().iter().map(|it| it.map(|index| corners_m[index as usize])).collect())
}

fn label_surface(scene: &Scene, name: &str, voxels: &StructureVoxels) -> Result<Vec<Triangle>, SurfaceError> {
    let is_inside = voxels.is_inside().map_err(|problem| malformed(name, problem))?;
    let grid =
        label_grid(scene, voxels).map_err(|cause| StructureError::Grid { name: name.to_owned(), cause })?;
    let hu: Vec<i16> = is_inside.iter().map(|inside| if *inside { HALF_HU } else { -HALF_HU }).collect();
    let (field, mut blocks) = (Field::new(grid, 0), Blocks::new(&grid));
    let mut triangles = Vec::new();
    while let Some(block) = blocks.mesh_changed(&field, &hu, 1).pop() {
        if triangles.len() + block.indices.len() / 3 > MOST_EXTRACTED {
            return Err(SurfaceError::Intricate(name.to_owned()));
        }
        let corners = block.indices.as_chunks::<3>().0;
        triangles.extend(corners.iter().map(|it| it.map(|vertex| block.vertex_m(vertex))));
    }
    Ok(triangles)
}

/// Merges corners that share a cell of a grid, whose cells grow until at most `most` triangles are left. A
/// closed surface stays closed. Rossignac and Borrel 1993, "Multi-resolution 3D approximations for rendering
/// complex scenes".
fn merged(triangles: Vec<Triangle>, most: usize) -> Vec<Triangle> {
    if triangles.len() <= most {
        return triangles;
    }
    let corners = || triangles.iter().flatten().copied().map(Vector3::from);
    let least_m = corners().fold(Vector3::repeat(f64::INFINITY), |least, corner| least.inf(&corner));
    let area_m2: f64 = triangles.iter().map(area_m2).sum();
    // A cell that the surface crosses leaves about two triangles; fewer where they are long and thin.
    let mut cell_m = (0.1 * area_m2 / most.max(1) as f64).sqrt().max(f64::MIN_POSITIVE);
    loop {
        let mut first_m: HashMap<[i64; 3], [f64; 3]> = HashMap::new();
        let mut place = |corner: [f64; 3]| {
            let cell = ((Vector3::from(corner) - least_m) / cell_m).map(|x| x as i64);
            *first_m.entry(cell.into()).or_insert(corner)
        };
        let placed = triangles.iter().map(|triangle| triangle.map(&mut place));
        let left: Vec<Triangle> = placed.filter(|[a, b, c]| a != b && b != c && c != a).collect();
        // With one cell for everything nothing is left, unless a corner is not a number.
        if left.len() <= most || !cell_m.is_finite() {
            return left;
        }
        cell_m *= GROWTH;
    }
}

fn area_m2(triangle: &Triangle) -> f64 {
    let [a, b, c] = triangle.map(Vector3::from);
    0.5 * (b - a).cross(&(c - a)).norm()
}
