//! Loads and checks scenes, volumes and logs for every command, with uniform error messages.
//!
//! **Boundary:** opens the files that a scene or a log names, and the user's cache of volumes; starts no
//! process, prints nothing, and knows nothing about sessions. Used by the program (`trabecula`) and the
//! in-process simulator (`sim`). **Invariant:** whatever is refused here is refused before anything is
//! written, with the exit code of its [`failure::Failure`].
//!
//! | module | contents |
//! |---|---|
//! | [`failure`] | how a command fails: a message and an exit code |
//! | [`scenes`] | built-in scenes, scene files, settings of the command line |
//! | [`plan`] | the cheapest settings that meet a scene's tolerance |
//! | [`volume_source`], [`suspicions`], [`cache`] | volumes, warnings about them, and their cache |
//! | [`feasibility`] | impossible and improbable settings of a checked scene |
//! | [`measurements`] | measured files: CSV, Parquet, MCAP, rosbag2 |
//! | [`log`] | a log with its scene and volume, and where it does not match this build |

pub mod cache;
pub mod failure;
pub mod feasibility;
pub mod log;
pub mod measurements;
pub mod plan;
pub mod scenes;
mod structure_files;
pub mod suspicions;
pub mod text;
pub mod volume_source;
