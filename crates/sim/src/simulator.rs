//! One simulation.

use std::collections::VecDeque;
use std::path::Path;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};

use controllers::{BuiltIn, Controller};
use hub::in_process::{Answer, Commands, InProcess, InProcessError};
use messages::{Breach, Command, ControllerIndex, Frame, Latched, SensorReading, State, Tick, TipJacobian};
use simulation::{Simulation, SimulationError, SimulationSnapshot, StateEntry};
use xray::Labels;
use xray::frame::RenderedFrame;

use crate::batch::SimFactory;
use crate::error::SimError;
use crate::recording::{Lane, Recording};
use crate::shared::SharedScene;
use crate::x_ray::{View, XRay};

/// Which controllers the caller drives, of those that the simulation could run itself. The caller always
/// drives external ones and programs; built-in ones otherwise run in the simulation, as in a run.
#[derive(Debug, Clone, PartialEq, Eq)]
pub enum Drive {
    /// No built-in controller.
    Nothing,
    /// Controllers of these names.
    These(Vec<String>),
    /// Every controller.
    Everything,
}

/// Maximum number of readings that [`Sim::readings`] returns: as many as a client's queue holds.
const READINGS_KEPT: usize = messages::services::SENSOR.queue_length;

/// A scene stepped in this process.
pub struct Sim {
    pub(crate) shared: Arc<SharedScene>,
    pub(crate) run: InProcess<Simulation<'static>>,
    pub(crate) drivers: Vec<Driver>,
    /// Voxels drilled since the start or the last reset, in the order of their removal.
    pub(crate) drilled: Vec<u32>,
    /// The newest scheduled frame with its pixels, for the controllers that see frames.
    pub(crate) frame: Option<Arc<(Frame, Vec<u16>)>>,
    pub(crate) frames_rendered: u64,
    /// u_k of the last tick; `None` at the start.
    pub(crate) latched: Option<Box<Latched>>,
    /// Parts of commands that could not be followed in the last call of [`Sim::step`].
    refusals: Vec<String>,
    /// Readings that arrived in the last call of [`Sim::step`], the newest [`READINGS_KEPT`].
    readings: VecDeque<SensorReading>,
    pub(crate) start: Option<Snapshot>,
    pub(crate) lane: Lane,
    x_ray: Option<XRay>,
}

/// A controller of the scene.
#[derive(Debug, Clone)]
pub(crate) struct Driver {
    pub(crate) name: String,
    /// `None` if the caller drives it.
    pub(crate) built_in: Option<BuiltIn>,
    /// Whether it is built in and sees frames.
    pub(crate) sees_frames: bool,
    /// Whether a run can begin without it.
    optional: bool,
}

/// A simulation's state at a tick. Its size grows with what has been drilled; copies share it.
#[derive(Debug, Clone)]
pub struct Snapshot(pub(crate) Arc<Saved>);

#[derive(Debug)]
pub(crate) struct Saved {
    vector: Vec<f64>,
    pub(crate) shared: Arc<SharedScene>,
    simulation: SimulationSnapshot,
    commands: Commands,
    pub(crate) drivers: Vec<Driver>,
    drilled: Vec<u32>,
    frame: Option<Arc<(Frame, Vec<u16>)>>,
    frames_rendered: u64,
    latched: Option<Box<Latched>>,
}

impl Snapshot {
    /// Returns the state at its tick.
    pub fn state(&self) -> &State {
        self.0.simulation.state()
    }

    /// Returns its state vector: the values of [`Sim::state_entries`].
    pub fn vector(&self) -> &[f64] {
        &self.0.vector
    }
}

impl Sim {
    /// Creates a simulation at tick 0.
    ///
    /// # Errors
    /// If the scene has no controller that `drive` names, a calibration cannot be used, or the physics
    /// refuses the scene.
    pub fn new(shared: &Arc<SharedScene>, drive: &Drive) -> Result<Sim, SimError> {
        let mut sim = Sim::at_start(shared, drivers(shared, drive)?)?;
        sim.start = Some(sim.snapshot());
        Ok(sim)
    }

    pub(crate) fn at_start(shared: &Arc<SharedScene>, drivers: Vec<Driver>) -> Result<Sim, SimError> {
        let plant = Simulation::with_shared_ct(shared.scene(), shared.ct());
        let plant = plant.map_err(|cause| SimError::Physics { tick: Tick::START, cause })?;
        Ok(Sim {
            run: InProcess::new(shared.scene(), plant),
            shared: Arc::clone(shared),
            drivers,
            drilled: Vec::new(),
            frame: None,
            frames_rendered: 0,
            latched: None,
            refusals: Vec::new(),
            readings: VecDeque::new(),
            start: None,
            lane: Lane::silent(),
            x_ray: None,
        })
    }

