//! A batch of frames equals the frames rendered one by one, bit for bit; a refused batch changes nothing.

use xray::{
    CArm, DrrError, DrrParameters, DrrRenderer, FrameReport, FrameSeed, Grid, Material, Output, Projector,
    RenderKind, Shot, Spectrum, Tool, ToolPart, VolumeView,
};

use crate::frames::{batch, close_up, tool, volume};
use crate::machine::{Desk, Small};

/// Frontal, oblique, lateral, along an edge and from above; then with parts of the volume behind the
/// detector, and from inside the volume.
fn c_arms() -> Vec<CArm> {
    let angles = [(0.0, 0.0), (37.0, 18.0), (90.0, 5.0), (46.0, -44.0), (5.0, 85.0)];
    let mut all: Vec<CArm> =
        angles.into_iter().map(|(primary, secondary)| close_up(primary, secondary)).collect();
    for (n, towards) in [0.85, 0.7, 1.0].into_iter().enumerate() {
        let mut c_arm = close_up(30.0 * n as f64, -20.0);
        let source_m = c_arm.source_m;
        let detector_m = c_arm.detector_centre_m;
        let between = |a: f64, b: f64, share: f64| a + share * (b - a);
        c_arm.detector_centre_m = [0, 1, 2].map(|a| between(source_m[a], detector_m[a], towards));
        if n == 2 {
            // The source in the middle of the volume, where the isocentre is.
            c_arm.source_m = [0, 1, 2].map(|a| between(source_m[a], detector_m[a], 0.75));
        }
        all.push(c_arm);
    }
    all
}

/// Inputs of the frames: C-arm, tool, seed.
fn frames() -> Vec<(CArm, Tool, FrameSeed)> {
    let numbered = c_arms().into_iter().zip(0_u64..);
    numbered.map(|(c_arm, n)| (c_arm, tool(3 * n), FrameSeed { seed: 7, frame: n / 2 })).collect()
}

type Made = Vec<(Vec<u16>, FrameReport)>;

fn at_once(renderer: &mut DrrRenderer, view: &VolumeView<'_>, frames: &[(CArm, Tool, FrameSeed)]) -> Made {
    let mut images: Vec<Vec<u16>> = frames.iter().map(|(c_arm, ..)| vec![9; c_arm.pixels()]).collect();
    let mut shots: Vec<Shot<'_>> = frames
        .iter()
        .zip(&mut images)
        .map(|((c_arm, tool, seed), image)| Shot {
            c_arm: *c_arm,
            tool,
            seed: *seed,
            output: Output::Mono16(image),
        })
        .collect();
    let reports = renderer.render_batch(view, &mut shots).unwrap();
    images.into_iter().zip(reports).collect()
}

fn one_by_one(renderer: &mut DrrRenderer, view: &VolumeView<'_>, frames: &[(CArm, Tool, FrameSeed)]) -> Made {
    let one = |(c_arm, tool, seed): &(CArm, Tool, FrameSeed)| {
        let mut image = vec![9; c_arm.pixels()];
        let report = renderer.render(view, c_arm, tool, *seed, &mut image).unwrap();
        (image, report)
    };
    frames.iter().map(one).collect()
}

fn assert_same(got: &Made, want: &Made, what: &str) {
    assert_eq!(got.len(), want.len());
    for (n, (got, want)) in got.iter().zip(want).enumerate() {
        assert!(got.0 == want.0, "{what}: the pixels of frame {n} differ");
        assert!(got.1 == want.1, "{what}: frame {n}: {:?}, alone {:?}", got.1, want.1);
    }
}

fn all_parameters() -> Vec<DrrParameters> {
    let projectors = [Projector::SLICE_ORDERED, Projector::PREVIEW, Projector::Joseph, Projector::Siddon];
    let mut all: Vec<DrrParameters> =
        projectors.map(|projector| DrrParameters { projector, ..DrrParameters::default() }).to_vec();
    all.push(DrrParameters { spectrum: Some(Spectrum::default()), ..DrrParameters::default() });
    all
}

