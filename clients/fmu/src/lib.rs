//! Scenes as Functional Mock-up Units (FMI 2.0 and 3.0, co-simulation), for Simulink, Modelica tools and
//! other masters.
//!
//! An FMU holds this library and the scene with its files. Inputs are the fields of the commands that the
//! caller's controllers send, outputs the fields of the state, sensor readings and X-ray frames; parameters
//! are keys of the scene. A step is a number of whole ticks with the same commands, so a run has the hash of
//! a lockstep run with the same commands. FMU states are snapshots, serialised ones keyframes.
//!
//! **Boundary:** everything but [`ffi`] is safe code above [`sim`]. An instance and an FMU state are numbers
//! in tables, not addresses, so a wrong or freed one is detected. No panic crosses the interface.
//!
//! | module | contents |
//! |---|---|
//! | `variables` | the variables of a scene, from the tables of the messages |
//! | `description` | `modelDescription.xml` |
//! | [`export`] | the archive |
//! | `instance` | one instance: values, steps, states |
//! | [`ffi`] | the C functions of both versions |
//! | [`master`] | runs the FMUs of others |

mod archive;
mod description;
mod error;
pub mod export;
pub mod ffi;
mod instance;
pub mod master;
mod variables;

pub use archive::Archive;
pub use description::Version;
pub use error::FmuError;
