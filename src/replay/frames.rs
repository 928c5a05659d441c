//! Re-renders the frames of a log.

use std::sync::Arc;

use drr_proc::{ThisMachine, arm_model};
use ipc_types::messages::{Frame, Restores, State, Tick, TickRange};
use recorder_proc::log_file::LogFile;
use run_log::diff::compare_frame;
use run_log::{FrameReader, FrameRecord, LogError, LogReader, Verdict, frames};
use xray::frame::{Cache, Job, label_job, render_job};
use xray::from_scene::{renderer_parameters, scene_isocentre_m};
use xray::message::c_arm_of;
use xray::surroundings::Surroundings;
use xray::{DrrRenderer, Labels, VolumeView};
use zerocopy::IntoBytes;

use super::OpenedLog;
use super::gone::gone_at;
use super::replies::Replies;
use crate::failure::Failure;

/// Re-renders the frames of a log with the same tick, C-arm and seed.
///
/// The inputs come from the log: the tick from the reply, the C-arm from the scene or the request, the seed
/// from the scene, and the state and removed voxels from that tick.
pub struct FrameReplay<'l> {
    log: &'l OpenedLog,
    view: VolumeView<'l>,
    renderer: DrrRenderer,
    recorded: FrameReader,
    ticks: LogReader,
    replies: Replies,
    predrilled: Vec<u32>,
    state: Box<State>,
    restores: Restores,
    removed: Vec<u32>,
    around: Arc<Surroundings>,
}

