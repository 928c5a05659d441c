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
    /// A scene, a volume or a log is refused, in the words of the command that checks it.
    #[error("{}", .0.message)]
    Input(Failure),
    /// A mesh of the arm that frames show.
    #[error(transparent)]
    ArmMesh(#[from] ArmMeshError),
    /// A built-in controller's calibration cannot be used.
    #[error(transparent)]
    Calibration(#[from] CalibrationError),
    /// The physics fails.
    #[error("tick {tick}: {cause}")]
    Physics {
        /// Tick.
        tick: Tick,
        /// Its reason.
        cause: SimulationError,
    },
    /// The caller asked to give up.
    #[error("tick {tick}: given up, as was asked for")]
    GivenUp {
        /// Tick that was reached.
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
    /// Not one command for each controller that the caller drives.
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
    /// A snapshot of another scene.
    #[error(
        "the snapshot is of another scene or of other driven controllers; expected one of a simulation of the same"
    )]
    OtherScene,
    /// A simulation that is being recorded cannot jump.
    #[error("a recording goes on into {}: close it before the simulation goes to another state", .path.display())]
    Recording {
        /// Its log.
        path: PathBuf,
    },
    /// A recording begins with tick 0.
    #[error(
        "a recording begins at tick 0, and the simulation is at tick {tick}: reset it first, or record a new one"
    )]
    RecordingLate {
        /// Its tick.
        tick: Tick,
    },
    /// The scene has no X-ray.
    #[error("the scene has no X-ray: a picture needs `[drr]` and `[volume]`")]
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
        /// Tick asked for.
        tick: Tick,
        /// The log.
        path: PathBuf,
        /// Its first tick.
        first: Tick,
        /// Its last tick.
        last: Tick,
    },
    /// The physics of this build leads to another state than the log holds.
    #[error("{}: {divergence}", .path.display())]
    Differs {
        /// The log.
        path: PathBuf,
        /// Where.
        divergence: Divergence,
    },
    /// A built-in controller cannot go on from the middle of this log.
    #[error("{}: controller `{controller}` cannot go on from here, because {reason}: drive it yourself", .path.display())]
    NoContinuation {
        /// The log.
        path: PathBuf,
        /// Name of the controller.
        controller: String,
        /// Why.
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
        "the simulation belongs to the process that made it: make one in each child, or start children by `spawn`"
    )]
    Forked,
    /// A simulation's thread has ended.
    #[error("the simulation's thread has ended after a defect in it")]
    Gone,
    /// Not one of something for each simulation of a batch.
    #[error("{given} {what}, expected {expected}: one for each simulation of the batch")]
    Count {
        /// What was given.
        what: &'static str,
        /// How many.
        given: usize,
        /// Simulations.
        expected: usize,
    },
}

impl SimError {
    /// Whether it is the machine's fault, such as too little memory or a full disk, or a defect: the same run
    /// may work elsewhere.
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

    /// Bug: a sweep kept a row of a run that had no memory, and never made it again.
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
