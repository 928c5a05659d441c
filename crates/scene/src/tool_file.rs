//! `manipulator.file`: a file that describes a tool.
//!
//! It goes into the scene's table as `[manipulator.tool]` before parsing, so a [`Scene`](crate::Scene) holds
//! the tool itself, and so do its copies in the session and in the log.

use std::path::Path;

use toml::{Table, Value};

use crate::check::{self, Checker};
use crate::declaration::TOOL;
use crate::error::SceneError;
use crate::named_file::{ReadText, take_text};
use crate::{ToolDescription, malformed, ranges};

impl ToolDescription {
    /// Parses and checks a tool file's text; `path` names it in errors.
    ///
    /// # Errors
    /// [`SceneError`]: a key is unknown or missing, a value is out of range, or the tool is inconsistent.
    pub fn parse(text: &str, path: &Path) -> Result<ToolDescription, SceneError> {
        let given: Table = toml::from_str(text).map_err(|cause| malformed(text, path, text, &cause))?;
        let tool: ToolDescription =
            toml::from_str(text).map_err(|cause| malformed(text, path, text, &cause))?;
        let checker = Checker { file: path };
        ranges::check(&TOOL, &given, "", &checker)?;
        check::tool(&tool, "", &checker)?;
        Ok(tool)
    }
}

/// Replaces `manipulator.file` in a scene's table by the tool it describes. Returns false if the scene names
/// no file.
///
/// # Errors
/// The file cannot be read or describes no tool, or the scene also describes one.
pub(crate) fn put_in(
    scene: &mut Table,
    folder: &Path,
    read: &ReadText,
    checker: &Checker,
) -> Result<bool, SceneError> {
    let Some(Value::Table(manipulator)) = scene.get_mut("manipulator") else { return Ok(false) };
    let Some(named) = take_text(manipulator, ["manipulator", "file"], "a path", checker)? else {
        return Ok(false);
    };
    let file = folder.join(named);
    if manipulator.contains_key("tool") {
        let problem = "and `manipulator.tool` are mutually exclusive; set only one";
        return Err(checker.invalid("manipulator.file", problem));
    }
    let name = foreign_text::foreign_path(&file);
    let text = read(&file).map_err(|cause| {
        checker.invalid("manipulator.file", format!("names {name}, which cannot be read ({cause})"))
    })?;
    let tool = ToolDescription::parse(&text, &file)?;
    let table = Value::try_from(&tool).map_err(|cause| {
        checker.invalid("manipulator.file", format!("cannot be embedded in the scene: {cause}"))
    })?;
    manipulator.insert("tool".to_owned(), table);
    Ok(true)
}
