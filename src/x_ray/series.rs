//! Renders and writes the frames of many poses on all threads, one frame per thread.

use std::time::Instant;

use rayon::prelude::*;
use xray::{DrrRenderer, FrameSeed, Machine, Output, Shot, Tool, VolumeView, WindowLimits};

use super::files::Picture;
use super::poses::ResolvedPose;
use crate::failure::Failure;

/// Approximate limit of pixel bytes in memory.
const GROUP_BYTES: usize = 64 << 20;

/// How a picture is rendered.
#[derive(Debug, Clone, Copy)]
pub struct RenderStyle {
    /// Whether to output values before windowing and rounding instead of greys.
    pub as_values: bool,
    /// Whether greys are proportional to the detector's readout; otherwise to its logarithm.
    pub linear: bool,
    /// Whether more attenuation is darker; unused if linear.
    pub dense_is_dark: bool,
    /// Seed of the noise, the same for every frame.
    pub seed: u64,
}

impl RenderStyle {
    fn empty(&self, placed: &ResolvedPose) -> Picture {
        let pixels = placed.c_arm.pixels();
        let (greys, values) = if self.as_values { (0, pixels) } else { (pixels, 0) };
        Picture {
            placed: *placed,
            look: *self,
            window: WindowLimits { low: 0.0, high: 1.0 },
            greys: vec![0; greys],
            values: vec![0.0; values],
        }
    }
}

/// Renders a frame of each pose and writes it under its number, from 0. Returns the rendering time, s.
pub fn render_and_write(
    renderer: &mut DrrRenderer,
    view: &VolumeView<'_>,
    poses: &[ResolvedPose],
    look: RenderStyle,
    write: impl Fn(usize, Picture) -> Result<(), Failure> + Sync,
) -> Result<f64, Failure> {
    let threads = renderer.parameters().threads;
    let pool = drr_proc::ThisMachine.workers(threads).map_err(Failure::failed)?;
    let most = poses.iter().map(|placed| placed.c_arm.pixels()).max().unwrap_or(1);
    let at_a_time = (GROUP_BYTES / (most * if look.as_values { 4 } else { 2 })).max(threads);
    let mut seconds = 0.0;
    for (group, poses) in poses.chunks(at_a_time).enumerate() {
        let began = Instant::now();
        let pictures = render(renderer, view, poses, look)?;
        seconds += began.elapsed().as_secs_f64();
        let numbered = pictures.into_par_iter().enumerate();
        pool.install(|| numbered.try_for_each(|(n, picture)| write(group * at_a_time + n, picture)))?;
    }
    Ok(seconds)
}

fn render(
    renderer: &mut DrrRenderer,
    view: &VolumeView<'_>,
    poses: &[ResolvedPose],
    look: RenderStyle,
) -> Result<Vec<Picture>, Failure> {
    let mut pictures: Vec<Picture> = poses.iter().map(|placed| look.empty(placed)).collect();
    let (tool, seed) = (Tool::default(), FrameSeed { seed: look.seed, frame: 0 });
    let mut shots: Vec<Shot<'_>> = pictures
        .iter_mut()
        .map(|Picture { placed, greys, values, .. }| {
            let output = if look.as_values { Output::Float32(values) } else { Output::Mono16(greys) };
            Shot { c_arm: placed.c_arm, tool: &tool, seed, output }
        })
        .collect();
    let reports = renderer.render_batch(view, &mut shots).map_err(Failure::failed)?;
    drop(shots);
    for (picture, report) in pictures.iter_mut().zip(reports) {
        picture.window = report.window;
    }
    Ok(pictures)
}
