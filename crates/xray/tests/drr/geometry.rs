//! C-arm and grid against hand-worked bead positions.

use messages::Volume;
use proptest::prelude::*;
use voxel_grid::GridError;
use xray::message::volume_view;
use xray::{CArm, DetectorFormat, DrrError, Grid, PositionerAngles};
use zerocopy::IntoBytes;

const FORMAT: DetectorFormat = DetectorFormat { columns: 101, rows: 81, pixel_pitch_m: [1e-3; 2] };

fn arm(primary_deg: f64, secondary_deg: f64) -> CArm {
    let angles = PositionerAngles::from_degrees(primary_deg, secondary_deg);
    CArm::from_positioner_angles([0.1, 0.2, 0.3], angles, 0.7, 1.0, FORMAT).unwrap()
}

fn bead(c_arm: &CArm, from_isocentre_m: [f64; 3]) -> (f64, f64) {
    let p = c_arm
        .project([0.1 + from_isocentre_m[0], 0.2 + from_isocentre_m[1], 0.3 + from_isocentre_m[2]])
        .unwrap();
    // Millimetres from the centre pixel (50, 40), as the pitch is 1 mm.
    (p.column - 50.0, p.row - 40.0)
}

fn assert_near(got: (f64, f64), want: (f64, f64)) {
    assert!((got.0 - want.0).abs() < 1e-9 && (got.1 - want.1).abs() < 1e-9, "got {got:?}, want {want:?}");
}

#[test]
fn ap_view_shows_left_on_the_right_and_head_up_magnified_by_sdd_over_sod() {
    let c_arm = arm(0.0, 0.0);
    // Detector at the chest: y (posterior) smaller than the isocentre's, source behind the back.
    assert!((c_arm.detector_centre_m[1] - (0.2 - 0.3)).abs() < 1e-12);
    assert!((c_arm.source_m[1] - (0.2 + 0.7)).abs() < 1e-12);
    let magnification = 1.0 / 0.7;
    assert_near(bead(&c_arm, [0.0; 3]), (0.0, 0.0));
    assert_near(bead(&c_arm, [0.01, 0.0, 0.0]), (10.0 * magnification, 0.0));
    assert_near(bead(&c_arm, [0.0, 0.0, 0.01]), (0.0, -10.0 * magnification));
    // 10 cm posterior is 60 cm from the source.
    assert_near(bead(&c_arm, [0.01, 0.1, 0.0]), (10.0 / 0.6, 0.0));
}

#[test]
fn plus_90_is_a_view_from_the_patients_left_with_posterior_on_the_right() {
    let c_arm = arm(90.0, 0.0);
    assert!((c_arm.detector_centre_m[0] - (0.1 + 0.3)).abs() < 1e-12);
    assert_near(bead(&c_arm, [0.0, 0.01, 0.0]), (10.0 / 0.7, 0.0));
    assert_near(bead(&c_arm, [0.0, 0.0, 0.01]), (0.0, -10.0 / 0.7));
    // 10 cm to the left is 80 cm from the source.
    assert_near(bead(&c_arm, [0.1, 0.01, 0.0]), (10.0 / 0.8, 0.0));
}

#[test]
fn minus_90_is_a_view_from_the_patients_right_with_anterior_on_the_right() {
    let c_arm = arm(-90.0, 0.0);
    assert!((c_arm.detector_centre_m[0] - (0.1 - 0.3)).abs() < 1e-12);
    assert_near(bead(&c_arm, [0.0, -0.01, 0.0]), (10.0 / 0.7, 0.0));
}

#[test]
fn cranial_angulation_moves_the_detector_to_the_head_and_anterior_beads_down() {
    let c_arm = arm(0.0, 30.0);
    let (s, c) = (0.5, 0.75_f64.sqrt());
    assert!((c_arm.detector_centre_m[2] - (0.3 + 0.3 * s)).abs() < 1e-12);
    // A bead a in front (anterior): depth grows by a cos, down in the image by a sin.
    let a = 0.05;
    assert_near(bead(&c_arm, [0.0, -a, 0.0]), (0.0, 1e3 * a * s / (0.7 + a * c)));
    assert_near(bead(&arm(0.0, -30.0), [0.0, -a, 0.0]), (0.0, -1e3 * a * s / (0.7 + a * c)));
}

#[test]
fn errors_name_the_field_and_the_range() {
    let bad = |sid, sdd, format| {
        CArm::from_positioner_angles([0.0; 3], PositionerAngles::AP, sid, sdd, format)
            .unwrap_err()
            .to_string()
    };
    assert!(bad(0.7, 0.5, FORMAT).contains("source_detector_m is 0.5"));
    assert!(bad(f64::NAN, 1.0, FORMAT).contains("source_isocentre_m is NaN"));
    assert!(bad(0.7, 1.0, DetectorFormat { columns: 0, ..FORMAT }).contains("columns is 0"));
    assert!(
        bad(0.7, 1.0, DetectorFormat { pixel_pitch_m: [1e-3, -1.0], ..FORMAT }).contains("pixel_pitch_m")
    );
    let mut skewed = arm(0.0, 0.0);
    skewed.column_axis = [0.6, 0.0, -0.8];
    assert!(matches!(skewed.validate(), Err(DrrError::NotOrthonormal { .. })));
    skewed.column_axis = [f64::NAN; 3];
    assert!(skewed.validate().is_err());
}

