//! Sums over slices from every side: the detector in front of, behind and inside the volume, the source
//! outside and inside, wide fans.

use std::sync::LazyLock;

use proptest::prelude::*;
use xray::ray::{IndexRay, RayFan, WorldRay};
use xray::reference::{self, Ellipsoid, relative_rms};
use xray::removal::{AttenuationField, BlockMap, RemovedVoxels};
use xray::slice_ordered::SliceOrderedOptions;
use xray::{CArm, DetectorFormat, Grid, Material, PositionerAngles, VolumeView, joseph};
use xxhash_rust::xxh3::xxh3_64;

use crate::slice_ordered::{full, same_hash, slices, table, volume, volume_in_air};
use crate::slice_ordered_changes::assert_removals_equal_full_renders;

/// A C-arm about the world's origin.
#[derive(Debug, Clone, Copy)]
struct Pose {
    degrees: (f64, f64),
    source_m: f64,
    detector_m: f64,
    field_m: f64,
}

const fn pose(degrees: (f64, f64), source_m: f64, detector_m: f64, field_m: f64) -> Pose {
    Pose { degrees, source_m, detector_m, field_m }
}

impl Pose {
    fn c_arm(&self, side: u32) -> CArm {
        let pitch = self.field_m / f64::from(side);
        let format = DetectorFormat { columns: side, rows: side - 7, pixel_pitch_m: [pitch; 2] };
        let angles = PositionerAngles::from_degrees(self.degrees.0, self.degrees.1);
        CArm::from_positioner_angles([0.0; 3], angles, self.source_m, self.detector_m, format).unwrap()
    }
}

/// Poses of the same view in which one image serves all rays.
const ORDINARY: [Pose; 3] =
    [pose((0.0, 0.0), 0.7, 1.0, 0.14), pose((45.0, 0.0), 0.7, 1.0, 0.14), pose((37.0, 18.0), 0.7, 1.0, 0.14)];

/// Only corners of the box, which are air, lie behind the detector.
const CORNERS_BEHIND: [Pose; 5] = [
    pose((45.0, 0.0), 0.7, 0.75, 0.12),
    pose((-45.0, 0.0), 0.7, 0.75, 0.12),
    pose((135.0, 20.0), 0.7, 0.76, 0.12),
    pose((20.0, 0.0), 0.7, 0.738, 0.12),
    pose((-100.0, -10.0), 0.7, 0.745, 0.12),
];

/// The detector cuts the thigh.
const CUT: [Pose; 6] = [
    pose((0.0, 0.0), 0.7, 0.705, 0.1),
    pose((45.0, 0.0), 0.7, 0.71, 0.1),
    pose((45.0, 35.0), 0.7, 0.7, 0.1),
    pose((-120.0, -40.0), 0.7, 0.72, 0.1),
    pose((0.0, 60.0), 0.7, 0.71, 0.1),
    pose((10.0, 89.0), 0.7, 0.72, 0.1),
];

/// Rays of more than four voxels per slice across any axis, from outside the box and from inside it.
const WIDE: [Pose; 6] = [
    pose((0.0, 0.0), 0.1, 0.2, 1.2),
    pose((45.0, 35.0), 0.1, 0.2, 1.2),
    pose((30.0, 0.0), 0.034, 0.12, 0.9),
    pose((0.0, 0.0), 0.034, 0.1, 0.9),
    pose((90.0, 45.0), 0.04, 0.06, 0.5),
    pose((-30.0, -20.0), 0.03, 0.035, 0.3),
];

/// The source lies inside the thigh, and the fan is wide or the detector cuts the box.
const INSIDE: [Pose; 4] = [
    pose((0.0, 0.0), 0.0104, 0.1, 0.9),
    pose((20.0, 20.0), 0.0101, 0.07, 0.5),
    pose((45.0, 0.0), 0.0102, 0.05, 0.05),
    pose((-140.0, 40.0), 0.0103, 0.04, 0.2),
];

