//! Checks the surface against a sphere's closed form, and incremental meshing against meshing from scratch.
#![allow(clippy::unwrap_used, reason = "a test")]

use std::collections::BTreeMap;

use viewer_proc::surface::{BlockMesh, Blocks, CoarseBone, Field, Voxel, link_mesh};
use voxel_grid::VoxelGrid;

const THRESHOLD_HU: i16 = 150;

/// A rotated grid with unequal spacings.
fn turned(dims: [usize; 3], spacing_m: [f64; 3]) -> VoxelGrid {
    // A rotation by 120° about (1, 1, 1) and one by 36.87° about z: columns are the axes of i, j, k.
    let axes = [[0.0, 0.8, 0.6], [0.0, -0.6, 0.8], [1.0, 0.0, 0.0]];
    VoxelGrid::new(dims, spacing_m, [0.01, -0.02, 0.03], axes).unwrap()
}

/// A ball whose HU pass the threshold linearly at its radius.
fn ball(grid: &VoxelGrid, centre_voxel: [f64; 3], radius_m: f64) -> Vec<i16> {
    let [ni, nj, nk] = grid.dims();
    let mut hu = Vec::with_capacity(grid.voxel_count());
    for k in 0..nk {
        for j in 0..nj {
            for i in 0..ni {
                let distance: f64 = [i, j, k]
                    .iter()
                    .enumerate()
                    .map(|(axis, x)| ((*x as f64 - centre_voxel[axis]) * grid.spacing_m()[axis]).powi(2))
                    .sum::<f64>()
                    .sqrt();
                let above = (radius_m - distance) * 4.0e5;
                hu.push((f64::from(THRESHOLD_HU) + above).clamp(-1000.0, 3000.0).round() as i16);
            }
        }
    }
    hu
}

fn mesh_all(blocks: &mut Blocks, field: &Field, hu: &[i16]) -> BTreeMap<u32, BlockMesh> {
    blocks.mesh_changed(field, hu, usize::MAX).into_iter().map(|mesh| (mesh.block, mesh)).collect()
}

/// Triangles by vertex position, which blocks share exactly.
fn triangles<'a>(meshes: impl IntoIterator<Item = &'a BlockMesh>) -> Vec<[[i64; 3]; 3]> {
    let of = |mesh: &'a BlockMesh| {
        mesh.indices.chunks_exact(3).map(move |t| [mesh.steps(t[0]), mesh.steps(t[1]), mesh.steps(t[2])])
    };
    meshes.into_iter().flat_map(of).collect()
}

/// Directed edges without an opposite; a closed, consistently oriented surface has none.
fn open_edges(triangles: &[[[i64; 3]; 3]]) -> usize {
    let mut balance: BTreeMap<([i64; 3], [i64; 3]), i64> = BTreeMap::new();
    for triangle in triangles {
        for side in 0..3 {
            let (a, b) = (triangle[side], triangle[(side + 1) % 3]);
            if a < b {
                *balance.entry((a, b)).or_default() += 1;
            } else {
                *balance.entry((b, a)).or_default() -= 1;
            }
        }
    }
    balance.values().filter(|count| **count != 0).count()
}

fn area_and_volume(triangles: &[[[i64; 3]; 3]], scale_m: f64) -> (f64, f64) {
    let (mut area, mut volume) = (0.0, 0.0);
    for triangle in triangles {
        let [a, b, c] = triangle.map(|vertex| vertex.map(|steps| steps as f64 * scale_m));
        let (u, v): ([f64; 3], [f64; 3]) =
            (core::array::from_fn(|i| b[i] - a[i]), core::array::from_fn(|i| c[i] - a[i]));
        let cross = [u[1] * v[2] - u[2] * v[1], u[2] * v[0] - u[0] * v[2], u[0] * v[1] - u[1] * v[0]];
        area += 0.5 * cross.iter().map(|x| x * x).sum::<f64>().sqrt();
        // The divergence theorem: signed volumes of the tetrahedra with the origin.
        volume += (0..3).map(|i| a[i] * cross[i]).sum::<f64>() / 6.0;
    }
    (area, volume)
}