#[test]
fn a_point_behind_the_source_is_not_seen() {
    assert!(arm(0.0, 0.0).project([0.1, 1.0, 0.3]).is_none());
}

#[test]
fn voxels_lie_along_the_axes_of_their_grid() {
    // i runs to +y, j to +z, k to +x.
    let axes = [[0.0, 1.0, 0.0], [0.0, 0.0, 1.0], [1.0, 0.0, 0.0]];
    let grid = Grid::new([4, 5, 6], [1e-3, 2e-3, 3e-3], [0.1, 0.2, 0.3], axes).unwrap();
    let p = grid.index_to_world([1.0, 2.0, 3.0]);
    assert!((p[0] - 0.109).abs() < 1e-15 && (p[1] - 0.201).abs() < 1e-15 && (p[2] - 0.304).abs() < 1e-15);
    assert_eq!(grid.linear_of([1, 2, 3]), Some(1 + 4 * (2 + 5 * 3)));
    assert_eq!(grid.voxel_of(69), [1, 2, 3]);
    assert_eq!(grid.linear_of([4, 0, 0]), None);
}

/// Regression: the process read the message's axes as rows, so a run showed an oblique CT rotated the wrong
/// way; physics and `trabecula drr` were right.
#[test]
fn the_process_sees_an_oblique_ct_where_its_message_says_it_is() {
    // i runs to +y, j to +z, k to +x.
    let direction = [0.0, 1.0, 0.0, 0.0, 0.0, 1.0, 1.0, 0.0, 0.0];
    let message = Volume {
        sha256: [0; 32],
        origin_m: [0.1, 0.2, 0.3],
        spacing_m: [1e-3, 2e-3, 3e-3],
        direction,
        dimensions: [4, 5, 6],
        hu_length: 120,
    };
    let hu = [0_i16; 120];
    let view = volume_view(&message, hu.as_bytes()).unwrap();
    let p = view.grid().index_to_world([1.0, 2.0, 3.0]);
    assert!(
        (p[0] - 0.109).abs() < 1e-15 && (p[1] - 0.201).abs() < 1e-15 && (p[2] - 0.304).abs() < 1e-15,
        "{p:?}"
    );
    let sheared = Volume { direction: [1.0, 0.0, 0.0, 0.01, 1.0, 0.0, 0.0, 0.0, 1.0], ..message };
    assert!(volume_view(&sheared, hu.as_bytes()).unwrap_err().to_string().contains("resample"));
}

#[test]
fn sheared_and_empty_grids_are_refused() {
    let shear = [[1.0, 0.0, 0.0], [0.1, 0.995, 0.0], [0.0, 0.0, 1.0]];
    assert!(matches!(
        Grid::new([4; 3], [1e-3; 3], [0.0; 3], shear),
        Err(DrrError::Grid(GridError::Sheared { .. }))
    ));
    let error = Grid::axis_aligned([4, 0, 4], [1e-3; 3], [0.0; 3]).unwrap_err().to_string();
    assert!(error.contains("[4, 0, 4] voxels; expected 1 to 65536"), "{error}");
    assert!(Grid::axis_aligned([65536, 65536, 2], [1e-3; 3], [0.0; 3]).is_err());
}

proptest! {
    #[test]
    fn projecting_a_detector_point_returns_its_pixel(
        primary in -180.0..180.0_f64, secondary in -89.0..89.0_f64,
        column in -20.0..120.0_f64, row in -20.0..100.0_f64, share in 0.05..1.0_f64,
    ) {
        let c_arm = arm(primary, secondary);
        let pixel = c_arm.pixel_m(column, row);
        // Any point on the ray projects to the same pixel.
        let point = std::array::from_fn(|a| c_arm.source_m[a] + share * (pixel[a] - c_arm.source_m[a]));
        let seen = c_arm.project(point).unwrap();
        prop_assert!((seen.column - column).abs() < 1e-9 && (seen.row - row).abs() < 1e-9);
        prop_assert!((seen.depth_m - share).abs() < 1e-12);
    }

    #[test]
    fn world_and_index_coordinates_are_inverse(
        angle in 0.0..6.0_f64, x in -50.0..50.0_f64, y in -50.0..50.0_f64, z in -50.0..50.0_f64,
    ) {
        let (s, c) = angle.sin_cos();
        // A left-handed, rotated grid with three different spacings.
        let axes = [[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, -1.0]];
        let grid = Grid::new([10, 20, 30], [0.5e-3, 0.7e-3, 1.1e-3], [0.1, -0.2, 0.3], axes).unwrap();
        let back = grid.world_to_index(grid.index_to_world([x, y, z]));
        prop_assert!((back[0] - x).abs() + (back[1] - y).abs() + (back[2] - z).abs() < 1e-10);
    }
}
