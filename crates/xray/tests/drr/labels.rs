//! Labels of a frame against closed forms and the renderer's own line integrals.

use std::sync::Arc;

use messages::Pose;
use xray::{
    CArm, Class, DrrError, DrrParameters, DrrRenderer, FrameSeed, Grid, Keypoint, LabelRequest, Labels,
    Material, PlacedSolids, Projector, Spectrum, Tool, ToolPart, Visibility, VolumeView,
};

use crate::machine::Desk;
use crate::poses::c_arm;
use crate::solids::cuboid;
use crate::tool::{turned_volume, whole_tool};

const BONE_FROM_HU: i16 = 300;

fn labelled(
    view: &VolumeView<'_>,
    removed: &[u32],
    c_arm: &CArm,
    tool: &Tool,
    points_m: &[[f64; 3]],
) -> Labels {
    let mut renderer = DrrRenderer::new(view, DrrParameters::default(), &Desk).unwrap();
    renderer.remove(view, removed).unwrap();
    let burr = tool.parts.len().saturating_sub(1);
    let request = LabelRequest { tool, burr, points_m, markers: &[], bone_from_hu: BONE_FROM_HU };
    renderer.labels(view, c_arm, &request).unwrap()
}

/// Anatomy and metal of the labels are computed separately, by a different loop than the frame's.
#[test]
fn anatomy_and_metal_make_the_attenuation_of_the_frame() {
    let (grid, hu, removed) = turned_volume();
    let view = VolumeView::new(grid, &hu).unwrap();
    let c_arm = c_arm(44.0, 35.0, 90, 0.09);
    let pose = Pose { position_m: [0.01, -0.02, 0.005], orientation_xyzw: [0.6, 0.0, 0.0, 0.8] };
    let solids = Arc::from(vec![cuboid([0.012, 0.007, 0.004])]);
    let arm = PlacedSolids::new(solids, &[pose], 1.3).unwrap();
    let cases = [None, Some(Spectrum::default())]
        .map(|spectrum| [None, Some(arm.clone())].map(|arm| (spectrum, arm)));
    for (spectrum, arm) in cases.into_iter().flatten() {
        let tool = Tool { arm, ..whole_tool() };
        let make = |projector, threads| {
            let parameters = DrrParameters { projector, spectrum, threads, ..DrrParameters::default() };
            let mut renderer = DrrRenderer::new(&view, parameters, &Desk).unwrap();
            renderer.remove(&view, &removed).unwrap();
            renderer
        };
        let mut renderer = make(Projector::Siddon, 2);
        let mut image = vec![0; c_arm.pixels()];
        renderer.render(&view, &c_arm, &tool, FrameSeed::default(), &mut image).unwrap();
        let request = LabelRequest {
            markers: &[],
            tool: &tool,
            burr: tool.parts.len() - 1,
            points_m: &[],
            bone_from_hu: BONE_FROM_HU,
        };
        let labels = renderer.labels(&view, &c_arm, &request).unwrap();
        let (mut with_metal, mut only_arm) = (0, 0);
        for (i, want) in renderer.line_integrals().into_iter().enumerate() {
            let got = f64::from(labels.anatomy[i]) + f64::from(labels.metal[i]);
            assert!(
                (got - want).abs() < 2e-6 * (1.0 + want),
                "{spectrum:?}, pixel {i}: {got}, expected {want}"
            );
            let is_metal = labels.mask[i] & (Class::Tool.bit() | Class::Burr.bit()) != 0;
            assert!(is_metal == (labels.metal[i] > 0.0) || tool.arm.is_some(), "pixel {i}");
            only_arm += usize::from(!is_metal && labels.metal[i] > 0.0);
            assert_eq!(is_metal, labels.tool_depth_m[i].is_finite(), "pixel {i}");
            assert_eq!(labels.bone_m[i] > 0.0, labels.bone_depth_m[i].is_finite(), "pixel {i}");
            with_metal += usize::from(is_metal);
        }
        assert!(with_metal > 300 && (only_arm > 300) == tool.arm.is_some(), "{with_metal}, {only_arm}");
        // Neither the number of threads nor the frame's projector changes a label.
        let other = make(Projector::default(), 1).labels(&view, &c_arm, &request).unwrap();
        assert_eq!(other.mask, labels.mask);
        let bits = |image: &[f32]| image.iter().map(|x| x.to_bits()).collect::<Vec<_>>();
        for (a, b) in [
            (&other.anatomy, &labels.anatomy),
            (&other.metal, &labels.metal),
            (&other.bone_m, &labels.bone_m),
            (&other.tunnel_m, &labels.tunnel_m),
            (&other.tool_depth_m, &labels.tool_depth_m),
            (&other.bone_depth_m, &labels.bone_depth_m),
        ] {
            assert_eq!(bits(a), bits(b));
        }
    }
}

