//! Machines that the tests render on, and tests that the machine does not change a bit of a frame.

use std::sync::LazyLock;
use std::sync::atomic::{AtomicU64, Ordering};
use std::time::Instant;

use xray::removal::RemovedVoxels;
use xray::slice_ordered::{SliceOrdered, SliceOrderedOptions, Update};
use xray::{
    CArm, DetectorFormat, DrrError, DrrParameters, DrrRenderer, FrameSeed, Grid, Machine, Material, Memory,
    MuTable, PositionerAngles, Tool, VolumeView,
};

use crate::slice_ordered::{c_arm, hash, random, remove, volume};

/// Threads from rayon, memory from the heap, and a running clock.
pub struct Desk;

static START: LazyLock<Instant> = LazyLock::new(Instant::now);

impl Machine for Desk {
    fn workers(&self, threads: usize) -> Result<rayon::ThreadPool, String> {
        rayon::ThreadPoolBuilder::new().num_threads(threads).build().map_err(|cause| cause.to_string())
    }

    fn now_ns(&self) -> u64 {
        START.elapsed().as_nanos() as u64
    }
}

/// A clock that advances by a second at every reading, so that changing a few voxels appears to cost more
/// than a full sum.
struct SlowUpdates(AtomicU64);

impl Machine for SlowUpdates {
    fn workers(&self, threads: usize) -> Result<rayon::ThreadPool, String> {
        Desk.workers(threads)
    }

    fn now_ns(&self) -> u64 {
        self.0.fetch_add(1_000_000_000, Ordering::Relaxed)
    }
}

/// A stopped clock, so that updates never appear slower.
pub struct NoClock;

impl Machine for NoClock {
    fn workers(&self, threads: usize) -> Result<rayon::ThreadPool, String> {
        Desk.workers(threads)
    }
}

/// A machine that reports this much free memory and allocates at most this many bytes.
pub struct Small {
    pub free_bytes: Option<u64>,
    pub given_bytes: usize,
}

impl Machine for Small {
    fn workers(&self, threads: usize) -> Result<rayon::ThreadPool, String> {
        if threads > 4 { Err("no more than 4".to_owned()) } else { Desk.workers(threads) }
    }

    fn available_bytes(&self) -> Option<u64> {
        self.free_bytes
    }

    fn zeroed(&self, bytes: usize) -> Option<Box<dyn Memory>> {
        Desk.zeroed(bytes.min(self.given_bytes))
    }
}

#[test]
fn the_clock_decides_how_changes_are_worked_in_and_not_what_comes_out() {
    static SLOW: SlowUpdates = SlowUpdates(AtomicU64::new(0));
    let (grid, hu) = volume(2500);
    let view = VolumeView::new(grid, &hu).unwrap();
    let c_arm = c_arm(20.0, 10.0, 64);
    let results = [&SLOW as &'static dyn Machine, &NoClock].map(|machine| {
        let table = MuTable::new(60.0, -900).unwrap();
        let unit_per_m = Material::Water.mu_per_m(60.0).unwrap() / 1000.0;
        let options = SliceOrderedOptions::default();
        let mut slices = SliceOrdered::new(&view, &table, unit_per_m, 0.0, options, machine).unwrap();
        let mut set = RemovedVoxels::new(&grid);
        let mut image = vec![0.0; c_arm.pixels()];
        let mut updates = Vec::new();
        for step in 0..4_u64 {
            // The first change measures the cost of one voxel.
            let count = if step == 1 { 1 } else { 1000 * step };
            let batch: Vec<u32> =
                (0..count).map(|i| (random(10_000 * step + i) % grid.voxels() as u64) as u32).collect();
            remove(&mut slices, &view, &mut set, &batch);
            updates.push(slices.project(&view, &set, &c_arm, &mut image).unwrap());
        }
        (updates, hash(&image))
    });
    let [(slow, slow_hash), (never, never_hash)] = results;
    assert_eq!(slow_hash, never_hash);
    assert_eq!(slow[2..], [Update::Full; 2]);
    assert!(never[1..].iter().all(|update| matches!(update, Update::Changed(_))), "{never:?}");
}

