use std::path::PathBuf;

use controllers::CalibrationError;
use hub::command_check::CommandRefusal;
use inputs::failure::Failure;
use ipc_types::arm_meshes::ArmMeshError;
use messages::Tick;
use output_file::OutputError;
use run_log::LogError;
use run_log::difference::Divergence;
use simulation::SimulationError;
use thiserror::Error;
use xray::DrrError;

/// Why a simulation cannot be built, stepped, rendered, recorded or taken from a log.
#[derive(Debug, Error)]
pub enum SimError {
    /// A scene, a volume or a log is refused, with the message of the command that checks it.
    #[error("{}", .0.message)]
    Input(Failure),
    /// A mesh of the arm shown in frames cannot be used.
    #[error(transparent)]
    ArmMesh(#[from] ArmMeshError),
    /// A built-in controller's calibration cannot be used.
    #[error(transparent)]
    Calibration(#[from] CalibrationError),
    /// The physics failed.
    #[error("tick {tick}: {cause}")]
    Physics {
        /// Tick.
        tick: Tick,
        /// Reason.
        cause: SimulationError,
    },
    /// The caller requested an abort.
    #[error("tick {tick}: aborted on request")]
    GivenUp {
        /// Tick reached.
        tick: Tick,
    },
    /// A command is refused; nothing has changed.
    #[error("tick {tick}: controller `{controller}`: {cause}")]
    Refused {
        /// Name of the controller.
        controller: String,
        /// Tick.
        tick: Tick,
        /// Reason.
        cause: CommandRefusal,
    },
    /// The number of commands differs from that of the controllers that the caller drives.
    #[error("{given} commands, expected one for each controller that you drive: {}", listed(.driven))]
    CommandCount {
        /// Commands given.
        given: usize,
        /// Names of the driven controllers.
        driven: Vec<String>,
    },
    /// The scene has no such controller.
    #[error("no controller `{name}`, expected one of the scene's: {}", listed(.scene))]
    NoController {
        /// Name given.
        name: String,
        /// The scene's controllers.
        scene: Vec<String>,
    },
    /// A state vector or a keyframe cannot be restored; nothing has changed.
    #[error("restored state: {0}")]
    StateVector(SimulationError),
    /// The bytes of a simulation or snapshot cannot be written or used.
    #[error("simulation as bytes: {0}")]
    Packed(String),
    /// No such input or output of a linear model.
    #[error("{kind} `{name}`: {reason}")]
    NoSignal {
        /// `input` or `output`.
        kind: &'static str,
        /// Name given.
        name: String,
        /// Reason.
        reason: String,
    },
    /// A snapshot of another scene.
    #[error(
        "the snapshot belongs to another scene or to other driven controllers; expected one of a simulation \
         with the same"
    )]
    OtherScene,
    /// A snapshot of a scene whose `[truth]` differs in a key that determines what the state means.
    #[error("the state of the snapshot does not fit this scene: `{key}` differs; use the same value in both")]
    OtherTruth {
        /// The key.
        key: &'static str,
    },
    /// A simulation that is being recorded cannot jump to another state.
    #[error(
        "still recording into {}: close the recording before moving the simulation to another state",
        .path.display()
    )]
    Recording {
        /// Its log.
        path: PathBuf,
    },
    /// A recording must begin at tick 0.
    #[error(
        "a recording begins at tick 0, but the simulation is at tick {tick}; reset it first, or record a new \
         one"
    )]
    RecordingLate {
        /// The simulation's tick.
        tick: Tick,
    },
    /// A log begins at the scene's own start, which this state is not.
    #[error(
        "no run of this scene begins in this state, taken from another `[truth]` or a state vector; reset \
         the simulation before recording"
    )]
    RecordingElsewhere,
    /// The scene has no X-ray.
    #[error("the scene has no X-ray: an image needs `[drr]` and `[volume]`")]
    NoXRay,
    /// The X-ray is refused.
    #[error("X-ray: {0}")]
    XRay(#[from] DrrError),
    /// A log cannot be read or written.
    #[error(transparent)]
    Log(#[from] LogError),
    /// A file cannot be written.
    #[error(transparent)]
    Output(#[from] OutputError),
    /// The scene cannot be written as text.
    #[error("the scene cannot be written as TOML: {0}")]
    SceneText(String),
    /// The log ends before the tick, or begins after it.
    #[error("tick {tick} is not in {}, whose ticks are {first} to {last}", .path.display())]
    NotInLog {
        /// Requested tick.
        tick: Tick,
        /// The log.
        path: PathBuf,
        /// Its first tick.
        first: Tick,
        /// Its last tick.
        last: Tick,
    },
    /// The physics of this build leads to a state that differs from the log's.
    #[error("{}: {divergence}", .path.display())]
    Differs {
        /// The log.
        path: PathBuf,
        /// The first difference.
        divergence: Divergence,
    },
    /// A built-in controller cannot continue from the middle of this log.
    #[error(
        "{}: controller `{controller}` cannot continue from here, because {reason}; drive it yourself",
        .path.display()
    )]
    NoContinuation {
        /// The log.
        path: PathBuf,
        /// Name of the controller.
        controller: String,
        /// Reason.
        reason: &'static str,
    },
    /// Threads cannot be started.
    #[error("{threads} threads cannot be started: {reason}")]
    Threads {
        /// Number of threads.
        threads: usize,
        /// The system's reason.
        reason: String,
    },
    /// A batch has no such simulation.
    #[error("no simulation {index} in the batch, which has {count}")]
    NoSimulation {
        /// Index given.
        index: usize,
        /// Simulations.
        count: usize,
    },
    /// A child of `fork` has none of the threads that hold the simulations.
    #[error(
        "the simulation belongs to the process that created it; create one in each child, or start children \
         with `spawn`"
    )]
    Forked,
    /// A simulation's thread has ended, most likely by a panic.
    #[error("the simulation's thread ended unexpectedly")]
    Gone,
    /// The number of items differs from the number of simulations of a batch.
    #[error("{given} {what}, expected {expected}: one for each simulation of the batch")]
    Count {
        /// The kind of items.
        what: &'static str,
        /// Number given.
        given: usize,
        /// Number of simulations.
        expected: usize,
    },
}

