//! Times (ms) the stages after the anatomy of an X-ray frame: the tool, the exposure, the display window.

use drr_proc::ThisMachine;
use xray::{
    DetectorParameters, DisplayParameters, DrrParameters, DrrRenderer, FrameSeed, LabelRequest, Material,
    Projector, Tool, ToolPart, VolumeView, Window,
};

use super::drr::{Times, pose};
use serde_json::json;

use super::failed;
use crate::sheet::Sheet;
use trabecula::failure::Failure;

/// Number of links of the tool.
const LINKS: usize = 27;

/// How two links of the tool are joined.
#[derive(Clone, Copy)]
enum Ends {
    /// Perpendicular to each link's axis, with a gap outside the bend: cheapest to compute.
    Flat,
    /// In the plane that bisects the bend, as in the X-ray of a run.
    Mitred,
}

/// 27 hollow links of nitinol (6 / 5 mm) along an arc, a shaft (6 / 4 mm, 120 mm), and a burr of 3 mm radius.
fn tool(ends: Ends) -> Tool {
    let material = Material::Nitinol;
    let (outer_radius_m, step_rad) = (3e-3, 0.03);
    let on_arc = |n: usize| {
        let angle = n as f64 * step_rad;
        [0.07 * (1.0 - angle.cos()), -0.02, 0.07 * angle.sin() - 0.03]
    };
    // The chords on both sides of a joint are equal: the arc's tangent bisects their angle.
    let tangent = |n: usize| [(n as f64 * step_rad).sin(), 0.0, (n as f64 * step_rad).cos()];
    let link = |n: usize| {
        let normals = match ends {
            Ends::Flat => None,
            Ends::Mitred => Some([tangent(n), tangent(n + 1)]),
        };
        ToolPart::Tube {
            start_m: on_arc(n),
            end_m: on_arc(n + 1),
            normals,
            outer_radius_m,
            inner_radius_m: 2.5e-3,
            notch: None,
            material,
        }
    };
    let mut parts: Vec<ToolPart> = (0..LINKS).map(link).collect();
    let end_m = on_arc(0);
    let start_m = [end_m[0], end_m[1], end_m[2] - 0.12];
    parts.push(ToolPart::tube(start_m, end_m, [outer_radius_m, 2e-3], material));
    parts.push(ToolPart::Sphere { centre_m: on_arc(LINKS), radius_m: 3e-3, material: Material::Steel316L });
    Tool { parts, ..Tool::default() }
}

/// Renders frames from a stationary C-arm with cached anatomy: alone, with the tool, with noise, and with a
/// window computed from the image's own grey values.
pub(super) fn run(view: &VolumeView<'_>, rounds: usize, sheet: &mut Sheet) -> Result<(), Failure> {
    let c_arm = pose(37.0, 18.0, 512).map_err(failed)?;
    let (nothing, flat, mitred) = (Tool::default(), tool(Ends::Flat), tool(Ends::Mitred));
    let fixed = Window::Fixed { low: 0.0, high: 6.0 };
    let parameters = |noise: bool, window: Window| DrrParameters {
        detector: DetectorParameters {
            quantum_noise: noise,
            blur_sigma_px: 0.0,
            ..DetectorParameters::default()
        },
        display: DisplayParameters { window, ..DisplayParameters::default() },
        ..DrrParameters::default()
    };
    let cases = [
        ("exposure alone", &nothing, parameters(false, fixed)),
        ("exposure with a tool of 29 parts", &flat, parameters(false, fixed)),
        ("exposure with its links mitred", &mitred, parameters(false, fixed)),
        ("exposure with noise", &nothing, parameters(true, fixed)),
        ("exposure, window of the picture", &nothing, parameters(false, DisplayParameters::default().window)),
    ];
    let mut image = vec![0; c_arm.pixels()];
    let mut all = Vec::new();
    for (name, tool, parameters) in cases {
        let mut renderer = DrrRenderer::new(view, parameters, &ThisMachine).map_err(failed)?;
        let mut covered = 0;
        let mut times = Times::default();
        for frame in 0..=rounds.max(20) as u64 {
            let seed = FrameSeed { seed: 1, frame };
            let mut render = || renderer.render(view, &c_arm, tool, seed, &mut image);
            // The first frame computes the anatomy.
            let report = if frame == 0 { render() } else { times.add(render) };
            covered = report.map_err(failed)?.tool_pixels;
        }
        let text = format!("{}; {covered} tool pixels", times.text());
        sheet.line(&format!("{:<46} {text}", format!("{name}, ms (512, 2 threads)")));
        sheet.push("layers", json!({"what": name, "times": times.figures(), "tool_pixels": covered}));
        all.push(times.least());
    }
    if let [alone, flat, mitred, ..] = all.as_slice() {
        for (name, key, least) in [
            ("  of which the tool of 29 parts", "tool_ms", flat),
            ("  of which the tool with mitred links", "mitred_tool_ms", mitred),
        ] {
            let tool_ms = least - alone;
            sheet.row(name, &format!("{tool_ms:8.3}"), key, json!(tool_ms));
        }
    }
    labels(view, rounds.min(5), sheet)
}

/// Times labels of a frame against the frame by Siddon's method, which visits the same voxels; both on one
/// thread, alternating.
fn labels(view: &VolumeView<'_>, rounds: usize, sheet: &mut Sheet) -> Result<(), Failure> {
    let c_arm = pose(37.0, 18.0, 256).map_err(failed)?;
    let parameters = DrrParameters { projector: Projector::Siddon, threads: 1, ..DrrParameters::default() };
    let mut renderer = DrrRenderer::new(view, parameters, &ThisMachine).map_err(failed)?;
    let tool = tool(Ends::Mitred);
    let request = LabelRequest {
        tool: &tool,
        burr: tool.parts.len() - 1,
        points_m: &[],
        markers: &[],
        bone_from_hu: 300,
    };
    let mut image = vec![0; c_arm.pixels()];
    let (mut frames, mut labels) = (Times::default(), Times::default());
    for _ in 0..rounds {
        // Without its cache, so that the anatomy is computed.
        renderer.restore_all(view).map_err(failed)?;
        let frame = frames.add(|| renderer.render(view, &c_arm, &tool, FrameSeed::default(), &mut image));
        frame.map_err(failed)?;
        labels.add(|| renderer.labels(view, &c_arm, &request)).map_err(failed)?;
    }
    let ratio = labels.ratio_to(&frames);
    let text = format!("{}; {ratio:.3} of a frame by Siddon's method", labels.text());
    sheet.line(&format!("{:<46} {text}", "labels, ms (256, 1 thread)"));
    sheet.push("labels", json!({"times": labels.figures(), "siddon": frames.figures(), "ratio": ratio}));
    Ok(())
}
