//! The state as a vector of numbers, for linear models and estimators.
//!
//! The vector holds what a tick integrates: coordinates of mount and tool with their rates, the tendons'
//! friction, elastic joints, the arm's joints, the drives of tube and burr. It leaves out what a linear model
//! keeps fixed (bone and its recession, free bodies, goals of motions in progress), what only warms a solver
//! up, the hash chain, and the sensors' delays. Those stay as they are when a vector is set.
//!
//! Coordinates of the tool by model: `constant_curvature` the bend; `modal` the amplitudes of its moment
//! modes, whose elastic energy is half their square; `planar` the angle of each flexure; `spatial` bend,
//! lateral bend and torsion of each; `full` also its two shears and its extension.

use messages::{MAX_ARM_JOINTS, MAX_TENDONS};
use thiserror::Error;
use xxhash_rust::xxh3::Xxh3;
use zerocopy::IntoBytes;

use super::{BurrDriveState, Simulation, SimulationError, SimulationSnapshot, TubeRefusal};
use crate::arm::{AxisState, ComplianceState};
use crate::manipulator::{ManipulatorModel, ManipulatorState, Rung, Wrench};

const AXES: [&str; 3] = ["x", "y", "z"];
/// Parts of an axis's state: position and its derivatives.
const ORDERS: [&str; 3] = ["position", "velocity", "acceleration"];

/// Why a vector is refused.
#[derive(Debug, Clone, PartialEq, Error)]
pub enum StateVectorError {
    /// The vector has another number of entries.
    #[error("the state vector has {given} entries, expected {expected}")]
    Length {
        /// Entries given.
        given: usize,
        /// Entries of this scene's vector.
        expected: usize,
    },
    /// An entry is not finite or out of range.
    #[error("state `{name}` is {given}, expected {} to {}", .range[0], .range[1])]
    OutOfRange {
        /// Name of the entry.
        name: String,
        /// Value given.
        given: f64,
        /// Allowed values.
        range: [f64; 2],
    },
}

/// One entry of the state vector.
#[derive(Debug, Clone, PartialEq)]
pub struct StateEntry {
    /// Name, such as `flexure_3.bend`.
    pub name: String,
    /// Unit: `m`, `rad`, `m/s`, and so on; `1` for a number, `sqrt(J)` for the amplitude of a moment mode.
    pub unit: &'static str,
    /// Allowed values.
    pub range: [f64; 2],
    /// Difference from which derivatives are taken: small enough for the model's curvature, and 1e5 times the
    /// rounding of the entry's usual values or more.
    pub difference: f64,
    slot: Slot,
}

/// Where an entry is stored.
#[derive(Debug, Clone, Copy, PartialEq)]
enum Slot {
    /// Coordinate of mount and tool.
    Position(usize),
    /// Its rate.
    Velocity(usize),
    /// Sliding state of a tendon.
    Sliding(usize),
    /// Deflection of an elastic joint of the arm.
    Deflection(usize),
    /// Its rate.
    DeflectionRate(usize),
    /// Wrench of the last step on the flange, which loads elastic joints one tick later.
    FlangeForce(usize),
    /// Its torque.
    FlangeTorque(usize),
    /// Joint of the arm, by [`ORDERS`].
    Joint(usize, usize),
    /// Axis of the tube's drive, by [`ORDERS`].
    Tube(usize, usize),
    /// Cutting torque of the last tick, which loads the motor in the next one.
    BurrTorque,
    /// Side force of the last tick, which acts in the next one.
    SideForce(usize),
    /// Its torque about the burr's centre.
    SideTorque(usize),
    /// Wind-up of a compliant drive shaft.
    WindUp,
    /// Speed of the burr on a compliant drive shaft.
    BurrSpeed,
}

impl StateEntry {
    fn new(name: String, unit: &'static str, slot: Slot) -> StateEntry {
        let difference = match unit {
            "m" => 1e-8,
            "m/s" => 1e-6,
            "rad" | "sqrt(J)" => 1e-7,
            "1" | "N m" => 1e-6,
            _ => 1e-5,
        };
        let range = match slot {
            Slot::Sliding(_) => [-1.0, 1.0],
            _ => [f64::MIN, f64::MAX],
        };
        StateEntry { name, unit, range, difference, slot }
    }

