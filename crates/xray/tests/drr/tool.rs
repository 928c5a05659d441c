//! Chords of the tool's parts, and the anatomy they displace, against closed forms.

use proptest::prelude::*;
use xray::ray::RayFan;
use xray::ray::WorldRay;
use xray::removal::{AttenuationField, BlockMap, RemovedVoxels};
use xray::{
    DetectorParameters, DrrParameters, DrrRenderer, FrameSeed, Grid, Material, MuTable, Notch, PreparedPart,
    Projector, Tool, ToolPart, VolumeView, join_intervals, joseph, siddon,
};

use crate::machine::Desk;

const NITINOL: Material = Material::Nitinol;

fn metal_m(part: &ToolPart, from: [f64; 3], to: [f64; 3]) -> f64 {
    PreparedPart::new(part).unwrap().cross(&WorldRay::between(from, to)).map_or(0.0, |c| c.metal_m)
}

fn tube(start_m: [f64; 3], end_m: [f64; 3]) -> ToolPart {
    ToolPart::tube(start_m, end_m, [3e-3, 2e-3], NITINOL)
}

/// A tube of 30 mm along z with a notch.
fn notched(notch: Notch) -> ToolPart {
    let (start_m, end_m, outer_radius_m, inner_radius_m) = ([0.0; 3], [0.0, 0.0, 0.03], 3e-3, 2e-3);
    let (notch, material) = (Some(notch), NITINOL);
    ToolPart::Tube { start_m, end_m, normals: None, outer_radius_m, inner_radius_m, notch, material }
}

#[test]
fn a_tube_by_hand() {
    let link = tube([0.0; 3], [0.0, 0.0, 0.03]);
    let near = |got: f64, want: f64| assert!((got - want).abs() < 1e-14, "got {got}, want {want}");
    let z = 0.01;
    // Across the middle: two walls of 1 mm. Off the axis by 2.5 mm: wall only. Outside: nothing.
    near(metal_m(&link, [-0.5, 0.0, z], [0.5, 0.0, z]), 2e-3);
    near(metal_m(&link, [-0.5, 2.5e-3, z], [0.5, 2.5e-3, z]), 2.0 * (9e-6_f64 - 6.25e-6).sqrt());
    near(metal_m(&link, [-0.5, 1e-3, z], [0.5, 1e-3, z]), 2.0 * (8e-6_f64.sqrt() - 3e-6_f64.sqrt()));
    near(metal_m(&link, [-0.5, 3.1e-3, z], [0.5, 3.1e-3, z]), 0.0);
    // Along the wall, and along the open lumen.
    near(metal_m(&link, [2.5e-3, 0.0, -0.1], [2.5e-3, 0.0, 0.1]), 0.03);
    near(metal_m(&link, [0.5e-3, 0.0, -0.1], [0.5e-3, 0.0, 0.1]), 0.0);
    // At 45 degrees through the middle, the caps far away: sqrt(2) times the walls.
    near(metal_m(&link, [-0.1, 0.0, 0.015 - 0.1], [0.1, 0.0, 0.015 + 0.1]), 2e-3 * 2.0_f64.sqrt());
    // In through the lower cap's lumen, out through the wall: one wall at 45 degrees.
    near(metal_m(&link, [-0.1, 0.0, -0.1], [0.1, 0.0, 0.1]), 1e-3 * 2.0_f64.sqrt());
    // The ray ends on the axis.
    near(metal_m(&link, [-0.5, 0.0, z], [0.0, 0.0, z]), 1e-3);
}

#[test]
fn solid_parts_by_hand() {
    let rod = ToolPart::tube([0.0; 3], [0.02, 0.0, 0.0], [1e-3, 0.0], NITINOL);
    assert!((metal_m(&rod, [0.01, -1.0, 0.0], [0.01, 1.0, 0.0]) - 2e-3).abs() < 1e-14);
    assert!((metal_m(&rod, [-1.0, 0.0, 0.0], [1.0, 0.0, 0.0]) - 0.02).abs() < 1e-14);
    let burr = ToolPart::Sphere { centre_m: [0.0; 3], radius_m: 3.25e-3, material: NITINOL };
    let p = 2e-3;
    let want = 2.0 * (3.25e-3_f64.powi(2) - p * p).sqrt();
    assert!((metal_m(&burr, [-1.0, p, 0.0], [1.0, p, 0.0]) - want).abs() < 1e-14);
}

