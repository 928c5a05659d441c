//! C-arms built by ITK (SimpleITK): its Euler transforms, its images' pixel and direction conventions.

use xray::{CArm, DetectorFormat, PositionerAngles};

const PACKAGES: [&str; 1] = ["SimpleITK==2.5.7"];

/// ITK rotates a frontal C-arm about the isocentre (`Euler3DTransform` with a centre, z y x), represents the
/// detector as an image with origin, spacing and direction, and returns the continuous index at which the ray
/// to a point ends.
const SCRIPT: &str = "
import SimpleITK as sitk
def add(a, b, s=1.0): return [x + s * y for x, y in zip(a, b)]
def dot(a, b): return sum(x * y for x, y in zip(a, b))
turn = sitk.Euler3DTransform()
turn.SetCenter(isocentre)
turn.SetComputeZYX(True)
# Rz(primary) Rx(-secondary): the secondary angle first, about the patient's left-right axis.
turn.SetRotation(-secondary, 0.0, primary)
def turned(p): return list(turn.TransformPoint(p))
source = turned(add(isocentre, [0.0, source_isocentre, 0.0]))
back = source_detector - source_isocentre
half = [(columns - 1) / 2 * pitch[0], (rows - 1) / 2 * pitch[1]]
origin = turned(add(isocentre, [-half[0], -back, half[1]]))
row = list(turn.TransformVector([1.0, 0.0, 0.0], [0.0, 0.0, 0.0]))
column = list(turn.TransformVector([0.0, 0.0, -1.0], [0.0, 0.0, 0.0]))
normal = list(turn.TransformVector([0.0, 1.0, 0.0], [0.0, 0.0, 0.0]))
detector = sitk.Image([columns, rows, 1], sitk.sitkUInt8)
detector.SetOrigin(origin)
detector.SetSpacing([pitch[0], pitch[1], 1.0])
detector.SetDirection([v for triple in zip(row, column, normal) for v in triple])
for point in points:
    ray = add(point, source, -1.0)
    t = dot(add(origin, source, -1.0), normal) / dot(ray, normal)
    u, v, w = detector.TransformPhysicalPointToContinuousIndex(add(source, ray, t))
    print(repr(u), repr(v), repr(w))
";

#[test]
fn itk_sees_points_at_the_same_pixels() {
    let isocentre_mm = [20.0, -10.0, 30.0];
    let points_mm: Vec<[f64; 3]> =
        (0..60).map(|i: i32| [37, 53, 71].map(|k| f64::from((i * k) % 59 - 29) * 2.5)).collect();
    let mut worst = 0.0_f64;
    for (primary_deg, secondary_deg) in [(0.0, 0.0), (37.0, 18.0), (90.0, 5.0), (-120.0, -40.0)] {
        let format = DetectorFormat { columns: 512, rows: 400, pixel_pitch_m: [0.6e-3, 0.55e-3] };
        let angles = PositionerAngles::from_degrees(primary_deg, secondary_deg);
        let c_arm =
            CArm::from_positioner_angles(isocentre_mm.map(|x| x * 1e-3), angles, 0.7, 1.02, format).unwrap();
        let (primary, secondary): (f64, f64) = (primary_deg, secondary_deg);
        let script = format!(
            "isocentre, primary, secondary = {isocentre_mm:?}, {:?}, {:?}\n\
             source_isocentre, source_detector, pitch, columns, rows = 700.0, 1020.0, [0.6, 0.55], 512, 400\n\
             points = {points_mm:?}\n{SCRIPT}",
            primary.to_radians(),
            secondary.to_radians(),
        );
        let Some(text) = crate::run_python("simpleitk-2.5.7", &PACKAGES, "SimpleITK", &script) else {
            return;
        };
        assert_eq!(text.lines().count(), points_mm.len());
        for (line, point_mm) in text.lines().zip(&points_mm) {
            let index: Vec<f64> = line.split(' ').map(|n| n.parse().unwrap()).collect();
            let seen = c_arm.project(point_mm.map(|x| x * 1e-3)).unwrap();
            for (theirs, ours) in [(index[0], seen.column), (index[1], seen.row), (index[2], 0.0)] {
                worst = worst.max((theirs - ours).abs());
            }
        }
    }
    println!("ITK: worst difference {worst:.1e} pixel");
    assert!(worst < 1e-6, "{worst}");
}