impl<'l> FrameReplay<'l> {
    /// Starts at the first frame; returns `None` if the scene has no X-ray.
    ///
    /// # Errors
    /// The renderer rejects the scene, an arm mesh shown in frames is missing or different, or the file
    /// cannot be opened.
    pub fn new(log: &'l OpenedLog, threads: usize) -> Result<Option<FrameReplay<'l>>, Failure> {
        let (Some(drr), Some(ct)) = (&log.scene.drr, &log.ct) else { return Ok(None) };
        let view = VolumeView::try_from(&ct.volume).map_err(Failure::failed)?;
        let parameters =
            xray::DrrParameters { threads, ..renderer_parameters(drr, log.scene.tolerance.as_ref()) };
        let arm = arm_model(&log.scene.arm).map_err(Failure::bad_input)?;
        let around = Surroundings::new(&log.scene, arm).map_err(Failure::bad_input)?;
        let ticks = log.reader()?;
        let (predrilled, removed) = match ticks.beginning() {
            None => (ticks.predrilled().to_vec(), ticks.predrilled().to_vec()),
            Some(keyframe) => gone_at(log, keyframe)?,
        };
        Ok(Some(FrameReplay {
            renderer: DrrRenderer::new(&view, parameters, &ThisMachine).map_err(Failure::failed)?,
            view,
            recorded: frames(&LogFile::at(&log.path), log.options())?,
            state: Box::new(*ticks.initial()),
            restores: Restores::Nothing,
            removed,
            predrilled,
            ticks,
            replies: Replies::open(log, drr)?,
            around: Arc::new(around),
            log,
        }))
    }

    /// Returns the next recorded frame, which the caller can skip without rendering.
    pub fn next_recorded(&mut self) -> Result<Option<FrameRecord>, Failure> {
        loop {
            match self.recorded.next().transpose() {
                // The log's verdict reports the missing frames.
                Err(LogError::Gap { .. }) if self.recorded.go_on() => {}
                other => return other.map_err(Failure::failed),
            }
        }
    }

    /// Re-renders a recorded frame; returns `None` if its tick is in a gap of the log.
    ///
    /// # Errors
    /// The reply disagrees with the frame or the request; the frame's tick is missing from the log; the
    /// renderer rejects the frame.
    pub fn render(&mut self, recorded: &Frame) -> Result<Option<FrameRecord>, Failure> {
        let Some(job) = self.job(recorded)? else { return Ok(None) };
        Ok(Some(self.render_job(&job)?))
    }

    /// Re-renders a recorded frame and labels its contents; voxels at or above `bone_from_hu` are bone.
    pub fn label(
        &mut self,
        recorded: &Frame,
        bone_from_hu: i16,
    ) -> Result<Option<(FrameRecord, Labels)>, Failure> {
        let Some(mut job) = self.job(recorded)? else { return Ok(None) };
        let rendered = self.render_job(&job)?;
        // The renderer now has the voxels of this frame.
        (job.restores, job.removed) = (Restores::Nothing, Vec::new());
        let labels = label_job(&mut self.renderer, &self.view, &job, bone_from_hu);
        Ok(Some((rendered, labels.map_err(of_frame(recorded.sequence, recorded.tick))?)))
    }

    /// Returns the log's verdict as far as its frames were read.
    pub fn verdict(&self) -> Verdict {
        self.recorded.verdict()
    }

    fn render_job(&mut self, job: &Job) -> Result<FrameRecord, Failure> {
        let rendered = render_job(&mut self.renderer, &self.view, job);
        let rendered = rendered.map_err(of_frame(job.sequence, job.state.tick))?;
        let pixels = rendered.pixels.as_bytes().to_vec();
        Ok(FrameRecord { frame: rendered.frame, image: Some(rendered.prefix), pixels })
    }

    /// Returns what to render for a frame, or `None` if its tick is in a gap.
    fn job(&mut self, recorded: &Frame) -> Result<Option<Job>, Failure> {
        let geometry = self.replies.geometry_of(recorded).map_err(|difference| {
            Failure::failed(format!("frame {}: {difference}{}", recorded.sequence, self.log.label()))
        })?;
        if !self.advance_to(recorded)? {
            return Ok(None);
        }
        Ok(Some(Job {
            state: self.state.clone(),
            restores: std::mem::take(&mut self.restores),
            removed: std::mem::take(&mut self.removed),
            sequence: recorded.sequence,
            request_id: recorded.request_id,
            c_arm: c_arm_of(&geometry).map_err(of_frame(recorded.sequence, recorded.tick))?,
            cache: Cache::Follows,
            isocentre_m: scene_isocentre_m(&self.log.scene),
            noise_seed: self.log.scene.run.seed,
            radii: self.log.scene.manipulator.radii(),
            holder: self.log.scene.arm.holder(),
            around: Arc::clone(&self.around),
            notch: self.log.scene.drr.as_ref().and_then(|drr| drr.notch),
        }))
    }

    /// Reads the log up to the state that the frame shows, collecting the voxels removed until then. Returns
    /// false if the state is in a gap.
    fn advance_to(&mut self, frame: &Frame) -> Result<bool, Failure> {
        while self.state.tick < frame.tick {
            let Some(record) = self.ticks.next() else { break };
            let record = match record {
                Err(LogError::Gap { .. }) => {
                    let Some(behind) = self.ticks.go_on().map_err(Failure::failed)? else { return Ok(false) };
                    (_, self.removed) = gone_at(self.log, &behind.keyframe)?;
                    (self.state, self.restores) = (behind.state, Restores::Drilled);
                    continue;
                }
                record => record.map_err(Failure::failed)?,
            };
            if record.latched.reset != 0 {
                self.restores = Restores::Drilled;
                self.removed.clone_from(&self.predrilled);
            }
            self.removed.extend_from_slice(&record.removed);
            *self.state = record.state;
        }
        // Frames are in tick order, so a skipped tick was in a gap.
        if self.state.tick >= frame.tick {
            return Ok(self.state.tick == frame.tick);
        }
        let (sequence, tick, at) = (frame.sequence, frame.tick, self.state.tick);
        Err(Failure::failed(format!(
            "frame {sequence} shows tick {tick}, but the log is already at tick {at}"
        )))
    }
}

/// Converts a render error of a frame.
fn of_frame(sequence: u64, tick: u64) -> impl Fn(xray::DrrError) -> Failure {
    move |cause| Failure::failed(format!("frame {sequence} of tick {tick}: {cause}"))
}

/// Result of a comparison in which all compared frames are identical.
#[derive(Debug, Clone, Copy, Default)]
pub struct ComparedFrames {
    /// Frames compared.
    pub identical: u64,
    /// Frames whose ticks are in a gap.
    pub in_gaps: u64,
    /// On-demand frames whose request is not in the timing lane.
    pub without_request: u64,
}

/// Re-renders the frames of these ticks and compares them with the recorded ones.
///
/// # Errors
/// The log has no such frames (2); the first frame that differs, or a log that cannot be read (1).
pub fn verify_frames(log: &OpenedLog, ticks: TickRange, threads: usize) -> Result<ComparedFrames, Failure> {
    let nothing = |what: &str| Failure::bad_input(format!("--frames: {}: {what}", log.path.display()));
    let Some(mut replay) = FrameReplay::new(log, threads)? else {
        return Err(nothing("the scene has no X-ray"));
    };
    let mut compared = ComparedFrames::default();
    while let Some(recorded) = replay.next_recorded()? {
        if ticks.contains(Tick(recorded.frame.tick)) {
            let Some(rendered) = replay.render(&recorded.frame)? else {
                compared.in_gaps += 1;
                continue;
            };
            compare(&recorded, &rendered).map_or(Ok(()), |difference| {
                Err(Failure::failed(format!(
                    "frame {}: {difference}{}",
                    recorded.frame.sequence,
                    log.label()
                )))
            })?;
            compared.identical += 1;
        }
    }
    if compared.identical + compared.in_gaps == 0 {
        return Err(nothing("the log has no frames in this range of ticks"));
    }
    Ok(ComparedFrames { without_request: replay.replies.without_request(), ..compared })
}

/// Returns where two frames differ: in fields, and in the first pixel if the log contains the image.
pub fn compare(recorded: &FrameRecord, rendered: &FrameRecord) -> Option<String> {
    let difference = compare_frame(recorded, rendered)?;
    let pixel = recorded.image.and_then(|image| first_pixel(image.width as usize, recorded, rendered));
    Some(format!("{difference}{}", pixel.unwrap_or_default()))
}

fn first_pixel(columns: usize, recorded: &FrameRecord, rendered: &FrameRecord) -> Option<String> {
    let pairs = || recorded.pixels.chunks_exact(2).zip(rendered.pixels.chunks_exact(2));
    let first = pairs().position(|(a, b)| a != b)?;
    let count = pairs().filter(|(a, b)| a != b).count();
    let (a, b) = pairs().nth(first)?;
    let value = |bytes: &[u8]| u16::from_le_bytes([bytes[0], bytes[1]]);
    let (row, column) = (first / columns.max(1), first % columns.max(1));
    Some(format!(
        "\n  {count} pixels differ, first at row {row}, column {column}: {} vs {}",
        value(a),
        value(b)
    ))
}
