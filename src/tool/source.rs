//! Input of `trabecula tool show`: a scene or a tool file.

use std::fmt::{self, Display, Formatter};
use std::path::Path;

use ipc_types::scene::{Scene, ToolDescription};
use ipc_types::text_file;

use crate::failure::Failure;
use crate::scenes::{BuiltIn, SceneSource};

/// A scene, either given or built around the tool of a file.
#[derive(Debug)]
pub struct ToolSource {
    /// The scene.
    pub scene: Scene,
    name: String,
}

impl ToolSource {
    /// Reads a scene or a tool file, which has a `[tube]`; default: the built-in femur with the standard
    /// tool.
    pub fn load(file: Option<&Path>) -> Result<ToolSource, Failure> {
        if let Some(file) = file
            && let Ok(text) = text_file::read(file)
            && text.parse::<toml::Table>().is_ok_and(|table| table.contains_key("tube"))
        {
            let tool = ToolDescription::parse(&text, file).map_err(Failure::bad_input)?;
            let mut scene = BuiltIn::FreeSpace.scene()?;
            scene.manipulator.tool = Some(tool);
            return Ok(ToolSource { scene, name: foreign_text::foreign_path(file) });
        }
        let source = SceneSource::new(file, BuiltIn::Femur);
        Ok(ToolSource { scene: source.load()?, name: source.to_string() })
    }
}

impl Display for ToolSource {
    fn fmt(&self, f: &mut Formatter<'_>) -> fmt::Result {
        f.write_str(&self.name)
    }
}
