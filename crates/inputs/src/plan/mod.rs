//! Finds the cheapest physics settings whose measured errors meet a scene's tolerance.
//!
//! The errors and costs of the standard tool come from `table.csv`, which `trabecula-lab chart physics`
//! measures and writes as `physics-plan.csv`; a test compares part of it with a fresh measurement. Those of
//! another tool are measured when a scene first needs them ([`Table::of`]).

pub mod check;
mod choice;
mod load;
pub mod measure;
mod model_error;
mod own;
pub mod reference;
pub mod table;

pub use choice::{resolve, resolve_by};
pub use load::{GENTLE_N, Load, MOST_TENDON_FRICTION, Pull, RAMPED_N, is_standard_tool};
pub use model_error::ModelError;
pub use own::{OwnTool, Table};
pub use table::{Beam, Row, Settings, write};

use ipc_types::scene::Scene;

use crate::failure::Failure;
use crate::scenes::SceneSource;

/// The measured table of this build.
pub const TABLE: &str = include_str!("table.csv");

/// Loads a scene and resolves its tolerance; also returns the choice as text.
///
/// # Errors
/// Bad input: an invalid scene, or a tolerance that no settings meet.
pub fn load_scene(source: &SceneSource) -> Result<(Scene, Option<String>), Failure> {
    let mut scene = source.load()?;
    let choice = resolve(&mut scene, &source.text()?).map_err(|failure| failure.of(source))?;
    Ok((scene, choice.map(|choice| choice.text())))
}