    /// Returns whether the entry is a rate or an acceleration that a drive's plan of limited jerk determines.
    /// A tick has no derivative by it where a plan begins or ends.
    pub fn is_of_plan(&self) -> bool {
        matches!(self.slot, Slot::Joint(1.., _) | Slot::Tube(1.., _))
    }

    /// Returns whether the entry belongs to the arm's joints, which cannot be changed while the arm follows a
    /// path.
    pub fn is_of_arm_joint(&self) -> bool {
        matches!(self.slot, Slot::Joint(..))
    }
}

impl Simulation<'_> {
    /// Returns the entries of the state vector, in order. They depend on the scene alone.
    pub fn state_entries(&self) -> Vec<StateEntry> {
        let mut entries = Vec::new();
        let mut push = |name: String, unit, slot| entries.push(StateEntry::new(name, unit, slot));
        let coordinates = self.coordinates();
        for (index, (name, [unit, _])) in coordinates.iter().enumerate() {
            push(name.clone(), unit, Slot::Position(index));
        }
        for (index, (name, [_, unit])) in coordinates.iter().enumerate() {
            push(format!("{name}.rate"), unit, Slot::Velocity(index));
        }
        for tendon in 0..self.manipulator.tendon_count() {
            push(format!("tendon_{tendon}.sliding"), "1", Slot::Sliding(tendon));
        }
        let geometry = &self.arm.parameters().geometry;
        let (joints, units) = match (geometry.moves(), geometry.turns()) {
            (false, _) => (0, [""; 3]),
            (true, false) => (3, ["m", "m/s", "m/s2"]),
            (true, true) => (geometry.joints(), ["rad", "rad/s", "rad/s2"]),
        };
        for (order, unit) in units.into_iter().enumerate() {
            for joint in 0..joints {
                push(format!("arm_joint_{joint}.{}", ORDERS[order]), unit, Slot::Joint(order, joint));
            }
        }
        if self.compliance.is_some() {
            for joint in 0..joints {
                push(format!("arm_joint_{joint}.deflection"), "rad", Slot::Deflection(joint));
            }
            for joint in 0..joints {
                push(format!("arm_joint_{joint}.deflection.rate"), "rad/s", Slot::DeflectionRate(joint));
            }
            for (k, axis) in AXES.iter().enumerate() {
                push(format!("flange.force.{axis}"), "N", Slot::FlangeForce(k));
            }
            for (k, axis) in AXES.iter().enumerate() {
                push(format!("flange.torque.{axis}"), "N m", Slot::FlangeTorque(k));
            }
        }
        if self.tube.is_some() {
            let units = [["m", "rad"], ["m/s", "rad/s"], ["m/s2", "rad/s2"]];
            for (order, units) in units.iter().enumerate() {
                for (axis, name) in ["deployed", "roll"].iter().enumerate() {
                    push(format!("tube.{name}.{}", ORDERS[order]), units[axis], Slot::Tube(order, axis));
                }
            }
        }
        if self.burr_drive.is_modelled() {
            push("burr.torque".to_owned(), "N m", Slot::BurrTorque);
        }
        if self.burr_drive.side_force {
            for (k, axis) in AXES.iter().enumerate() {
                push(format!("burr.side_force.{axis}"), "N", Slot::SideForce(k));
            }
        }
        if self.has_side_torque() {
            for (k, axis) in AXES.iter().enumerate() {
                push(format!("burr.side_torque.{axis}"), "N m", Slot::SideTorque(k));
            }
        }
        if self.burr_drive.torsion.is_some() {
            push("burr.wind_up".to_owned(), "rad", Slot::WindUp);
            push("burr.speed".to_owned(), "rad/s", Slot::BurrSpeed);
        }
        entries
    }

    /// Returns the coordinates of mount and tool in the order of [`ManipulatorState::position`], with the
    /// units of their values and rates. Entries beyond the tool's own are left out.
    fn coordinates(&self) -> Vec<(String, [&'static str; 2])> {
        const LENGTH: [&str; 2] = ["m", "m/s"];
        const ANGLE: [&str; 2] = ["rad", "rad/s"];
        let mut all: Vec<_> = AXES.iter().map(|axis| (format!("mount.{axis}"), LENGTH)).collect();
        let kinds: &[(&str, [&str; 2])] = match self.manipulator.rung() {
            Rung::ConstantCurvature => {
                all.push(("bend".to_owned(), ANGLE));
                return all;
            }
            Rung::Modal => {
                let unit = ["sqrt(J)", "sqrt(J)/s"];
                all.extend(
                    (0..self.manipulator.parameters().moment_modes).map(|m| (format!("mode_{m}"), unit)),
                );
                return all;
            }
            Rung::Planar => &[("bend", ANGLE)],
            Rung::Spatial => &[("bend", ANGLE), ("lateral_bend", ANGLE), ("torsion", ANGLE)],
            Rung::Full => &[
                ("shear_toward", LENGTH),
                ("shear_across", LENGTH),
                ("extension", LENGTH),
                ("bend", ANGLE),
                ("lateral_bend", ANGLE),
                ("torsion", ANGLE),
            ],
        };
        for joint in 0..self.manipulator.joint_count() {
            all.extend(kinds.iter().map(|(kind, units)| (format!("flexure_{joint}.{kind}"), *units)));
        }
        all
    }

    /// Returns the present value of each of [`Simulation::state_entries`].
    pub fn state_vector(&self) -> Vec<f64> {
        let mut parts = Parts::of(self);
        self.state_entries().iter().map(|entry| *parts.value(entry.slot)).collect()
    }

    /// Sets the state to these values of [`Simulation::state_entries`]; everything else stays as it is. The
    /// state message shows the new pose. If any bit is new, the hash chain takes in the vector, so a state to
    /// which no run leads has a hash that no run has.
    ///
    /// # Errors
    /// [`StateVectorError`]; or joints of the arm differ although it follows a path. Nothing has changed
    /// then.
    pub fn set_state_vector(&mut self, vector: &[f64]) -> Result<(), SimulationError> {
        let entries = self.state_entries();
        check(&entries, vector)?;
        let mut parts = Parts::of(self);
        let mut changed = Changed::default();
        for (entry, value) in entries.iter().zip(vector) {
            let present = parts.value(entry.slot);
            if present.to_bits() != value.to_bits() {
                *present = *value;
                changed.note(entry.slot);
            }
        }
        if !changed.any {
            return Ok(());
        }
        self.take(parts, changed)?;
        self.show_pose();
        self.hash_in(vector);
        Ok(())
    }

    /// Restores a snapshot of a simulation whose scene differs in parameters by which no state is stored
    /// (`Scene::state_mismatch`): the state, the bone and motions in progress are the snapshot's, and so is
    /// what the last tick left for the next one (contact forces, recession of bone); what follows from
    /// parameters is this scene's. The hash chain takes in the state vector, because no run leads from the
    /// one scene to the other.
    ///
    /// # Errors
    /// The snapshot does not fit.
    pub fn restore_of_other_truth(&mut self, snapshot: &SimulationSnapshot) -> Result<(), SimulationError> {
        self.restore(snapshot)?;
        // What bounds the energy of free motion is the other tool's.
        let mut tool = self.manipulator.snapshot();
        let (sliding, wrench) = (tool.sliding(), *tool.flange_wrench());
        tool.displace(&sliding, &wrench);
        self.manipulator.restore(&tool);
        self.hash_in(&self.state_vector());
        Ok(())
    }

    /// Extends the hash chain with a state vector.
    fn hash_in(&mut self, vector: &[f64]) {
        let mut hasher = Xxh3::new();
        hasher.update(self.state.hash.as_bytes());
        hasher.update(vector.as_bytes());
        let hash = hasher.digest128();
        self.state.hash = [hash as u64, (hash >> 64) as u64];
    }

    fn take(&mut self, parts: Parts, changed: Changed) -> Result<(), SimulationError> {
        let Parts { mut tool, sliding, wrench, joints, elastic, tube, burr } = parts;
        // The only part that can be refused comes first.
        if changed.joints {
            self.arm.displace(&joints)?;
        }
        if let Some(drive) = &mut self.tube
            && changed.tube
        {
            drive.displace(&tube).map_err(TubeRefusal::from)?;
            self.manipulator.set_deployed(drive.deployed_m());
        }
        if let Some(compliance) = &mut self.compliance {
            compliance.restore(&elastic);
        }
        tool.displace(&sliding, &wrench);
        if changed.joints || changed.tube || changed.elastic {
            let base = self.arm_base();
            tool.base = self.tube.as_ref().map_or(base, |tube| tube.carried(&base));
        }
        self.manipulator.restore(&tool);
        if changed.shape {
            self.manipulator.update_take_up();
        }
        self.burr_drive.state = burr;
        Ok(())
    }
}

