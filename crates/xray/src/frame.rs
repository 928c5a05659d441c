//! One frame: from the state, the removed voxels and the C-arm to the message bytes.

use std::sync::Arc;

use messages::{Frame, ImagePrefix, Restores, State};
use scene::{Holder, Notch as SceneNotch, ToolRadii};
use xxhash_rust::xxh3::xxh3_128;
use zerocopy::IntoBytes;

use crate::message::{c_arm_message, projection_message};
use crate::surroundings::Surroundings;
use crate::tool_model::{points_of, tool_of};
use crate::{
    CArm, DrrError, DrrRenderer, FrameReport, FrameSeed, LabelRequest, Labels, Output, RenderKind, Shot,
    Tool, VolumeView,
};

/// What happens to the cached anatomy image.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Cache {
    /// It is replaced by the image from this frame's C-arm.
    Follows,
    /// It stays that of the scene's C-arm; this frame's C-arm is used once.
    Kept,
}

/// Inputs of a frame.
#[derive(Debug, Clone)]
pub struct Job {
    /// State of the tick.
    pub state: Box<State>,
    /// Voxels to restore before removing `removed`.
    pub restores: Restores,
    /// Voxels removed since the last job.
    pub removed: Vec<u32>,
    /// `Frame.sequence`.
    pub sequence: u64,
    /// `DrrRequest.request_id`, or 0.
    pub request_id: u64,
    /// C-arm.
    pub c_arm: CArm,
    /// What happens to the cached anatomy.
    pub cache: Cache,
    /// The scene's isocentre.
    pub isocentre_m: [f64; 3],
    /// The scene's seed.
    pub noise_seed: u64,
    /// The tool's radii.
    pub radii: ToolRadii,
    /// The holder that joins the tool to the arm.
    pub holder: Holder,
    /// Notches of the links.
    pub notch: Option<SceneNotch>,
    /// The arm and the objects that frames show.
    pub around: Arc<Surroundings>,
}

/// A finished frame.
#[derive(Debug, Clone)]
pub struct RenderedFrame {
    /// The frame's metadata.
    pub frame: Frame,
    /// The image header.
    pub prefix: ImagePrefix,
    /// Pixels, row-major from top to bottom.
    pub pixels: Vec<u16>,
    /// How much was computed.
    pub report: FrameReport,
}

impl RenderedFrame {
    /// True if all of the anatomy was recomputed.
    pub fn is_full(&self) -> bool {
        self.report.kind == RenderKind::Full
    }

    /// The three parts of the message, in order.
    pub fn parts(&self) -> [&[u8]; 3] {
        [self.frame.as_bytes(), self.prefix.as_bytes(), self.pixels.as_bytes()]
    }
}

/// Renders one frame. The result depends only on this job and on the removals of the jobs before it.
///
/// # Errors
/// Any error of the renderer.
pub fn render_job(
    renderer: &mut DrrRenderer,
    view: &VolumeView<'_>,
    job: &Job,
) -> Result<RenderedFrame, DrrError> {
    take_removals(renderer, view, job)?;
    let tool = tool_and_surroundings(job);
    let seed = FrameSeed { seed: job.noise_seed, frame: job.state.tick };
    let mut pixels = vec![0_u16; job.c_arm.pixels()];
    let report = match job.cache {
        Cache::Kept => renderer.render_aside(view, &job.c_arm, &tool, seed, &mut pixels)?,
        Cache::Follows => renderer.render(view, &job.c_arm, &tool, seed, &mut pixels)?,
    };
    Ok(rendered(job, (job.sequence, &job.c_arm), pixels, report))
}

/// Renders a frame of the same state from each C-arm, numbered from `job.sequence` on; the job's own C-arm
/// and cache mode are ignored. Each frame is bit-identical to [`render_job`]'s, and rendering them together
/// is faster ([`DrrRenderer::render_batch`]).
///
/// # Errors
/// Any error of the renderer.
pub fn render_poses(
    renderer: &mut DrrRenderer,
    view: &VolumeView<'_>,
    job: &Job,
    c_arms: &[CArm],
) -> Result<Vec<RenderedFrame>, DrrError> {
    take_removals(renderer, view, job)?;
    let tool = tool_and_surroundings(job);
    let seed = FrameSeed { seed: job.noise_seed, frame: job.state.tick };
    let mut images: Vec<Vec<u16>> = c_arms.iter().map(|c_arm| vec![0; c_arm.pixels()]).collect();
    let shot = |(c_arm, image)| Shot { c_arm, tool: &tool, seed, output: Output::Mono16(image) };
    let mut shots: Vec<Shot<'_>> =
        c_arms.iter().copied().zip(images.iter_mut().map(|i| &mut i[..])).map(shot).collect();
    let reports = renderer.render_batch(view, &mut shots)?;
    drop(shots);
    let frames = images.into_iter().zip(reports).zip(c_arms).zip(job.sequence..);
    Ok(frames
        .map(|(((pixels, report), c_arm), number)| rendered(job, (number, c_arm), pixels, report))
        .collect())
}

/// Assembles the message.
fn rendered(
    job: &Job,
    (sequence, c_arm): (u64, &CArm),
    pixels: Vec<u16>,
    report: FrameReport,
) -> RenderedFrame {
    let hash = xxh3_128(pixels.as_bytes());
    let frame = Frame {
        sequence,
        request_id: job.request_id,
        tick: job.state.tick,
        removed_total: job.state.removed_total,
        sim_time_s: job.state.sim_time_s,
        pixel_hash: [hash as u64, (hash >> 64) as u64],
        noise_seed: job.noise_seed,
        t_world_burr: job.state.t_world_burr,
        geometry: c_arm_message(c_arm),
        projection: projection_message(c_arm, job.isocentre_m),
    };
    let prefix = ImagePrefix::mono16(c_arm.columns, c_arm.rows, job.state.sim_time_s);
    RenderedFrame { frame, prefix, pixels, report }
}

/// Computes the labels of a frame; voxels at or above `bone_from_hu` are bone. Can run before or after
/// [`render_job`] of the same job.
///
/// # Errors
/// Any error of the renderer.
pub fn label_job(
    renderer: &mut DrrRenderer,
    view: &VolumeView<'_>,
    job: &Job,
    bone_from_hu: i16,
) -> Result<Labels, DrrError> {
    take_removals(renderer, view, job)?;
    let tool = tool_and_surroundings(job);
    // The burr's parts are the tool's last ones.
    let burr = tool.parts.len().saturating_sub(job.radii.cutter.balls().len());
    let points_m = points_of(&job.state);
    let markers = job.around.markers_m(&job.state);
    let request = LabelRequest { tool: &tool, burr, points_m: &points_m, markers: &markers, bone_from_hu };
    renderer.labels(view, &job.c_arm, &request)
}

fn tool_and_surroundings(job: &Job) -> Tool {
    let mut tool = tool_of(&job.state, &job.radii, &job.holder, job.notch.as_ref());
    job.around.put_around(&job.state, &mut tool);
    tool
}

fn take_removals(renderer: &mut DrrRenderer, view: &VolumeView<'_>, job: &Job) -> Result<(), DrrError> {
    if job.restores == Restores::Drilled {
        renderer.restore_all(view)?;
    }
    renderer.remove(view, &job.removed).map(|_| ())
}
