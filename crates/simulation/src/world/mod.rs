//! The whole simulated world: arm, manipulator, bone, burr.
//!
//! One tick:
//!
//! 1. apply the latched commands: arm goal, tendon target, burr speed, wrench or pose of a body;
//! 2. move the arm along its jerk-limited path; the flange is the manipulator's base, on which a tool with an
//!    outer tube slides and rolls;
//! 3. find the contact planes between the manipulator's proxy spheres and the bone and rigid bodies;
//! 4. step the manipulator with these planes and the tendon tensions, contact impulses inside its implicit
//!    solve; free and driven bodies step with it; without bodies, repeat from 3 if a sphere moved farther
//!    than its planes were searched for, or into bone that supports more force;
//! 5. let bone that was pressed beyond its strength recede, and remove bone with the burr, using the contact
//!    normal forces of that solve; measure the clearance of critical structures, which may stop the arm;
//! 6. extend the hash chain with commands, state and removed voxels; sample the sensors.

mod apply;
mod arm_in_bone;
mod breach;
mod burr_drive;
mod drive_shaft;
mod energy;
mod error;
mod feasibility;
mod fixture;
mod keyframe;
mod lost;
mod message;
mod move_tool;
mod outer_surface;
mod plant;
mod receding;
mod setup;
mod state_vector;
mod structures;
mod tendon_drive;
mod tool;
mod tube_drive;
mod validity;

use std::sync::Arc;

use messages::{
    Approach, ArmEntry, ArmStatus, Breach, ControllerIndex, Latched, MAX_CONTROLLERS, Refusal, SensorReading,
    State,
};
use nalgebra::Vector3;
use scene::{Holder, Scene};
use sensors::{SensorArray, SensorArrayState};
use voxel_grid::{Ct, Volume, VoxelGrid};
use xxhash_rust::xxh3::Xxh3;
use zerocopy::IntoBytes;

use crate::arm::{Arm, ArmError, ArmSnapshot, Compliance, ComplianceState};
use crate::bone::{
    Ball, BoneField, BoneSnapshot, BurrContact, BurrState, ContactBuffer, GridGeometry, Indentation, Outside,
    TickLoads, VoxelIndex,
};
use crate::contact_plane::ContactPlane;
use crate::manipulator::{AnyManipulator, BaseMotion, ManipulatorModel, ManipulatorState, StepReport};
use crate::rigid::{RigidScene, RigidSnapshot, ToolDrive};
use arm_in_bone::ArmWatch;
use breach::BreachWatch;
use burr_drive::{BurrDrive, BurrDriveState};
use move_tool::SearchRange;
use receding::RecessionState;
use structures::StructureWatch;
use tendon_drive::{TendonDrive, TendonDriveState};
use tube_drive::{TubeDrive, TubeDriveState};

pub use energy::creation_bound_j;
pub use error::SimulationError;
pub use feasibility::{Finding, Verdict, findings, planned_time_s, validated_range};
pub use keyframe::KeyframeError;
pub use lost::LostTool;
pub use message::pose;
pub use move_tool::ToolEffort;
pub use outer_surface::outer_surface;
pub use setup::{contact_kind, manipulator_parameters, rung};
pub use state_vector::{StateEntry, StateVectorError};
pub use tube_drive::TubeRefusal;

/// The simulation's view of the CT: geometry and Hounsfield units, x fastest, borrowed.
#[derive(Debug, Clone, Copy)]
pub struct CtView<'v> {
    /// Grid.
    pub geometry: GridGeometry,
    /// Hounsfield units.
    pub hu: &'v [i16],
}

impl<'v> CtView<'v> {
    /// Creates a view of a grid's voxels.
    pub fn new(grid: &VoxelGrid, hu: &'v [i16]) -> CtView<'v> {
        CtView { geometry: GridGeometry::from(grid), hu }
    }
}

impl<'v> From<&'v Volume> for CtView<'v> {
    fn from(volume: &'v Volume) -> CtView<'v> {
        CtView::new(&volume.grid, &volume.hu)
    }
}

/// The voxels of a CT: borrowed from a volume that outlives the simulation, or shared.
enum Hounsfield<'v> {
    Borrowed(&'v [i16]),
    Shared(Arc<Ct>),
}

impl core::ops::Deref for Hounsfield<'_> {
    type Target = [i16];

    #[inline]
    fn deref(&self) -> &[i16] {
        match self {
            Hounsfield::Borrowed(hu) => hu,
            Hounsfield::Shared(ct) => &ct.volume.hu,
        }
    }
}

