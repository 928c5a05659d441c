//! The controlled system: a world that latched commands step from one state to the next.

use std::sync::Arc;

use crate::{ControllerIndex, Latched, SensorReading, State, TipJacobian};

/// A deterministic system: x_{k+1} = step(x_k, u_k) and nothing else: no clock, no randomness, no I/O.
///
/// The hub, replays and benches drive any plant; `simulation::Simulation` is the real one.
pub trait Plant {
    /// Why a tick failed, or a keyframe could not be written or read.
    type Error: core::fmt::Display;

    /// Returns x_k, the state after the last tick.
    fn state(&self) -> &State;

    /// Steps the plant with u_k = `latched`.
    ///
    /// # Errors
    /// If the plant rejects the tick; it must not be used afterwards.
    fn step(&mut self, latched: &Latched) -> Result<(), Self::Error>;

    /// Returns the voxels that the last tick removed, by linear index.
    fn removed(&self) -> &[u32];

    /// Returns the voxels removed before tick 0, by linear index, ascending.
    fn predrilled(&self) -> &[u32];

    /// Returns the sensor readings that arrive with the present state.
    fn readings(&self) -> &[SensorReading] {
        &[]
    }

    /// Returns the tip's Jacobian at the present state, of a system that has one.
    fn tip_jacobian(&self) -> Option<TipJacobian> {
        None
    }

    /// Returns the parts of the last tick's commands that could not be followed.
    fn refusals(&self) -> &[Refusal];

    /// Returns the number of voxels that the last tick should have cut but could not: out of memory.
    fn uncut_voxels(&self) -> usize {
        0
    }

    /// Returns the number of contacts that the last tick found but did not solve, because it ran out of
    /// contact slots.
    fn left_out_contacts(&self) -> usize {
        0
    }

    /// Returns the part of the arm that was found to have entered bone in the last tick.
    fn arm_entry(&self) -> Option<&ArmEntry> {
        None
    }

    /// Returns where the tool was found in the last tick to have left the bone.
    fn breach(&self) -> Option<&Breach> {
        None
    }

    /// Returns the critical structures that the tool came close to or entered in the last tick.
    fn approaches(&self) -> &[Approach] {
        &[]
    }

    /// Returns the flexure farthest past its stop after the last tick, if that makes the tool's model
    /// invalid.
    fn invalid_flexure(&self) -> Option<PastStop> {
        None
    }

    /// Allocates the memory that the next tick may need. Called between ticks; changes no result.
    fn make_room(&mut self) {}

    /// Writes everything that a later run needs to continue bit for bit; returns its length in bytes.
    ///
    /// # Errors
    /// If the state does not fit into `buffer`.
    fn write_keyframe(&self, buffer: &mut [u8]) -> Result<usize, Self::Error>;

    /// Continues from a keyframe written by [`Plant::write_keyframe`]. After an error the plant must not be
    /// used.
    ///
    /// # Errors
    /// If it is not a keyframe, or comes from another scene.
    fn restore_keyframe(&mut self, keyframe: &[u8]) -> Result<(), Self::Error>;
}

/// A part of the arm that has entered bone, where there is no collision.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct ArmEntry {
    /// The link, holder or shaft.
    pub part: &'static str,
    /// How far bone reaches into it, m.
    pub depth_m: f64,
}

/// A part of the tool has left the bone elsewhere than through the hole that it came by.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Breach {
    /// `burr` or `tube`.
    pub part: &'static str,
    /// Point of its surface that is outside, world frame, m.
    pub place_m: [f64; 3],
    /// Unit vector from its axis to that point, world frame.
    pub direction: [f64; 3],
}

impl core::fmt::Display for Breach {
    fn fmt(&self, f: &mut core::fmt::Formatter<'_>) -> core::fmt::Result {
        let ([x, y, z], [u, v, w]) = (self.place_m.map(|x| x * 1e3), self.direction);
        let part = self.part;
        write!(
            f,
            "the {part} breached the bone at ({x:.1}, {y:.1}, {z:.1}) mm, toward ({u:.2}, {v:.2}, {w:.2})"
        )
    }
}

/// The tool has come closer to a critical structure than its margin, or has entered it.
#[derive(Debug, Clone, PartialEq)]
pub struct Approach {
    /// Index of the structure in the scene.
    pub index: usize,
    /// Its name.
    pub structure: Arc<str>,
    /// Whether the tool has entered it.
    pub has_entered: bool,
    /// Clearance, m; negative inside.
    pub clearance_m: f64,
    /// Part of the tool: `burr`, `tube` or `shaft`.
    pub part: &'static str,
    /// Centre of the part's sphere that is closest, world frame, m.
    pub place_m: [f64; 3],
    /// Whether this stops the arm.
    pub stops: bool,
}

impl core::fmt::Display for Approach {
    fn fmt(&self, f: &mut core::fmt::Formatter<'_>) -> core::fmt::Result {
        let (clearance_mm, [x, y, z]) = (self.clearance_m * 1e3, self.place_m.map(|x| x * 1e3));
        let what = if self.has_entered { "entered" } else { "came close to" };
        let stop = if self.stops { "; protective stop of the arm" } else { "" };
        let (part, name) = (self.part, &self.structure);
        write!(
            f,
            "the {part} {what} `{name}` at ({x:.1}, {y:.1}, {z:.1}) mm, clearance {clearance_mm:.2} mm{stop}"
        )
    }
}

/// A flexure past its stop, where the model of the tool is invalid.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct PastStop {
    /// The model, as scenes name it.
    pub model: &'static str,
    /// Its index in [`State::joint_position_rad`].
    pub flexure: usize,
    /// How far it is past its stop, rad.
    pub excess_rad: f64,
}

/// Part of a valid command that the plant could not follow (an unreachable goal), or an arm motion that was
/// accepted but aborted later. The part in question, tendon or arm, keeps its previous command; the command's
/// other parts take effect.
#[derive(Debug, Clone, PartialEq)]
pub struct Refusal {
    /// The controller that sent it.
    pub controller: ControllerIndex,
    /// Sequence number of the command.
    pub sequence: u64,
    /// Reason.
    pub reason: String,
    /// The command was accepted first: the arm later aborted its motion or stopped a joint.
    pub stopped_later: bool,
}