#[test]
fn frames_of_a_batch_have_the_bits_of_frames_alone_on_any_number_of_threads() {
    let (grid, hu) = volume();
    let view = VolumeView::new(grid, &hu).unwrap();
    let frames = frames();
    let backwards: Vec<_> = frames.iter().rev().cloned().collect();
    for parameters in all_parameters() {
        let gone = batch(&grid, 5000, 300);
        let mut alone = DrrRenderer::new(&view, DrrParameters { threads: 1, ..parameters }, &Desk).unwrap();
        alone.remove(&view, &gone).unwrap();
        let want = one_by_one(&mut alone, &view, &frames);
        for threads in [1, 2, 4] {
            let mut renderer =
                DrrRenderer::new(&view, DrrParameters { threads, ..parameters }, &Desk).unwrap();
            renderer.remove(&view, &gone).unwrap();
            let what = format!("{:?}, {threads} threads", parameters.projector);
            assert_same(&at_once(&mut renderer, &view, &frames), &want, &what);
            // Reuses the memory of earlier frames of other sizes, in another order.
            let mut again = at_once(&mut renderer, &view, &backwards);
            again.reverse();
            assert_same(&again, &want, &format!("{what}, again"));
        }
    }
}

#[test]
fn a_batch_keeps_the_picture_of_the_stationary_c_arm() {
    let (grid, hu) = volume();
    let view = VolumeView::new(grid, &hu).unwrap();
    let standing = [(close_up(12.0, 3.0), tool(1), FrameSeed::default())];
    for parameters in all_parameters() {
        let mut kept = DrrRenderer::new(&view, parameters, &Desk).unwrap();
        let mut gone = Vec::new();
        let before = one_by_one(&mut kept, &view, &standing);
        at_once(&mut kept, &view, &frames());
        let after = one_by_one(&mut kept, &view, &standing);
        assert_eq!(after[0].1.kind, RenderKind::Cached, "{:?}", parameters.projector);
        assert!(after[0].0 == before[0].0);
        for step in 0..4 {
            // Removed before the batch; the batch and the cached image after it must both show it.
            let new = batch(&grid, 1000 * step, 40);
            kept.remove(&view, &new).unwrap();
            gone.extend(new);
            let mut fresh = DrrRenderer::new(&view, parameters, &Desk).unwrap();
            fresh.remove(&view, &gone).unwrap();
            assert_same(
                &at_once(&mut kept, &view, &frames()),
                &one_by_one(&mut fresh, &view, &frames()),
                "after removals",
            );
            let pixels = |made: Made| made.into_iter().map(|(image, _)| image).collect::<Vec<_>>();
            assert!(
                pixels(one_by_one(&mut kept, &view, &standing))
                    == pixels(one_by_one(&mut fresh, &view, &standing)),
                "{:?}: the stationary C-arm's image after {step} batches",
                parameters.projector
            );
        }
    }
}

const BALL_OF_NOTHING: ToolPart =
    ToolPart::Sphere { centre_m: [0.0; 3], radius_m: -1e-3, material: Material::Steel316L };

/// A change that makes a valid batch invalid.
type Fault = fn(&mut CArm, &mut Tool, &mut Vec<u16>);

