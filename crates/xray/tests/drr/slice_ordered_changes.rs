//! Sums over slices updated for removed voxels: they equal full renders, and cost little.

use proptest::prelude::*;
use xray::removal::RemovedVoxels;
use xray::slice_ordered::{Instructions, SliceOrdered, SliceOrderedOptions, Update};
use xray::{CArm, DrrParameters, DrrRenderer, FrameSeed, Grid, Projector, RenderKind, Tool, VolumeView};

use crate::machine::{Desk, NoClock};
use crate::slice_ordered::{POSES, c_arm, full, hash, random, remove, slices, table, volume, water};

/// Removes voxels in batches of these sizes; after each, sums and image must equal a full render with the
/// voxels in reverse order. Returns the number of batches that updated the cached sums instead of recomputing
/// them.
pub fn assert_removals_equal_full_renders(
    view: &VolumeView<'_>,
    grid: &Grid,
    c_arm: &CArm,
    options: SliceOrderedOptions,
    batches: &[u64],
) -> usize {
    let mut kept = slices(view, options);
    let mut set = RemovedVoxels::new(grid);
    let mut image = vec![0.0; c_arm.pixels()];
    kept.project(view, &set, c_arm, &mut image).unwrap();
    let mut all: Vec<u32> = Vec::new();
    let mut changed = 0;
    for (step, count) in batches.iter().enumerate() {
        let from = 1_000_000 * step as u64;
        let batch: Vec<u32> =
            (from..from + count).map(|i| (random(i) % grid.voxels() as u64) as u32).collect();
        remove(&mut kept, view, &mut set, &batch);
        all.extend(&batch);
        let update = kept.project(view, &set, c_arm, &mut image).unwrap();
        changed += usize::from(matches!(update, Update::Changed(_)));
        let reversed: Vec<u32> = all.iter().rev().copied().collect();
        let (want, sums) = full(view, options, &reversed, c_arm);
        assert!(kept.sums().values == sums, "{c_arm:?}: sums after {} removals", all.len());
        assert!(hash(&image) == hash(&want), "{c_arm:?}: image after {} removals", all.len());
    }
    assert_eq!(kept.project(view, &set, c_arm, &mut image).unwrap(), Update::Unchanged);
    changed
}

#[test]
fn removals_by_ones_and_by_thousands_equal_full_renders_bit_for_bit() {
    let (grid, hu) = volume(2500);
    let view = VolumeView::new(grid, &hu).unwrap();
    for (reduction, poses) in [(1, &POSES[..]), (2, &POSES[..2])] {
        for &(primary, secondary) in poses {
            let c_arm = c_arm(primary, secondary, 90);
            let options = SliceOrderedOptions { reduction, ..SliceOrderedOptions::default() };
            let batches = [1, 100, 3, 10_000, 100_000];
            let changed = assert_removals_equal_full_renders(&view, &grid, &c_arm, options, &batches);
            assert!(changed >= 2, "the cached sums were hardly used");
        }
    }
}

#[test]
fn blocks_of_equal_voxels_hold_exactly_what_their_voxels_take_away_one_by_one() {
    let dims = [128, 96, 40];
    let grid = Grid::centred(dims, [1e-3; 3]).unwrap();
    // Seams next to and across the 32-voxel cells; blocks longer and shorter than a group of samples.
    let block = |v: [usize; 3]| (v[0] / 65 + v[0] / 96 + v[1] / 40 + v[2] / 9) % 4;
    let hu: Vec<i16> = (0..grid.voxels())
        .map(|n| [-1000, 300, 1200, 1200][block([n % dims[0], n / dims[0] % dims[1], n / dims[0] / dims[1]])])
        .collect();
    let view = VolumeView::new(grid, &hu).unwrap();
    let all: Vec<u32> = (0..grid.voxels() as u32).collect();
    for instructions in Instructions::available() {
        for (primary, secondary) in [(0.0, 0.0), (37.0, 18.0), (90.0, 5.0)] {
            let c_arm = c_arm(primary, secondary, 64);
            let options = SliceOrderedOptions { instructions, ..SliceOrderedOptions::default() };
            let mut kept =
                SliceOrdered::new(&view, &table(), water() / 1000.0, 0.0, options, &NoClock).unwrap();
            let mut set = RemovedVoxels::new(&grid);
            let mut image = vec![0.0; c_arm.pixels()];
            kept.project(&view, &set, &c_arm, &mut image).unwrap();
            let share = kept.cell_shares().into_iter().flatten().next().unwrap();
            assert!(share.mixed < 0.7 && share.occupied > 0.6, "{share:?}");
            for batch in all.chunks(20_000) {
                remove(&mut kept, &view, &mut set, batch);
                let update = kept.project(&view, &set, &c_arm, &mut image).unwrap();
                assert!(!matches!(update, Update::Full), "summed again");
            }
            assert!(kept.sums().values.iter().all(|sum| *sum == 0), "something is left");
            kept.forget();
            kept.project(&view, &set, &c_arm, &mut image).unwrap();
            assert!(kept.sums().values.iter().all(|sum| *sum == 0), "a removed voxel is still summed");
        }
    }
}