#[test]
fn impossible_parts_are_refused_with_a_reason() {
    let sphere = |radius_m| ToolPart::Sphere { centre_m: [0.0; 3], radius_m, material: NITINOL };
    assert!(PreparedPart::new(&sphere(0.0)).is_err());
    assert!(PreparedPart::new(&sphere(f64::NAN)).is_err());
    assert!(PreparedPart::new(&tube([0.0; 3], [0.0; 3])).unwrap_err().contains("coincide"));
    assert!(PreparedPart::new(&tube([f64::INFINITY, 0.0, 0.0], [0.0; 3])).is_err());
    let mut solid = tube([0.0; 3], [0.0, 0.0, 0.1]);
    if let ToolPart::Tube { inner_radius_m, .. } = &mut solid {
        *inner_radius_m = 3e-3;
    }
    assert!(PreparedPart::new(&solid).unwrap_err().contains("inner_radius_m < outer_radius_m"));
}

#[test]
fn intervals_are_joined() {
    let mut i = [(0.5, 0.6), (0.1, 0.2), (0.15, 0.3), (0.55, 0.58), (0.6, 0.7)];
    let n = join_intervals(&mut i);
    assert_eq!(&i[..n], &[(0.1, 0.3), (0.5, 0.7)]);
    assert_eq!(join_intervals(&mut []), 0);
}

/// A noise-free image of a tool in a 40 mm water cube against mu_w (cube - union of envelopes) + mu_metal
/// chords.
#[test]
fn metal_displaces_the_anatomy_once() {
    let grid = Grid::centred([40; 3], [1e-3; 3]).unwrap();
    let hu = vec![0; grid.voxels()];
    let view = VolumeView::new(grid, &hu).unwrap();
    // A cable inside a tube, and a burr that overlaps its end: the union of three envelopes.
    let cable = ToolPart::tube([-0.01, 0.0, 0.0], [0.01, 0.0, 0.0], [1e-3, 0.0], Material::Steel316L);
    let burr =
        ToolPart::Sphere { centre_m: [0.012, 0.0, 0.0], radius_m: 3.25e-3, material: Material::Steel316L };
    let tool =
        Tool { parts: vec![tube([-0.01, 0.0, 0.0], [0.01, 0.0, 0.0]), cable, burr], ..Tool::default() };
    let c_arm = crate::poses::c_arm(0.0, 0.0, 41, 0.05);
    let [water, nitinol, steel] =
        [Material::Water, NITINOL, Material::Steel316L].map(|m| m.mu_per_m(60.0).unwrap());
    for projector in [Projector::Siddon, Projector::Joseph] {
        let parameters = DrrParameters { projector, threads: 1, ..DrrParameters::default() };
        let mut renderer = DrrRenderer::new(&view, parameters, &Desk).unwrap();
        let mut image = vec![0; c_arm.pixels()];
        renderer.render(&view, &c_arm, &tool, FrameSeed::default(), &mut image).unwrap();
        let (total, anatomy) = (renderer.line_integrals(), renderer.anatomy());
        // Row 20 is the plane z = 0 (the tool's axis lies in it); the ray of column c meets y = 0 at x = (c -
        // 20) pitch 0.7.
        let mut checked = 0;
        for c in 0..41_usize {
            let i = 20 * 41 + c;
            let ray = WorldRay::between(c_arm.source_m, c_arm.pixel_m(c as f64, 20.0));
            let cross = |p: &ToolPart| PreparedPart::new(p).unwrap().cross(&ray);
            let hits: Vec<_> = tool.parts.iter().map(cross).collect();
            let mut envelopes: Vec<_> = hits.iter().flatten().map(|h| h.envelope).collect();
            if envelopes.is_empty() {
                assert_eq!(total[i].to_bits(), anatomy[i].to_bits());
                continue;
            }
            let n = join_intervals(&mut envelopes);
            let inside: f64 = envelopes[..n].iter().map(|(a, b)| (b - a) * ray.length_m).sum();
            let metal: f64 = hits
                .iter()
                .zip([nitinol, steel, steel])
                .map(|(h, mu)| h.map_or(0.0, |h| h.metal_m * mu))
                .sum();
            let want = anatomy[i] - water * inside + metal;
            assert!((total[i] - want).abs() < 1e-12, "{projector:?} column {c}: {} {want}", total[i]);
            checked += 1;
        }
        assert!(checked > 15);
        // On the axis: 40 mm of water minus 6 mm, two nitinol walls, a 2 mm cable (the ray of column 20 is
        // straight).
        let want = water * (0.04 - 0.006) + nitinol * 2e-3 + steel * 2e-3;
        assert!((total[20 * 41 + 20] - want).abs() < 1e-12);
    }
}