    /// Creates another simulation in the same state; it shares scene and volume and is not recorded.
    ///
    /// # Errors
    /// If the physics refuses the scene, which it has accepted before.
    pub fn branch(&self) -> Result<Sim, SimError> {
        self.brancher()()
    }

    /// Returns a maker that performs [`Sim::branch`] of the present state on any thread.
    pub fn brancher(&self) -> SimFactory {
        let (here, start) = (self.snapshot(), self.start.clone());
        Box::new(move || {
            let mut branch = Sim::at_start(&here.0.shared, here.0.drivers.clone())?;
            branch.restore(&here)?;
            branch.start = start;
            Ok(branch)
        })
    }

    /// Returns the scene with its volume.
    pub fn shared(&self) -> &Arc<SharedScene> {
        &self.shared
    }

    /// Returns x_k, including h_k.
    pub fn state(&self) -> &State {
        self.run.plant().state()
    }

    /// Returns the sensor readings that arrived in the last call of [`Sim::step`], the newest 1024; before
    /// the first call and after a jump, those of the present state.
    pub fn readings(&self) -> Vec<SensorReading> {
        match self.readings.is_empty() {
            true => self.run.plant().readings().to_vec(),
            false => self.readings.iter().copied().collect(),
        }
    }

    /// Returns Jacobian and compliance of the tip at the present state, also without
    /// `manipulator.tip_jacobian`.
    pub fn tip_jacobian(&self) -> TipJacobian {
        self.run.plant().tip_jacobian()
    }

    /// Returns the names of the controllers that the caller drives, in the scene's order.
    pub fn driven(&self) -> Vec<String> {
        let driven = self.drivers.iter().filter(|driver| driver.built_in.is_none());
        driven.map(|driver| driver.name.clone()).collect()
    }

    /// Returns the linear indices of the voxels drilled since the start, in the order of their removal.
    pub fn drilled(&self) -> &[u32] {
        &self.drilled
    }

    /// Returns the parts of commands that could not be followed in the last call of [`Sim::step`], such as
    /// unreachable goals, each with its reason.
    pub fn refusals(&self) -> &[String] {
        &self.refusals
    }

    /// Returns where the burr or the tube was found in the last tick to have left the bone elsewhere than
    /// through the hole that it came by.
    pub fn breach(&self) -> Option<&Breach> {
        self.run.plant().breach()
    }

    /// Runs `ticks` ticks, in each of which every driven controller sends its command again. `commands` holds
    /// one for each of [`Sim::driven`], in that order; their `sequence` and `state_tick` are filled in.
    ///
    /// # Errors
    /// If a command is refused, in which case nothing has changed; if the physics, the X-ray or the recording
    /// fails.
    pub fn step(&mut self, commands: &[Command], ticks: u64) -> Result<(), SimError> {
        self.step_until(commands, ticks, &AtomicBool::new(false))
    }

    /// As [`Sim::step`], but runs no further tick once another thread has set `is_to_end`.
    ///
    /// # Errors
    /// As [`Sim::step`].
    pub fn step_until(
        &mut self,
        commands: &[Command],
        ticks: u64,
        is_to_end: &AtomicBool,
    ) -> Result<(), SimError> {
        self.refusals.clear();
        self.readings.clear();
        self.check(commands)?;
        (0..ticks).take_while(|_| !is_to_end.load(Ordering::Relaxed)).try_for_each(|_| self.tick(commands))
    }

    fn check(&self, commands: &[Command]) -> Result<(), SimError> {
        let is_driven = |driver: &Driver| driver.built_in.is_none();
        if commands.len() != self.drivers.iter().filter(|driver| is_driven(driver)).count() {
            return Err(SimError::CommandCount { given: commands.len(), driven: self.driven() });
        }
        let tick = Tick(self.state().tick);
        let driven = ControllerIndex::first(self.drivers.len()).zip(&self.drivers);
        for (command, (index, driver)) in commands.iter().zip(driven.filter(|(_, driver)| is_driven(driver)))
        {
            let refused = |cause| SimError::Refused { controller: driver.name.clone(), tick, cause };
            self.run.check(index, command).map_err(refused)?;
        }
        Ok(())
    }

    fn tick(&mut self, commands: &[Command]) -> Result<(), SimError> {
        let latched = self.latch(commands)?;
        self.latched = Some(Box::new(latched));
        self.lane.tick(self.run.plant_mut(), &latched)?;
        self.drilled.extend_from_slice(self.run.plant().removed());
        self.take_refusals(Tick(latched.tick));
        self.take_readings();
        Ok(())
    }

