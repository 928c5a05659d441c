//! Loads scenes from files.

use std::path::Path;

use crate::scene::{Scene, SceneError};
use crate::{arm_meshes, text_file};

/// Reads and checks a scene file, and the plan that it may name.
///
/// # Errors
/// [`SceneError`]: the file cannot be read, a key is unknown or missing, or a value is out of its range.
pub fn load(path: &Path) -> Result<Scene, SceneError> {
    let text = text_file::read(path)
        .map_err(|cause| SceneError::Unreadable { file: path.to_owned(), cause: cause.to_string() })?;
    parse(&text, path)
}

/// Checks a scene's text; `path` names it, and the files that it may name are looked for from there.
///
/// # Errors
/// As [`load`].
pub fn parse(text: &str, path: &Path) -> Result<Scene, SceneError> {
    let mut scene = Scene::parse_with(text, path, &text_file::read)?;
    arm_meshes::note_content(&mut scene.arm);
    Ok(scene)
}