#[test]
fn a_tool_in_a_drilled_channel_displaces_nothing_more() {
    // All voxels around the tube are removed and become air, so only the metal is added.
    let grid = Grid::centred([40; 3], [1e-3; 3]).unwrap();
    let hu = vec![300; grid.voxels()];
    let view = VolumeView::new(grid, &hu).unwrap();
    let removed: Vec<u32> = (0..grid.voxels())
        .filter(|&i| {
            let p = grid.index_to_world(grid.voxel_of(i).map(|v| v as f64));
            (p[1] * p[1] + p[2] * p[2]).sqrt() < 5e-3
        })
        .map(|i| i as u32)
        .collect();
    let tool = Tool { parts: vec![tube([-0.01, 0.0, 0.0], [0.01, 0.0, 0.0])], ..Tool::default() };
    let c_arm = crate::poses::c_arm(0.0, 0.0, 41, 0.05);
    let quiet = DetectorParameters { quantum_noise: false, ..DetectorParameters::default() };
    let mut renderer =
        DrrRenderer::new(&view, DrrParameters { detector: quiet, ..DrrParameters::default() }, &Desk)
            .unwrap();
    renderer.remove(&view, &removed).unwrap();
    let mut image = vec![0; c_arm.pixels()];
    renderer.render(&view, &c_arm, &tool, FrameSeed::default(), &mut image).unwrap();
    let i = 20 * 41 + 20;
    let added = renderer.line_integrals()[i] - renderer.anatomy()[i];
    assert!((added - NITINOL.mu_per_m(60.0).unwrap() * 2e-3).abs() < 1e-12, "{added}");
}

/// A chain of 27 links, two of three of them notched and every second with mitred ends, a shaft, a cone and a
/// burr, bent in a plane; half a metre of shaft extends out of the image.
pub fn whole_tool() -> Tool {
    let mut at = [0.0_f64, -0.01, 0.0];
    let along = |angle: f64| [angle.cos() * 0.8, -0.6, angle.sin() * 0.8];
    let step = |p: [f64; 3], d: [f64; 3], length: f64| std::array::from_fn(|i| p[i] + length * d[i]);
    let shaft = ToolPart::tube(step(at, along(0.6), -0.5), at, [3e-3, 2e-3], Material::Steel316L);
    let mut parts = vec![shaft];
    for i in 0..27 {
        let angle = 0.6 + 0.03 * f64::from(i);
        let next = step(at, along(angle), 1.3e-3);
        // Perpendicular to the axis, on alternating sides.
        let turn = if i % 2 == 0 { 1.0 } else { -1.0 };
        let side = [-turn * angle.sin(), 0.0, turn * angle.cos()];
        let notch = Notch { offset_m: 0.4e-3, width_m: 0.5e-3, side, depth_m: 2e-3 };
        let (outer_radius_m, inner_radius_m, material) = (3e-3, 2e-3, NITINOL);
        let normals = (i % 2 == 1).then(|| [-0.4, 0.6].map(|turn| along(angle + turn)));
        let notch = (i % 2 == 0 || i % 3 > 0).then_some(notch);
        let (start_m, end_m) = (at, next);
        parts.push(ToolPart::Tube {
            start_m,
            end_m,
            normals,
            outer_radius_m,
            inner_radius_m,
            notch,
            material,
        });
        at = next;
    }
    let tip = step(at, along(1.4), 4e-3);
    let (start_radius_m, end_radius_m, material) = (2e-3, 0.5e-3, Material::Steel316L);
    parts.push(ToolPart::Cone { start_m: at, end_m: tip, start_radius_m, end_radius_m, material });
    parts.push(ToolPart::Sphere { centre_m: tip, radius_m: 3.25e-3, material });
    Tool { parts, ..Tool::default() }
}

