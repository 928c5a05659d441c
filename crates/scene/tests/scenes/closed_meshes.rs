//! Tests which meshes count as the surface of a solid.
#![allow(clippy::unwrap_used, reason = "a test fails by it")]

use scene::closed_mesh::{ClosedMesh, MeshFault};
use scene::mesh::Triangle;

/// A box between two corners, facing outward or, if turned, inward.
fn cuboid(low: [f32; 3], high: [f32; 3], is_turned: bool) -> Vec<Triangle> {
    let mut triangles = Vec::new();
    for axis in 0..3 {
        for (side, order) in [(low, [0, 2, 1, 0, 3, 2]), (high, [0, 1, 2, 0, 2, 3])] {
            let corner = |k: usize| {
                let (u, v) = ((axis + 1) % 3, (axis + 2) % 3);
                let mut at = [side[axis]; 3];
                (at[u], at[v]) =
                    [(low[u], low[v]), (high[u], low[v]), (high[u], high[v]), (low[u], high[v])][k];
                at
            };
            for facet in order.chunks(3) {
                let [a, b, c] = [corner(facet[0]), corner(facet[1]), corner(facet[2])];
                triangles.push(if is_turned { [a, c, b] } else { [a, b, c] });
            }
        }
    }
    triangles
}

fn volume(shells: &[Vec<Triangle>]) -> f64 {
    ClosedMesh::new(&shells.concat()).unwrap().volume()
}

#[test]
fn shells_are_turned_outward_and_those_turned_against_what_is_around_are_cavities() {
    let cube = |size: f32, is_turned| cuboid([-size; 3], [size; 3], is_turned);
    let beside = |is_turned| cuboid([4.0, 0.0, 0.0], [5.0, 1.0, 1.0], is_turned);
    for (shells, expected) in [
        (vec![cube(1.0, false)], 8.0),
        (vec![cube(1.0, true)], 8.0),
        // Side by side, in either orientation.
        (vec![cube(1.0, false), beside(true)], 9.0),
        (vec![beside(false), cube(1.0, true)], 9.0),
        // A cavity of half the size, in a file with either orientation, optionally with a solid inside the
        // cavity.
        (vec![cube(0.5, true), cube(1.0, false)], 7.0),
        (vec![cube(1.0, true), cube(0.5, false)], 7.0),
        (vec![cube(1.0, false), cube(0.5, true), cube(0.25, false)], 7.125),
        (vec![cube(1.0, true), cube(0.5, false), cube(0.25, true)], 7.125),
        // With the same orientation, it is a second solid in the same place.
        (vec![cube(1.0, false), cube(0.5, false)], 9.0),
    ] {
        let found = volume(&shells);
        assert!((found - expected).abs() < 1e-12, "{found} of {expected}");
    }
    let mesh = ClosedMesh::new(&cube(1.0, false)).unwrap();
    assert_eq!((mesh.corners().len(), mesh.triangles().len(), mesh.bounds()), (8, 12, [[-1.0; 3], [1.0; 3]]));
    for factor in [0.5, -0.5] {
        let scaled = mesh.clone().scaled([2.0, 1.0, factor]);
        assert!((scaled.volume() - 8.0).abs() < 1e-12, "mirrored or not");
    }
}

#[test]
fn holes_turned_neighbours_and_sheets_are_refused_with_their_place() {
    let cube = cuboid([0.0; 3], [1.0; 3], false);
    let fault = |triangles: &[Triangle]| ClosedMesh::new(triangles).unwrap_err();
    for gone in 0..cube.len() {
        let mut open = cube.clone();
        let hole = open.remove(gone);
        let MeshFault::Open { edges: 3, from, to } = fault(&open) else { unreachable!("{gone}") };
        let is_corner = |at: [f64; 3]| hole.iter().any(|corner| corner.map(f64::from) == at);
        assert!(is_corner(from) && is_corner(to));
        let mut turned = cube.clone();
        turned[gone].swap(0, 1);
        assert!(matches!(fault(&turned), MeshFault::Open { edges: 3, .. }), "{gone}");
    }
    // A corner that is slightly displaced in one triangle.
    let mut torn = cube.clone();
    torn[0][0][0] += 1e-6;
    assert!(fault(&torn).to_string().contains("is not closed: 4 edges"), "{}", fault(&torn));
    let sheet: [Triangle; 2] =
        [[[0.0; 3], [1.0, 0.0, 0.0], [0.0, 1.0, 0.0]], [[0.0; 3], [0.0, 1.0, 0.0], [1.0, 0.0, 0.0]]];
    assert_eq!(
        (fault(&sheet), fault(&[[[0.0; 3]; 3]]), fault(&[])),
        (MeshFault::Flat, MeshFault::Flat, MeshFault::Flat)
    );
    // A triangle without area is harmless; -0 equals 0.
    let mut more = cube.clone();
    more.push([[0.0; 3], [0.0; 3], [1.0; 3]]);
    more.iter_mut().take(5).flatten().flatten().filter(|x| **x == 0.0).for_each(|x| *x = -0.0);
    assert_eq!(ClosedMesh::new(&more).unwrap(), ClosedMesh::new(&cube).unwrap());
    let many: Vec<Triangle> = (0..10_001_u16)
        .flat_map(|k| cuboid([3.0 * f32::from(k), 0.0, 0.0], [3.0 * f32::from(k) + 1.0, 1.0, 1.0], false))
        .collect();
    assert_eq!(fault(&many), MeshFault::Shells { shells: 10_001 });
}