#[test]
fn a_ball_is_closed_and_has_its_area_and_volume() {
    let grid = turned([64, 60, 40], [0.5e-3, 0.5e-3, 0.75e-3]);
    let radius_m = 0.012;
    let centre = [30.3, 29.6, 19.2];
    let hu = ball(&grid, centre, radius_m);
    let field = Field::new(grid, THRESHOLD_HU);
    let mut blocks = Blocks::new(&grid);
    let meshes = mesh_all(&mut blocks, &field, &hu);
    assert!(meshes.len() > 8, "the ball spans blocks: {}", meshes.len());
    let triangles = triangles(meshes.values());
    assert_eq!(open_edges(&triangles), 0);
    let scale_m = meshes.values().next().unwrap().scale_m;
    let (area, volume) = area_and_volume(&triangles, scale_m);
    let (pi, r) = (core::f64::consts::PI, radius_m);
    let (expected_area, expected_volume) = (4.0 * pi * r * r, 4.0 / 3.0 * pi * r.powi(3));
    println!(
        "ball: area {:.4}, volume {:.4} of the closed form",
        area / expected_area,
        volume / expected_volume
    );
    // Vertices lie inside by at most the sagitta of a cell, h²/8r ≈ 0.006 mm of 12 mm; measured: 0.3 %.
    assert!((volume / expected_volume - 1.0).abs() < 0.01, "{volume} {expected_volume}");
    assert!((area / expected_area - 1.0).abs() < 0.02, "{area} {expected_area}");
    // Every vertex lies on the ball and its normal points away from the centre.
    let middle = grid.world_m(centre);
    for mesh in meshes.values() {
        for (number, normal) in mesh.normals.iter().enumerate() {
            let point = mesh.vertex_m(number as u32);
            let out: [f64; 3] = core::array::from_fn(|i| point[i] - middle[i]);
            let distance = out.iter().map(|x| x * x).sum::<f64>().sqrt();
            assert!((distance - radius_m).abs() < 0.1e-3, "{distance}");
            let along: f64 = (0..3).map(|i| out[i] / distance * f64::from(normal[i]) / 127.0).sum();
            assert!(along > 0.97, "{along}");
        }
    }
}

#[test]
fn bone_that_reaches_the_edge_of_the_volume_is_closed_there() {
    let grid = turned([30, 25, 23], [1e-3; 3]);
    let hu = vec![1000; grid.voxel_count()];
    let field = Field::new(grid, THRESHOLD_HU);
    let meshes = mesh_all(&mut Blocks::new(&grid), &field, &hu);
    let triangles = triangles(meshes.values());
    assert!(!triangles.is_empty());
    assert_eq!(open_edges(&triangles), 0);
}

/// A small generator of pseudo-random numbers (Marsaglia, "Xorshift RNGs", 2003).
fn next(seed: &mut u64) -> u64 {
    *seed ^= *seed << 13;
    *seed ^= *seed >> 7;
    *seed ^= *seed << 17;
    *seed
}

#[test]
fn meshing_what_changed_is_meshing_from_nothing() {
    let grid = turned([50, 49, 47], [0.5e-3; 3]);
    let hu = ball(&grid, [25.0, 24.0, 23.0], 0.011);
    let mut field = Field::new(grid, THRESHOLD_HU);
    let mut blocks = Blocks::new(&grid);
    let mut shown = mesh_all(&mut blocks, &field, &hu);
    let mut seed = 7;
    for round in 0..12 {
        // Drills a ball at a random place; every third round restores one.
        let middle: [f64; 3] =
            core::array::from_fn(|axis| (next(&mut seed) % grid.dims()[axis] as u64) as f64);
        let mut changed = 0;
        for index in 0..grid.voxel_count() as u32 {
            let voxel = grid.voxel(index as usize).unwrap();
            let distance: f64 = (0..3).map(|axis| (voxel[axis] as f64 - middle[axis]).powi(2)).sum();
            if distance < 36.0
                && field.set(index, if round % 3 == 2 { Voxel::Present } else { Voxel::Removed })
            {
                blocks.touch(voxel);
                changed += 1;
            }
        }
        let waiting = blocks.changed_count();
        assert!(waiting <= 27 || changed == 0, "{waiting} blocks for a ball of 12 voxels");
        for (block, mesh) in mesh_all(&mut blocks, &field, &hu) {
            match mesh.indices.is_empty() {
                true => drop(shown.remove(&block)),
                false => drop(shown.insert(block, mesh)),
            }
        }
        let fresh = mesh_all(&mut Blocks::new(&grid), &field, &hu);
        assert_eq!(shown, fresh, "round {round}");
        assert_eq!(open_edges(&triangles(shown.values())), 0, "round {round}");
    }
}

#[test]
fn a_mesh_is_written_as_the_contract_says() {
    let grid = turned([4, 4, 4], [1e-3; 3]);
    let field = Field::new(grid, THRESHOLD_HU);
    let mesh = mesh_all(&mut Blocks::new(&grid), &field, &[500; 64]).remove(&0).unwrap();
    let bytes = mesh.bytes();
    let word = |at: usize| u32::from_le_bytes(bytes[at..at + 4].try_into().unwrap());
    let float = |at: usize| f32::from_bits(word(at));
    assert_eq!((word(0), word(4), word(8)), (0x4853_4D54, 1, 0));
    let (n, m) = (word(12) as usize, word(16) as usize);
    assert_eq!((n, m), (mesh.positions.len(), mesh.indices.len()));
    let positions = 36;
    let normals = positions + (6 * n).next_multiple_of(4);
    assert_eq!(bytes.len(), normals + 4 * n + 4 * m);
    for vertex in 0..n {
        let expected = mesh.vertex_m(vertex as u32);
        for (axis, expected) in expected.iter().enumerate() {
            let at = positions + 6 * vertex + 2 * axis;
            let steps = u16::from_le_bytes(bytes[at..at + 2].try_into().unwrap());
            let metres = float(20 + 4 * axis) + float(32) * f32::from(steps);
            assert!((f64::from(metres) - expected).abs() < 1e-7, "{metres} {expected}");
        }
    }
    assert_eq!(word(normals + 4 * n), mesh.indices[0]);
}