#[test]
fn a_batch_with_a_bad_frame_is_refused_by_its_number_before_anything_is_rendered() {
    let (grid, hu) = volume();
    let view = VolumeView::new(grid, &hu).unwrap();
    let mut renderer = DrrRenderer::new(&view, DrrParameters::default(), &Desk).unwrap();
    let standing = [(close_up(12.0, 3.0), tool(1), FrameSeed::default())];
    let before = one_by_one(&mut renderer, &view, &standing);
    let faults: [(Fault, &str); 4] = [
        (|c_arm, _, _| c_arm.source_m[1] = f64::NAN, "source_m is NaN"),
        (|c_arm, _, _| c_arm.columns = 0, "columns is 0"),
        (|_, _, image| image.truncate(7), "image has 7 elements"),
        (|_, tool, _| tool.parts[2] = BALL_OF_NOTHING, "tool part 2"),
    ];
    for (fault, words) in faults {
        let (mut c_arms, mut tools) = (c_arms(), vec![tool(1); c_arms().len()]);
        let mut images: Vec<Vec<u16>> = c_arms.iter().map(|c_arm| vec![9; c_arm.pixels()]).collect();
        fault(&mut c_arms[3], &mut tools[3], &mut images[3]);
        let mut shots: Vec<Shot<'_>> = c_arms
            .iter()
            .zip(&tools)
            .zip(&mut images)
            .map(|((c_arm, tool), image)| Shot {
                c_arm: *c_arm,
                tool,
                seed: FrameSeed::default(),
                output: Output::Mono16(image),
            })
            .collect();
        let refused = renderer.render_batch(&view, &mut shots).unwrap_err();
        assert!(matches!(refused, DrrError::Frame { frame: 3, .. }), "{refused:?}");
        let text = refused.to_string();
        assert!(text.contains("frame 3 of the batch") && text.contains(words), "{text}");
        assert!(images.iter().flatten().all(|grey| *grey == 9), "{words}: something was rendered");
        let after = one_by_one(&mut renderer, &view, &standing);
        assert!(after[0].1.kind == RenderKind::Cached && after[0].0 == before[0].0);
    }
}

#[test]
fn a_batch_of_nothing_is_nothing_and_one_in_another_grid_is_refused() {
    let (grid, hu) = volume();
    let view = VolumeView::new(grid, &hu).unwrap();
    let mut renderer = DrrRenderer::new(&view, DrrParameters::default(), &Desk).unwrap();
    assert_eq!(renderer.render_batch(&view, &mut []), Ok(Vec::new()));
    let other = Grid::centred([4, 4, 4], [1e-3; 3]).unwrap();
    let few = [0; 64];
    let elsewhere = VolumeView::new(other, &few).unwrap();
    assert_eq!(renderer.render_batch(&elsewhere, &mut []), Err(DrrError::GridChanged));
}

/// Memory for one thread's images fits, for four threads' it does not.
#[test]
fn a_batch_whose_images_the_memory_cannot_hold_is_refused_with_both_sizes() {
    static GIBIBYTE: Small = Small { free_bytes: Some(1 << 30), given_bytes: usize::MAX };
    let grid = Grid::centred([1500, 1500, 1], [1e-3; 3]).unwrap();
    let hu = vec![100; grid.voxels()];
    let view = VolumeView::new(grid, &hu).unwrap();
    let format = xray::DetectorFormat { columns: 64, rows: 64, pixel_pitch_m: [0.05; 2] };
    let from_below = xray::PositionerAngles::from_degrees(0.0, 90.0);
    let c_arm = CArm::from_positioner_angles([0.0; 3], from_below, 1.6, 1.7, format).unwrap();
    let projector = Projector::SliceOrdered { oversampling: 4.0, sharpen: true };
    let parameters = DrrParameters { projector, threads: 4, ..DrrParameters::default() };
    let mut renderer = DrrRenderer::new(&view, parameters, &GIBIBYTE).unwrap();
    let frames = [(c_arm, Tool::default(), FrameSeed::default())];
    one_by_one(&mut renderer, &view, &frames);
    let mut image = vec![0; c_arm.pixels()];
    let (tool, seed) = (Tool::default(), FrameSeed::default());
    let shot = Shot { c_arm, tool: &tool, seed, output: Output::Mono16(&mut image) };
    let refused = renderer.render_batch(&view, &mut [shot]).unwrap_err();
    let DrrError::Images { samples, needed_bytes, available_bytes } = refused else { panic!("{refused}") };
    assert_eq!((needed_bytes, available_bytes), (12 * samples as u64, 1 << 30));
}