fn check(entries: &[StateEntry], vector: &[f64]) -> Result<(), StateVectorError> {
    if vector.len() != entries.len() {
        return Err(StateVectorError::Length { given: vector.len(), expected: entries.len() });
    }
    // NaN and infinities are in no range.
    let outside = |(entry, value): &(&StateEntry, &f64)| !(entry.range[0]..=entry.range[1]).contains(value);
    match entries.iter().zip(vector).find(outside) {
        None => Ok(()),
        Some((StateEntry { name, range, .. }, given)) => {
            Err(StateVectorError::OutOfRange { name: name.clone(), given: *given, range: *range })
        }
    }
}

/// The groups of entries that differ from the present state.
#[derive(Debug, Clone, Copy, Default)]
struct Changed {
    any: bool,
    shape: bool,
    joints: bool,
    tube: bool,
    elastic: bool,
}

impl Changed {
    fn note(&mut self, slot: Slot) {
        self.any = true;
        self.shape |= matches!(slot, Slot::Position(_));
        self.joints |= matches!(slot, Slot::Joint(..));
        self.tube |= matches!(slot, Slot::Tube(..));
        self.elastic |= matches!(slot, Slot::Deflection(_) | Slot::DeflectionRate(_));
    }
}

/// Copies of everything that holds entries.
struct Parts {
    tool: ManipulatorState,
    sliding: [f64; MAX_TENDONS],
    wrench: Wrench,
    joints: AxisState<MAX_ARM_JOINTS>,
    elastic: ComplianceState,
    tube: AxisState<2>,
    burr: BurrDriveState,
}