/// A rotated grid of air and pseudo-random values, and voxels removed from it.
pub fn turned_volume() -> (Grid, Vec<i16>, Vec<u32>) {
    let (s, c) = 0.3_f64.sin_cos();
    let axes = [[c, s, 0.0], [-s, c, 0.0], [0.0, 0.0, 1.0]];
    let grid = Grid::new([60, 50, 55], [1.0e-3, 1.2e-3, 0.9e-3], [-0.02, -0.035, -0.02], axes).unwrap();
    let hu: Vec<i16> = (0..grid.voxels())
        .map(|i| if (i / 9) % 40 < 12 { -1000 } else { ((i * 7919) % 2000) as i16 - 500 })
        .collect();
    let removed: Vec<u32> = (0..grid.voxels() as u32).filter(|i| i % 31 == 3 && i / 1000 % 3 == 0).collect();
    (grid, hu, removed)
}

/// Outlines, sweeps and the short-interval integral against every part at every pixel, and the projectors'
/// own intervals.
#[test]
fn the_fast_tool_layer_is_every_part_on_every_pixel() {
    let (grid, hu, removed) = turned_volume();
    let view = VolumeView::new(grid, &hu).unwrap();
    let tool = whole_tool();
    let parts: Vec<PreparedPart> = tool.parts.iter().map(|p| PreparedPart::new(p).unwrap()).collect();
    let table = MuTable::new(60.0, -900).unwrap();
    let blocks = BlockMap::new(&view, &table);
    for (projector, primary, secondary) in [
        (Projector::Joseph, 0.0, 0.0),
        (Projector::Joseph, 37.0, 18.0),
        (Projector::Joseph, 90.0, 5.0),
        (Projector::Joseph, -120.0, 60.0),
        (Projector::Siddon, 44.0, 35.0),
    ] {
        let c_arm = crate::poses::c_arm(primary, secondary, 90, 0.09);
        let parameters = DrrParameters { projector, threads: 2, ..DrrParameters::default() };
        let mut renderer = DrrRenderer::new(&view, parameters, &Desk).unwrap();
        renderer.remove(&view, &removed).unwrap();
        let mut image = vec![0; c_arm.pixels()];
        let report = renderer.render(&view, &c_arm, &tool, FrameSeed::default(), &mut image).unwrap();
        let (total, anatomy) = (renderer.line_integrals(), renderer.anatomy());
        let fan = RayFan::new(&grid, &c_arm);
        // The renderer's own set of removed voxels; without block flags for them, nothing must be skipped by
        // mistake.
        let gone: &RemovedVoxels = renderer.removed();
        let mut every = vec![0; grid.voxels()];
        every.clone_from(&hu);
        removed.iter().for_each(|&i| every[i as usize] = -1000);
        let drilled = VolumeView::new(grid, &every).unwrap();
        let none = RemovedVoxels::new(&grid);
        assert_eq!(gone.count(), removed.len());
        let field = AttenuationField {
            view: drilled,
            removed: &none,
            blocks: &blocks,
            table: &table,
            fill_mu_per_m: 0.0,
        };
        let mut covered = 0;
        for i in 0..c_arm.pixels() {
            let (column, row) = (i as u32 % 90, i as u32 / 90);
            let ray = fan.world_ray(column, row);
            let mut envelopes = Vec::new();
            let mut metal = 0.0;
            for part in &parts {
                if let Some(crossing) = part.cross(&ray) {
                    envelopes.push(crossing.envelope);
                    metal += part.material().mu_per_m(60.0).unwrap() * crossing.metal_m;
                }
            }
            let n = join_intervals(&mut envelopes);
            let displaced = |range: &(f64, f64)| match projector {
                Projector::Siddon => siddon::line_integral(&field, &fan.index_ray(column, row), *range),
                _ => joseph::interval_integral(&field, &fan.index_ray(column, row), *range),
            };
            let displaced: f64 = envelopes[..n].iter().map(displaced).sum();
            let want = (anatomy[i] - displaced).max(0.0) + metal;
            let want = if n == 0 { anatomy[i] } else { want };
            assert_eq!(total[i].to_bits(), want.to_bits(), "{projector:?} pixel {column} {row}");
            covered += usize::from(metal > 0.0 || displaced > 0.0);
        }
        assert_eq!(report.tool_pixels, covered);
        assert!(covered > 300, "{covered}");
    }
}