    /// Latches the commands of the next tick: those given, and those of the built-in controllers.
    fn latch(&mut self, commands: &[Command]) -> Result<Latched, SimError> {
        self.exchange_frames()?;
        let (readings, drivers) = (self.run.plant().readings().to_vec(), &mut self.drivers);
        let mut given = commands.iter();
        let latched = self.run.latch(|index, state, command| {
            let driver = &mut drivers[index.slot()];
            match &mut driver.built_in {
                Some(built_in) => {
                    readings.iter().for_each(|reading| built_in.reading(reading));
                    built_in.step(state, command);
                }
                None => {
                    let own = given.next().copied().unwrap_or_else(Command::zeroed);
                    if driver.optional && command.sequence == 1 && !asks(&own) {
                        return Answer::Nothing;
                    }
                    let Command { sequence, state_tick, .. } = *command;
                    *command = Command { sequence, state_tick, ..own };
                }
            }
            Answer::Command
        });
        latched.map_err(|error| match error {
            InProcessError::Refused { controller, tick, cause } => {
                SimError::Refused { controller: drivers[controller.slot()].name.clone(), tick, cause }
            }
            InProcessError::Plant { tick, cause } => SimError::Physics { tick, cause },
        })
    }

    /// Runs `work` with the plant and the commands that its next tick would latch; then everything is as it
    /// was, bit for bit.
    pub(crate) fn at_next_tick<R>(
        &mut self,
        commands: &[Command],
        work: impl FnOnce(&mut Simulation<'static>, &SimulationSnapshot, &Latched) -> Result<R, SimulationError>,
    ) -> Result<R, SimError> {
        self.check(commands)?;
        let here = self.run.plant().snapshot();
        let (sent, drivers) = (self.run.commands().clone(), self.drivers.clone());
        let (frame, frames_rendered) = (self.frame.clone(), self.frames_rendered);
        let latched = self.latch(commands);
        self.run.restore_commands(&sent);
        (self.drivers, self.frame, self.frames_rendered) = (drivers, frame, frames_rendered);
        let latched = latched?;
        let plant = self.run.plant_mut();
        let done = work(plant, &here, &latched);
        let restored = plant.restore(&here);
        let failed = |cause| SimError::Physics { tick: Tick(here.state().tick), cause };
        restored.map_err(failed)?;
        done.map_err(failed)
    }

    /// Returns the entries of the state vector: names, units and ranges.
    pub fn state_entries(&self) -> Vec<StateEntry> {
        self.run.plant().state_entries()
    }

    /// Moves to the state of a snapshot, as [`Sim::restore`] does, but with these values in its state
    /// vector. What the vector does not hold (bone, free bodies, motions in progress, sensors' delays,
    /// controllers) is the snapshot's. If a bit differs from the snapshot's vector, the hash is one that no
    /// run has.
    ///
    /// # Errors
    /// As [`Sim::restore`]; also if the vector has the wrong length, a value is out of range, or joints of
    /// the arm differ although it follows a path. Nothing has changed then.
    pub fn restore_vector(&mut self, snapshot: &Snapshot, vector: &[f64]) -> Result<(), SimError> {
        let here = self.snapshot();
        self.restore(snapshot)?;
        let set = self.run.plant_mut().set_state_vector(vector);
        set.map_err(|cause| match self.restore(&here) {
            Ok(()) => SimError::StateVector(cause),
            Err(error) => error,
        })
    }

    fn take_readings(&mut self) {
        self.readings.extend(self.run.plant().readings());
        let too_many = self.readings.len().saturating_sub(READINGS_KEPT);
        self.readings.drain(..too_many);
    }

    fn take_refusals(&mut self, tick: Tick) {
        let drivers = &self.drivers;
        self.refusals.extend(self.run.plant().refusals().iter().map(|refusal| {
            let name = drivers.get(refusal.controller.slot()).map_or("", |driver| &driver.name);
            format!("tick {tick}: controller `{name}`: {}", refusal.reason)
        }));
    }

    /// Shows the newest frame to the controllers that are due to see it, and renders the next one if it is
    /// due.
    fn exchange_frames(&mut self) -> Result<(), SimError> {
        if !self.drivers.iter().any(|driver| driver.sees_frames) {
            return Ok(());
        }
        let tick = self.state().tick;
        let due = self.shared.scene().frame_seen_at(tick);
        if let Some((frame, pixels)) = self.frame.as_deref().filter(|(frame, _)| due == Some(frame.tick)) {
            let controllers = self.drivers.iter_mut().filter_map(|driver| driver.built_in.as_mut());
            controllers.for_each(|controller| controller.frame(frame, pixels));
        }
        if self.shared.scene().frame_period_ticks().is_some_and(|period| tick.is_multiple_of(period)) {
            let rendered = self.render(View::Scene)?;
            self.frame = Some(Arc::new((rendered.frame, rendered.pixels)));
        }
        Ok(())
    }

    /// Renders the X-ray of the present state, without any effect on later ticks. The noise is seeded with
    /// the scene's seed and the tick, so the scene's C-arm gives the pixels of a run's scheduled frame.
    ///
    /// # Errors
    /// If the scene has no X-ray, or the C-arm is refused.
    pub fn render(&mut self, from: View) -> Result<RenderedFrame, SimError> {
        self.frames_rendered += 1;
        let sequence = self.frames_rendered;
        let Sim { shared, run, drilled, x_ray, .. } = self;
        let plant = run.plant();
        XRay::of(x_ray, shared, plant.predrilled())?.render(shared, plant.state(), drilled, from, sequence)
    }

    /// Renders the X-ray of the present state from each of these views, with the same pixels as
    /// [`Sim::render`] but in less time than one after the other.
    ///
    /// # Errors
    /// As [`Sim::render`]; nothing has been rendered then.
    pub fn render_many(&mut self, from: &[View]) -> Result<Vec<RenderedFrame>, SimError> {
        self.render_many_unless(from, &AtomicBool::new(false))
    }

    /// As [`Sim::render_many`], but aborts once another thread has set `is_to_end`.
    ///
    /// # Errors
    /// As [`Sim::render_many`]; [`SimError::GivenUp`].
    pub fn render_many_unless(
        &mut self,
        from: &[View],
        is_to_end: &AtomicBool,
    ) -> Result<Vec<RenderedFrame>, SimError> {
        let numbered = (from, self.frames_rendered + 1);
        self.frames_rendered += from.len() as u64;
        let Sim { shared, run, drilled, x_ray, .. } = self;
        let plant = run.plant();
        let x_ray = XRay::of(x_ray, shared, plant.predrilled())?;
        x_ray.render_many(shared, plant.state(), drilled, numbered, is_to_end)
    }

    /// Renders the X-ray of the present state as [`Sim::render`] does, with its labels. Voxels at or above
    /// `bone_from_hu` are bone; by default the scene's `drr.labels.bone_from_hu`, or else its
    /// `volume.bone_threshold_hu`.
    ///
    /// # Errors
    /// As [`Sim::render`].
    pub fn labels(
        &mut self,
        from: View,
        bone_from_hu: Option<i16>,
    ) -> Result<(RenderedFrame, Labels), SimError> {
        self.frames_rendered += 1;
        let sequence = self.frames_rendered;
        let Sim { shared, run, drilled, x_ray, .. } = self;
        let plant = run.plant();
        let x_ray = XRay::of(x_ray, shared, plant.predrilled())?;
        x_ray.labels(shared, plant.state(), drilled, from, sequence, bone_from_hu)
    }

    /// Takes a snapshot of the present state. Its size and cost grow with what has been drilled.
    pub fn snapshot(&self) -> Snapshot {
        Snapshot(Arc::new(Saved {
            shared: Arc::clone(&self.shared),
            simulation: self.run.plant().snapshot(),
            vector: self.run.plant().state_vector(),
            commands: self.run.commands().clone(),
            drivers: self.drivers.clone(),
            drilled: self.drilled.clone(),
            frame: self.frame.clone(),
            frames_rendered: self.frames_rendered,
            latched: self.latched.clone(),
        }))
    }

    /// Moves to the state of a snapshot, of this or another simulation of the same scene, and continues from
    /// there bit for bit.
    ///
    /// The scene of the snapshot may differ in `[truth]`, as that of a model that follows a plant: the state,
    /// the drilled bone, motions in progress and the controllers are then the snapshot's, and the parameters
    /// remain those of this scene. The hash then matches no run.
    ///
    /// # Errors
    /// If the snapshot belongs to another scene or to a simulation with other driven controllers, its
    /// `[truth]` differs in a key that determines what the state means, or this simulation is being recorded.
    pub fn restore(&mut self, snapshot: &Snapshot) -> Result<(), SimError> {
        self.refuse_unfit(snapshot)?;
        let saved = &*snapshot.0;
        let tick = Tick(saved.simulation.state().tick);
        let plant = self.run.plant_mut();
        let restored = match self.shared.is_same(&saved.shared) {
            true => plant.restore(&saved.simulation),
            false => plant.restore_of_other_truth(&saved.simulation),
        };
        restored.map_err(|cause| SimError::Physics { tick, cause })?;
        self.run.restore_commands(&saved.commands);
        self.drivers.clone_from(&saved.drivers);
        self.drilled.clone_from(&saved.drilled);
        self.frame.clone_from(&saved.frame);
        self.frames_rendered = saved.frames_rendered;
        self.latched.clone_from(&saved.latched);
        self.refusals.clear();
        self.readings.clear();
        if let Some(x_ray) = &mut self.x_ray {
            x_ray.forget();
        }
        Ok(())
    }

    /// Refuses a snapshot that [`Sim::restore`] cannot take.
    pub(crate) fn refuse_unfit(&self, snapshot: &Snapshot) -> Result<(), SimError> {
        let saved = &*snapshot.0;
        let drives = |drivers: &[Driver]| -> Vec<bool> {
            drivers.iter().map(|driver| driver.built_in.is_some()).collect()
        };
        if drives(&self.drivers) != drives(&saved.drivers) {
            return Err(SimError::OtherScene);
        }
        if !self.shared.is_same(&saved.shared) {
            self.shared.refuse_other_state(&saved.shared)?;
        }
        self.lane.refuse_a_jump()
    }

    /// Resets to tick 0 or, for a simulation from a log, to the tick at which it was created.
    ///
    /// # Errors
    /// If it is being recorded.
    pub fn reset(&mut self) -> Result<(), SimError> {
        match self.start.clone() {
            Some(start) => self.restore(&start),
            None => Ok(()),
        }
    }

    /// Makes the present state the target of [`Sim::reset`].
    pub(crate) fn starts_here(&mut self) {
        self.start = Some(self.snapshot());
    }

    /// Records from tick 0 into `run.mcap` of a folder, which is created. `trabecula replay --verify` accepts
    /// the log. The file gets its name when the recording is closed.
    ///
    /// # Errors
    /// If the simulation is not in the state in which runs of the scene start, a recording is open, or the
    /// folder contains a `run.mcap` or cannot be written.
    pub fn record(&mut self, folder: &Path) -> Result<(), SimError> {
        self.lane.refuse_a_jump()?;
        let tick = Tick(self.state().tick);
        if tick != Tick::START {
            return Err(SimError::RecordingLate { tick });
        }
        if self.state().hash != [0; 2] {
            return Err(SimError::RecordingElsewhere);
        }
        let recording = Recording::create(folder, &self.shared)?;
        self.lane = Lane::recorded(recording, self.shared.scene().keyframe_period_ticks());
        self.lane.begin(self.run.plant())
    }

    /// Completes and names the log; returns false if nothing was recorded.
    ///
    /// # Errors
    /// If the log cannot be written.
    pub fn close_recording(&mut self) -> Result<bool, SimError> {
        let ended = self.state().tick >= self.shared.scene().tick_count();
        std::mem::replace(&mut self.lane, Lane::silent()).finish(ended)
    }
}

/// Returns whether a command drives anything. An optional controller joins with the first that does.
fn asks(command: &Command) -> bool {
    [command.tendon_mode, command.arm_mode, command.burr_mode, command.tube_mode]
        .iter()
        .any(|mode| *mode != 0)
}

/// Creates the scene's controllers.
fn drivers(shared: &SharedScene, drive: &Drive) -> Result<Vec<Driver>, SimError> {
    let scene = shared.scene();
    if let Drive::These(names) = drive {
        let known = scene.controller_names();
        if let Some(name) = names.iter().find(|name| !known.contains(name)) {
            return Err(SimError::NoController { name: name.clone(), scene: known });
        }
    }
    let driver = |entry: &scene::Controller| -> Result<Driver, SimError> {
        let is_driven = match drive {
            Drive::Nothing => false,
            Drive::These(names) => names.contains(&entry.name),
            Drive::Everything => true,
        };
        let built_in = match is_driven {
            true => None,
            false => BuiltIn::of(scene, &entry.name, &ipc_types::text_file::read)?,
        };
        let by_image =
            entry.curved_drilling.as_ref().is_some_and(|plan| plan.feedback == scene::Feedback::Image);
        let sees_frames = built_in.is_some() && by_image && scene.frame_period_ticks().is_some();
        Ok(Driver { name: entry.name.clone(), built_in, sees_frames, optional: entry.optional })
    };
    scene.controller.iter().map(driver).collect()
}