/// Poses that need more than one image.
fn unordinary() -> impl Iterator<Item = Pose> {
    CORNERS_BEHIND.into_iter().chain(CUT).chain(WIDE).chain(INSIDE)
}

fn water() -> f64 {
    Material::Water.mu_per_m(60.0).unwrap()
}

/// Line integral of ellipsoids from the source to the pixel, between the ends of a box at |z| = `half_m`.
fn closed_form(shapes: &[Ellipsoid], half_m: f64, ray: &WorldRay) -> f64 {
    let ends = [-half_m, half_m].map(|z| (z - ray.origin_m[2]) / ray.direction_m[2]);
    let (first, last) = (ends[0].min(ends[1]).max(0.0), ends[0].max(ends[1]).min(1.0));
    let chord_m = |shape: &Ellipsoid| {
        let scaled = |p: [f64; 3], c: [f64; 3]| -> [f64; 3] {
            std::array::from_fn(|a| (p[a] - c[a]) / shape.semi_axes_m[a])
        };
        let (o, d) = (scaled(ray.origin_m, shape.centre_m), scaled(ray.direction_m, [0.0; 3]));
        let dot = |a: [f64; 3], b: [f64; 3]| a[0] * b[0] + a[1] * b[1] + a[2] * b[2];
        let (middle, squared) = (-dot(o, d) / dot(d, d), dot(o, o) - 1.0);
        let half = (middle * middle - squared / dot(d, d)).max(0.0).sqrt();
        ((middle + half).min(last) - (middle - half).max(first)).max(0.0) * ray.length_m
    };
    shapes.iter().map(|shape| water() * shape.added_hu / 1000.0 * chord_m(shape)).sum()
}

/// A thigh in a box with air around it; it extends through both ends of the box.
struct Thigh {
    shapes: Vec<Ellipsoid>,
    grid: Grid,
    hu: Vec<i16>,
}

impl Thigh {
    fn new(dims: [usize; 3], spacing_m: [f64; 3]) -> Self {
        // An ellipsoid of 66 x 56 mm: the box of 90 x 76 mm has air on all sides but its ends.
        let shapes = reference::thigh(0.35);
        let grid = Grid::centred(dims, spacing_m).unwrap();
        let hu = reference::voxelise(&grid, &shapes, 4);
        Self { shapes, grid, hu }
    }

    fn view(&self) -> VolumeView<'_> {
        VolumeView::new(self.grid, &self.hu).unwrap()
    }

    /// Computes every pixel with `of`.
    fn image(&self, c_arm: &CArm, of: impl Fn(&WorldRay) -> f64) -> Vec<f64> {
        let fan = RayFan::new(&self.grid, c_arm);
        let pixels = 0..c_arm.pixels() as u32;
        pixels.map(|i| of(&fan.world_ray(i % c_arm.columns, i / c_arm.columns))).collect()
    }

    fn joseph(&self, c_arm: &CArm) -> Vec<f64> {
        let (removed, table) = (RemovedVoxels::new(&self.grid), table());
        let blocks = BlockMap::new(&self.view(), &table);
        let field = AttenuationField {
            view: self.view(),
            removed: &removed,
            blocks: &blocks,
            table: &table,
            fill_mu_per_m: 0.0,
        };
        self.image(c_arm, |ray| joseph::line_integral(&field, &IndexRay::new(&self.grid, ray)))
    }

    /// Number of images and relative errors: of Joseph's method and of the sums against the closed form, and
    /// between the two.
    fn errors(&self, c_arm: &CArm, options: SliceOrderedOptions) -> (usize, [f64; 3]) {
        let half_m = 0.5 * self.grid.dims()[2] as f64 * self.grid.spacing_m()[2];
        let truth = self.image(c_arm, |ray| closed_form(&self.shapes, half_m, ray));
        let by_ray = self.joseph(c_arm);
        let mut slices = slices(&self.view(), options);
        let mut image = vec![f64::NAN; c_arm.pixels()];
        slices.project(&self.view(), &RemovedVoxels::new(&self.grid), c_arm, &mut image).unwrap();
        let errors =
            [relative_rms(&by_ray, &truth), relative_rms(&image, &truth), relative_rms(&image, &by_ray)];
        (slices.sums().images, errors)
    }
}

