//! `trabecula tool show [SCENE]`: the dimensions of a scene's tool.

use std::path::PathBuf;

use clap::Subcommand;

use crate::failure::Failure;
use crate::say::Figures;
use crate::scenes::{BuiltIn, SceneSource};
use crate::tool::{Dimension, dimensions, rounded};

/// What to do with the tool.
#[derive(Debug, Subcommand)]
pub enum ToolCommand {
    /// Print its dimensions.
    Show {
        /// Scene file; default: the built-in femur, whose tool is the standard one.
        scene: Option<PathBuf>,
        /// How they are printed.
        #[command(flatten)]
        figures: Figures,
    },
}

/// Runs the command.
///
/// # Errors
/// An invalid scene (2).
pub fn run(command: &ToolCommand) -> Result<(), Failure> {
    let ToolCommand::Show { scene, figures } = command;
    let source = SceneSource::new(scene.as_deref(), BuiltIn::Femur);
    let dimensions = dimensions(&source.load()?)?;
    let line = |it: &Dimension| format!("\n{:<17} {:>7}  {}", it.name, rounded(it.value), it.text);
    figures.say(
        || format!("the tool of {source}{}", dimensions.iter().map(line).collect::<String>()),
        || {
            dimensions
                .iter()
                .map(|it| (it.name.to_owned(), it.value.into()))
                .collect::<serde_json::Map<_, _>>()
                .into()
        },
    );
    Ok(())
}