/// Everything that a tick changes: see [`Simulation::snapshot`].
#[derive(Debug, Clone)]
pub struct SimulationSnapshot {
    arm: ArmSnapshot,
    compliance: Option<ComplianceState>,
    manipulator: ManipulatorState,
    bone: Option<BoneSnapshot>,
    rigid: Option<RigidSnapshot>,
    tendon: TendonDriveState,
    tube: Option<TubeDriveState>,
    burr_drive: BurrDriveState,
    burr_speed_rad_per_s: f64,
    cutting_energy_j: f64,
    crushing_energy_j: f64,
    receding: RecessionState,
    sensors: SensorArrayState,
    state: State,
}

impl SimulationSnapshot {
    /// Returns the state after the last tick before the snapshot.
    pub fn state(&self) -> &State {
        &self.state
    }
}

/// The simulated world.
pub struct Simulation<'v> {
    dt_s: f64,
    arm: Arm,
    compliance: Option<Compliance>,
    max_flange_force_n: Option<f64>,
    manipulator: AnyManipulator,
    bone: Option<Bone<'v>>,
    rigid: Option<RigidScene>,
    /// The rigid body that each controller drives.
    driven_bodies: [Option<usize>; MAX_CONTROLLERS],
    /// The controller that the scene has drive the tendons.
    tendon_controller: Option<ControllerIndex>,
    planes: Vec<ContactPlane>,
    /// Where the last step pressed bone beyond its strength.
    indentations: Vec<Indentation>,
    /// The burr's contacts with bone that carried force in the last step.
    burr_contacts: Vec<BurrContact>,
    /// Workspace: the balls of a longer cutter behind its front one.
    balls_behind: Vec<Ball>,
    /// Search range of each proxy sphere.
    reach: Vec<SearchRange>,
    /// Work of the last tick's steps of the tool.
    effort: ToolEffort,
    /// Workspace: the tool before the tick.
    before: ManipulatorState,
    tendon: TendonDrive,
    /// Drive of a tool that slides out of an outer tube.
    tube: Option<TubeDrive>,
    burr_drive: BurrDrive,
    /// Burr speed in this tick; as commanded, unless the motor can stall.
    burr_speed_rad_per_s: f64,
    cutting_energy_j: f64,
    crushing_energy_j: f64,
    /// How the bone under the burr receded in the last tick.
    receding: RecessionState,
    /// Voxels that the last tick could not cut: out of memory.
    uncut_voxels: usize,
    /// Whether ticks leave the bone as it is.
    bone_is_frozen: bool,
    /// Contacts that exceeded the capacity in the last tick.
    left_out_contacts: usize,
    sensors: SensorArray,
    state: State,
    predrilled: Vec<u32>,
    refusals: Vec<Refusal>,
    holder: Holder,
    arm_watch: ArmWatch,
    breach_watch: BreachWatch,
    structure_watch: StructureWatch,
    /// The sender of the last arm command.
    arm_driver: Driver,
    /// The sender of the last burr command.
    burr_driver: Driver,
    /// The sender of the last tendon command.
    tendon_driver: Driver,
    /// The arm fault that has already been reported.
    arm_fault: Option<ArmError>,
    initial: Option<Box<SimulationSnapshot>>,
}

/// Identifies a command by its sender and sequence number.
#[derive(Debug, Clone, Copy, Default)]
struct Driver {
    controller: ControllerIndex,
    /// Sequence number of the command.
    sequence: u64,
}

struct Bone<'v> {
    hu: Hounsfield<'v>,
    field: BoneField,
    contacts: ContactBuffer,
    outside: Arc<Outside>,
}

impl Simulation<'static> {
    /// Returns the world of a scene at tick 0, with a shared CT: the same bits as [`Simulation::new`] with a
    /// borrowed one.
    ///
    /// # Errors
    /// Same as [`Simulation::new`].
    pub fn with_shared_ct(
        scene: &Scene,
        ct: Option<&Arc<Ct>>,
    ) -> Result<Simulation<'static>, SimulationError> {
        let ct = ct.map(|ct| (GridGeometry::from(&ct.volume.grid), Hounsfield::Shared(Arc::clone(ct))));
        Simulation::start(setup::build(scene, ct)?)
    }
}

