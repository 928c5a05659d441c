//! A frame is a pure function of its inputs: incremental equals full, any threads, any order, bit for bit.

use xray::{
    CArm, DetectorFormat, DrrError, DrrParameters, DrrRenderer, FrameSeed, Grid, Material, PositionerAngles,
    Projector, RenderKind, Tool, ToolPart, VolumeView,
};

use crate::machine::Desk;

const PIXELS: u32 = 72;

/// An oblique, anisotropic volume with structure everywhere except in some empty blocks.
pub fn volume() -> (Grid, Vec<i16>) {
    let (s, c) = 0.4_f64.sin_cos();
    let axes = [[c, s, 0.0], [-s, c, 0.0], [0.0, 0.0, 1.0]];
    let grid = Grid::new([40, 33, 29], [0.9e-3, 1.0e-3, 1.3e-3], [-0.012, -0.022, -0.018], axes).unwrap();
    let hu = (0..grid.voxels())
        .map(|i| {
            let [x, y, _] = grid.voxel_of(i);
            if x / 8 == 1 && y / 8 != 2 { -1000 } else { (random(i as u64) % 2500) as i16 - 1000 }
        })
        .collect();
    (grid, hu)
}

fn random(i: u64) -> u64 {
    FrameSeed { seed: 99, frame: 0 }.hash(i)
}

pub fn batch(grid: &Grid, from: u64, count: u64) -> Vec<u32> {
    (from..from + count).map(|i| (random(i + 1_000_000) % grid.voxels() as u64) as u32).collect()
}

pub fn tool(step: u64) -> Tool {
    let x = step as f64 * 1e-3 - 0.02;
    Tool {
        parts: vec![
            ToolPart::tube(
                [x - 0.02, 0.001, 0.002],
                [x + 0.005, 0.0, 0.004],
                [3e-3, 2e-3],
                Material::Nitinol,
            ),
            ToolPart::tube(
                [x - 0.02, 0.001, 0.002],
                [x + 0.005, 0.0, 0.004],
                [1e-3, 0.0],
                Material::Steel316L,
            ),
            ToolPart::Sphere {
                centre_m: [x + 0.007, 0.0, 0.004],
                radius_m: 3.25e-3,
                material: Material::Steel316L,
            },
        ],
        ..Tool::default()
    }
}

fn parameters(projector: Projector, threads: usize) -> DrrParameters {
    DrrParameters { projector, threads, ..DrrParameters::default() }
}

/// A detector close to the volume, so that its pixels are a third of a voxel and many rays graze the border.
pub fn close_up(primary_deg: f64, secondary_deg: f64) -> CArm {
    let format = DetectorFormat { columns: PIXELS, rows: PIXELS, pixel_pitch_m: [0.9e-3, 0.8e-3] };
    let angles = PositionerAngles::from_degrees(primary_deg, secondary_deg);
    CArm::from_positioner_angles([0.0; 3], angles, 0.12, 0.16, format).unwrap()
}

struct Frame {
    image: Vec<u16>,
    anatomy: Vec<u64>,
    total: Vec<u64>,
}

fn frame(renderer: &mut DrrRenderer, view: &VolumeView<'_>, c_arm: &CArm, step: u64) -> (Frame, RenderKind) {
    let mut image = vec![0; c_arm.pixels()];
    let report =
        renderer.render(view, c_arm, &tool(step), FrameSeed { seed: 7, frame: step }, &mut image).unwrap();
    let bits = |values: &[f64]| values.iter().map(|v| v.to_bits()).collect();
    (Frame { image, anatomy: bits(renderer.anatomy()), total: bits(&renderer.line_integrals()) }, report.kind)
}

fn assert_same(a: &Frame, b: &Frame) {
    assert!(a.anatomy == b.anatomy, "anatomy differs");
    assert!(a.total == b.total, "line integrals with the tool differ");
    assert!(a.image == b.image, "the images differ");
}

#[test]
fn a_cache_after_many_removals_equals_a_full_render_bit_for_bit() {
    let (grid, hu) = volume();
    let view = VolumeView::new(grid, &hu).unwrap();
    for projector in [Projector::SLICE_ORDERED, Projector::PREVIEW, Projector::Joseph, Projector::Siddon] {
        for (primary, secondary) in [(0.0, 0.0), (37.0, 18.0), (90.0, 5.0), (46.0, -44.0), (5.0, 85.0)] {
            let c_arm = close_up(primary, secondary);
            let mut kept = DrrRenderer::new(&view, parameters(projector, 2), &Desk).unwrap();
            assert_eq!(frame(&mut kept, &view, &c_arm, 0).1, RenderKind::Full);
            let mut all = Vec::new();
            for step in 1..=8 {
                let new = batch(&grid, step * 1000, [1, 3, 40, 300][step as usize % 4]);
                kept.remove(&view, &new).unwrap();
                all.extend(new);
                let (incremental, kind) = frame(&mut kept, &view, &c_arm, step);
                // Sums over slices are updated or recomputed, whichever is faster.
                if matches!(projector, Projector::Joseph | Projector::Siddon) {
                    assert_ne!(kind, RenderKind::Full);
                }
                let mut fresh = DrrRenderer::new(&view, parameters(projector, 1), &Desk).unwrap();
                fresh.remove(&view, &all).unwrap();
                let (full, kind) = frame(&mut fresh, &view, &c_arm, step);
                assert_eq!(kind, RenderKind::Full);
                assert_same(&incremental, &full);
            }
        }
    }
}

