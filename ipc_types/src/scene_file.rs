//! Loads scenes from files.

use std::path::Path;

use crate::scene::{Scene, SceneError};
use crate::text_file;

/// Reads and checks a scene file, and the plan that it may name.
///
/// # Errors
/// [`SceneError`]: the file cannot be read, a key is unknown or missing, or a value is out of its range.
pub fn load(path: &Path) -> Result<Scene, SceneError> {
    let text = text_file::read(path)
        .map_err(|cause| SceneError::Unreadable { file: path.to_owned(), cause: cause.to_string() })?;
    Scene::parse_with(&text, path, &text_file::read)
}
