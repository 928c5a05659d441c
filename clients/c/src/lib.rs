//! Clients of a running session: controllers and observers in any language.
//!
//! A controller in Rust is one method and one call:
//!
//! ```no_run
//! use trabecula_client::{Command, State, TENDON_SERVO_JF};
//!
//! fn main() -> Result<(), trabecula_client::ClientError> {
//!     trabecula_client::run(|_: &State, command: &mut Command| {
//!         command.tendon_mode = TENDON_SERVO_JF;
//!         command.tendon_force_n[0] = 5.0;
//!     })
//! }
//! ```
//!
//! [`Client`] offers everything else: frames, volume, run control, events. [`ffi`] is the same interface for
//! C and, through C, for all other languages; [`bindings`] generates the C header and the Python declarations
//! from the messages.

pub mod bindings;
mod client;
mod error;
pub mod ffi;
mod frames;
mod run;

pub use client::{Client, Connection, Info};
pub use error::ClientError;
pub use frames::{FrameView, VolumeView};
pub use ipc_types::messages::*;
pub use run::{Controller, run, run_as};
