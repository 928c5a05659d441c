//! Scenes, volumes and logs as every command takes them: found, read, checked, with one wording for what is
//! wrong.
//!
//! **Boundary:** it opens the files that a scene or a log names, and the user's cache of volumes; it starts
//! no part, prints nothing, and knows no session. The program (`trabecula`) and the simulator in one process
//! (`sim`) stand on it. **Invariant:** what is refused here is refused before anything is written, with the
//! exit code that its [`failure::Failure`] carries.
//!
//! | module | what it holds |
//! |---|---|
//! | [`failure`] | how a command fails: a message and an exit code |
//! | [`scenes`] | built-in scenes, scene files, settings of the command line |
//! | [`plan`] | the cheapest settings that meet a scene's tolerance |
//! | [`volume_source`], [`suspicions`], [`cache`] | a scene's volume; what looks wrong about it; volumes that take long, kept |
//! | [`feasibility`] | what of a checked scene cannot be, or is most likely a mistake |
//! | [`log`] | a log with its scene and volume, and where it does not match this build |

pub mod cache;
pub mod failure;
pub mod feasibility;
pub mod log;
pub mod plan;
pub mod scenes;
pub mod suspicions;
pub mod text;
pub mod volume_source;