/// Sums cover the box of voxels that attenuate. Irrigation also fills air outside it.
#[test]
fn air_beyond_the_bone_that_is_filled_is_summed() {
    let dims = [60, 50, 40];
    let grid = Grid::centred(dims, [1e-3; 3]).unwrap();
    let is_bone =
        |[x, y, z]: [usize; 3]| (20..30).contains(&x) && (22..35).contains(&y) && (9..30).contains(&z);
    let hu: Vec<i16> =
        (0..grid.voxels()).map(|n| if is_bone(grid.voxel_of(n)) { 900 } else { -1000 }).collect();
    let view = VolumeView::new(grid, &hu).unwrap();
    let c_arm = c_arm(40.0, 20.0, 64);
    // Through the bone, outside it, and in the volume's corners.
    let filled: Vec<u32> = [[25, 30, 20], [21, 22, 9], [19, 30, 20], [0, 0, 0], [59, 49, 39], [40, 2, 30]]
        .map(|voxel| grid.linear_of(voxel).unwrap() as u32)
        .to_vec();
    for reduction in [1, 2] {
        let options = SliceOrderedOptions { reduction, ..SliceOrderedOptions::default() };
        let new = || SliceOrdered::new(&view, &table(), water() / 1000.0, water(), options, &Desk).unwrap();
        let all_at_once = |order: &[u32]| {
            let (mut slices, mut set) = (new(), RemovedVoxels::new(&grid));
            remove(&mut slices, &view, &mut set, order);
            let mut image = vec![f64::NAN; c_arm.pixels()];
            slices.project(&view, &set, &c_arm, &mut image).unwrap();
            image
        };
        let (mut kept, mut set) = (new(), RemovedVoxels::new(&grid));
        let mut image = vec![0.0; c_arm.pixels()];
        kept.project(&view, &set, &c_arm, &mut image).unwrap();
        for (n, voxel) in filled.iter().enumerate() {
            let before = image.clone();
            remove(&mut kept, &view, &mut set, &[*voxel]);
            kept.project(&view, &set, &c_arm, &mut image).unwrap();
            assert!(image != before, "voxel {n} does not show");
            let reversed: Vec<u32> = filled[..=n].iter().rev().copied().collect();
            assert!(hash(&image) == hash(&all_at_once(&reversed)), "after {} voxels", n + 1);
        }
        kept.restore_all(&view);
        let set = RemovedVoxels::new(&grid);
        kept.project(&view, &set, &c_arm, &mut image).unwrap();
        assert!(hash(&image) == hash(&all_at_once(&[])), "restored");
    }
}

#[test]
fn a_single_voxel_changes_a_small_rectangle_only() {
    let (grid, hu) = volume(2500);
    let view = VolumeView::new(grid, &hu).unwrap();
    let c_arm = c_arm(20.0, 10.0, 256);
    let mut kept = slices(&view, SliceOrderedOptions::default());
    let mut set = RemovedVoxels::new(&grid);
    let mut image = vec![0.0; c_arm.pixels()];
    kept.project(&view, &set, &c_arm, &mut image).unwrap();
    let middle = grid.linear_of([37, 50, 26]).unwrap() as u32;
    assert!(hu[middle as usize] > -900);
    remove(&mut kept, &view, &mut set, &[middle]);
    match kept.project(&view, &set, &c_arm, &mut image).unwrap() {
        // 1.1 mm magnified 1.5 times on pixels of 0.5 mm, with 8 samples of margin: within 40 pixels.
        Update::Changed(pixels) => assert!(pixels <= 40 * 40, "{pixels}"),
        other => panic!("{other:?}"),
    }
}