#[test]
fn corners_are_where_they_were_to_a_step_and_facets_look_outward() {
    // Two facets of a cuboid that share an edge, and a triangle without area.
    let [a, b, c, d] = [[-0.1, 0.0, 0.2], [0.5, 0.0, 0.2], [0.5, 0.3, 0.2], [0.5, 0.3, -0.4]];
    let mesh = link_mesh(4, &[[a, b, c], [b, d, c], [a, a, b]]);
    assert_eq!((mesh.block, mesh.indices.len(), mesh.positions.len()), (4, 6, 6));
    let step_m = 0.6 / 65_534.0;
    for (index, corner) in mesh.indices.iter().zip([a, b, c, b, d, c]) {
        let place = mesh.vertex_m(*index);
        let off = (0..3).map(|axis| (place[axis] - corner[axis]).abs()).fold(0.0, f64::max);
        assert!(off <= 0.5 * step_m + 1e-12, "{off} m");
    }
    assert_eq!((mesh.normals[0], mesh.normals[3]), ([0, 0, 127], [127, 0, 0]));
    assert!(link_mesh(0, &[]).indices.is_empty());
}

/// A page without a graphics card draws this surface.
#[test]
fn the_coarse_surface_has_the_balls_volume_at_a_tenth_of_the_triangles_and_follows_the_drill() {
    let grid = turned([180, 175, 190], [0.5e-3, 0.5e-3, 0.5e-3]);
    let (centre, radius_m) = ([90.0, 87.0, 95.0], 0.035);
    let hu = ball(&grid, centre, radius_m);
    let mut field = Field::new(grid, THRESHOLD_HU);
    let mut coarse = CoarseBone::new(&grid, THRESHOLD_HU).unwrap();
    coarse.update(&field, &hu);
    let shown = |meshes: Vec<BlockMesh>, shown: &mut BTreeMap<u32, BlockMesh>| {
        meshes.into_iter().for_each(|mesh| drop(shown.insert(mesh.block, mesh)));
    };
    let mut meshes = BTreeMap::new();
    shown(coarse.mesh_changed(), &mut meshes);
    let fine = triangles(mesh_all(&mut Blocks::new(&grid), &field, &hu).values()).len();
    let all = triangles(meshes.values());
    assert_eq!(open_edges(&all), 0);
    assert!(5 * all.len() < fine, "{} of {fine} triangles", all.len());
    let scale_m = meshes.values().next().unwrap().scale_m;
    let (_, volume) = area_and_volume(&all, scale_m);
    let expected = 4.0 / 3.0 * core::f64::consts::PI * radius_m.powi(3);
    // The sagitta of a cell of 1.5 mm on 35 mm, h²/8r = 0.008 mm, and the mean of a cell that the surface
    // cuts, whose Hounsfield units are clamped.
    assert!((volume / expected - 1.0).abs() < 0.03, "{volume} {expected}");

    // A tunnel of 6 mm, drilled in two rounds and restored in part.
    let drill = |coarse: &mut CoarseBone, field: &mut Field, (from, to): (usize, usize), voxel: Voxel| {
        for index in 0..grid.voxel_count() as u32 {
            let at = grid.voxel(index as usize).unwrap();
            let off = [at[0] as f64 - centre[0], at[1] as f64 - centre[1]];
            let is_in = (from..to).contains(&at[2]) && off[0].hypot(off[1]) < 6.0;
            if is_in && field.set(index, voxel) {
                coarse.touch(at);
            }
        }
        coarse.update(field, &hu);
    };
    for (range, voxel) in
        [((20, 90), Voxel::Removed), ((90, 120), Voxel::Removed), ((60, 90), Voxel::Present)]
    {
        drill(&mut coarse, &mut field, range, voxel);
        shown(coarse.mesh_changed(), &mut meshes);
        let mut fresh = CoarseBone::new(&grid, THRESHOLD_HU).unwrap();
        fresh.update(&field, &hu);
        let mut expected = BTreeMap::new();
        shown(fresh.mesh_changed(), &mut expected);
        meshes.retain(|_, mesh| !mesh.indices.is_empty());
        assert_eq!(meshes, expected, "{range:?}");
    }
    let (_, drilled) = area_and_volume(&triangles(meshes.values()), scale_m);
    // Inside the ball, 64.7 slices are drilled; the round wall of 6 mm is cut into cells of 1.5 mm.
    let tunnel = core::f64::consts::PI * 3.0e-3_f64.powi(2) * 0.5e-3 * 64.7;
    assert!(((volume - drilled) / tunnel - 1.0).abs() < 0.15, "{} {tunnel}", volume - drilled);
}