/// A plate of bone 20 mm thick in soft tissue, a drilled layer of 6 mm in it, and a ball in front of it, all
/// seen along y.
#[test]
fn a_plate_with_a_tunnel_and_a_burr_by_hand() {
    let grid = Grid::centred([81, 81, 81], [1e-3; 3]).unwrap();
    let y_mm = |i: usize| grid.voxel_of(i)[1] as i64 - 40;
    let hu: Vec<i16> = (0..grid.voxels()).map(|i| if y_mm(i).abs() <= 10 { 1000 } else { 40 }).collect();
    // From -0.5 to 5.5 mm, and only on the left.
    let is_drilled = |i: &u32| {
        let i = *i as usize;
        (0..6).contains(&y_mm(i)) && grid.voxel_of(i)[0] < 40
    };
    let removed: Vec<u32> = (0..grid.voxels() as u32).filter(is_drilled).collect();
    let view = VolumeView::new(grid, &hu).unwrap();
    // AP: the source is behind, at y = +0.7 m, and rays run toward -y.
    let c_arm = c_arm(0.0, 0.0, 61, 0.061);
    let burr = ToolPart::Sphere { centre_m: [0.0, 0.03, 0.0], radius_m: 3e-3, material: Material::Steel316L };
    let labels = labelled(
        &view,
        &removed,
        &c_arm,
        &Tool { parts: vec![burr], ..Tool::default() },
        &[[0.0, 0.03, 0.0]],
    );
    let near = |got: f32, want: f64| assert!((f64::from(got) - want).abs() < 1e-6, "{got}, expected {want}");
    let middle = 30 * 61 + 30;
    near(labels.bone_m[middle], 0.021);
    near(labels.tunnel_m[middle], 0.0);
    near(labels.bone_depth_m[middle], 0.7 - 0.0105);
    near(labels.tool_depth_m[middle], 0.7 - 0.033);
    let mu = Material::Steel316L.mu_per_m(60.0).unwrap();
    assert!((f64::from(labels.metal[middle]) - 6e-3 * mu).abs() < 1e-5);
    assert_eq!(labels.mask[middle], Class::Bone.bit() | Class::Burr.bit());
    // The patient's right, x < 0, is on the left of an AP image. Its rays are longer by the secant of their
    // angle.
    let left = 30 * 61 + 10;
    let secant = (1.0_f64 + 0.02 * 0.02).sqrt();
    near(labels.bone_m[left], 0.015 * secant);
    near(labels.tunnel_m[left], 0.006 * secant);
    near(labels.bone_depth_m[left], 0.7 - 0.0105);
    assert_eq!(labels.mask[left], Class::Bone.bit() | Class::Tunnel.bit());
    let right = 30 * 61 + 50;
    assert_eq!(labels.mask[right], Class::Bone.bit());
    assert!(labels.tool_depth_m[right].is_nan());
    let [Keypoint { column, row, depth_m, visibility }] = labels.keypoints[..] else { panic!() };
    assert!((column - 30.0).abs() < 1e-9 && (row - 30.0).abs() < 1e-9 && (depth_m - 0.67).abs() < 1e-12);
    assert_eq!(visibility, Visibility::Alone);
}

/// A rod with joints every 10 mm and a burr, seen from the side and end-on.
#[test]
fn a_keypoint_is_overlapped_where_another_part_lies_on_its_ray() {
    let grid = Grid::centred([4, 4, 4], [1e-3; 3]).unwrap();
    let hu = vec![-1000; 64];
    let view = VolumeView::new(grid, &hu).unwrap();
    let points_m: Vec<[f64; 3]> = (0..6).map(|i| [f64::from(i) * 0.01 - 0.04, 0.0, 0.0]).collect();
    let mut parts: Vec<ToolPart> = points_m
        .windows(2)
        .map(|ends| ToolPart::tube(ends[0], ends[1], [3e-3, 2e-3], Material::Nitinol))
        .collect();
    parts.push(ToolPart::Sphere { centre_m: points_m[5], radius_m: 3.25e-3, material: Material::Steel316L });
    let tool = Tool { parts, ..Tool::default() };
    let seen = |primary_deg: f64| -> Vec<Visibility> {
        let labels = labelled(&view, &[], &c_arm(primary_deg, 0.0, 64, 0.064), &tool, &points_m);
        labels.keypoints.iter().map(|point| point.visibility).collect()
    };
    use Visibility::{Alone, Outside, Overlapped};
    // 64 mm on the detector are 45 mm at the isocentre: the base is 40 mm to the side.
    assert_eq!(seen(0.0), [Outside, Outside, Alone, Alone, Alone, Alone]);
    // Seen end-on, everything overlaps. The lumen is open, but each ray to a joint crosses the burr; the ray
    // to the burr runs in the lumen and crosses nothing else.
    assert_eq!(seen(90.0), [Overlapped, Overlapped, Overlapped, Overlapped, Overlapped, Alone]);
    // A point behind the source, and one behind the detector.
    let away = [[0.0, 2.0, 0.0], [0.0, -0.5, 0.0]];
    let labels = labelled(&view, &[], &c_arm(0.0, 0.0, 64, 0.064), &tool, &away);
    assert!(labels.keypoints.iter().all(|point| point.visibility == Outside), "{:?}", labels.keypoints);
    assert!(labels.keypoints[0].column.is_nan());
}