#[test]
fn every_pose_has_the_error_of_ordinary_poses() {
    let thigh = Thigh::new([90, 76, 116], [1e-3; 3]);
    for pose in ORDINARY.into_iter().chain(unordinary()) {
        let (images, [joseph, sums, between]) = thigh.errors(&pose.c_arm(96), SliceOrderedOptions::default());
        println!("{pose:?}: {images} images, joseph {joseph:.2e}, sums {sums:.2e}, between {between:.2e}");
        // The bound for ordinary poses: `the_error_beside_closed_forms_is_the_voxels_own`.
        assert!(sums < 1.1 * joseph, "{pose:?}: {sums} {joseph}");
    }
}

#[test]
fn a_detector_that_cuts_only_air_takes_one_image() {
    let thigh = Thigh::new([90, 76, 116], [1e-3; 3]);
    let empty = Grid::centred([20, 30, 10], [1e-3; 3]).unwrap();
    let nothing = vec![-1000; empty.voxels()];
    for pose in CORNERS_BEHIND {
        let (images, _) = thigh.errors(&pose.c_arm(96), SliceOrderedOptions::default());
        assert_eq!(images, 1, "{pose:?}");
    }
    for pose in ORDINARY.into_iter().chain(unordinary()) {
        let view = VolumeView::new(empty, &nothing).unwrap();
        let (image, _) = full(&view, SliceOrderedOptions::default(), &[], &pose.c_arm(40));
        assert!(image.iter().all(|pixel| *pixel == 0.0), "{pose:?} of nothing");
    }
}

#[test]
fn thick_slices_seen_along_an_edge_have_the_error_of_joseph() {
    // Slices eight times as thick as wide: a few degrees change the best axis.
    let thigh = Thigh::new([180, 152, 29], [0.5e-3, 0.5e-3, 4e-3]);
    for degrees in [(0.0, 84.0), (20.0, 80.0), (-70.0, -85.0)] {
        let pose = pose(degrees, 0.2, 0.3, 0.35);
        let (images, [joseph, sums, between]) = thigh.errors(&pose.c_arm(96), SliceOrderedOptions::default());
        println!("{pose:?}: {images} images, joseph {joseph:.2e}, sums {sums:.2e}, between {between:.2e}");
        assert!(images > 1 && sums < 1.1 * joseph, "{pose:?}: {images} {sums} {joseph}");
    }
}

#[test]
fn every_instruction_set_and_number_of_threads_gives_the_same_bits_from_every_side() {
    let mut golden = Vec::new();
    // At 32767, four slices fill the 32-bit sums.
    for largest in [2000, 31_767] {
        let (grid, hu) = volume(largest);
        let view = VolumeView::new(grid, &hu).unwrap();
        for (n, pose) in unordinary().enumerate() {
            let c_arm = pose.c_arm(60);
            for reduction in [1, 3] {
                let options = SliceOrderedOptions { reduction, ..SliceOrderedOptions::default() };
                let threads = if n % 4 == 0 { &[1, 2, 4][..] } else { &[2] };
                golden.push(same_hash(&view, options, &c_arm, threads));
            }
        }
    }
    let all: Vec<u8> = golden.iter().flat_map(|h| h.to_le_bytes()).collect();
    // Changes only with the algorithm; update it only with a stated reason.
    assert_eq!(xxh3_64(&all), GOLDEN, "{:#018x}", xxh3_64(&all));
}

const GOLDEN: u64 = 0x7bf5_387e_3c8e_8993;

