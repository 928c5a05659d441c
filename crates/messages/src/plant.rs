//! The controlled system: a world that latched commands step from one state to the next.

use crate::{ControllerIndex, Latched, SensorReading, State};

/// x_{k+1} = step(x_k, u_k) and nothing else: no clock, no randomness, no I/O.
///
/// The hub, replays and benches drive any plant; `simulation::Simulation` is the real one.
pub trait Plant {
    /// Why a tick failed, or a keyframe could not be written or read.
    type Error: core::fmt::Display;

    /// x_k: the state after the last tick.
    fn state(&self) -> &State;

    /// Steps the plant with u_k = `latched`.
    ///
    /// # Errors
    /// The plant rejects the tick and must not be used any more.
    fn step(&mut self, latched: &Latched) -> Result<(), Self::Error>;

    /// Voxels that the last tick removed, by linear index.
    fn removed(&self) -> &[u32];

    /// Voxels removed before tick 0, by linear index, ascending.
    fn predrilled(&self) -> &[u32];

    /// Readings of sensors that arrive with the present state.
    fn readings(&self) -> &[SensorReading] {
        &[]
    }

    /// Parts of the last tick's commands that could not be followed.
    fn refusals(&self) -> &[Refusal];

    /// Voxels that the last tick should have cut, but for which there was no memory.
    fn uncut_voxels(&self) -> usize {
        0
    }

    /// Contacts that the last tick found and did not solve, because there are more than it has room for.
    fn left_out_contacts(&self) -> usize {
        0
    }

    /// The part of the arm that was found to have entered bone in the last tick.
    fn arm_entry(&self) -> Option<&ArmEntry> {
        None
    }

    /// The flexure farthest past its stop after the last tick, if the tool's model is not valid while one is.
    fn invalid_flexure(&self) -> Option<PastStop> {
        None
    }

    /// Takes the memory that the next tick may need. Called between ticks; changes no result.
    fn make_room(&mut self) {}

    /// Writes what a later run needs to continue bit for bit; returns its length in bytes.
    ///
    /// # Errors
    /// The state does not fit into `buffer`.
    fn write_keyframe(&self, buffer: &mut [u8]) -> Result<usize, Self::Error>;

    /// Continues from what [`Plant::write_keyframe`] wrote. After an error the plant must not be used.
    ///
    /// # Errors
    /// Not a keyframe, or from another scene.
    fn restore_keyframe(&mut self, keyframe: &[u8]) -> Result<(), Self::Error>;
}

/// A part of the arm that has entered bone, where nothing collides.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct ArmEntry {
    /// Which link, holder or shaft.
    pub part: &'static str,
    /// How far bone reaches into it, m.
    pub depth_m: f64,
}

/// A flexure past its stop, where the model of the tool is not valid.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct PastStop {
    /// The model, as scenes name it.
    pub model: &'static str,
    /// Its place in [`State::joint_position_rad`].
    pub flexure: usize,
    /// How far it is past its stop, rad.
    pub excess_rad: f64,
}

/// Part of a valid command that the plant could not follow (an unreachable goal). That part, tendon or arm,
/// is unchanged; the command's other parts take effect. Or an arm motion that was accepted but given up
/// later.
#[derive(Debug, Clone, PartialEq)]
pub struct Refusal {
    /// The controller that sent it.
    pub controller: ControllerIndex,
    /// Sequence number of the command.
    pub sequence: u64,
    /// Reason.
    pub reason: String,
    /// The command was accepted first: the arm gave up its motion, or stopped a joint, on the way.
    pub stopped_later: bool,
}
