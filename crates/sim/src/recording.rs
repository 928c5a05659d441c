//! Output of a simulation's run lane: into a log, or discarded.

use std::fs::File;
use std::io::{BufWriter, Write};
use std::path::{Path, PathBuf};

use hub::Outputs;
use hub::run_lane::{LaneError, RunLane};
use messages::layout::Message;
use messages::{CArmGeometry, Keyframe, Latched, Removed, SensorReading, State, Tick};
use output_file::{OutputError, OutputFile};
use recorder_proc::build_info;
use recorder_proc::log_file::index_beside;
use run_log::cat::whole;
use run_log::{EndReason, LogError, LogHeader, RunLog, RunMode};
use simulation::{Simulation, SimulationError};
use xray::from_scene::scene_c_arm;
use xray::message::c_arm_message;
use zerocopy::IntoBytes;

use crate::error::SimError;
use crate::shared::{SharedScene, log_in};

/// Runs ticks, and publishes them as the physics of a run does.
pub(crate) struct Lane {
    lane: RunLane,
    out: Out,
}

/// Destination of published ticks: a log, or none.
struct Out(Option<Box<Recording>>);

/// A log that is being written; it gets its final name when it is complete.
pub(crate) struct Recording {
    log: RunLog<BufWriter<File>>,
    file: OutputFile,
    path: PathBuf,
}

impl Recording {
    pub(crate) fn create(folder: &Path, shared: &SharedScene) -> Result<Recording, SimError> {
        let path = log_in(folder);
        output_file::refuse_existing(&[&path])?;
        output_file::create_folder(folder)
            .map_err(|source| OutputError::Create { path: folder.to_owned(), source })?;
        let file = OutputFile::create(&path)?;
        let written = BufWriter::with_capacity(1 << 16, file.handle()?);
        let log = RunLog::create_named(written, &path, index_beside(&path), &header(shared)?)?;
        Ok(Recording { log, file, path })
    }

    fn finish(self, reason: EndReason) -> Result<(), SimError> {
        let (_, mut written) = self.log.finish(reason, &Default::default())?;
        // A failed flush must be an error, or the file would silently lack its end.
        written.flush().map_err(OutputError::write(&self.path))?;
        Ok(self.file.keep()?)
    }
}

impl Out {
    fn log(
        &mut self,
        write: impl FnOnce(&mut RunLog<BufWriter<File>>) -> Result<(), LogError>,
    ) -> Result<(), LogError> {
        self.0.as_mut().map_or(Ok(()), |recording| write(&mut recording.log))
    }
}

impl Lane {
    pub(crate) fn silent() -> Lane {
        Lane { lane: RunLane::new(None), out: Out(None) }
    }

    pub(crate) fn recorded(recording: Recording, keyframe_period_ticks: Option<u64>) -> Lane {
        Lane { lane: RunLane::new(keyframe_period_ticks), out: Out(Some(Box::new(recording))) }
    }

    pub(crate) fn begin(&mut self, plant: &Simulation<'static>) -> Result<(), SimError> {
        self.lane.begin(plant, &mut self.out).map_err(|error| failed(error, Tick::START))
    }

    /// Runs a tick, with its keyframe if one is due.
    pub(crate) fn tick(
        &mut self,
        plant: &mut Simulation<'static>,
        latched: &Latched,
    ) -> Result<(), SimError> {
        let failed = |error| failed(error, Tick(latched.tick));
        self.lane.tick(plant, latched, &mut self.out, |_| 0).map_err(failed)?;
        plant.make_room();
        self.lane.keyframe_if_due(plant, &mut self.out).map_err(failed)
    }

    /// Refuses to jump to another state while recording, because recorded ticks must be consecutive.
    ///
    /// # Errors
    /// [`SimError::Recording`].
    pub(crate) fn refuse_a_jump(&self) -> Result<(), SimError> {
        match &self.out.0 {
            None => Ok(()),
            Some(recording) => Err(SimError::Recording { path: recording.path.clone() }),
        }
    }

    /// Closes the recording, which is then complete; returns whether there was one.
    pub(crate) fn finish(mut self, ended: bool) -> Result<bool, SimError> {
        let Some(recording) = self.out.0.take() else { return Ok(false) };
        recording.finish(if ended { EndReason::Completed } else { EndReason::Stopped })?;
        Ok(true)
    }
}

impl Drop for Lane {
    /// Completes the log of a simulation that is dropped while recording.
    fn drop(&mut self) {
        // Errors are ignored here: a caller that needs them closes the recording.
        let _ = self.out.0.take().map(|recording| recording.finish(EndReason::Stopped));
    }
}

fn failed(error: LaneError<LogError, SimulationError>, tick: Tick) -> SimError {
    match error {
        LaneError::Plant(cause) => SimError::Physics { tick, cause },
        LaneError::Output(cause) => SimError::Log(cause),
    }
}

/// Returns the header that the recorder of a lockstep run writes.
fn header(shared: &SharedScene) -> Result<LogHeader, SimError> {
    let scene = shared.scene();
    let c_arm = scene.drr.as_ref().and_then(|drr| scene_c_arm(drr).ok());
    let calibration =
        |c_arm| format!("{:#}\n", whole(CArmGeometry::DESCRIPTION, c_arm_message(&c_arm).as_bytes()));
    Ok(LogHeader {
        scene_toml: shared.toml()?,
        calibration_json: c_arm.map(calibration),
        scene_name: scene.name.clone(),
        volume_sha256: shared.ct().map(|ct| ct.sha256),
        volume_dimensions: shared.volume().map_or([0; 3], |volume| volume.dimensions),
        dt_ns: scene.dt_ns(),
        mode: RunMode::Lockstep,
        controllers: scene.controller_names(),
        build: build_info::current(),
        first_tick: Tick::START,
    })
}

impl Outputs for Out {
    type Error = LogError;

    fn send_latched(&mut self, latched: &Latched) -> Result<(), LogError> {
        self.log(|log| log.latched(latched))
    }

    fn send_removed(&mut self, removed: &Removed, voxels: &[u32]) -> Result<(), LogError> {
        self.log(|log| log.removed(&[removed.as_bytes(), voxels.as_bytes()].concat()))
    }

    fn send_reading(&mut self, reading: &SensorReading) -> Result<(), LogError> {
        self.log(|log| log.reading(reading))
    }

    fn send_state(&mut self, state: &State) -> Result<(), LogError> {
        self.log(|log| log.state(state))
    }

    fn send_keyframe(&mut self, keyframe: &Keyframe, part: &[u8]) -> Result<(), LogError> {
        self.log(|log| log.keyframe(&[keyframe.as_bytes(), part].concat()))
    }
}
