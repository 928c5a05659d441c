//! Bad input never silently becomes a wrong image: it is refused by name, or rendered as given.

use xray::message::{c_arm_message, c_arm_of};
use xray::{
    CArm, DetectorParameters, DisplayParameters, DrrError, DrrParameters, DrrRenderer, FrameSeed, Grid,
    PositionerAngles, Projector, Tool, VolumeView, Window,
};

use voxel_grid::GridError;

use crate::machine::Desk;
use crate::poses::c_arm;

const DIMS: [usize; 3] = [24, 20, 22];
const PROJECTORS: [Projector; 4] =
    [Projector::Siddon, Projector::Joseph, Projector::SLICE_ORDERED, Projector::PREVIEW];

fn grid() -> Grid {
    Grid::centred(DIMS, [2e-3; 3]).unwrap()
}

fn renderer(view: &VolumeView<'_>, projector: Projector) -> DrrRenderer {
    let detector = DetectorParameters { quantum_noise: false, blur_sigma_px: 0.0, ..Default::default() };
    let display = DisplayParameters { window: Window::Fixed { low: 0.0, high: 6.0 }, ..Default::default() };
    DrrRenderer::new(view, DrrParameters { projector, detector, display, ..Default::default() }, &Desk)
        .unwrap()
}

fn frame(renderer: &mut DrrRenderer, view: &VolumeView<'_>, c_arm: &CArm) -> Result<Vec<u16>, DrrError> {
    let mut image = vec![0; c_arm.pixels()];
    renderer.render(view, c_arm, &Tool::default(), FrameSeed::default(), &mut image)?;
    Ok(image)
}

#[test]
fn a_spacing_of_zero_below_zero_infinite_or_nan_is_refused() {
    for bad in [0.0, -1e-3, f64::INFINITY, f64::NAN, 1e-9, 1.0] {
        for axis in 0..3 {
            let mut spacing_m = [1e-3; 3];
            spacing_m[axis] = bad;
            let error = Grid::axis_aligned(DIMS, spacing_m, [0.0; 3]).unwrap_err().to_string();
            assert!(
                error.contains(&format!("a voxel spacing of {spacing_m:?} m; expected 1e-6 to 0.1 m")),
                "{error}"
            );
        }
    }
    assert!(Grid::axis_aligned(DIMS, [1e-3; 3], [f64::NAN, 0.0, 0.0]).is_err());
    let nan = [[f64::NAN, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]];
    assert!(matches!(
        Grid::new(DIMS, [1e-3; 3], [0.0; 3], nan),
        Err(DrrError::Grid(GridError::Sheared { .. }))
    ));
}

#[test]
fn a_pose_with_a_nan_anywhere_is_refused_and_the_cache_survives() {
    let hu = vec![0; grid().voxels()];
    let view = VolumeView::new(grid(), &hu).unwrap();
    let good = c_arm(20.0, 10.0, 32, 0.1);
    let mut renderer = renderer(&view, Projector::SLICE_ORDERED);
    let before = frame(&mut renderer, &view, &good).unwrap();
    for bad in [f64::NAN, f64::INFINITY, f64::NEG_INFINITY] {
        for component in 0..14 {
            let mut c_arm = good;
            let axis = component % 3;
            match component / 3 {
                0 => c_arm.source_m[axis] = bad,
                1 => c_arm.detector_centre_m[axis] = bad,
                2 => c_arm.row_axis[axis] = bad,
                3 => c_arm.column_axis[axis] = bad,
                _ => c_arm.pixel_pitch_m[axis] = bad,
            }
            assert!(frame(&mut renderer, &view, &c_arm).is_err(), "component {component} of {c_arm:?}");
            // The same in a request message.
            assert!(c_arm_of(&c_arm_message(&c_arm)).is_err(), "component {component}");
        }
        let angles = PositionerAngles::from_degrees(bad, 0.0);
        let format = xray::DetectorFormat { columns: 32, rows: 32, pixel_pitch_m: good.pixel_pitch_m };
        assert!(CArm::from_positioner_angles([0.0; 3], angles, 0.7, 1.0, format).is_err());
    }
    assert_eq!(frame(&mut renderer, &view, &good).unwrap(), before);
}