#[test]
fn removals_far_apart_are_shown_as_small_rectangles() {
    let (grid, hu) = volume(2500);
    let view = VolumeView::new(grid, &hu).unwrap();
    let c_arm = c_arm(20.0, 10.0, 256);
    let options = SliceOrderedOptions::default();
    let mut kept = slices(&view, options);
    let mut set = RemovedVoxels::new(&grid);
    let mut image = vec![0.0; c_arm.pixels()];
    kept.project(&view, &set, &c_arm, &mut image).unwrap();
    let voxels: Vec<u32> = [[5, 50, 5], [70, 5, 48], [40, 55, 48], [60, 50, 5]]
        .map(|voxel| grid.linear_of(voxel).unwrap() as u32)
        .to_vec();
    remove(&mut kept, &view, &mut set, &voxels);
    match kept.refresh(&c_arm, &mut image) {
        // One rectangle around them would cover most of the image.
        Some(Update::Changed(pixels)) => assert!(4 * pixels <= image.len(), "{pixels}"),
        other => panic!("{other:?}"),
    }
    let (want, sums) = full(&view, options, &voxels, &c_arm);
    assert!(kept.sums().values == sums && hash(&image) == hash(&want));
}

#[test]
fn a_frame_rendered_aside_leaves_the_standing_c_arm_its_cache() {
    let (grid, hu) = volume(2500);
    let view = VolumeView::new(grid, &hu).unwrap();
    for projector in [Projector::SLICE_ORDERED, Projector::PREVIEW, Projector::Joseph] {
        let parameters = DrrParameters { projector, threads: 2, ..DrrParameters::default() };
        let mut renderer = DrrRenderer::new(&view, parameters, &Desk).unwrap();
        let (stands, other) = (c_arm(20.0, 10.0, 96), c_arm(90.0, 0.0, 96));
        let (tool, seed) = (Tool::default(), FrameSeed::default());
        let mut image = vec![0; stands.pixels()];
        renderer.render(&view, &stands, &tool, seed, &mut image).unwrap();
        let mut removed = Vec::new();
        for round in 0..3_u32 {
            let before: Vec<u32> = (0..50).map(|i| 40_000 + 1000 * round + i).collect();
            let after: Vec<u32> = (0..50).map(|i| 90_000 + 1000 * round + i).collect();
            renderer.remove(&view, &before).unwrap();
            let mut aside = vec![0; other.pixels()];
            renderer.render_aside(&view, &other, &tool, seed, &mut aside).unwrap();
            removed.extend_from_slice(&before);
            let fresh = |c_arm: &CArm, removed: &[u32]| {
                let mut renderer = DrrRenderer::new(&view, parameters, &Desk).unwrap();
                renderer.remove(&view, removed).unwrap();
                let mut image = vec![0; c_arm.pixels()];
                renderer.render(&view, c_arm, &tool, seed, &mut image).unwrap();
                (image, hash(renderer.anatomy()))
            };
            assert!(aside == fresh(&other, &removed).0, "{projector:?} aside, round {round}");
            renderer.remove(&view, &after).unwrap();
            removed.extend_from_slice(&after);
            let report = renderer.render(&view, &stands, &tool, seed, &mut image).unwrap();
            // Incremental, or full where the measured costs predict that to be faster.
            assert_ne!(report.kind, RenderKind::Cached, "{projector:?} round {round}");
            let want = fresh(&stands, &removed);
            assert!(image == want.0 && hash(renderer.anatomy()) == want.1, "{projector:?} round {round}");
        }
    }
}

proptest! {
    #![proptest_config(ProptestConfig::with_cases(48))]

    #[test]
    fn any_order_of_any_removals_from_any_side_equals_a_full_render(
        primary in -180.0..180.0_f64, secondary in -90.0..90.0_f64,
        order in prop::collection::vec(0_u32..75 * 61 * 53, 1..300), split in 0_usize..300,
        oversampling in 0.8..2.5_f64,
    ) {
        let (grid, hu) = volume(2500);
        let view = VolumeView::new(grid, &hu).unwrap();
        let c_arm = c_arm(primary, secondary, 40);
        let options = SliceOrderedOptions { oversampling, ..SliceOrderedOptions::default() };
        let mut kept = slices(&view, options);
        let mut set = RemovedVoxels::new(&grid);
        let mut image = vec![0.0; c_arm.pixels()];
        kept.project(&view, &set, &c_arm, &mut image).unwrap();
        let (a, b) = order.split_at(split.min(order.len()));
        for part in [a, b] {
            remove(&mut kept, &view, &mut set, part);
            kept.project(&view, &set, &c_arm, &mut image).unwrap();
        }
        let (want, sums) = full(&view, options, &order, &c_arm);
        prop_assert!(kept.sums().values == sums && hash(&image) == hash(&want));
    }
}