#[test]
fn a_copy_that_the_memory_cannot_hold_is_refused_with_both_sizes() {
    static FULL: Small = Small { free_bytes: Some(1 << 10), given_bytes: usize::MAX };
    static STINGY: Small = Small { free_bytes: None, given_bytes: 1 << 10 };
    let (grid, hu) = volume(2500);
    let view = VolumeView::new(grid, &hu).unwrap();
    let c_arm = c_arm(20.0, 10.0, 32);
    for (machine, free) in [(&FULL, 1 << 10), (&STINGY, 0)] {
        let mut renderer = DrrRenderer::new(&view, DrrParameters::default(), machine).unwrap();
        let mut image = vec![0; c_arm.pixels()];
        let (tool, seed) = (Tool::default(), FrameSeed::default());
        let refused = renderer.render(&view, &c_arm, &tool, seed, &mut image).unwrap_err();
        let DrrError::Memory { dims, bytes_each: 2, needed_bytes, available_bytes } = refused else {
            panic!("{refused}")
        };
        assert_eq!((dims, available_bytes), (grid.dims(), free));
        assert!(needed_bytes >= 2 * grid.voxels() as u64);
    }
    let too_many = DrrParameters { threads: 5, ..DrrParameters::default() };
    let refused = DrrRenderer::new(&view, too_many, &FULL).err();
    assert_eq!(refused, Some(DrrError::Threads { threads: 5, reason: "no more than 4".to_owned() }));
}

#[test]
fn images_that_the_memory_cannot_hold_are_refused_with_both_sizes() {
    static GIBIBYTE: Small = Small { free_bytes: Some(1 << 30), given_bytes: usize::MAX };
    // A slice of 3 x 3 m at four samples per voxel has 144 million samples of 12 bytes, less those between
    // the halves of the detector.
    let grid = Grid::centred([3000, 3000, 1], [1e-3; 3]).unwrap();
    let hu = vec![100; grid.voxels()];
    let view = VolumeView::new(grid, &hu).unwrap();
    let format = DetectorFormat { columns: 64, rows: 64, pixel_pitch_m: [0.1; 2] };
    let from_below = PositionerAngles::from_degrees(0.0, 90.0);
    let c_arm = CArm::from_positioner_angles([0.0; 3], from_below, 1.6, 1.7, format).unwrap();
    let table = MuTable::new(60.0, -900).unwrap();
    let options = SliceOrderedOptions { oversampling: 4.0, ..SliceOrderedOptions::default() };
    let mut slices = SliceOrdered::new(&view, &table, 0.02, 0.0, options, &GIBIBYTE).unwrap();
    let mut image = vec![0.0; c_arm.pixels()];
    let refused = slices.project(&view, &RemovedVoxels::new(&grid), &c_arm, &mut image).unwrap_err();
    let DrrError::Images { samples, needed_bytes, available_bytes } = refused else { panic!("{refused}") };
    assert!((130_000_000..150_000_000).contains(&samples), "{samples}");
    assert_eq!((needed_bytes, available_bytes), (12 * samples as u64, 1 << 30));
    let text = refused.to_string();
    assert!(text.contains("1.00 GiB are free") && text.contains("oversampling"), "{text}");
}

#[test]
fn slices_across_z_have_the_same_bits_with_a_copy_of_their_own_and_without() {
    // A third copy (0.8 MB) does not fit into a quarter of it.
    static SCARCE: Small = Small { free_bytes: Some(2_000_000), given_bytes: usize::MAX };
    static PLENTY: Small = Small { free_bytes: Some(1 << 30), given_bytes: usize::MAX };
    let (grid, hu) = volume(2500);
    let view = VolumeView::new(grid, &hu).unwrap();
    let table = MuTable::new(60.0, -900).unwrap();
    let from_above = c_arm(5.0, 85.0, 64);
    let results = [&SCARCE, &PLENTY].map(|machine| {
        let options = SliceOrderedOptions::default();
        let mut slices = SliceOrdered::new(&view, &table, 0.02, 0.0, options, machine).unwrap();
        let mut set = RemovedVoxels::new(&grid);
        let mut image = vec![0.0; from_above.pixels()];
        slices.project(&view, &set, &from_above, &mut image).unwrap();
        let before = hash(&image);
        let batch: Vec<u32> = (0..500).map(|i| (random(i) % grid.voxels() as u64) as u32).collect();
        remove(&mut slices, &view, &mut set, &batch);
        let update = slices.project(&view, &set, &from_above, &mut image).unwrap();
        assert!(matches!(update, Update::Changed(_)), "{update:?}");
        (slices.memory().copies.map(|bytes| bytes > 0), [before, hash(&image)])
    });
    assert_eq!(results.map(|(copies, _)| copies), [[false, true, false], [false, false, true]]);
    assert_eq!(results[0].1, results[1].1);
}