#[test]
fn labels_of_another_grid_or_an_impossible_tool_are_refused() {
    let grid = Grid::centred([4, 4, 4], [1e-3; 3]).unwrap();
    let hu = vec![0; 64];
    let view = VolumeView::new(grid, &hu).unwrap();
    let mut renderer = DrrRenderer::new(&view, DrrParameters::default(), &Desk).unwrap();
    let wide = ToolPart::Sphere { centre_m: [0.0; 3], radius_m: 2.0, material: Material::Steel316L };
    let tool = Tool { parts: vec![wide], ..Tool::default() };
    let request = LabelRequest { tool: &tool, burr: 0, points_m: &[], markers: &[], bone_from_hu: 0 };
    let c_arm = c_arm(0.0, 0.0, 8, 0.01);
    let refused = renderer.labels(&view, &c_arm, &request);
    assert!(matches!(refused, Err(DrrError::ToolPart { part: 0, .. })), "{refused:?}");
    let other = Grid::centred([4, 4, 4], [2e-3; 3]).unwrap();
    let other = VolumeView::new(other, &hu).unwrap();
    let tool = Tool::default();
    let request = LabelRequest { tool: &tool, ..request };
    assert_eq!(renderer.labels(&other, &c_arm, &request), Err(DrrError::GridChanged));
}

/// Air attenuates nothing, so its blocks are skipped, unless it counts as bone.
#[test]
fn air_is_bone_if_asked_for() {
    let grid = Grid::centred([40, 40, 40], [1e-3; 3]).unwrap();
    let hu = vec![-1000; grid.voxels()];
    let view = VolumeView::new(grid, &hu).unwrap();
    let mut renderer = DrrRenderer::new(&view, DrrParameters::default(), &Desk).unwrap();
    let c_arm = c_arm(0.0, 0.0, 9, 0.009);
    let tool = Tool::default();
    let mut length_m = |bone_from_hu| {
        let request = LabelRequest { tool: &tool, burr: 0, points_m: &[], markers: &[], bone_from_hu };
        renderer.labels(&view, &c_arm, &request).unwrap().bone_m[4 * 9 + 4]
    };
    assert!((length_m(-1000) - 0.04).abs() < 1e-9, "{}", length_m(-1000));
    assert_eq!(length_m(-999), 0.0);
}

/// The renderer keeps the walks through the voxels for the next frame of the C-arm: as many as there are
/// pixels took a second for a frame of which removed voxels change a few hundred.
#[test]
fn labels_do_not_depend_on_earlier_frames() {
    let (grid, hu, removed) = turned_volume();
    let view = VolumeView::new(grid, &hu).unwrap();
    let (c_arm, other) = (c_arm(44.0, 35.0, 90, 0.09), c_arm(10.0, 80.0, 64, 0.12));
    let tool = whole_tool();
    let request = |bone_from_hu| LabelRequest {
        tool: &tool,
        burr: tool.parts.len() - 1,
        points_m: &[],
        markers: &[],
        bone_from_hu,
    };
    let fresh = |gone: &[u32], c_arm: &CArm, bone_from_hu| {
        let mut renderer = DrrRenderer::new(&view, DrrParameters::default(), &Desk).unwrap();
        renderer.remove(&view, gone).unwrap();
        // Depths outside of bone are not numbers, which equal nothing.
        format!("{:?}", renderer.labels(&view, c_arm, &request(bone_from_hu)).unwrap())
    };
    let mut renderer = DrrRenderer::new(&view, DrrParameters::default(), &Desk).unwrap();
    let mut last = String::new();
    for part in 0..4 {
        let count = removed.len() * part / 3;
        renderer.remove(&view, &removed[..count]).unwrap();
        let frames = [
            (&c_arm, BONE_FROM_HU),
            (&c_arm, BONE_FROM_HU),
            (&c_arm, 100),
            (&other, 100),
            (&c_arm, BONE_FROM_HU),
        ];
        for (c_arm, bone_from_hu) in if part == 2 { &frames[..] } else { &frames[..2] } {
            let labels = format!("{:?}", renderer.labels(&view, c_arm, &request(*bone_from_hu)).unwrap());
            assert!(labels == fresh(&removed[..count], c_arm, *bone_from_hu), "part {part}");
            assert!(part == 0 || labels != last, "the removed voxels are not in the image");
        }
        last = format!("{:?}", renderer.labels(&view, &c_arm, &request(BONE_FROM_HU)).unwrap());
    }
    renderer.restore_all(&view).unwrap();
    let labels = format!("{:?}", renderer.labels(&view, &c_arm, &request(BONE_FROM_HU)).unwrap());
    assert!(labels == fresh(&[], &c_arm, BONE_FROM_HU), "all restored");
}