#[test]
fn a_single_removed_voxel_is_followed_through_the_whole_volume() {
    let (grid, hu) = volume();
    let view = VolumeView::new(grid, &hu).unwrap();
    let c_arm = close_up(30.0, 40.0);
    let mut kept = DrrRenderer::new(&view, parameters(Projector::Joseph, 1), &Desk).unwrap();
    frame(&mut kept, &view, &c_arm, 0);
    let mut all = Vec::new();
    // Corners and faces first, then a stride through the rest.
    let last = grid.voxels() as u32 - 1;
    for index in [0, 39, last - 39, last].into_iter().chain((1..last).step_by(1999)) {
        kept.remove(&view, &[index]).unwrap();
        all.push(index);
        let (incremental, _) = frame(&mut kept, &view, &c_arm, 1);
        let mut fresh = DrrRenderer::new(&view, parameters(Projector::Joseph, 1), &Desk).unwrap();
        fresh.remove(&view, &all).unwrap();
        assert_same(&incremental, &frame(&mut fresh, &view, &c_arm, 1).0);
    }
}

#[test]
fn one_two_and_four_threads_any_order_and_any_history_give_the_same_frame() {
    let (grid, hu) = volume();
    let view = VolumeView::new(grid, &hu).unwrap();
    let (c_arm, other) = (close_up(20.0, 10.0), close_up(-60.0, 0.0));
    let removed = batch(&grid, 0, 900);
    let mut reference = DrrRenderer::new(&view, parameters(Projector::Joseph, 1), &Desk).unwrap();
    reference.remove(&view, &removed).unwrap();
    let (want, _) = frame(&mut reference, &view, &c_arm, 5);
    for threads in [2, 4] {
        let mut renderer = DrrRenderer::new(&view, parameters(Projector::Joseph, threads), &Desk).unwrap();
        // A different history: other poses, tools, frames and batches, and the voxels in reverse order, some
        // of them twice.
        for (step, chunk) in removed.rchunks(130).enumerate() {
            let reversed: Vec<u32> = chunk.iter().rev().copied().collect();
            renderer.remove(&view, &reversed).unwrap();
            assert_eq!(renderer.remove(&view, chunk).unwrap(), 0);
            frame(&mut renderer, &view, if step % 3 == 1 { &other } else { &c_arm }, step as u64 + 40);
        }
        assert_same(&frame(&mut renderer, &view, &c_arm, 5).0, &want);
    }
}

#[test]
fn putting_everything_back_gives_the_first_frame_again() {
    let (grid, hu) = volume();
    let view = VolumeView::new(grid, &hu).unwrap();
    let c_arm = close_up(0.0, 0.0);
    let mut renderer = DrrRenderer::new(&view, parameters(Projector::Joseph, 2), &Desk).unwrap();
    let (first, _) = frame(&mut renderer, &view, &c_arm, 3);
    renderer.remove(&view, &batch(&grid, 0, 500)).unwrap();
    let (drilled, _) = frame(&mut renderer, &view, &c_arm, 3);
    assert!(drilled.anatomy != first.anatomy);
    renderer.restore_all(&view).unwrap();
    assert_eq!(renderer.removed().count(), 0);
    assert_same(&frame(&mut renderer, &view, &c_arm, 3).0, &first);
}

#[test]
fn a_removed_voxel_is_what_fills_it() {
    // Removing and filling with water equals a CT with water there.
    let (grid, hu) = volume();
    let removed = batch(&grid, 0, 400);
    let mut filled = hu.clone();
    removed.iter().for_each(|&i| filled[i as usize] = 0);
    let (view, filled) = (VolumeView::new(grid, &hu).unwrap(), VolumeView::new(grid, &filled).unwrap());
    for projector in [Projector::SLICE_ORDERED, Projector::PREVIEW, Projector::Joseph, Projector::Siddon] {
        let with_water = DrrParameters { fill_hu: 0, ..parameters(projector, 2) };
        let mut a = DrrRenderer::new(&view, with_water, &Desk).unwrap();
        a.remove(&view, &removed).unwrap();
        let mut b = DrrRenderer::new(&filled, with_water, &Desk).unwrap();
        let c_arm = close_up(37.0, 18.0);
        assert_same(&frame(&mut a, &view, &c_arm, 0).0, &frame(&mut b, &filled, &c_arm, 0).0);
    }
}

