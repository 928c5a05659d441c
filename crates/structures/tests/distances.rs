//! Distances from voxels and from a mesh against those of SciPy and trimesh, which
//! `tests/python/distances.py` writes.

#![allow(clippy::unwrap_used, reason = "a test fails by it")]

use nalgebra::Vector3;
use scene::closed_mesh::ClosedMesh;
use scene::mesh::{MeshFormat, triangles};
use structures::{DistanceField, Solid};
use voxel_grid::VoxelGrid;

const DIMS: [usize; 3] = [44, 36, 30];
const SPACING_MM: [f64; 3] = [0.5, 0.6, 0.8];

/// Two balls and a rod, as `voxels` in the script.
fn is_inside(index: usize) -> bool {
    let voxel = [index % DIMS[0], index / DIMS[0] % DIMS[1], index / (DIMS[0] * DIMS[1])];
    let place = [0, 1, 2].map(|axis| voxel[axis] as f64 * SPACING_MM[axis]);
    let ball = |centre: [f64; 3], radius: f64| {
        (0..3).map(|axis| (place[axis] - centre[axis]).powi(2)).sum::<f64>() < radius * radius
    };
    let rod = (place[1] - 12.0).abs() < 1.3 && (place[2] - 15.0).abs() < 1.3 && place[0] > 6.0;
    (ball([7.0, 9.0, 10.0], 4.1) || ball([11.0, 12.0, 13.0], 3.2) || rod) && place[0] < 18.0
}

/// Points, mm, and their distances, mm: of voxels, and of the mesh.
fn references() -> Vec<[([f64; 3], f64); 2]> {
    let row = |line: &str| {
        let numbers: Vec<f64> = line.split(',').map(|number| number.parse().unwrap()).collect();
        [0, 4].map(|at| ([numbers[at], numbers[at + 1], numbers[at + 2]], numbers[at + 3]))
    };
    include_str!("data/distances.csv").lines().skip(1).map(row).collect()
}

/// Checks 1,000 distances, of which more than 50 are negative, to the digits of the file.
fn check(points: impl Iterator<Item = ([f64; 3], f64)>, distance_m: impl Fn(&Vector3<f64>) -> f64) {
    let (mut count, mut inside) = (0, 0);
    for (point_mm, expected_mm) in points {
        let found_mm = 1e3 * distance_m(&(Vector3::from(point_mm) * 1e-3));
        assert!(
            (found_mm - expected_mm).abs() < 1e-5,
            "{point_mm:?}: {found_mm} mm, expected {expected_mm} mm"
        );
        (count, inside) = (count + 1, inside + i32::from(expected_mm < 0.0));
    }
    assert!(count == 1000 && inside > 50, "{count}, {inside} inside");
}

#[test]
fn distances_from_voxels_are_those_of_scipy() {
    let grid = VoxelGrid::axis_aligned(DIMS, SPACING_MM.map(|x| x * 1e-3), [0.0; 3]).unwrap();
    let inside: Vec<bool> = (0..grid.voxel_count()).map(is_inside).collect();
    let field = DistanceField::new(&grid, &inside);
    check(references().into_iter().map(|[voxels, _]| voxels), |point| field.distance_m(point));
}

#[test]
fn distances_from_a_mesh_are_those_of_trimesh() {
    let triangles = triangles(include_bytes!("data/torus.obj"), MeshFormat::Obj, 10_000).unwrap();
    let mesh = ClosedMesh::new(&triangles).unwrap();
    let solid = Solid::new(&mesh, |point_mm| Vector3::from(point_mm) * 1e-3);
    check(references().into_iter().map(|[_, mesh]| mesh), |point| solid.distance_m(point));
}