impl<'v> Simulation<'v> {
    /// Creates the world of a scene at tick 0.
    ///
    /// # Errors
    /// A component rejects its parameters; the error names them.
    pub fn new(scene: &Scene, ct: Option<CtView<'v>>) -> Result<Simulation<'v>, SimulationError> {
        Self::start(setup::build(scene, ct.map(|ct| (ct.geometry, Hounsfield::Borrowed(ct.hu))))?)
    }

    fn start(mut simulation: Simulation<'v>) -> Result<Simulation<'v>, SimulationError> {
        simulation.update_state(&Latched::zeroed(), 0);
        simulation.measure_clearances();
        simulation.look_ahead()?;
        simulation.sample_sensors();
        simulation.initial = Some(Box::new(simulation.snapshot()));
        Ok(simulation)
    }

    /// Disables vector instructions: slower, with the same bits.
    pub fn use_plain_instructions(&mut self) {
        self.manipulator.use_plain_instructions();
        if let Some(bone) = &mut self.bone {
            bone.field.use_plain_instructions();
        }
    }

    /// Sets whether ticks leave the bone as it is: nothing is cut or crushed, and no energy is spent. A
    /// cutter of several balls whose motor or side force is modelled cuts all the same.
    pub fn freeze_bone(&mut self, is_frozen: bool) {
        self.bone_is_frozen = is_frozen;
    }

    /// Returns the number of changes of the bone so far: if it is the same twice, so is the bone.
    pub fn bone_changes(&self) -> u64 {
        self.bone.as_ref().map_or(0, |bone| bone.field.changes())
    }

    /// Returns whether the arm follows a path, which determines its joints.
    pub fn is_arm_on_path(&self) -> bool {
        self.arm.is_on_path()
    }

    /// Sets the speed by which contacts may violate their law when their solver stops, m/s; returns the
    /// previous one. Results within it change; derivatives need a smaller one.
    pub fn set_contact_tolerance(&mut self, m_per_s: f64) -> f64 {
        self.manipulator.set_contact_tolerance(m_per_s)
    }

    /// Drops the caches of the bone. Results do not change (tested).
    pub fn rebuild_caches(&mut self) {
        if let Some(bone) = &mut self.bone {
            bone.field.rebuild_caches();
        }
    }

    /// Returns the state after the last tick.
    pub fn state(&self) -> &State {
        &self.state
    }

    /// Returns the report of the tool's last step: contacts, solver iterations and residual, forces.
    pub fn tool_report(&self) -> &StepReport {
        self.manipulator.last_report()
    }

    /// Returns the voxels that the last tick drilled, by linear index.
    pub fn removed(&self) -> &[u32] {
        let removed = self.bone.as_ref().map_or(&[][..], |bone| bone.field.voxels().removed_this_tick());
        VoxelIndex::numbers(removed)
    }

    /// Returns the voxels that the scene predrills, by linear index, ascending: gone from tick 0 on.
    pub fn predrilled(&self) -> &[u32] {
        &self.predrilled
    }

    /// Returns the voxels of bone that are gone in the present state, by linear index, ascending. Visits
    /// every voxel; not for the real-time loop.
    pub fn gone(&self) -> Vec<u32> {
        let Some(bone) = &self.bone else { return Vec::new() };
        let voxels = bone.field.voxels();
        let threshold_hu = voxels.parameters().threshold_hu;
        let was_solid = (0..).zip(&*bone.hu).filter(|(_, hu)| **hu >= threshold_hu);
        was_solid
            .map(|(number, _)| number)
            .filter(|number| !voxels.is_listed_solid(VoxelIndex::new(*number)))
            .collect()
    }

    /// Returns the number of voxels that the last tick could not cut because memory ran out.
    pub fn uncut_voxels(&self) -> usize {
        self.uncut_voxels
    }

    /// Reserves memory for the voxels that the next tick may cut, so that the tick does not allocate. Results
    /// do not change (tested).
    pub fn make_room(&mut self) {
        if let Some(bone) = &mut self.bone {
            // If memory runs out, the tick counts the voxels that it cannot cut.
            bone.field.make_room();
        }
    }

    /// Returns the memory used by partly cut voxels, in bytes.
    pub fn bone_bytes(&self) -> usize {
        self.bone.as_ref().map_or(0, |bone| bone.field.voxels().pool_bytes())
    }

    /// Returns the sensor readings that arrive with the present state.
    pub fn readings(&self) -> &[SensorReading] {
        self.sensors.readings()
    }

    /// Returns the commands rejected in the last tick, with reasons.
    pub fn refusals(&self) -> &[Refusal] {
        &self.refusals
    }

    /// Returns the link of the arm, holder or shaft that was found in bone in the last tick and was outside
    /// when last checked.
    pub fn arm_entry(&self) -> Option<&ArmEntry> {
        self.arm_watch.entry()
    }

    /// Returns where the burr or the tube was found in the last tick to have left the bone elsewhere than
    /// through the hole that it came by, and was inside when last checked.
    pub fn breach(&self) -> Option<&Breach> {
        self.breach_watch.breach()
    }

    /// Returns the critical structures that the tool came close to or entered in the last tick.
    pub fn approaches(&self) -> &[Approach] {
        self.structure_watch.approaches()
    }

    /// Computes tick k from its commands u_k, `latched`.
    ///
    /// # Errors
    /// A component rejects its input, which does not happen with a valid scene and valid commands; or
    /// [`SimulationError::Lost`]: extreme parameters drove the tool out of bounds. The simulation must not be
    /// used after an error.
    pub fn step(&mut self, latched: &Latched) -> Result<(), SimulationError> {
        if latched.reset != 0 {
            self.reset()?;
        }
        self.apply(latched);
        let start = self.tick_start();
        let base = self.move_arm()?;
        let base = self.slide_tube(base)?;
        let slid_j = if self.tube.is_some() { self.tool_energy_j() - start.tool_energy_j() } else { 0.0 };
        self.turn_burr();
        self.report_arm_fault();
        let tendon = self.step_tendons();
        let drive = ToolDrive { base, tendon, tip_wrench: self.cutting_wrench() };
        let report = self.move_tool(&drive)?;
        self.check_not_lost()?;
        let dropped = self.bone.as_ref().map_or(0, |bone| bone.contacts.dropped());
        self.left_out_contacts = dropped + report.refused_contact_count;
        let removed = self.wear()?;
        self.balance_energy(&start, slid_j, &drive);
        self.watch_structures();
        self.look_ahead()?;
        self.update_state(latched, removed);
        self.update_hash(latched);
        self.sample_sensors();
        self.watch_arm();
        self.watch_breach();
        Ok(())
    }

    /// Moves the arm, or stops it if the tool pushed too hard on its flange in the last tick. Returns the
    /// tool base's motion, including the deflection of elastic joints.
    fn move_arm(&mut self) -> Result<BaseMotion, SimulationError> {
        if let Some(limit_n) = self.max_flange_force_n {
            self.arm.watch_force(self.manipulator.flange_wrench().force_n.norm(), limit_n);
        }
        self.step_arm();
        let wrench = self.flange_wrench();
        if let Some(compliance) = &mut self.compliance {
            compliance.step(&self.arm, &wrench.force_n, &wrench.torque_nm)?;
        }
        Ok(self.arm_base())
    }

    /// Returns the motion of the tool base on the arm, including the deflection of elastic joints.
    fn arm_base(&self) -> BaseMotion {
        match &self.compliance {
            Some(compliance) => {
                let deflected = compliance.base(&self.arm);
                BaseMotion {
                    t_world_base: deflected.t_world_tool,
                    linear_velocity_m_per_s: deflected.linear_velocity_m_s,
                    angular_velocity_rad_per_s: deflected.angular_velocity_rad_s,
                }
            }
            None => {
                let arm = self.arm.state();
                BaseMotion {
                    t_world_base: arm.t_world_tool,
                    linear_velocity_m_per_s: arm.linear_velocity_m_s,
                    angular_velocity_rad_per_s: arm.angular_velocity_rad_s,
                }
            }
        }
    }

    /// Passes the clearances to the sensors.
    fn give_clearances(&mut self) {
        let clearances = self.structure_watch.clearances().iter();
        self.sensors.set_clearances(clearances.map(|clearance| (clearance.distance_m, clearance.sphere)));
    }

    /// Samples the sensors from the present state.
    fn sample_sensors(&mut self) {
        self.give_clearances();
        self.sensors.see(&self.state);
    }

    fn wear(&mut self) -> Result<usize, SimulationError> {
        self.find_indentations();
        self.find_burr_contacts();
        // The lever of a cutter of several balls is known only from the bone that it cuts.
        let is_ball = self.manipulator.parameters().cutter.only_radius_m().is_some();
        if self.bone_is_frozen && (is_ball || !self.burr_drive.is_modelled()) {
            self.load_burr(0.0);
            return Ok(0);
        }
        let Some(bone) = &mut self.bone else {
            self.load_burr(0.0);
            return Ok(0);
        };
        let burr = BurrState {
            centre_m: self.manipulator.t_world_tip().translation.vector,
            radius_m: self.manipulator.parameters().cutter.front_radius_m(),
            speed_rad_s: self.burr_speed_rad_per_s,
            normal_force_n: self.burr_contacts.iter().map(|contact| contact.normal_force_n).sum(),
        };
        let (behind, contacts) = (&self.balls_behind, &self.burr_contacts);
        let work = TickLoads { burr: &burr, behind, contacts, indentations: &self.indentations };
        let report = bone.field.wear(&bone.hu, work, self.dt_s)?;
        self.receding = RecessionState::after(&report, burr.speed_rad_s.abs() * self.dt_s);
        self.load_burr(report.lever_m);
        self.cutting_energy_j += report.energy_used_j;
        self.crushing_energy_j += report.crushed.energy_j;
        self.uncut_voxels = report.refused_count + report.crushed.refused_count;
        Ok(report.removed_count)
    }

    fn update_hash(&mut self, latched: &Latched) {
        let mut hasher = Xxh3::new();
        hasher.update(self.state.hash.as_bytes());
        self.state.hash = [0; 2];
        hasher.update(latched.as_bytes());
        hasher.update(self.state.as_bytes());
        hasher.update(self.removed().as_bytes());
        let hash = hasher.digest128();
        self.state.hash = [hash as u64, (hash >> 64) as u64];
    }

    /// Returns everything that a tick changes. Allocates memory; not for the real-time loop.
    pub fn snapshot(&self) -> SimulationSnapshot {
        SimulationSnapshot {
            arm: self.arm.snapshot(),
            compliance: self.compliance.as_ref().map(|compliance| *compliance.state()),
            manipulator: self.manipulator.snapshot(),
            bone: self.bone.as_ref().map(|bone| bone.field.voxels().snapshot()),
            rigid: self.rigid.as_ref().map(RigidScene::snapshot),
            tendon: self.tendon.snapshot(),
            tube: self.tube.as_ref().map(TubeDrive::snapshot),
            burr_drive: self.burr_drive.state,
            burr_speed_rad_per_s: self.burr_speed_rad_per_s,
            cutting_energy_j: self.cutting_energy_j,
            crushing_energy_j: self.crushing_energy_j,
            receding: self.receding,
            sensors: self.sensors.state(),
            state: self.state,
        }
    }

    /// Restores a snapshot of a simulation of the same scene and volume; continues bit for bit.
    ///
    /// # Errors
    /// The snapshot is from another scene.
    pub fn restore(&mut self, snapshot: &SimulationSnapshot) -> Result<(), SimulationError> {
        if let (Some(bone), Some(saved)) = (&mut self.bone, &snapshot.bone) {
            bone.field.restore(saved)?;
        }
        self.restore_beside_bone(snapshot)
    }

    /// Restores a snapshot as [`Simulation::restore`] does, except for the bone.
    ///
    /// # Errors
    /// The snapshot is from another scene.
    pub fn restore_beside_bone(&mut self, snapshot: &SimulationSnapshot) -> Result<(), SimulationError> {
        self.arm.restore(&snapshot.arm)?;
        if snapshot.state.arm_status() == Ok(ArmStatus::Fault) {
            self.arm.keep_fault();
        }
        self.arm_fault = self.arm.state().fault;
        if let (Some(compliance), Some(saved)) = (&mut self.compliance, &snapshot.compliance) {
            compliance.restore(saved);
        }
        if let (Some(tube), Some(saved)) = (&mut self.tube, &snapshot.tube) {
            tube.restore(saved);
            self.manipulator.set_deployed(tube.deployed_m());
        }
        self.manipulator.restore(&snapshot.manipulator);
        if let (Some(rigid), Some(saved)) = (&mut self.rigid, &snapshot.rigid) {
            rigid.restore(saved);
        }
        self.tendon.restore(&snapshot.tendon);
        self.burr_drive.state = snapshot.burr_drive;
        self.burr_speed_rad_per_s = snapshot.burr_speed_rad_per_s;
        self.cutting_energy_j = snapshot.cutting_energy_j;
        self.crushing_energy_j = snapshot.crushing_energy_j;
        self.receding = snapshot.receding;
        self.state = snapshot.state;
        self.note_arm();
        self.note_breach();
        self.measure_clearances();
        self.look_ahead()?;
        self.give_clearances();
        self.sensors.restore(&snapshot.sensors);
        Ok(())
    }

    /// Returns to the initial state; tick count, hash and the sensors' sequence numbers continue.
    fn reset(&mut self) -> Result<(), SimulationError> {
        let Some(initial) = self.initial.take() else { return Ok(()) };
        let (tick, hash) = (self.state.tick, self.state.hash);
        let mut sensors = core::mem::take(&mut self.sensors);
        let restored = self.restore(&initial);
        sensors.reset();
        self.sensors = sensors;
        self.initial = Some(initial);
        self.state.tick = tick;
        self.state.hash = hash;
        restored
    }
}

/// Returns the components of a vector.
fn numbers(vector: &Vector3<f64>) -> [f64; 3] {
    [vector.x, vector.y, vector.z]
}