#[test]
fn a_notch_and_a_cone_by_hand() {
    let notch = Notch { offset_m: 0.01, width_m: 5e-3, side: [0.0, 1.0, 0.0], depth_m: 2.5e-3 };
    let link = notched(notch);
    // Rounding of ray parameters over 1 m.
    let near = |got: f64, want: f64| assert!((got - want).abs() < 1e-13, "got {got}, want {want}");
    // Along y through the notch: the wall at -y only, as y > 0.5 mm is open; outside the notch, both walls.
    near(metal_m(&link, [0.0, -0.5, 0.012], [0.0, 0.5, 0.012]), 1e-3);
    near(metal_m(&link, [0.0, -0.5, 0.008], [0.0, 0.5, 0.008]), 2e-3);
    // Along x in the notch at y = 1 mm: nothing; at y = 0: both walls.
    near(metal_m(&link, [-0.5, 1e-3, 0.012], [0.5, 1e-3, 0.012]), 0.0);
    near(metal_m(&link, [-0.5, 0.0, 0.012], [0.5, 0.0, 0.012]), 2e-3);
    // Along the axis in the wall: everything except the notch's width.
    near(metal_m(&link, [0.0, 2.5e-3, -0.1], [0.0, 2.5e-3, 0.1]), 0.025);
    let cone = |start_radius_m, end_radius_m| ToolPart::Cone {
        start_m: [0.0; 3],
        end_m: [0.0, 0.0, 0.01],
        start_radius_m,
        end_radius_m,
        material: NITINOL,
    };
    for part in [cone(4e-3, 2e-3), cone(4e-3, 0.0), cone(0.0, 4e-3)] {
        let ToolPart::Cone { start_radius_m: a, end_radius_m: b, .. } = part else { unreachable!() };
        let radius = a + (b - a) * 0.3;
        near(metal_m(&part, [-1.0, 0.0, 3e-3], [1.0, 0.0, 3e-3]), 2.0 * radius);
        let half = (radius * radius - 1e-6_f64).max(0.0).sqrt();
        near(metal_m(&part, [-1.0, 1e-3, 3e-3], [1.0, 1e-3, 3e-3]), 2.0 * half);
        // Parallel to the axis at half the wider radius: up to where the cone is that narrow.
        let wide = a.max(b);
        let x = 0.5 * wide;
        let length = if a.min(b) >= x { 0.01 } else { 0.01 * (wide - x) / (wide - a.min(b)) };
        near(metal_m(&part, [x, 0.0, -0.1], [x, 0.0, 0.1]), length);
    }
    // A cylinder is a cone of one radius.
    let rod = ToolPart::tube([0.0; 3], [0.0, 0.0, 0.01], [2e-3, 0.0], NITINOL);
    let (from, to) = ([-0.02, 0.003, -0.01], [0.02, -0.002, 0.02]);
    near(metal_m(&cone(2e-3, 2e-3), from, to), metal_m(&rod, from, to));
}

