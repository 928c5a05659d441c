//! Files that a scene names: their content goes into the scene's table before parsing.

use std::path::Path;

use toml::{Table, Value};

use crate::check::Checker;
use crate::error::SceneError;

/// Returns the text of a file that a scene names; this crate opens no files itself.
pub type ReadText<'a> = dyn Fn(&Path) -> std::io::Result<String> + 'a;

/// Removes a text from the table `[above]` of a scene; `None` if the key is absent.
///
/// # Errors
/// The value is not a text; `expected` describes what it should be.
pub(crate) fn take_text(
    table: &mut Table,
    [above, key]: [&str; 2],
    expected: &str,
    checker: &Checker,
) -> Result<Option<String>, SceneError> {
    match table.remove(key) {
        None => Ok(None),
        Some(Value::String(text)) => Ok(Some(text)),
        Some(other) => Err(checker
            .invalid(&format!("{above}.{key}"), format!("is {other}, expected {expected} as a string"))),
    }
}

/// Removes a flag from the table `[above]` of a scene; `None` if the key is absent.
///
/// # Errors
/// The value is not a boolean.
pub(crate) fn take_flag(
    table: &mut Table,
    [above, key]: [&str; 2],
    checker: &Checker,
) -> Result<Option<bool>, SceneError> {
    match table.remove(key) {
        None => Ok(None),
        Some(Value::Boolean(flag)) => Ok(Some(flag)),
        Some(other) => {
            Err(checker.invalid(&format!("{above}.{key}"), format!("is {other}, expected true or false")))
        }
    }
}

/// Three numbers as a TOML value.
pub(crate) fn numbers(place: [f64; 3]) -> Value {
    Value::Array(place.map(Value::Float).to_vec())
}

/// The tables of an array of tables.
pub(crate) fn tables<'t>(scene: &'t mut Table, key: &str) -> impl Iterator<Item = &'t mut Table> {
    let values = match scene.get_mut(key) {
        Some(Value::Array(values)) => values.as_mut_slice(),
        _ => &mut [],
    };
    values.iter_mut().filter_map(|value| match value {
        Value::Table(table) => Some(table),
        _ => None,
    })
}