#[test]
fn removals_from_every_side_equal_full_renders_bit_for_bit() {
    for (grid, hu) in [volume(2500), volume_in_air(2500)] {
        let view = VolumeView::new(grid, &hu).unwrap();
        let mut changed = 0;
        for (reduction, pose) in unordinary().enumerate().map(|(n, pose)| (1 + n as u32 % 2, pose)) {
            let c_arm = pose.c_arm(60);
            let options = SliceOrderedOptions { reduction, ..SliceOrderedOptions::default() };
            changed += assert_removals_equal_full_renders(&view, &grid, &c_arm, options, &[1, 100, 10_000]);
        }
        assert!(changed >= unordinary().count(), "the cached sums were hardly used");
    }
}

/// Errors of Joseph's method and of the sums at a pose about a coarse thigh, and the number of images; `None`
/// if the source is inside it.
fn errors_at(degrees: (f64, f64), source_m: f64, beyond_m: f64, field_m: f64) -> Option<(usize, [f64; 2])> {
    static WHOLE: LazyLock<Thigh> = LazyLock::new(|| Thigh::new([45, 38, 86], [2e-3; 3]));
    let thigh = &*WHOLE;
    let c_arm = pose(degrees, source_m, source_m + beyond_m, field_m).c_arm(64);
    // Where one image serves all rays, the slice nearest to the source is missing: nothing must attenuate
    // there. A slice is 2 mm thick, rays cross it obliquely, and surface voxels protrude from the skin: 4 mm.
    let [x, y, z] = std::array::from_fn(|a| c_arm.source_m[a] / (thigh.shapes[0].semi_axes_m[a] + 4e-3));
    if x * x + y * y + z * z <= 1.0 {
        return None;
    }
    let (images, [joseph, sums, _]) = thigh.errors(&c_arm, SliceOrderedOptions::default());
    Some((images, [joseph, sums]))
}

/// Two samplings of an edge differ by chance at a single pose (next test), but not over many: the same 500
/// poses every time.
#[test]
fn many_poses_have_together_the_error_of_joseph() {
    let (mut count, mut joseph2, mut sums2) = (0, 0.0, 0.0);
    for n in 1..=500 {
        // Roberts' sequence in five dimensions covers the ranges evenly: powers of 1/g, with g^6 = g + 1.
        let between = |low: f64, high: f64, axis: i32| {
            low + (high - low) * (f64::from(n) * 1.134_724_138_401_519_5_f64.powi(-axis)).fract()
        };
        let degrees = (between(-180.0, 180.0, 1), between(-90.0, 90.0, 2));
        let (source_m, beyond_m) = (between(0.05, 0.7, 3), between(0.001, 0.3, 4));
        if let Some((_, [joseph, sums])) = errors_at(degrees, source_m, beyond_m, between(0.05, 0.4, 5)) {
            (joseph2, sums2, count) = (joseph2 + joseph * joseph, sums2 + sums * sums, count + 1);
        }
    }
    let ratio = (sums2 / joseph2).sqrt();
    println!("rms error of {count} poses over Joseph's: {ratio:.4}");
    assert!(ratio < 1.0, "{ratio}");
}

proptest! {
    #![proptest_config(ProptestConfig::with_cases(64))]

    #[test]
    fn any_pose_has_the_error_of_joseph(
        primary in -180.0..180.0_f64, secondary in -90.0..90.0_f64,
        source_m in 0.05..0.7_f64, beyond_m in 0.001..0.3_f64, field_m in 0.05..0.4_f64,
    ) {
        let found = errors_at((primary, secondary), source_m, beyond_m, field_m);
        prop_assume!(found.is_some());
        let (images, [joseph, sums]) = found.unwrap();
        // Two samplings of an edge differ by chance: 24 of 12 000 poses had more than 1.08 times Joseph's
        // error, the worst 1.29.
        prop_assert!(sums < 1.5 * joseph, "{images} images: {sums} {joseph}");
    }
}
