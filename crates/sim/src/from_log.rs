//! A simulation in a log's state at a tick.

use std::path::Path;
use std::sync::atomic::{AtomicBool, Ordering};

use controllers::Controller;
use inputs::log::{OpenedLog, Overrides};
use messages::{Command, Latched, Reset, Tick};
use run_log::difference::Divergence;
use run_log::verify::{compare_state, compare_tick};
use run_log::{LogReader, RunMode};

use crate::error::SimError;
use crate::shared::SharedScene;
use crate::simulator::{Drive, Sim};

impl Sim {
    /// Creates a simulation of a log's scene in the state of `tick`, or of the log's last tick: steps the
    /// log's commands through the physics, and compares every state on the way with the log's. Built-in
    /// controllers that `drive` leaves to the simulation see the states on the way, so they continue as they
    /// would have.
    ///
    /// # Errors
    /// If it is not a log of this build, the tick is not in it or lies behind a gap, or a built-in controller
    /// cannot be restored: the log is of a real-time run or begins with a keyframe, or the controller sees
    /// frames.
    pub fn from_log(log: &Path, tick: Option<u64>, drive: &Drive) -> Result<Sim, SimError> {
        Sim::from_log_unless(log, tick, drive, &AtomicBool::new(false))
    }

    /// As [`Sim::from_log`], but aborts once another thread has set `is_to_end`.
    ///
    /// # Errors
    /// As [`Sim::from_log`]; [`SimError::GivenUp`].
    pub fn from_log_unless(
        log: &Path,
        tick: Option<u64>,
        drive: &Drive,
        is_to_end: &AtomicBool,
    ) -> Result<Sim, SimError> {
        let mut opened = OpenedLog::open(log, &Overrides::default())?;
        let mut reader = opened.reader()?;
        let shared = SharedScene::of_log(&mut opened);
        let mut sim = Sim::new(&shared, drive)?;
        let path = &opened.path;
        refuse_lost_controllers(&sim, &reader, path)?;
        let differs = |divergence: Divergence| SimError::Differs { path: path.clone(), divergence };
        if let Some(saved) = reader.beginning() {
            let restored = sim.run.plant_mut().restore_keyframe(&saved.bytes);
            restored.map_err(|cause| SimError::Physics { tick: Tick(reader.initial().tick), cause })?;
            let predrilled = sim.run.plant().predrilled().to_vec();
            sim.drilled = sim.run.plant().gone();
            sim.drilled.retain(|voxel| predrilled.binary_search(voxel).is_err());
        }
        compare_state(reader.initial(), sim.run.plant().state())
            .map_or(Ok(()), |found| Err(differs(found)))?;
        let first = Tick(reader.initial().tick);
        let goal = tick.map(Tick);
        while goal.is_none_or(|goal| Tick(sim.state().tick) < goal) {
            let Some(record) = reader.next().transpose()? else { break };
            if is_to_end.load(Ordering::Relaxed) {
                return Err(SimError::GivenUp { tick: Tick(sim.state().tick) });
            }
            sim.follow(&record.latched)?;
            compare_tick(&record, sim.run.plant()).map_or(Ok(()), |found| Err(differs(found)))?;
        }
        let last = Tick(sim.state().tick);
        match goal.filter(|goal| *goal != last) {
            Some(tick) => Err(SimError::NotInLog { tick, path: path.clone(), first, last }),
            None => {
                sim.starts_here();
                Ok(sim)
            }
        }
    }

    /// Runs a tick with the commands that were latched in it.
    pub(crate) fn follow(&mut self, latched: &Latched) -> Result<(), SimError> {
        let state = self.run.plant().state();
        let built_in = self.drivers.iter_mut().filter_map(|driver| driver.built_in.as_mut());
        built_in.for_each(|built_in| built_in.step(state, &mut Command::zeroed()));
        self.run.follow(latched);
        if latched.reset() == Reset::Yes {
            self.drilled.clear();
        }
        self.lane.tick(self.run.plant_mut(), latched)?;
        self.drilled.extend_from_slice(self.run.plant().removed());
        Ok(())
    }
}

/// Refuses to continue with a built-in controller whose inner state cannot be recovered from the log.
fn refuse_lost_controllers(sim: &Sim, reader: &LogReader, path: &Path) -> Result<(), SimError> {
    let Some(driver) = sim.drivers.iter().find(|driver| driver.built_in.is_some()) else { return Ok(()) };
    let frames = sim.drivers.iter().find(|driver| driver.sees_frames);
    let (driver, reason) = match () {
        () if reader.header().mode == RunMode::RealTime => {
            (driver, "it ran in real time and saw states other than the log's")
        }
        () if reader.beginning().is_some() => (driver, "the log does not begin at tick 0"),
        () => match frames {
            Some(driver) => (driver, "it sees frames"),
            None => return Ok(()),
        },
    };
    Err(SimError::NoContinuation { path: path.to_owned(), controller: driver.name.clone(), reason })
}
