//! C-arms as cameras and as positioner angles: round trips, refusals, and OpenCV's own projection.

use proptest::prelude::*;
use xray::{CArm, Camera, DetectorFormat, PixelCentre, PositionerAngles};

const ISOCENTRE_M: [f64; 3] = [0.02, -0.01, 0.03];

fn arm(primary_deg: f64, secondary_deg: f64) -> CArm {
    let format = DetectorFormat { columns: 512, rows: 400, pixel_pitch_m: [0.6e-3, 0.55e-3] };
    let angles = PositionerAngles::from_degrees(primary_deg, secondary_deg);
    CArm::from_positioner_angles(ISOCENTRE_M, angles, 0.7, 1.02, format).unwrap()
}

/// A detector shifted and tilted against the central ray, with the image seen from the source.
fn general() -> CArm {
    let (s, c) = 0.2_f64.sin_cos();
    CArm {
        source_m: [0.1, 0.6, -0.2],
        detector_centre_m: [0.03, -0.4, 0.05],
        row_axis: [-c, 0.0, -s],
        column_axis: [s, 0.0, -c],
        pixel_pitch_m: [0.3e-3, 0.4e-3],
        columns: 300,
        rows: 200,
    }
}

fn points() -> Vec<[f64; 3]> {
    (0..60).map(|i: i32| [37, 53, 71].map(|k| f64::from((i * k) % 59 - 29) * 2.5e-3)).collect()
}

/// `s (u, v, 1) = K (R x + t)` by hand.
fn project(camera: &Camera, x: &[f64; 3]) -> [f64; 2] {
    let dot = |row: &[f64; 3], v: &[f64; 3]| row[0] * v[0] + row[1] * v[1] + row[2] * v[2];
    let c: [f64; 3] = std::array::from_fn(|i| dot(&camera.rotation[i], x) + camera.translation_m[i]);
    let p = camera.intrinsics.map(|row| dot(&row, &c));
    [p[0] / p[2], p[1] / p[2]]
}

#[test]
fn a_camera_sees_points_where_the_c_arm_sees_them() {
    for c_arm in [arm(0.0, 0.0), arm(37.0, 18.0), arm(-120.0, -40.0), general()] {
        for (centre, shift) in [(PixelCentre::Whole, 0.0), (PixelCentre::Half, 0.5)] {
            let camera = c_arm.camera(centre);
            let pitch_m = c_arm.pixel_pitch_m[0];
            let back = CArm::from_camera(&camera, centre, pitch_m, c_arm.columns, c_arm.rows).unwrap();
            for x in points() {
                let (want, again) = (c_arm.project(x).unwrap(), back.project(x).unwrap());
                let got = project(&camera, &x);
                for (a, b) in [(got[0] - shift, want.column), (got[1] - shift, want.row)] {
                    assert!((a - b).abs() < 1e-9, "{a} {b}");
                }
                assert!((again.column - want.column).abs() < 1e-9 && (again.row - want.row).abs() < 1e-9);
            }
            let near = |a: [f64; 3], b: [f64; 3]| a.iter().zip(&b).all(|(a, b)| (a - b).abs() < 1e-12);
            assert!(near(back.source_m, c_arm.source_m) && near(back.row_axis, c_arm.row_axis));
            assert!(near(back.detector_centre_m, c_arm.detector_centre_m));
        }
    }
}

#[test]
fn a_deepdrr_camera_with_negative_focal_length_and_half_pixels() {
    // Source 0.8 m behind the world's origin on the posterior side, detector 0.4 m in front of it, 100 x 80
    // pixels of 2 mm; the patient's left on the right. fx = -1.2/0.002; the image centre is at (50, 40) where
    // pixel centres are at halves.
    let camera = Camera {
        intrinsics: [[-600.0, 0.0, 50.0], [0.0, 600.0, 40.0], [0.0, 0.0, 1.0]],
        rotation: [[-1.0, 0.0, 0.0], [0.0, 0.0, -1.0], [0.0, -1.0, 0.0]],
        translation_m: [0.0, 0.0, 0.8],
    };
    let c_arm = CArm::from_camera(&camera, PixelCentre::Half, 2e-3, 100, 80).unwrap();
    assert_eq!((c_arm.row_axis, c_arm.column_axis), ([1.0, 0.0, 0.0], [0.0, 0.0, -1.0]));
    let angles = PositionerAngles::AP;
    let format = DetectorFormat { columns: 100, rows: 80, pixel_pitch_m: [2e-3; 2] };
    let same = CArm::from_positioner_angles([0.0; 3], angles, 0.8, 1.2, format).unwrap();
    for x in points() {
        let (a, b) = (c_arm.project(x).unwrap(), same.project(x).unwrap());
        assert!((a.column - b.column).abs() < 1e-9 && (a.row - b.row).abs() < 1e-9);
    }
}

