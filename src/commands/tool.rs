//! `trabecula tool show [SCENE]`: the dimensions of a scene's tool.

use std::path::PathBuf;

use clap::Subcommand;

use crate::failure::Failure;
use crate::scenes::{BuiltIn, SceneSource};
use crate::tool::{dimensions, rounded};

/// What to do with the tool.
#[derive(Debug, Subcommand)]
pub enum ToolCommand {
    /// Print its dimensions.
    Show {
        /// Scene file; default: the built-in femur, whose tool is the standard one.
        scene: Option<PathBuf>,
        /// As JSON.
        #[arg(long)]
        json: bool,
    },
}

/// Runs the command.
///
/// # Errors
/// An invalid scene (2).
pub fn run(command: &ToolCommand) -> Result<(), Failure> {
    let ToolCommand::Show { scene, json } = command;
    let source = SceneSource::new(scene.as_deref(), BuiltIn::Femur);
    let dimensions = dimensions(&source.load()?)?;
    if *json {
        let values = dimensions.iter().map(|it| (it.name.to_owned(), it.value.into()));
        say!("{}", serde_json::Value::Object(values.collect()));
        return Ok(());
    }
    say!("the tool of {source}");
    for dimension in dimensions {
        say!("{:<17} {:>7}  {}", dimension.name, rounded(dimension.value), dimension.text);
    }
    Ok(())
}