#[test]
fn a_source_inside_bone_sees_the_bone_between_it_and_the_detector() {
    let hu = vec![1000; grid().voxels()];
    let view = VolumeView::new(grid(), &hu).unwrap();
    // From the middle of the volume to 10 cm in front of it; the central ray crosses half of the 40 mm along
    // y.
    let inside = CArm {
        source_m: [0.0, 0.0, 0.0],
        detector_centre_m: [0.0, -0.1, 0.0],
        row_axis: [1.0, 0.0, 0.0],
        column_axis: [0.0, 0.0, -1.0],
        pixel_pitch_m: [1e-3; 2],
        columns: 5,
        rows: 5,
    };
    let want = 2.0 * xray::Material::Water.mu_per_m(60.0).unwrap() * 0.02;
    for projector in PROJECTORS {
        let mut renderer = renderer(&view, projector);
        frame(&mut renderer, &view, &inside).unwrap();
        let got = renderer.anatomy()[12];
        // Sums over slices begin with a whole slice: 2 mm, or 4 mm for the preview's merged voxels.
        let slice = if projector == Projector::PREVIEW { 0.21 } else { 0.11 };
        assert!((got / want - 1.0).abs() < slice, "{projector:?}: {got}, half of the volume is {want}");
    }
}

#[test]
fn a_detector_of_no_size_is_refused() {
    let hu = vec![0; grid().voxels()];
    let view = VolumeView::new(grid(), &hu).unwrap();
    let mut renderer = renderer(&view, Projector::Joseph);
    let good = c_arm(0.0, 0.0, 32, 0.1);
    for (bad, name) in [
        (CArm { columns: 0, ..good }, "columns is 0"),
        (CArm { rows: 0, ..good }, "rows is 0"),
        (CArm { pixel_pitch_m: [0.0, 1e-3], ..good }, "pixel_pitch_m"),
        (CArm { pixel_pitch_m: [1e-3, -1e-3], ..good }, "pixel_pitch_m"),
        (CArm { columns: u32::MAX, ..good }, "columns"),
    ] {
        // The image is as empty as the detector.
        let error = renderer
            .render(&view, &bad, &Tool::default(), FrameSeed::default(), &mut [])
            .unwrap_err()
            .to_string();
        assert!(error.contains(name), "{error}");
    }
}

#[test]
fn a_volume_of_another_length_than_its_grid_is_refused() {
    let right = grid().voxels();
    for wrong in [0, right - 1, right + 1] {
        let hu = vec![0; wrong];
        let error = VolumeView::new(grid(), &hu).unwrap_err();
        assert_eq!(error, DrrError::Length { field: "hu", given: wrong, expected: right });
    }
}

#[test]
fn a_removal_outside_the_volume_is_refused_and_one_twice_counts_once() {
    let hu: Vec<i16> = (0..grid().voxels()).map(|i| (i % 700) as i16).collect();
    let view = VolumeView::new(grid(), &hu).unwrap();
    let pose = c_arm(30.0, 10.0, 48, 0.1);
    for projector in PROJECTORS {
        let mut renderer = renderer(&view, projector);
        let intact = frame(&mut renderer, &view, &pose).unwrap();
        let beyond = grid().voxels() as u32;
        for bad in [beyond, u32::MAX] {
            let error = renderer.remove(&view, &[bad]).unwrap_err();
            assert_eq!(error, DrrError::VoxelIndex { given: bad, position: 0, voxels: grid().voxels() });
        }
        assert_eq!(frame(&mut renderer, &view, &pose).unwrap(), intact);
        let some: Vec<u32> = (4000..4200).collect();
        assert_eq!(renderer.remove(&view, &some).unwrap(), 200);
        let once = frame(&mut renderer, &view, &pose).unwrap();
        assert!(once != intact);
        assert_eq!(renderer.remove(&view, &[&some[..], &some[..]].concat()).unwrap(), 0);
        assert_eq!(frame(&mut renderer, &view, &pose).unwrap(), once);
    }
}