impl Parts {
    fn of(simulation: &Simulation) -> Parts {
        let tool = simulation.manipulator.snapshot();
        Parts {
            sliding: tool.sliding(),
            wrench: *tool.flange_wrench(),
            tool,
            joints: simulation.arm.joint_state(),
            elastic: simulation.compliance.as_ref().map(|it| *it.state()).unwrap_or_default(),
            tube: simulation.tube.as_ref().map_or(AxisState::at_rest([0.0; 2]), |tube| *tube.at()),
            burr: simulation.burr_drive.state,
        }
    }

    fn value(&mut self, slot: Slot) -> &mut f64 {
        match slot {
            Slot::Position(index) => &mut self.tool.position[index],
            Slot::Velocity(index) => &mut self.tool.velocity[index],
            Slot::Sliding(tendon) => &mut self.sliding[tendon],
            Slot::Deflection(joint) => &mut self.elastic.deflection_rad[joint],
            Slot::DeflectionRate(joint) => &mut self.elastic.rate_rad_s[joint],
            Slot::FlangeForce(k) => &mut self.wrench.force_n[k],
            Slot::FlangeTorque(k) => &mut self.wrench.torque_nm[k],
            Slot::Joint(order, joint) => &mut of_order(&mut self.joints, order)[joint],
            Slot::Tube(order, axis) => &mut of_order(&mut self.tube, order)[axis],
            Slot::BurrTorque => &mut self.burr.torque_nm,
            Slot::SideForce(k) => &mut self.burr.side_force_n[k],
            Slot::SideTorque(k) => &mut self.burr.side_torque_nm[k],
            Slot::WindUp => &mut self.burr.shaft.wind_up_rad,
            Slot::BurrSpeed => &mut self.burr.shaft.speed_rad_per_s,
        }
    }
}

/// Returns position, velocity or acceleration of axes, by [`ORDERS`].
fn of_order<const N: usize>(axes: &mut AxisState<N>, order: usize) -> &mut [f64; N] {
    match order {
        0 => &mut axes.position,
        1 => &mut axes.velocity,
        _ => &mut axes.acceleration,
    }
}
