//! Loads scenes from files.

use std::path::Path;

use crate::scene::{Scene, SceneError};
use crate::{arm_meshes, text_file};

/// Reads and checks a scene file and the plan that it names, if any.
///
/// # Errors
/// [`SceneError`] if the file cannot be read, a key is unknown or missing, or a value is out of range.
pub fn load(path: &Path) -> Result<Scene, SceneError> {
    let text = text_file::read(path)
        .map_err(|cause| SceneError::Unreadable { file: path.to_owned(), cause: cause.to_string() })?;
    parse(&text, path)
}

/// Checks a scene's text; `path` is its file name, and files that it names are resolved relative to it.
///
/// # Errors
/// As [`load`].
pub fn parse(text: &str, path: &Path) -> Result<Scene, SceneError> {
    let mut scene = Scene::parse_with(text, path, &text_file::read)?;
    arm_meshes::note_content(&mut scene.arm);
    Ok(scene)
}