/// Regression: a rotation with five decimals, as text files have, was refused.
#[test]
fn a_rotation_of_five_decimals_is_made_orthonormal() {
    for angles in [[10.0, 5.0], [-33.0, 21.0], [77.0, -8.0]] {
        let exact = arm(angles[0], angles[1]).camera(PixelCentre::Whole);
        let mut rounded = exact;
        rounded.rotation = exact.rotation.map(|row| row.map(|x| (x * 1e5).round() / 1e5));
        let of = |camera| CArm::from_camera(camera, PixelCentre::Whole, 6e-4, 512, 400).unwrap();
        let (exact, rounded) = (of(&exact), of(&rounded));
        for x in points() {
            let (a, b) = (exact.project(x).unwrap(), rounded.project(x).unwrap());
            assert!((a.column - b.column).abs() < 0.1 && (a.row - b.row).abs() < 0.1);
        }
    }
}

#[test]
fn what_is_no_camera_is_refused_by_name() {
    let good = arm(10.0, 5.0).camera(PixelCentre::Whole);
    let refused = |change: &dyn Fn(&mut Camera)| {
        let mut camera = good;
        change(&mut camera);
        CArm::from_camera(&camera, PixelCentre::Whole, 6e-4, 512, 400).unwrap_err().to_string()
    };
    assert!(refused(&|c| c.intrinsics[0][1] = 0.1).contains("skew"));
    assert!(refused(&|c| c.intrinsics[0][0] = 0.0).contains("fx"));
    assert!(refused(&|c| c.intrinsics[1][1] = f64::NAN).contains("fy"));
    assert!(refused(&|c| c.intrinsics[2][2] = 2.0).contains("K[2]"));
    assert!(refused(&|c| c.rotation[0] = [1.0, 1.0, 0.0]).contains("rows of the rotation"));
    assert!(refused(&|c| c.rotation[0] = c.rotation[0].map(|x| -x)).contains("determinant"));
    assert!(refused(&|c| c.translation_m[1] = f64::INFINITY).contains("translation_m"));
    for (pitch, columns, name) in
        [(0.0, 512, "pixel_pitch_m"), (f64::NAN, 512, "pixel_pitch_m"), (6e-4, 0, "columns")]
    {
        let error = CArm::from_camera(&good, PixelCentre::Whole, pitch, columns, 400).unwrap_err();
        assert!(error.to_string().contains(name), "{error}");
    }
}

proptest! {
    #[test]
    fn positioner_angles_come_back(primary in -179.0..179.0_f64, secondary in -89.0..89.0_f64) {
        let got = arm(primary, secondary).positioner(ISOCENTRE_M);
        prop_assert!((got.primary_rad - primary.to_radians()).abs() < 1e-9);
        prop_assert!((got.secondary_rad - secondary.to_radians()).abs() < 1e-9);
        prop_assert!((got.source_detector_m - 1.02).abs() < 1e-12);
        prop_assert!((got.source_isocentre_m - 0.7).abs() < 1e-12);
    }
}

const PACKAGES: [&str; 2] = ["numpy==2.2.6", "opencv-python-headless==4.12.0.88"];

/// OpenCV projects points with K, R and t; this C-arm must agree within 1e-6 pixel.
#[test]
fn opencv_projects_points_to_the_same_pixels() {
    for c_arm in [arm(0.0, 0.0), arm(37.0, 18.0), arm(-100.0, -30.0), general()] {
        let camera = c_arm.camera(PixelCentre::Whole);
        let list = |v: &[f64]| format!("{v:?}");
        let rows = |m: &[[f64; 3]]| format!("[{}]", m.iter().map(|r| list(r)).collect::<Vec<_>>().join(","));
        let script = format!(
            "import cv2, numpy as np\n\
             K, R = np.array({}), np.array({})\n\
             p, _ = cv2.projectPoints(np.array({}), cv2.Rodrigues(R)[0], np.array({}), K, None)\n\
             [print(repr(float(u)), repr(float(v))) for u, v in p.reshape(-1, 2)]",
            rows(&camera.intrinsics),
            rows(&camera.rotation),
            rows(&points()),
            list(&camera.translation_m),
        );
        let Some(text) = crate::run_python("opencv-4.12.0.88", &PACKAGES, "cv2", &script) else { return };
        let mut worst = 0.0_f64;
        for (line, x) in text.lines().zip(points()) {
            let uv: Vec<f64> = line.split(' ').map(|n| n.parse().unwrap()).collect();
            let seen = c_arm.project(x).unwrap();
            worst = worst.max((uv[0] - seen.column).abs()).max((uv[1] - seen.row).abs());
        }
        assert_eq!(text.lines().count(), points().len());
        println!("OpenCV: worst difference {worst:.1e} pixel");
        assert!(worst < 1e-6, "{worst}");
    }
}