#[test]
fn impossible_notches_and_cones_are_refused_with_a_reason() {
    let refused = |offset_m, width_m, side, depth_m| {
        let part = notched(Notch { offset_m, width_m, side, depth_m });
        PreparedPart::new(&part).map(|_| ()).unwrap_err()
    };
    let y = [0.0, 1.0, 0.0];
    assert!(refused(0.028, 5e-3, y, 1e-3).contains("within the tube"));
    assert!(refused(0.01, f64::NAN, y, 1e-3).contains("within the tube"));
    assert!(refused(0.01, 5e-3, y, 7e-3).contains("depth"));
    assert!(refused(0.01, 5e-3, [0.0, 0.0, 1.0], 1e-3).contains("perpendicular"));
    for radii in [(0.0, 0.0), (-1e-3, 1e-3), (f64::NAN, 1e-3)] {
        let part = ToolPart::Cone {
            start_m: [0.0; 3],
            end_m: [0.0, 0.0, 0.01],
            start_radius_m: radii.0,
            end_radius_m: radii.1,
            material: NITINOL,
        };
        assert!(PreparedPart::new(&part).is_err(), "{radii:?}");
    }
}

proptest! {
    #[test]
    fn a_chord_agrees_with_counting_points_on_the_ray(
        from in prop::array::uniform3(-0.02..0.02_f64), to in prop::array::uniform3(-0.02..0.02_f64),
        start in prop::array::uniform3(-0.006..0.006_f64), end in prop::array::uniform3(-0.006..0.006_f64),
    ) {
        let length = start.iter().zip(&end).map(|(a, b)| (a - b).powi(2)).sum::<f64>().sqrt();
        prop_assume!(length > 1e-3);
        let ray = WorldRay::between(from, to);
        let got = PreparedPart::new(&tube(start, end)).unwrap().cross(&ray).map_or(0.0, |c| c.metal_m);
        let n = 20_000;
        let inside = (0..n).filter(|&i| {
            let t = (f64::from(i) + 0.5) / f64::from(n);
            let q: [f64; 3] = std::array::from_fn(|a| from[a] + t * (to[a] - from[a]) - start[a]);
            let axis: [f64; 3] = std::array::from_fn(|a| (end[a] - start[a]) / length);
            let along: f64 = (0..3).map(|a| q[a] * axis[a]).sum();
            let square: f64 = q.iter().map(|x| x * x).sum();
            let radius = (square - along * along).max(0.0).sqrt();
            (0.0..length).contains(&along) && (2e-3..3e-3).contains(&radius)
        }).count();
        let want = inside as f64 / f64::from(n) * ray.length_m;
        // At most four boundaries, each off by one sample.
        prop_assert!((got - want).abs() <= 4.0 * ray.length_m / f64::from(n), "{} {}", got, want);
    }

    #[test]
    fn a_cones_chord_agrees_with_counting_points_on_the_ray(
        from in prop::array::uniform3(-0.02..0.02_f64), to in prop::array::uniform3(-0.02..0.02_f64),
        radii in prop::array::uniform2(0.0..0.008_f64),
    ) {
        let ray = WorldRay::between(from, to);
        let [start_radius_m, end_radius_m] = radii;
        let part = ToolPart::Cone {
            start_m: [0.0, 0.0, -0.005],
            end_m: [0.0, 0.0, 0.007],
            start_radius_m,
            end_radius_m,
            material: NITINOL,
        };
        let got = PreparedPart::new(&part).unwrap().cross(&ray).map_or(0.0, |c| c.metal_m);
        let n = 20_000;
        let inside = (0..n).filter(|&i| {
            let t = (f64::from(i) + 0.5) / f64::from(n);
            let q: [f64; 3] = std::array::from_fn(|a| from[a] + t * (to[a] - from[a]));
            let share = (q[2] + 0.005) / 0.012;
            let radius = start_radius_m + share * (end_radius_m - start_radius_m);
            (0.0..1.0).contains(&share) && q[0].hypot(q[1]) < radius
        }).count();
        let want = inside as f64 / f64::from(n) * ray.length_m;
        // At most two boundaries, each off by one sample.
        prop_assert!((got - want).abs() <= 2.0 * ray.length_m / f64::from(n), "{} {}", got, want);
    }
}