#[test]
fn an_unchanged_frame_traces_nothing_and_irrelevant_removals_trace_little() {
    let (grid, hu) = volume();
    let view = VolumeView::new(grid, &hu).unwrap();
    let c_arm = close_up(0.0, 0.0);
    let mut renderer = DrrRenderer::new(&view, parameters(Projector::Joseph, 1), &Desk).unwrap();
    frame(&mut renderer, &view, &c_arm, 0);
    assert_eq!(frame(&mut renderer, &view, &c_arm, 1).1, RenderKind::Cached);
    // Air where there was air: nothing to trace.
    let air = hu.iter().position(|&h| h == -1000).unwrap();
    assert_eq!(renderer.remove(&view, &[air as u32]).unwrap(), 1);
    assert_eq!(frame(&mut renderer, &view, &c_arm, 2).1, RenderKind::Cached);
    // One voxel of about 1 mm, magnified less than twice on pixels of 0.8 mm: a ray that passes more than 1
    // voxel away cannot reach it, so a square of at most 2 sqrt(3) * 1.3 * 2 / 0.8 = 12 pixels a side.
    let bone = hu.iter().position(|&h| h > 1000).unwrap() + grid.voxels() / 2;
    let bone = (bone..).find(|&i| hu[i] > 1000).unwrap();
    renderer.remove(&view, &[bone as u32]).unwrap();
    let mut image = vec![0; c_arm.pixels()];
    let report = renderer.render(&view, &c_arm, &tool(0), FrameSeed::default(), &mut image).unwrap();
    assert!(report.rays_traced > 0 && report.rays_traced <= 144, "{report:?}");
}

#[test]
fn seed_and_frame_number_change_the_noise_only() {
    let (grid, hu) = volume();
    let view = VolumeView::new(grid, &hu).unwrap();
    let c_arm = close_up(0.0, 0.0);
    let mut renderer = DrrRenderer::new(&view, parameters(Projector::Joseph, 1), &Desk).unwrap();
    let mut shoot = |seed, frame| {
        let mut image = vec![0; c_arm.pixels()];
        renderer.render(&view, &c_arm, &tool(0), FrameSeed { seed, frame }, &mut image).unwrap();
        image
    };
    let first = shoot(1, 1);
    assert!(first == shoot(1, 1) && first != shoot(1, 2) && first != shoot(2, 1));
}

#[test]
fn refusals_change_nothing() {
    let (grid, hu) = volume();
    let view = VolumeView::new(grid, &hu).unwrap();
    let mut renderer = DrrRenderer::new(&view, parameters(Projector::Joseph, 1), &Desk).unwrap();
    let c_arm = close_up(0.0, 0.0);
    let (before, _) = frame(&mut renderer, &view, &c_arm, 0);
    let beyond = grid.voxels() as u32;
    let error = renderer.remove(&view, &[5, 6, beyond]).unwrap_err();
    assert_eq!(error, DrrError::VoxelIndex { given: beyond, position: 2, voxels: grid.voxels() });
    assert_eq!(renderer.removed().count(), 0);
    let mut image = vec![0; c_arm.pixels()];
    let seed = FrameSeed { seed: 7, frame: 0 };
    let bad_tool = Tool {
        parts: vec![ToolPart::Sphere { centre_m: [0.0; 3], radius_m: -1.0, material: Material::Water }],
        ..Tool::default()
    };
    assert!(matches!(
        renderer.render(&view, &c_arm, &bad_tool, seed, &mut image),
        Err(DrrError::ToolPart { part: 0, .. })
    ));
    assert!(matches!(
        renderer.render(&view, &c_arm, &tool(0), seed, &mut image[1..]),
        Err(DrrError::Length { field: "image", .. })
    ));
    let small = Grid::axis_aligned([2; 3], [1e-3; 3], [0.0; 3]).unwrap();
    let small = VolumeView::new(small, &[0; 8]).unwrap();
    assert_eq!(renderer.render(&small, &c_arm, &tool(0), seed, &mut image), Err(DrrError::GridChanged));
    assert!(VolumeView::new(grid, &hu[1..]).is_err());
    assert!(
        DrrRenderer::new(&view, DrrParameters { threads: 0, ..DrrParameters::default() }, &Desk).is_err()
    );
    let (after, kind) = frame(&mut renderer, &view, &c_arm, 0);
    assert_eq!(kind, RenderKind::Cached);
    assert_same(&before, &after);
}
