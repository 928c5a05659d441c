//! Meshes of the arm's links, of both formats.

use ipc_types::scene::mesh::{MeshFormat, triangles};

/// Maximum number of triangles: small, so that the limit is reached, too.
const MOST: usize = 1000;

/// Reads a mesh file as STL and as OBJ. An accepted mesh consists of triangles with finite corners.
pub fn mesh(data: &[u8]) {
    for format in [MeshFormat::Stl, MeshFormat::Obj] {
        let Ok(triangles) = triangles(data, format, MOST) else { continue };
        assert!((1..=MOST).contains(&triangles.len()), "{}", triangles.len());
        assert!(triangles.iter().flatten().flatten().all(|x| x.is_finite()));
        let surface = viewer_proc::surface::link_mesh(
            0,
            &triangles.iter().map(|corners| corners.map(|corner| corner.map(f64::from))).collect::<Vec<_>>(),
        );
        assert!(surface.indices.iter().all(|index| (*index as usize) < surface.positions.len()));
    }
}

/// Seeds: a binary STL, a text STL, and an OBJ.
pub fn seeds() -> Vec<Vec<u8>> {
    let corners: [f32; 12] = [0.0, 0.0, 1.0, 0.0, 0.0, 0.5, 1.0, 0.0, 0.5, 0.0, 2.0, 0.5];
    let mut binary = vec![b' '; 80];
    binary.extend_from_slice(&3_u32.to_le_bytes());
    for _ in 0..3 {
        corners.iter().for_each(|x| binary.extend_from_slice(&x.to_le_bytes()));
        binary.extend_from_slice(&[0; 2]);
    }
    let facet = "facet normal 0 0 1\n outer loop\n  vertex 0 0 0.5\n  vertex 1e0 0 .5\n  vertex 0 2 5e-1\n endloop\nendfacet\n";
    let text = format!("solid a\n{facet}{facet}endsolid a\n");
    let obj = "mtllib a.mtl\no a\nv 0 0 0\nv 1 0 0\nv 1 1 0\nv 0 1 0.5\nvt 0 0\nvn 0 0 1\nf 1/1/1 2/1/1 3/1/1 4/1/1\nf -1 -2 -3\nl 1 2\n";
    vec![binary, text.into_bytes(), obj.as_bytes().to_vec()]
}