impl SimError {
    /// Returns whether the machine or a defect is the cause, such as too little memory or a full disk: the
    /// same run may succeed elsewhere.
    pub fn is_of_the_machine(&self) -> bool {
        match self {
            SimError::Log(_)
            | SimError::Output(_)
            | SimError::Recording { .. }
            | SimError::Threads { .. }
            | SimError::Gone => true,
            SimError::XRay(cause) => cause.is_of_the_machine(),
            SimError::Physics { cause, .. } => cause.is_of_the_machine(),
            _ => false,
        }
    }
}

impl From<Failure> for SimError {
    fn from(failure: Failure) -> SimError {
        SimError::Input(failure)
    }
}

fn listed(names: &[String]) -> String {
    if names.is_empty() { "none".to_owned() } else { format!("`{}`", names.join("`, `")) }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Regression: a sweep kept the row of a run that had run out of memory, and never repeated it.
    #[test]
    fn too_little_memory_is_no_property_of_a_run() {
        let memory = || DrrError::Memory { dims: [1; 3], bytes_each: 2, needed_bytes: 2, available_bytes: 1 };
        assert!(SimError::XRay(memory()).is_of_the_machine());
        assert!(SimError::XRay(DrrError::Frame { frame: 0, cause: Box::new(memory()) }).is_of_the_machine());
        let cause = SimulationError::Bone(simulation::bone::BoneError::Memory { bytes: 1 });
        assert!(SimError::Physics { tick: Tick(0), cause }.is_of_the_machine());
        assert!(
            !SimError::Physics { tick: Tick(0), cause: SimulationError::VolumeMissing }.is_of_the_machine()
        );
    }
}
